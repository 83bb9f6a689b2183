"""What can be said of the files of a survey, and of clicks on an object, before any photo is matched."""

from pathlib import Path

from scenefuse.io.tables import composed
from scenefuse.sfm.fiducials import Labels, ScenePoints, read_points
from scenefuse.sfm.survey.control_file import read_control, unknown_photo
from scenefuse.sfm.survey.lengths import read_ends
from scenefuse.stage import StageError


def check_files(names: list[str], control: Path | None = None, lengths: Path | None = None) -> None:
    """Check that the files of a survey can be read, and that their clicks are in photos of these names.

    Raises:
        StageError: what `read_control` and `read_ends` say; a click in a photo that does not exist.
    """
    clicked: list[tuple[Path, str, str]] = []
    if control is not None:
        clicked += [(control, point.name, photo) for point in read_control(control).points for photo, _ in point.clicks]
    if lengths is not None:
        ends = read_ends(lengths)[2]
        clicked += [(lengths, point, photo) for point, photo in zip(ends.points, ends.photos)]
    known = set(map(composed, names))
    for path, point, photo in clicked:
        if composed(photo) not in known:
            raise unknown_photo(path, point, photo, names)


def check_marks(path: Path, photos: list[str] | None = None, used: list[str] | None = None) -> None:
    """Check that a file of clicks or points can be read, and that its clicks are in photos that will be used.

    Args:
        path: of the file.
        photos: names that the photos will have; None where they are not known yet.
        used: those of them that will be used; None for all.

    Raises:
        StageError: what `read_points` says; a click in a photo that does not exist, or will not be used.
    """
    marked = read_points(path)
    if photos is None or isinstance(marked, ScenePoints):
        return
    known, taken = set(map(composed, photos)), set(map(composed, photos if used is None else used))
    names = [f"the click {name}" for name in marked.labels] if isinstance(marked, Labels) else marked.points
    for name, photo in zip(names, marked.photos):
        if composed(photo) not in known:
            raise StageError(
                f"{path}: {name} is in {photo}, which is none of the {len(photos)} photos ({photos[0]}, ...);"
                " correct the name"
            )
        if composed(photo) not in taken:
            raise StageError(
                f"{path}: {name} is in {photo}, but only {len(taken)} of the {len(photos)} photos are used"
                f" (object.frames), and this is none of them: click in one that is ({(used or photos)[0]}, ...), or set"
                f" max_frames to {len(photos)} and frame_step to 1"
            )
