# Settings of a registration variant, and what marks an object for the crop.


def registration_of(wildcards):
    """The settings of `registration` for an object and a variant."""
    return PROJECT.registration(wildcards.object, wildcards.variant)


def variant_options(*parts):
    """Params function: settings of a variant, of some parts of `registration`."""

    def words(wildcards):
        found = registration_of(wildcards)
        return flags(
            {key: value for part in parts for key, value in found.get(part, {}).items()}
        )

    return words


def crop_mode(wildcards):
    """How a variant crops: by the object's masks (or its given cloud) where the photos of both sides may be linked, else by the file in the
    column fiducials. Without either, the whole scene is kept: None."""
    crop = registration_of(wildcards)["crop"]
    marked, linked = object_row(wildcards.object).get("fiducials"), is_linked(wildcards)
    if crop.get("whole_scene") or not (marked or linked):
        return None
    return crop["mode"] if marked and linked else "fiducials" if marked else "masks"


def crop_marks(wildcards):
    """The files that mark an object in its scene: option of the crop -> path. Fiducials check the masks, or take their
    place where shared features give no alignment."""
    mode = crop_mode(wildcards)
    clicked = own_file("object", wildcards.object, "fiducials") if mode else []
    if clicked:
        check_clicks(wildcards.object, "fiducials")
    own = dict(zip(["fiducials"], clicked))
    if mode == "masks":
        folder = f"results/objects/{wildcards.object}"
        own["alignment_json"] = f"{folder}/alignment.json"
        if has_masks(object_row(wildcards.object)):
            own |= {"workspace": f"{folder}/undistorted", "masks": f"{folder}/masks"}
        else:
            own["cloud"] = f"{folder}/object.ply"
    return own


def crop_inputs(wildcards):
    """The same, and what else says that one of them has changed."""
    marks = crop_marks(wildcards)
    return [*marks.values()] + [
        f"{path}.json" for name, path in marks.items() if name in ("workspace", "masks")
    ]


def crop_options(wildcards):
    """Settings of a variant's crop."""
    mode = crop_mode(wildcards)
    own = {"mode": mode} if mode else {"whole_scene": True}
    return flags(registration_of(wildcards)["crop"] | own | crop_marks(wildcards))
