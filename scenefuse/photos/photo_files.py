"""Which files of a folder are photos, which of these become frames, and which hold cameras. Standard library only: the
workflow lists them often."""

from __future__ import annotations

import os
import re
import struct
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from scenefuse.core.stage import StageError, sha256

if TYPE_CHECKING:
    from PIL.Image import Image

JPEG = (".jpg", ".jpeg", ".jpe", ".jfif")
SUFFIXES = (*JPEG, ".png", ".tif", ".tiff", ".bmp", ".ppm")
# What COLMAP reads, whatever the ending, as Pillow calls it. The photos of many phones are MPO.
FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "BMP", "PPM")
VIDEO_SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts"}
# Photos all the same, but in formats that not every stage can decode.
UNREADABLE = {".heic", ".heif", ".hif", ".avif", ".jxl", ".webp", ".jp2", ".j2k", ".jpx", ".gif", ".tga", ".dib"}
UNREADABLE |= {".pgm", ".pnm", ".mpo", ".insp", ".dng", ".raw", ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".gpr"}
UNREADABLE |= {".iiq", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".srw", ".x3f", ".rwl", ".sr2", ".mef"}
UNREADABLE |= {".mrw", ".erf", ".kdc", ".dcr", ".fff"}


# Fewest photos of an object: so many of its masks have to be good.
MIN_OBJECT_PHOTOS = 5
# Phones' photos have 200 million pixels. A small file that claims more would fill the memory.
MAX_PIXELS = 250_000_000
# What decoding a damaged file ends with; a parser's error is a SyntaxError.
DAMAGED = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError),
    *(SyntaxError, MemoryError, struct.error),
)

# Where servers and systems keep thumbnails and what was deleted.
SYSTEM_FOLDERS = ("@eadir", "#recycle", "$recycle.bin", "__macosx")
# Where in a folder other programs keep cameras, and under which names; Blender keeps some apart.
CAMERA_FILES = ("reconstruction.json", "opensfm/reconstruction.json", "transforms.json", "transforms_train.json")
HELD_OUT_FILE = "transforms_test.json"
MODEL_FILES = tuple(f"{name}.{kind}" for name in ("cameras", "images") for kind in ("bin", "txt"))
BUNDLER = ".out"
# Where in an OpenDroneMap project its place on the earth is.
COORDS = "odm_georeferencing/coords.txt"
# What the name of a mask may have more than its photo's: a_mask, a.jpg.mask, a-mask, mask_a.
MASK = re.compile(r"(.+?)(?:[_. -]mask)+|mask[_. -](.+)", re.DOTALL)
# What drones take along with a photo of the same number: thermal and multispectral bands.
BAND = re.compile(r".*?(\d{4,})_(?:(t|thrm|ms_\w+|gre|nir|red|reg)|[vwzd]|wide|zoom|rgb)", re.DOTALL)
# What to do about names that do not tell photos apart.
RENAME = "give the folder that holds the photos alone, or every photo a name of its own"

_Key = tuple[str, str]


def camera_files(given: Path) -> list[Path]:
    """The files that hold cameras of another program: in a folder, or a file itself with what belongs to it."""
    if given.is_file():
        listed, coords = bundler_list(given), given.parent.parent / COORDS
        return [given, *([listed] if listed else []), *([coords] if coords.is_file() else [])]
    exported = [file for export in exports(given) for file in camera_files(export)]
    models = [model / name for model in colmap_models(given) for name in MODEL_FILES]
    places = [given / name for name in (*CAMERA_FILES, HELD_OUT_FILE, COORDS)]
    return [file for file in [*models, *places] if file.is_file()] or exported or [given]


def exports(folder: Path) -> list[Path]:
    """Metashape's XML and Bundler's files in a folder."""
    begin = {".xml": b"<chunk", BUNDLER: b"# Bundle"}
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return [file for file in files if (mark := begin.get(file.suffix.lower())) and mark in head(file)]


