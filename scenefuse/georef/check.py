"""What can be said of the files of a survey before any photo is matched."""

from pathlib import Path

from scenefuse.core.tables import composed
from scenefuse.georef.control_file import read_control, unknown_photo
from scenefuse.marks.lengths import read_ends


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
