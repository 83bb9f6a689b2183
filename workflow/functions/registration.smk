# Settings of a registration variant, and what marks an object for the crop.


def variant_options(part):
    """Params function: the settings of one step of a variant."""
    return lambda wildcards: flags(VARIANTS[wildcards.variant][part])


def crop_mode(wildcards):
    """How a variant crops; without fiducials, the object's masks mark it, which takes photos of both sides."""
    marked = object_row(wildcards.object).get("fiducials")
    mode = VARIANTS[wildcards.variant]["crop"]["mode"] if marked else "masks"
    if mode == "masks" and not is_linked(wildcards):
        return "fiducials" if marked else "none"
    return mode


def crop_marks(wildcards):
    """The files that mark an object in its scene: option of the crop -> path."""
    if VARIANTS[wildcards.variant]["crop"].get("whole_scene"):
        return {}
    if crop_mode(wildcards) == "none":
        return {}
    if crop_mode(wildcards) == "masks":
        folder = f"results/objects/{wildcards.object}"
        return {
            "alignment_json": f"{folder}/alignment.json",
            "workspace": f"{folder}/undistorted",
            "masks": f"{folder}/masks",
        }
    return {"fiducials": object_row(wildcards.object)["fiducials"]}


def crop_inputs(wildcards):
    """The same, and what else says that one of them has changed."""
    marks = crop_marks(wildcards)
    return [*marks.values()] + [
        f"{path}.json" for name, path in marks.items() if name in ("workspace", "masks")
    ]


def crop_options(wildcards):
    """Settings of a variant's crop."""
    own = {"mode": crop_mode(wildcards)} | crop_marks(wildcards)
    return flags(VARIANTS[wildcards.variant]["crop"] | own)
