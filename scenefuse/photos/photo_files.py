"""Which files of a folder are photos, which of these become frames, and which hold cameras. Standard library only: the
workflow lists them often."""

import os
from collections import Counter
from functools import cached_property
from pathlib import Path

from scenefuse.core.stage import StageError

# Positions of the photos beside it, as OpenDroneMap names the file.
GEO_FILE = "geo.txt"
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
VIDEO_SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts"}
# Photos all the same, but in formats that not every stage can decode.
UNREADABLE = frozenset(
    (".heic", ".heif", ".avif", ".jxl", ".webp", ".dng", ".raw", ".3fr", ".arw", ".cr2", ".cr3", ".crw")
)
UNREADABLE |= frozenset((".gpr", ".iiq", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".srw", ".x3f"))

# Where in a folder other programs keep cameras, and under which names.
CAMERA_PLACES = (".", "sparse", "sparse/0", "opensfm")
CAMERA_FILES = tuple(f"{name}.{kind}" for name in ("cameras", "images", "frames", "rigs") for kind in ("bin", "txt"))
CAMERA_FILES += ("transforms.json", "transforms_train.json", "reconstruction.json")
BUNDLER = ".out"
# Where in an OpenDroneMap project its place on the earth is.
COORDS = "odm_georeferencing/coords.txt"


def camera_files(given: Path) -> list[Path]:
    """The files that hold cameras of another program: in a folder, or a file itself with what belongs to it."""
    if given.is_file():
        listed, coords = bundler_list(given), given.parent.parent / COORDS
        return [given, *([listed] if listed else []), *([coords] if coords.is_file() else [])]
    places = [given / place / name for place in CAMERA_PLACES for name in CAMERA_FILES]
    return [file for file in [*places, given / COORDS] if file.is_file()] or [given]


def bundler_list(file: Path) -> Path | None:
    """The list of photos beside a Bundler file, by its usual names; None where there is none."""
    names = (f"{file.stem}.list.txt", f"{file.stem}.lst", f"{file.stem}.txt", "list.txt", "images.list")
    beside = (file.with_name(name) for name in names)
    return next((path for path in beside if path.is_file()), None) if file.suffix == BUNDLER else None


def photo_files(folder: Path) -> list[Path]:
    """The photos below a folder, symlinked folders included, sorted by their names relative to it.

    Hidden files and folders and files that are no photos are left out; so are raw files and HEIC where the same photo
    lies beside them in a readable format.

    Raises:
        StageError: the folder is missing or holds no photo, or a photo has a format that cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise StageError(f"the photo folder {folder} does not exist; check its path in the configuration")
    files = _files_below(folder)
    photos = [file for file in files if file.suffix.lower() in SUFFIXES]
    readable = {file.with_suffix("") for file in photos}
    unreadable = [f for f in files if f.suffix.lower() in UNREADABLE and f.with_suffix("") not in readable]
    if unreadable:
        more = f" and {len(unreadable) - 1} other files" if len(unreadable) > 1 else ""
        raise StageError(
            f"{unreadable[0]}{more} cannot be read: {unreadable[0].suffix} is not supported; convert to JPEG with the"
            " EXIF data kept, or take them out of the folder"
        )
    if not photos:
        raise StageError(
            f"the photo folder {folder} holds no photos; put JPEG, PNG, TIFF or BMP files there"
            f" ({len(files)} other files were found)"
        )
    return sorted(photos, key=lambda file: file.relative_to(folder).as_posix())


def mask_files(folder: Path) -> dict[str, Path]:
    """The pictures of a folder by the stem of the photo they belong to: without the photo's ending and `_mask`.

    Those in folders below it have the folders' names in front, joined by `_`.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"):
            stem = "_".join((*path.relative_to(folder).parts[:-1], path.stem))
            for ending in (".jpg", ".JPG", ".jpeg", ".JPEG", ".png", ".PNG"):
                stem = stem.removesuffix(ending)
            files[stem.removesuffix("_mask")] = path
    return files


class PhotosByName:
    """Photos by the names that other programs give them.

    Args:
        folder: of the photos.
        beside: folder that names may be relative to, which is looked at first.
    """

    def __init__(self, folder: Path, beside: Path | None = None) -> None:
        self.folder, self.places = folder, [folder] if beside is None else [beside, folder]

    def at(self, name: str) -> Path | None:
        """The file of that path, or of a frame's name, with or without its ending; None where there is none."""
        paths = [place / called for place in self.places for called in (name, frame_name(name))]
        endings = ("", *SUFFIXES, *map(str.upper, SUFFIXES))
        named = (Path(os.path.abspath(path.with_name(path.name + ending))) for path in paths for ending in endings)
        return next((file for file in named if file.is_file()), None)

    def find(self, name: str) -> Path:
        """The same, or else the photo in the folder that has the name's last part; without any, what it would be."""
        name = name.replace("\\", "/")
        found, wanted = self.at(name), Path(name).name
        alike = [file for file in self._files if file.name == wanted] if found is None else [found]
        alike = alike or [file for file in self._files if file.stem == wanted]
        return (alike or [Path(os.path.abspath(self.places[0] / name))])[0]

    @cached_property
    def _files(self) -> list[Path]:
        return photo_files(self.folder) if self.folder.is_dir() else []


def in_folders(names: list[str]) -> str:
    """How many photos (paths below a folder) there are, and where those below its own folders lie."""
    below = Counter(folder for name in names if (folder := name.rpartition("/")[0]))
    where = ", ".join(f"{count} of them in {folder}/" for folder, count in sorted(below.items())[:5])
    more = f", and {len(below) - 5} more folders" if len(below) > 5 else ""
    return f"{len(names)} photos" + (f", {where}{more}" if below else "")


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as people see it; only its header is read.

    Raises:
        StageError: it is no readable picture.
    """
    from PIL import Image
    from PIL.TiffImagePlugin import TiffImageFile

    try:
        with open(path, "rb") as file, Image.open(file) as image:
            turned = image.getexif().get(0x0112, 1) in (5, 6, 7, 8)
            # Pillow 13 gives the size of a TIFF as it will be when turned; its tags have it as stored.
            tags = image.tag_v2 if isinstance(image, TiffImageFile) else None
            width, height = image.size if tags is None else (int(tags[256]), int(tags[257]))
            return (height, width) if turned else (width, height)
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise StageError(f"{path} cannot be read as a picture ({error}); replace it, or take it away") from None


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as it is stored; errors as of `upright_size`."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return picture.size
    except OSError:
        raise StageError(f"{path} is not a readable picture; export it again") from None


def frame_name(photo: str) -> str:
    """The name of the frame that is made of a photo, by its path in the folder of photos."""
    return photo.replace("/", "_")


def thin_out(count: int, step: int, limit: int) -> list[int]:
    """Indices 0, step, 2 step, ... below count; spread evenly over the same range where more than `limit` (0: none)."""
    chosen = list(range(0, count, max(step, 1)))
    if 0 < limit < len(chosen):
        spacing = (len(chosen) - 1) / max(limit - 1, 1)
        chosen = [chosen[round(k * spacing)] for k in range(limit)]
    return chosen


def _files_below(folder: Path) -> list[Path]:
    """All files that are not hidden; a link to a folder that was already entered is not followed again."""
    files, entered = [], set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in entered:
            folders.clear()
            continue
        entered.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        files += [Path(place, name) for name in names if not name.startswith(".")]
    return [file for file in files if file.is_file()]
