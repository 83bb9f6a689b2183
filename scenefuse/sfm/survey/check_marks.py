"""What can be said of clicks on an object before any photo is matched. The workflow asks it whenever it plans: nothing
here takes long to import."""

from collections import Counter
from pathlib import Path

from scenefuse.io.tables import composed
from scenefuse.sfm.fiducials import Labels, ScenePoints, read_points
from scenefuse.stage import StageError


def check_marks(path: Path, photos: list[str] | None = None, used: list[str] | None = None) -> None:
    """Check that a file of clicks or points can be read, and that its clicks are in photos that will be used.

    Args:
        path: of the file.
        photos: names that the photos will have; None where they are not known yet.
        used: those of them that will be used; None for all.

    Raises:
        StageError: what `read_points` says; nothing inside; half a box; a click in a photo that does not exist, or will
            not be used.
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
