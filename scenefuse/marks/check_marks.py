"""What can be said of clicks on an object before any photo is matched. The workflow asks it whenever it plans: nothing
here takes long to import."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from scenefuse.core.stage import StageError
from scenefuse.core.tables import composed
from scenefuse.marks.fiducials import Labels, ScenePoints, read_points
from scenefuse.photos.photo_files import upright_size


def check_marks(path: Path, photos: Mapping[str, Path] | None = None, used: list[str] | None = None) -> None:
    """Check that a file of clicks or points can be read, and that its clicks are in photos that will be used.

    Args:
        path: of the file.
        photos: the photos' files, by the names that they will have; None where they are not known yet.
        used: those of them that will be used; None for all.

    Raises:
        StageError: what `read_points` says; nothing inside; half a box; a click in a photo that does not exist, will
            not be used or cannot be read, or outside its photo.
    """
    marked = read_points(path)
    if isinstance(marked, Labels):
        if not {"inside", "box"}.intersection(marked.labels):
            raise StageError(f"{path} holds only clicks outside the object; add a few inside it, or a box around it")
        boxes = Counter(photo for label, photo in zip(marked.labels, marked.photos) if label == "box")
        if odd := [photo for photo, corners in boxes.items() if corners != 2]:
            raise StageError(
                f"{path}: a box needs two lines, two opposite corners; in {odd[0]} there are {boxes[odd[0]]}"
            )
    if photos is None or isinstance(marked, ScenePoints):
        return
    known = {composed(name): file for name, file in photos.items()}
    taken, sizes = set(map(composed, photos if used is None else used)), dict[str, tuple[int, int]]()
    first = next(iter(photos if used is None else used))
    names = [f"the click {name}" for name in marked.labels] if isinstance(marked, Labels) else marked.points
    for name, photo, pixel in zip(names, marked.photos, marked.pixels):
        if composed(photo) not in known:
            raise StageError(
                f"{path}: {name} is in {photo}, which is none of the {len(photos)} photos ({next(iter(known))}, ...);"
                " correct the name"
            )
        if composed(photo) not in taken:
            raise StageError(
                f"{path}: {name} is in {photo}, but only {len(taken)} of the {len(photos)} photos are used"
                f" (object.frames), and this is none of them: click in one that is ({first}, ...), or set"
                f" max_frames to {len(photos)} and frame_step to 1"
            )
        if photo not in sizes:
            sizes[photo] = upright_size(known[composed(photo)])
        width, height = sizes[photo]
        if not (0 <= pixel[0] <= width and 0 <= pixel[1] <= height):
            raise StageError(
                f"{path}: {name} at ({pixel[0]:g}, {pixel[1]:g}) lies outside {photo}, which has {width} x {height}"
                " pixels; correct it"
            )