def head(file: Path) -> bytes:
    """Enough of a file to know its format; nothing of one that cannot be read."""
    try:
        with open(file, "rb") as stream:
            return stream.read(4096)
    except OSError:
        return b""


def colmap_models(given: Path) -> list[Path]:
    """The COLMAP models in a folder: itself, sparse/, and the numbered ones in both, which a mapping that fell apart
    writes."""
    homes = [home for home in (given / "sparse", given) if home.is_dir()]
    parts = [part for home in homes for part in sorted(home.iterdir()) if part.name.isdigit()]
    return [m for m in [*parts, *homes] if any((m / name).is_file() for name in ("images.bin", "images.txt"))]


def bundler_list(file: Path) -> Path | None:
    """The list of photos beside a Bundler file, by its usual names; None where there is none."""
    if file.suffix.lower() != BUNDLER:
        return None
    stem = file.stem.casefold()
    names = (f"{stem}.list.txt", f"{stem}.lst", f"{stem}.txt", "list.txt", "images.list")
    beside = {path.name.casefold(): path for path in sorted(file.parent.iterdir(), reverse=True) if path.is_file()}
    return next((beside[name] for name in names if name in beside), None)


def photo_files(folder: Path) -> list[Path]:
    """The photos below a folder, symlinked folders included, sorted by their names relative to it.

    Hidden files and folders and files that are no photos are left out; so are those that belong to photos
    (`beside_photos`), and raw files and HEIC where the same photo lies beside them in a readable format.

    Raises:
        StageError: the folder is missing or holds no photo, or a photo has a format that cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise StageError(f"the photos {folder} do not exist; check their path in the configuration")
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
        videos = [str(file) for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
        found = f"{len(files)} other files were found"
        found = f"or give a video itself: {', '.join(videos[:3])}" if videos else found
        raise StageError(f"the photo folder {folder} holds no photos; put JPEG, PNG, TIFF or BMP files there ({found})")
    beside = {folder / name for name in beside_photos(folder)}
    return sorted({*photos} - beside, key=lambda file: file.relative_to(folder).as_posix())


def distinct_photos(folder: Path) -> tuple[list[str], list[str]]:
    """Relative names of the photos below a folder (`photo_files`), sorted, of which none is another's file again, byte
    for byte, in fewer pixels or edited; and notes that name pictures that were left out.

    A copy sees nothing that its original does not, but would count as one more photo that confirms it. The shortest
    name stays.

    Raises:
        StageError: what `photo_files` says; a name that holds control characters or undecodable bytes.
    """
    names = [file.relative_to(folder).as_posix() for file in photo_files(folder)]
    odd = next((name for name in names if not name.isprintable()), None)
    if odd is not None:
        raise StageError(f"{odd!r} in {folder} has a name that lists and tables cannot hold; rename it")
    beside = beside_photos(folder)
    of = "masks or other bands of photos by their names, or these photos in another format"
    notes = [f"{len(beside)} pictures are {of}, and are left out ({beside[0]}, ...)"] if beside else []
    by_size, first_of = dict[int, list[str]](), dict[str, str]()
    for name in sorted(names, key=lambda name: (len(name), name)):
        by_size.setdefault((folder / name).stat().st_size, []).append(name)
    # Empty files are no copies: each is to be named.
    for alike in (group for size, group in by_size.items() if size and len(group) > 1):
        kept = dict[str, str]()
        for name in alike:
            first = kept.setdefault(sha256(folder / name), name)
            if first != name:
                first_of[name] = first
    others = _other_copies(folder, [name for name in names if name not in first_of])
    for found, how in ((first_of, "copies of others, byte for byte,"), (others, "other copies of the same shots")):
        if found:
            one = f"{(copy := min(found))} of {found[copy]}"
            notes.append(f"{len(found)} photos are {how} and are left out ({one})")
    return [name for name in names if name not in first_of | others], notes


def _other_copies(folder: Path, names: list[str]) -> dict[str, str]:
    """Photos of which there is the same shot, by name, time and camera, in more pixels, or not edited; and that one.

    Edited copies are named like their photo, with more behind: IMG_1-edited, IMG_1-2; those of iPhones IMG_E1. Photos
    of one second may be so, too: then the fraction of the second tells. Cameras of a rig may agree in all that, but in
    the number of pixels too: of as many of one name, only a camera's serial number tells an edited copy from another
    photo.
    """
    from PIL.ExifTags import IFD, Base

    stems = {name: _stem(name.rpartition("/")[2].casefold()) for name in names}
    by_name, found, first = defaultdict[str, list[str]](list), dict[str, str](), ""
    for stem, name in sorted((re.sub(r"^img_e(?=\d)", "img_", stem), name) for name, stem in stems.items()):
        first = first if first and stem.startswith(first) else stem
        by_name[first].append(name)
    for alike in (group for group in by_name.values() if len(group) > 1):
        largest = dict[tuple[str, ...], tuple[int, str]]()
        pixels = dict[str, tuple[int, tuple[str, ...]]]()
        for name in sorted(alike, key=len):
            with suppress(StageError), open_picture(folder / name) as image:
                exif = image.getexif()
                taken = exif.get_ifd(IFD.Exif)
                # A clock that was not set writes blanks or zeros.
                if (when := str(taken.get(Base.DateTimeOriginal) or "")).strip("0: \0"):
                    own = exif.get(Base.Model), taken.get(Base.BodySerialNumber, "")
                    fraction = str(taken.get(Base.SubsecTimeOriginal) or "")
                    shot = tuple(map(str, (when, fraction if fraction.strip("0 \0") else stems[name], *own)))
                    pixels[name] = image.width * image.height, shot
                    if pixels[name][0] > largest.get(shot, (0, ""))[0]:
                        largest[shot] = pixels[name][0], name
        for name, (count, shot) in pixels.items():
            most, first = largest[shot]
            if count < most or (name != first and (shot[-1] or stems[name] != stems[first])):
                found[name] = first
    return found


def geo_file(folder: Path) -> Path | None:
    """The positions of a folder's photos, in the file that OpenDroneMap calls geo.txt, if there is one."""
    return min(folder.glob("[Gg][Ee][Oo].[Tt][Xx][Tt]"), default=None)


