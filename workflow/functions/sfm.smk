# Inputs of structure from motion: the photos that the tables name.


def scene_photos(wildcards):
    """The photos of a scene."""
    return photos_in(
        scene_row(wildcards.scene)["photos"],
        f"{config['scenes']}, scene '{wildcards.scene}'",
    )


def scene_folder(wildcards):
    """Their folder, for a command line."""
    return shlex.quote(scene_row(wildcards.scene)["photos"])


def object_photos(wildcards):
    """The photos, or the video, of an object."""
    return photos_in(
        object_row(wildcards.object)["photos"],
        f"{config['objects']}, object '{wildcards.object}'",
    )


def object_source(wildcards):
    """Their folder, or the video, for a command line."""
    return shlex.quote(object_row(wildcards.object)["photos"])
