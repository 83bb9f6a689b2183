# What masks are made from, and how.
from scenefuse.masks.sam2_weights import WEIGHTS


def mask_inputs(wildcards):
    """What the masks of an object are made from: your own masks, or prompts and perhaps weights."""
    row = object_row(wildcards.object)
    photos_of(row, f"object '{wildcards.object}'")
    if row.get("masks"):
        return photos_in(
            row["masks"], f"{config['objects']}, masks of '{wildcards.object}'"
        )
    if not row.get("prompts"):
        refuse(
            f"{config['objects']}: '{wildcards.object}' has neither prompts nor masks; fill one of these columns"
        )
    check_clicks(wildcards.object, "prompts")
    by_network = settings_of(wildcards)["object"]["masks"]["method"] in ("auto", "sam2")
    weights = [WEIGHTS] if by_network else []
    return weights + own_file("object", wildcards.object, "prompts")


def mask_options(wildcards):
    """Settings of the masks; your own masks beat any method."""
    row = object_row(wildcards.object)
    settings = settings_of(wildcards)["object"]["masks"]
    own = {
        "supplied": row.get("masks") or None,
        "prompts": None if row.get("masks") else row.get("prompts") or None,
    }
    return flags(settings | own | ({"method": "supplied"} if row.get("masks") else {}))