def subtitles(video: Path) -> Path | None:
    """The subtitles beside a video, in which drones write their positions, if there are any."""
    name = video.with_suffix(".srt").name.casefold()
    beside = video.parent.iterdir() if video.suffix.lower() in VIDEO_SUFFIXES and video.is_file() else ()
    return next((path for path in beside if path.name.casefold() == name), None)


def pictures_below(folder: Path) -> dict[str, Path]:
    """The pictures below a folder, symlinked folders included, by their paths relative to it."""
    files = sorted(path for path in _files_below(folder) if path.suffix.lower() in SUFFIXES)
    return {path.relative_to(folder).as_posix(): path for path in files}


def files_by_name(names: Iterable[str], folder: Path, where: str) -> dict[str, Path]:
    """The photos below a folder by the names that another program gives them; see `photos_by_name`."""
    root, names = Path(os.path.abspath(folder)), list(names)
    paths = {name: Path(os.path.normpath(root / name.replace("\\", "/"))) for name in names}
    found = {name: path for name, path in paths.items() if path.is_relative_to(root) and os.path.isfile(path)}
    if len(found) < len(paths):
        files = pictures_below(root)
        found = {name: files[path] for name, path in photos_by_name(names, files, where).items()}
    return found


def masks_by_name(photos: Iterable[str], folder: Path) -> dict[str, Path]:
    """The masks below a folder by the names of their photos: for each photo the one that is named as a mask, else the
    one named like the photo; where the folder has both kinds, a file of a photo's whole name is this photo itself."""
    files, photos = pictures_below(folder), list(photos)
    marked = [name for name, path in files.items() if MASK.fullmatch(_stem(path.name.casefold()))]
    found = photos_by_name(photos, marked, str(folder), True)
    whole = {_keys(photo)[1] for photo in photos if found}
    plain = [name for name in files if name not in found.values() and whole.isdisjoint(_keys(name))]
    found |= photos_by_name([photo for photo in photos if photo not in found], plain, str(folder))
    return {photo: files[name] for photo, name in found.items()}


