# Settings of a registration variant, and what marks an object for the crop.


def variant_options(part):
    """Params function: the settings of one step of a variant."""
    return lambda wildcards: flags(VARIANTS[wildcards.variant][part])


def crop_mode(wildcards):
    """How a variant crops; without fiducials, the object's masks mark it."""
    mode = VARIANTS[wildcards.variant]["crop"]["mode"]
    unmarked = not object_row(wildcards.object).get("fiducials")
    return "masks" if mode == "fiducials" and unmarked else mode


def crop_marks(wildcards):
    """The files that mark an object in its scene: option of the crop -> path."""
    mode, row = crop_mode(wildcards), object_row(wildcards.object)
    if mode == "masks":
        folder = f"results/objects/{wildcards.object}"
        return {
            "alignment": f"{folder}/alignment.json",
            "cameras": f"{folder}/undistorted",
            "masks": f"{folder}/masks",
        }
    return {"fiducials": row["fiducials"]} if mode == "fiducials" else {}


def crop_inputs(wildcards):
    """The same, and what else says that one of them has changed."""
    marks = crop_marks(wildcards)
    return [*marks.values()] + [
        f"{path}.json" for name, path in marks.items() if name in ("cameras", "masks")
    ]


def crop_options(wildcards):
    """Settings of a variant's crop."""
    own = {"mode": crop_mode(wildcards)} | crop_marks(wildcards)
    return flags(VARIANTS[wildcards.variant]["crop"] | own)
