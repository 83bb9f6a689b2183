# Inputs of structure from motion: the photos that the tables name.


def photos_of(row, who):
    """The cell `photos` of a row; a scene or object that is given as a cloud has none."""
    if row.get("cloud"):
        raise WorkflowError(
            f"{who} is given as a cloud: nothing is made from photos of it"
        )
    return row["photos"]


def scene_photos(wildcards):
    """The photos of a scene, and the file of their positions where there is one."""
    folder = photos_of(scene_row(wildcards.scene), f"scene '{wildcards.scene}'")
    positions = Path(folder) / GEO_FILE
    photos = photos_in(folder, f"{config['scenes']}, scene '{wildcards.scene}'")
    return photos + ([str(positions)] if positions.is_file() else [])


def scene_folder(wildcards):
    """Their folder, for a command line."""
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


def calibration_of(row, kind):
    """Input function: the known calibration of a scene's or an object's camera, where the table has one."""

    def files(wildcards):
        given = row(wildcards[kind]).get("calibration")
        return [given] if given else []

    return files


def calibration_flag(row, kind):
    """The same as a command-line option."""
    return lambda wildcards: flags(
        dict(zip(["calibration"], calibration_of(row, kind)(wildcards)))
    )


def cameras_of(row, kind):
    """Input function: the files of cameras that another program found for a scene or an object, where the table has them."""

    def files(wildcards):
        given = row(wildcards[kind]).get("cameras")
        if not given:
            return []
        if not Path(given).is_dir():
            return [given]
        names = (
            f"{n}.{e}"
            for n in ("cameras", "images", "frames", "rigs")
            for e in ("bin", "txt")
        )
        names = [
            *names,
            "transforms.json",
            "transforms_train.json",
            "reconstruction.json",
        ]
        places = [
            Path(given, place) for place in (".", "sparse", "sparse/0", "opensfm")
        ]
        found = [str(p / n) for p in places for n in names if (p / n).is_file()]
        return found or [given]

    return files


def cameras_flag(row, kind):
    """The same as a command-line option."""

    def words(wildcards):
        given = row(wildcards[kind]).get("cameras")
        return flags({"cameras": given} if given else {})

    return words


def surveyed(scene):
    """Control points and known lengths of a scene, where the table has them: column -> file."""
    row = scene_row(scene)
    return {column: row[column] for column in ("control", "lengths") if row.get(column)}


def survey_of(wildcards):
    """Input function: their files."""
    return list(surveyed(wildcards.scene).values())


def survey_flags(wildcards):
    """The same as command-line options."""
    return flags(surveyed(wildcards.scene))


def calibrated(row, kind):
    """Params function: whether there is one."""
    return lambda wildcards: bool(calibration_of(row, kind)(wildcards))