def no_match(folder: Path, photo: str) -> str:
    """What is wrong with a folder of masks that belong to none of the photos, and what to do; `photo`: name of one."""
    masks = pictures_below(folder)
    return (
        f"masks that match no photo: {len(masks)} masks in {folder} (first: {next(iter(masks), 'none')}), photos are"
        f" named like {photo}; name a mask like its photo, with or without _mask behind it"
    )


def beside_photos(folder: Path) -> list[str]:
    """Pictures below a folder of photos (paths relative to it) that belong to others by their names: masks, pictures in
    a folder of masks, other bands, and those that lie beside the same photo as JPEG."""
    stems = {name: _stem(name.casefold().rpartition("/")[2]) for name in pictures_below(folder)}
    jpegs = {name.rpartition(".")[0] for name in stems if name.lower().endswith(JPEG)}
    again = [name for name in stems if not name.lower().endswith(JPEG) and name.rpartition(".")[0] in jpegs]
    of = {name: mask[1] or mask[2] for name, stem in stems.items() if (mask := MASK.fullmatch(stem))}
    of = {name: stem for name, stem in stems.items() if re.search(r"(^|/)masks?/[^/]*$", name.casefold())} | of
    photos = {stem for name, stem in stems.items() if name not in of}
    bands = {name: band for name, stem in stems.items() if (band := BAND.fullmatch(stem))}
    seen = {band[1] for band in bands.values() if not band[2]}
    again += [name for name, band in bands.items() if band[2] and band[1] in seen]
    return sorted({*again, *(name for name, stem in of.items() if _stem(stem) in photos)})


def photos_by_name(wanted: Iterable[str], known: Iterable[str], where: str, masks: bool = False) -> dict[str, str]:
    """Which photo is meant by each name that another program, a list or a person gives; those not there are left out.

    Names are compared from their end, folder by folder, as far as they agree: other machines' paths, and frames with
    their folders in their name, are found. Kinds of slashes, blanks and byte order marks around a name, and how letters
    like umlauts are composed, never count; case, and then endings that are missing, doubled or others, count only
    where they tell photos apart.

    Args:
        wanted: names as given.
        known: paths of photos below their folder.
        where: the file that gives the names, for messages.
        masks: whether `known` are masks, which may be named as such.

    Raises:
        StageError: a name may be of several photos, or a photo of several names.
    """
    index = defaultdict[_Key, list[str]](list)
    for name in dict.fromkeys(known):
        for key in dict.fromkeys(_keys(name, masks)):
            index[key].append(name)
    claims: list[tuple[int, str, str]] = []
    for name in dict.fromkeys(wanted):
        keys = _keys(name)
        key = next((key for key in keys if key in index), ("", ""))
        alike = index.get(key, [])
        whole = [photo for photo in alike if key in _keys(photo, masks)[:3]]
        if len(whole) == 1 or len(alike) == 1:
            claims.append((len(key[1]), name, (whole if len(whole) == 1 else alike)[0]))
        elif key in keys[:3]:
            raise StageError(
                f"{where}: {name} may be any of {len(alike)} photos ({', '.join(alike[:2])}, ...); {RENAME}"
            )
    # Of names in one folder all agree with their photos as far up as one does.
    depths = defaultdict[str, int](int)
    for _, name, photo in claims:
        depths[_folder(name)] = max(depths[_folder(name)], _shared_folders(name, photo))
    found = dict[str, tuple[int, str]]()
    for length, name, photo in claims:
        if _shared_folders(name, photo) == depths[_folder(name)]:
            if photo in found and found[photo][0] == length:
                both = f"{found[photo][1]} and {name} may both be the photo {photo}"
                raise StageError(f"{where}: {both}; write it alike if it is one, or {RENAME}")
            found[photo] = max((length, name), found.get(photo, (0, "")))
    return {name: photo for photo, (_, name) in found.items()}


