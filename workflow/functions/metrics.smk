# Truths that the tables name.


def truth_of(scene):
    """The truth of a scene that an object with known truth lies in."""
    truth = scene_row(scene).get("truth")
    if not truth:
        refuse(
            f"{config['scenes']}: scene '{scene}' has no truth, but an object in it has; fill both or neither"
        )
    return truth


def scene_truth(wildcards):
    return [truth_of(wildcards.scene)]


def object_truth(wildcards):
    """The truth of the object's scene, and its own."""
    row = object_row(wildcards.object)
    return [truth_of(row["scene"]), row["truth"]]
