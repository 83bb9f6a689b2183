# What masks are made from, and how.
from scenefuse.masks.algebra import mask_folders
from scenefuse.masks.sam2_weights import WEIGHTS
from scenefuse.photos.photo_files import (
    MIN_OBJECT_PHOTOS,
    masks_by_name,
    no_match,
    pictures_below,
)


@cache
def masks_in(folder, where):
    """The pictures in a folder of masks, which may lie among photos; or the folder, where a rule makes it."""
    pictures = pictures_below(Path(folder)).values()
    if not pictures and not made_here(folder):
        refuse(
            f"{where}: {folder} is no folder with masks; correct its path (relative paths begin at {os.getcwd()})"
        )
    return [folder] if made_here(folder) else [str(file) for file in pictures]


def kept_masks(wildcards):
    """What an object's masks keep."""
    keep = settings_of(wildcards)["object"]["masks"]["keep"]
    return keep.replace("{object}", wildcards.object)


@cache
def check_masks(name):
    """Stop before hours of work where a folder of masks has none of the object's photos."""
    row, where = object_row(name), f"{config['objects']}, object '{name}'"
    photos = [frame_name(photo) for photo in names_in(row["photos"], where) or ()]
    if photos and not made_here(row["masks"]):
        try:
            if not masks_by_name(photos, Path(row["masks"])):
                refuse(f"{where}: {no_match(Path(row['masks']), photos[0])}")
        except StageError as error:
            refuse(f"{where}: {error}")


def mask_inputs(wildcards):
    """What the masks of an object are made from: your own masks, or prompts and perhaps weights; masks to combine."""
    row = object_row(wildcards.object)
    settings = settings_of(wildcards)["object"]["masks"]
    who = f"{config['objects']}, object '{wildcards.object}'"
    photos = names_in(photos_of(row, who), who)
    if photos and len(photos) < MIN_OBJECT_PHOTOS:
        refuse(
            f"{who} has {len(photos)} photos, {MIN_OBJECT_PHOTOS} or more are needed; take more"
        )
    try:
        folders = mask_folders(kept_masks(wildcards))
    except StageError as error:
        refuse(str(error))
    where = f"object.masks.keep of '{wildcards.object}'"
    files = [file for folder in folders for file in masks_in(str(folder), where)]
    if row.get("masks"):
        files += masks_in(
            row["masks"], f"{config['objects']}, masks of '{wildcards.object}'"
        )
        check_masks(wildcards.object)
        return files
    if not row.get("prompts"):
        refuse(
            f"{config['objects']}: '{wildcards.object}' has neither prompts nor masks; fill one of these columns"
        )
    check_clicks(wildcards.object, "prompts")
    if settings["method"] in ("auto", "sam2"):
        files.append(WEIGHTS)
    return files + own_file("object", wildcards.object, "prompts")


def mask_options(wildcards):
    """Settings of the masks; your own masks beat any method."""
    row = object_row(wildcards.object)
    settings = settings_of(wildcards)["object"]["masks"]
    own = {
        "keep": kept_masks(wildcards),
        "supplied": row.get("masks") or None,
        "prompts": None if row.get("masks") else row.get("prompts") or None,
    }
    return flags(settings | own | ({"method": "supplied"} if row.get("masks") else {}))
