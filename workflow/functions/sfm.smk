# Inputs of structure from motion: the photos that the tables name.
from scenefuse.photos.photo_files import distinct_photos, frame_name, thin_out


def photos_of(row, who):
    """The cell `photos` of a row; a scene or object that is given as a cloud alone has none."""
    if not row.get("photos"):
        refuse(f"{who} is given as a cloud: nothing is made from photos of it")
    return row["photos"]


def scene_photos(wildcards):
    """The photos of a scene, or its video, and the file of their positions where there is one."""
    folder = photos_of(scene_row(wildcards.scene), f"scene '{wildcards.scene}'")
    photos = photos_in(folder, f"{config['scenes']}, scene '{wildcards.scene}'")
    positions = geo_file(Path(folder))
    return photos + ([str(positions)] if positions else [])


def scene_source(wildcards):
    """Their folder, or the video, for a command line."""
    return shlex.quote(scene_row(wildcards.scene).get("photos", ""))


def object_photos(wildcards):
    """The photos, or the video, of an object."""
    return photos_in(
        photos_of(object_row(wildcards.object), f"object '{wildcards.object}'"),
        f"{config['objects']}, object '{wildcards.object}'",
    )


def object_source(wildcards):
    """Their folder, or the video, for a command line."""
    return shlex.quote(object_row(wildcards.object).get("photos", ""))


def calibration_of(kind):
    """Input function: the known calibration of a scene's or an object's camera, where the table has one."""
    return lambda wildcards: own_file(kind, wildcards[kind], "calibration")


def calibration_flag(kind):
    """The same as a command-line option."""
    return lambda wildcards: flags(
        dict(zip(["calibration"], calibration_of(kind)(wildcards)))
    )


def calibrated(kind):
    """Params function: whether there is one."""
    return lambda wildcards: bool(calibration_of(kind)(wildcards))


def cameras_of(kind):
    """Input function: the files of cameras that another program found for a scene or an object, where the table has them."""

    def files(wildcards):
        given = own_file(kind, wildcards[kind], "cameras")
        return [
            str(file)
            for path in given
            for file in ([path] if made_here(path) else camera_files(Path(path)))
        ]

    return files


def cameras_flag(kind):
    """The same as a command-line option."""
    return lambda wildcards: flags(
        dict(zip(["cameras"], own_file(kind, wildcards[kind], "cameras")))
    )


def surveyed(scene):
    """Control points and known lengths of a scene, where the table has them: column -> file."""
    found = {
        column: own_file("scene", scene, column) for column in ("control", "lengths")
    }
    return {column: files[0] for column, files in found.items() if files}


@cache
def check_survey(scene):
    """Stop before hours of mapping where a survey's file cannot be read or names photos that the scene lacks."""
    row, files = scene_row(scene), surveyed(scene)
    own = {column: Path(f) for column, f in files.items() if not made_here(f)}
    if own and Path(row["photos"]).is_dir() and not made_here(row["photos"]):
        # Takes long to import, and most scenes have no survey.
        from scenefuse.georef.control import check_survey_files

        try:
            check_survey_files(distinct_photos(Path(row["photos"]))[0], **own)
        except StageError as error:
            refuse(f"{config['scenes']}, scene '{scene}': {error}")


@cache
def crs_of(scene):
    """The CRS that the table names for a scene, checked before anything runs; none where it names none."""
    row = scene_row(scene)
    if not row.get("crs"):
        return {}
    from scenefuse.cloud.crs import projected_crs

    try:
        where = f"{config['scenes']}, scene '{scene}', column crs"
        projected_crs(row["crs"], where, heights=bool(row.get("cloud")))
    except StageError as error:
        refuse(str(error))
    return {"crs": row["crs"]}


def crs_flag(wildcards):
    """The same, as a command-line option."""
    return flags(crs_of(wildcards.scene))


def lies_on_cloud(wildcards):
    """Whether a scene has a cloud beside photos whose cameras are not given."""
    row = scene_row(wildcards.scene)
    return bool(row.get("cloud") and row.get("photos") and not row.get("cameras"))


def cloud_to_lie_on(wildcards):
    """Input function: the cloud on which a scene's photos are laid: one beside photos without given cameras."""
    beside = lies_on_cloud(wildcards)
    files = own_file("scene", wildcards.scene, "cloud") if beside else []
    for file in files:
        if not made_here(file):
            check_cloud_crs(wildcards.scene, file)
    return files


@cache
def check_cloud_crs(scene, file):
    """Stop before hours of mapping where a cloud on which photos are to be laid names no CRS, or one in degrees."""
    from scenefuse.georef.on_cloud import cloud_crs

    try:
        cloud_crs(Path(file), crs_of(scene).get("crs"))
    except StageError as error:
        refuse(f"{config['scenes']}, scene '{scene}': {error}")


def lie_on_flag(wildcards):
    """The same as a command-line option."""
    return flags(dict(zip(["cloud"], cloud_to_lie_on(wildcards))))


def survey_of(wildcards):
    """Input function: their files."""
    check_survey(wildcards.scene)
    return list(surveyed(wildcards.scene).values())


def survey_flags(wildcards):
    """The same as command-line options."""
    return flags(surveyed(wildcards.scene))


def lengths_flag(wildcards):
    """Known lengths in an object's photos, where the table has them, as a command-line option."""
    return flags(
        dict(zip(["lengths"], own_file("object", wildcards.object, "lengths")))
    )


@cache
def names_in(folder, where):
    """The photos in a cell's folder, by name; None where it is no folder, or a rule makes it."""
    if not folder or made_here(folder) or not Path(folder).is_dir():
        return None
    try:
        return {name: Path(folder, name) for name in distinct_photos(Path(folder))[0]}
    except StageError as error:
        refuse(f"{where}: {error}")


@cache
def check_clicks(name, column):
    """Stop before hours of work where prompts or fiducials cannot be read, or are in photos that will not be used."""
    from scenefuse.marks.clicks import check_marks

    row, used = object_row(name), None
    if column == "prompts":
        photos = names_in(row.get("photos"), f"{config['objects']}, object '{name}'")
        if photos:
            frames = PROJECT.of("object", name)["object"]["frames"]
            photos = {frame_name(photo): file for photo, file in photos.items()}
            chosen = thin_out(len(photos), frames["frame_step"], frames["max_frames"])
            used = [list(photos)[index] for index in chosen]
    else:
        folder = scene_row(row["scene"]).get("photos")
        photos = names_in(folder, f"{config['scenes']}, scene '{row['scene']}'")
    for file in own_file("object", name, column):
        if not made_here(file):
            try:
                check_marks(Path(file), photos, used)
            except StageError as error:
                refuse(f"{config['objects']}, object '{name}': {error}")


@cache
def check_lengths(name):
    """Stop before hours of matching where their file cannot be read or names photos that the object lacks."""
    photos = object_row(name)["photos"]
    for file in own_file("object", name, "lengths"):
        if Path(photos).is_dir() and not made_here(file):
            from scenefuse.georef.control import check_survey_files

            try:
                names = [
                    frame_name(photo) for photo in distinct_photos(Path(photos))[0]
                ]
                check_survey_files(names, lengths=Path(file))
            except StageError as error:
                refuse(f"{config['objects']}, object '{name}': {error}")


def given_of(wildcards):
    """Input function: what a user gives an object's cameras: other programs' files, known lengths."""
    check_lengths(wildcards.object)
    return [
        *cameras_of("object")(wildcards),
        *own_file("object", wildcards.object, "lengths"),
    ]