def _parts(name: str) -> list[str]:
    """The folders and the name of a photo, spelled alike whoever wrote them."""
    plain = unicodedata.normalize("NFC", name.strip("\ufeff\"' \t\r\n")).replace("\\", "/")
    return [part for part in plain.split("/") if part.strip(". ")]


def _folder(name: str) -> str:
    return "/".join(_parts(name)[:-1])


def _shared_folders(one: str, other: str) -> int:
    """How many folders two paths share, from their names upwards."""
    pairs = zip(_parts(one.casefold())[-2::-1], _parts(other.casefold())[-2::-1])
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _keys(name: str, mask: bool = False) -> list[_Key]:
    """What names have in common that may be of one photo: three keys of the whole name, then of less and less of it."""
    parts = _parts(name)
    *folders, last = [part.casefold() for part in parts] or [""]
    stem = _stem(last)
    if mask and (marked := MASK.fullmatch(stem)):
        stem = _stem(marked[1] or marked[2])
    keys: list[_Key] = []
    for k in range(len(parts)):
        spelled = "_".join(parts[k:])
        keys += [("spelled", spelled), ("folded", spelled.casefold()), ("stem", "_".join([*folders[k:], stem]))]
    return keys


def _stem(name: str) -> str:
    """A name without its endings, however many."""
    while (path := Path(name)).suffix in (*SUFFIXES, *UNREADABLE):
        name = path.stem
    return name


def in_folders(names: list[str]) -> str:
    """How many photos (paths below a folder) there are, and where those below its own folders lie."""
    below = Counter(folder for name in names if (folder := name.rpartition("/")[0]))
    where = ", ".join(f"{count} of them in {folder}/" for folder, count in sorted(below.items())[:5])
    more = f", and {len(below) - 5} more folders" if len(below) > 5 else ""
    return f"{len(names)} photos" + (f", {where}{more}" if below else "")


@contextmanager
def open_picture(path: Path) -> Iterator[Image]:
    """A picture whose header was read, by Pillow.

    Raises:
        StageError: it is none that can be read, or claims more pixels than any camera takes.
    """
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = MAX_PIXELS
    # Opened by handle: by name, Pillow 13 scrambles rotated TIFF files that are not RGB.
    try:
        with open(path, "rb") as file, Image.open(file) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels are more than any camera takes")
            yield image
    except (*DAMAGED, Image.DecompressionBombError) as error:
        why = str(error) or type(error).__name__
        if isinstance(error, Image.UnidentifiedImageError):
            heic = head(path)[4:8] == b"ftyp"
            why = "it is HEIC" if heic else "it is no picture, or of a format that is not read"
            why += f", whatever its ending{': convert it to JPEG' if heic else ''}"
        raise StageError(f"{path} cannot be decoded ({why}); replace it, or remove it from its folder") from None


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as people see it; only its header is read. Errors as of `open_picture`."""
    width, height = stored_size(path)
    with open_picture(path) as image:
        return (height, width) if image.getexif().get(0x0112, 1) in (5, 6, 7, 8) else (width, height)


def stored_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as it is stored; errors as of `open_picture`."""
    with open_picture(path) as image:
        # Pillow 13 gives the size of a TIFF as it will be when turned; its tags have it as stored.
        tags = getattr(image, "tag_v2", None)
        return image.size if tags is None else (int(tags[256]), int(tags[257]))


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
    """All files that are not hidden; a link to a folder that was already entered is not followed again.

    Raises:
        StageError: a picture, or what may be a folder, is a link to nothing: git-annex has not fetched it, or a disk is
            not there.
    """
    files, entered = [], set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in entered:
            folders.clear()
            continue
        entered.add(real)
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f.casefold() not in SYSTEM_FOLDERS)
        files += [Path(place, name) for name in names if not name.startswith(".")]
    lost = next((file for file in files if file.suffix.lower() in (*SUFFIXES, "") and not file.exists()), None)
    if lost is not None:
        raise StageError(f"{lost} is a link to what is not there; fetch that, or remove the link")
    return [file for file in files if file.is_file()]
