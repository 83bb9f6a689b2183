"""Checks of clicks on an object before any photo is matched.

The workflow imports this whenever it plans: nothing here takes long to import.
"""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from scenefuse.core.stage import StageError
from scenefuse.core.tables import composed
from scenefuse.marks.clicks import ScenePoints, check_inside, read_points
from scenefuse.photos.photo_files import upright_size


def check_marks(path: Path, photos: Mapping[str, Path] | None = None, used: list[str] | None = None) -> None:
    """Check that a file of clicks or points can be read, and that its clicks are in photos that will be used.

    Args:
        path: of the file.
        photos: the photos' files, by the names that they will have; None where they are not known yet.
        used: those of them that will be used; None for all.

    Raises:
        StageError: what `read_points` says; no click inside and no box; half a box; a click in a photo that does not
            exist, will not be used or cannot be read, or outside its photo.
    """
    marked = read_points(path)
    if isinstance(marked, ScenePoints):
        return
    if marked.kind == "labels":
        if set(marked.labels) == {"outside"}:
            raise StageError(f"{path} holds only clicks outside the object; add a few inside it, or a box around it")
        boxes = Counter(click.photo for click in marked.rows if click.label == "box")
        if odd := [photo for photo, corners in boxes.items() if corners != 2]:
            raise StageError(
                f"{path}: a box needs two lines, two opposite corners; in {odd[0]} there are {boxes[odd[0]]}"
            )
    if photos is None:
        return
    files = {composed(name): file for name, file in photos.items()}
    names = list(photos) if used is None else used
    taken = set(map(composed, names))
    sizes: dict[str, tuple[int, int]] = {}
    for click in marked.rows:
        photo = composed(click.photo)
        if photo not in files:
            raise StageError(
                f"{path}: {click} is in {click.photo}, which is none of the {len(photos)} photos"
                f" ({next(iter(files))}, ...); correct the name"
            )
        if photo not in taken:
            raise StageError(
                f"{path}: {click} is in {click.photo}, but only {len(taken)} of the {len(photos)} photos are used"
                f" (object.frames), and this is none of them: click in one that is ({names[0]}, ...), or set"
                f" max_frames to {len(photos)} and frame_step to 1"
            )
        if photo not in sizes:
            sizes[photo] = upright_size(files[photo])
        check_inside(path, click, sizes[photo])
