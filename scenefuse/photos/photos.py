"""Photos as the reconstruction reads them: checked, upright, and what their EXIF says."""

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from PIL.ExifTags import GPS, IFD, Base

from scenefuse.core.stage import StageError, atomic_directory, quantity, read_json, sha256, threads, value, write_json
from scenefuse.photos.photo_files import GEO_FILE, in_folders, photo_files
from scenefuse.photos.pictures import JPEG_QUALITY
from scenefuse.photos.positions import positions_of, read_geo, rtk_accuracy

# Pillow warns of pictures with more pixels, and refuses those with twice as many: by itself, phones' of 200 megapixels.
Image.MAX_IMAGE_PIXELS = 250_000_000
# Photos and cameras differ in shape by no more than what rounding to whole pixels does.
SHAPE_TOLERANCE = 0.01
# What the reconstruction reads. Other tags say how the old file's pixels were stored, or point into it.
KEPT_EXIF = {
    IFD.Exif: (Base.FocalLength, Base.FocalLengthIn35mmFilm, Base.DateTimeOriginal),
    IFD.GPSInfo: (GPS.GPSLatitudeRef, GPS.GPSLatitude, GPS.GPSLongitudeRef, GPS.GPSLongitude)
    + (GPS.GPSAltitudeRef, GPS.GPSAltitude),
}


Result = TypeVar("Result")


@dataclass(frozen=True)
class Photo:
    """One photo as later stages need to know it.

    Attributes:
        name: path relative to its folder, with forward slashes.
        width: columns as stored; as people see them where `orientation` is 1.
        height: rows, likewise.
        sha256: of the file's bytes.
        latitude_deg: WGS84 latitude from EXIF or geo.txt, or None.
        longitude_deg: WGS84 longitude, likewise.
        altitude_m: altitude, likewise.
        focal_px: focal length that EXIF's 35 mm equivalent gives, or None.
        camera: maker and model from EXIF, or "".
        orientation: EXIF orientation; 1 is upright.
        horizontal_sd_m: standard deviation of the position, east and north, from XMP or geo.txt, or None.
        vertical_sd_m: of the altitude, likewise.
        focal_mm: EXIF's focal length as it is, or None.
    """

    name: str
    width: int
    height: int
    sha256: str
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    focal_px: float | None = None
    camera: str = ""
    orientation: int = 1
    horizontal_sd_m: float | None = None
    vertical_sd_m: float | None = None
    focal_mm: float | None = None

    @property
    def has_gps(self) -> bool:
        """Whether a position is known."""
        return self.latitude_deg is not None and self.longitude_deg is not None


def list_photos(*, folder: Path, upright: Path, photos: Path) -> None:
    """List the photos of a folder and its subfolders, check that every one can be decoded, and stand them upright.

    Photos that EXIF says are rotated are turned and written again; all others are linked. From here on pixels count as
    people see them. A geo.txt in the folder takes the place of the positions in EXIF.

    Args:
        folder: folder of photos; JPEG, PNG, TIFF or BMP.
        upright: output, folder of the same names with upright copies of the rotated photos and links to all others.
        photos: output, JSON with name, size in pixels, SHA-256, position and focal length of each photo in `upright`.

    Raises:
        StageError: the folder is missing or holds no photo, a photo cannot be decoded, or geo.txt is not well formed.
    """
    names, copies = without_copies(folder, photo_names(folder))
    positions = read_geo(folder / GEO_FILE) if (folder / GEO_FILE).is_file() else None
    with atomic_directory(upright) as temporary:
        stood = each_photo(lambda name: _stood_upright(folder, name, temporary), names)
    turned = {p.name: orientation for p, orientation in stood if orientation != 1}
    listed = [p for p, _ in stood]
    notes = copies + below_folder(names) + photo_notes(listed)
    if positions is not None:
        listed = [replace(p, **place) for p, place in zip(listed, positions_of(names, positions, folder / GEO_FILE))]
        notes.append(
            f"{GEO_FILE} gives {sum(p.has_gps for p in listed)} of {len(listed)} positions; EXIF's are not used"
        )
    if turned:
        first = next(iter(turned))
        notes.append(f"{len(turned)} photos ({first}, ...) carry an EXIF rotation; upright copies of them are used")
    with_gps, stated = sum(p.has_gps for p in listed), sum(p.has_gps and bool(p.horizontal_sd_m) for p in listed)
    print(f"{len(listed)} photos in {folder}, {with_gps} with a GPS position, {stated} with its accuracy", flush=True)
    write_photos(photos, listed, upright, kind="photos", notes=notes, turned=quantity(turned, ""))


def photo_names(folder: Path) -> list[str]:
    """Relative names of all photos below a folder, sorted; see `photo_files`.

    Raises:
        StageError: what `photo_files` says; a name that holds control characters or undecodable bytes.
    """
    names = [file.relative_to(folder).as_posix() for file in photo_files(folder)]
    odd = next((name for name in names if not name.isprintable()), None)
    if odd is not None:
        raise StageError(f"{odd!r} in {folder} has a name that lists and tables cannot hold; rename it")
    return names


def without_copies(folder: Path, names: list[str]) -> tuple[list[str], list[str]]:
    """Photos of which none is another's file again, byte for byte, and a note that names those left out.

    A copy sees nothing that its original does not, but would count as one more photo that confirms it. The shortest
    name stays.
    """
    by_size, first_of = dict[int, list[str]](), dict[str, str]()
    for name in sorted(names, key=lambda name: (len(name), name)):
        by_size.setdefault((folder / name).stat().st_size, []).append(name)
    for alike in (group for group in by_size.values() if len(group) > 1):
        kept = dict[str, str]()
        for name in alike:
            first = kept.setdefault(sha256(folder / name), name)
            if first != name:
                first_of[name] = first
    if not first_of:
        return names, []
    copy = min(first_of)
    note = f"{len(first_of)} photos are copies of others, byte for byte, and are left out ({copy} of {first_of[copy]})"
    return [name for name in names if name not in first_of], [note]


def orientations_in(content: Mapping[str, Any]) -> dict[str, int]:
    """The EXIF orientation that photos had before they were stood upright, by name, from the content of photos.json."""
    turned: dict[str, int] = value(content, "turned") if "turned" in content else {}
    return turned


def _stood_upright(folder: Path, name: str, output: Path) -> tuple[Photo, int]:
    """Link or turn one photo into `output`; what is listed is the result, and the EXIF orientation that it had."""
    photo, target = inspect_photo(folder, name), output / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if photo.orientation == 1:
        target.symlink_to(os.path.relpath(os.path.realpath(folder / name), os.path.realpath(target.parent)))
        return photo, 1
    save_upright(folder / name, target)
    turned = inspect_photo(output, name)
    stated = replace(turned, horizontal_sd_m=photo.horizontal_sd_m, vertical_sd_m=photo.vertical_sd_m)
    return stated, photo.orientation


def save_upright(source: Path, target: Path, max_width_px: int | None = None) -> tuple[int, int]:
    """Write a photo as people see it, at most `max_width_px` wide; position, camera and focal length in EXIF stay.

    Returns:
        Width and height of the upright photo before it was scaled.
    """
    with open(source, "rb") as file, Image.open(file) as image:
        before = image.getexif()
        exif = Image.Exif()
        exif.update({tag: before[tag] for tag in (Base.Make, Base.Model) if tag in before})
        for block, wanted in KEPT_EXIF.items():
            if tags := {tag: entry for tag, entry in before.get_ifd(block).items() if tag in wanted}:
                exif[block] = tags
        upright = ImageOps.exif_transpose(image)
        size = upright.size
        if max_width_px is not None and upright.width > max_width_px:
            height = round(upright.height * max_width_px / upright.width)
            upright = upright.resize((max_width_px, height), Image.Resampling.LANCZOS, reducing_gap=3.0)
        coded: dict[str, Any] = (
            {"quality": JPEG_QUALITY, "subsampling": 0} if target.suffix.lower() in (".jpg", ".jpeg") else {}
        )
        upright.save(target, exif=exif.tobytes(), **coded)
    return size


def check_unchanged(folder: Path, photos: Iterable[Photo]) -> None:
    """Check that photos are still the files that were listed.

    Raises:
        StageError: photos are missing, or have other bytes than when they were listed.
    """
    photos = list(photos)
    missing = [p.name for p in photos if not (folder / p.name).is_file()]
    if missing:
        raise StageError(
            f"{len(missing)} photos are missing in {folder}, {missing[0]} for one; put them back, or delete the"
            " photos.json that lists them and run again"
        )
    with ThreadPoolExecutor(threads()) as pool:
        found = pool.map(lambda photo: sha256(folder / photo.name), photos)
        changed = [photo.name for photo, digest in zip(photos, found) if digest != photo.sha256]
    if changed:
        raise StageError(
            f"{folder / changed[0]} is not the photo that was listed any more ({len(changed)} have changed); delete the"
            " photos.json that lists it and run again"
        )


def inspect_photo(folder: Path, name: str) -> Photo:
    """Decode one photo completely and read its EXIF; StageError names a photo that cannot be decoded."""
    path = folder / name
    try:
        # Opened by handle: by name, Pillow 13 scrambles rotated TIFF files that are not RGB.
        with open(path, "rb") as file, Image.open(file) as image:
            exif = image.getexif()
            # Decoding a TIFF turns it upright and forgets the tag.
            orientation = int(exif.get(Base.Orientation, 1) or 1)
            camera = f"{_text(exif.get(Base.Make))} {_text(exif.get(Base.Model))}".strip()
            latitude, longitude, altitude = _position(exif.get_ifd(IFD.GPSInfo))
            xmp = image.info.get("xmp", b"")
            horizontal, vertical = rtk_accuracy(xmp if isinstance(xmp, bytes) else str(xmp).encode())
            taken = exif.get_ifd(IFD.Exif)
            equivalent_mm, focal_mm = (
                _number(taken.get(tag)) or None for tag in (Base.FocalLengthIn35mmFilm, Base.FocalLength)
            )
            if image.mode == "F":
                raise ValueError("its pixels are 32-bit measurements, as a thermal camera's, and no picture")
            image.load()
            width, height = image.size
    except Exception as error:
        raise StageError(
            f"the photo {path} cannot be decoded ({_why(error)}); replace it or remove it from the folder"
        ) from None
    # A 35 mm frame is 36 mm wide; COLMAP takes its prior from the longer side in the same way.
    focal_px = equivalent_mm / 36.0 * max(width, height) if equivalent_mm else None
    digest = sha256(path)
    place = (latitude, longitude, altitude)
    return Photo(name, width, height, digest, *place, focal_px, camera, orientation, horizontal, vertical, focal_mm)


def _why(error: Exception) -> str:
    """Why a photo cannot be decoded, in a user's words."""
    return "it is no picture" if isinstance(error, UnidentifiedImageError) else str(error) or type(error).__name__


def each_photo(function: Callable[[str], Result], names: Iterable[str]) -> list[Result]:
    """What a function gives for each photo, in parallel.

    Raises:
        StageError: of the first photo that it fails for, which names the others.
    """

    def tried(name: str) -> Result | StageError:
        try:
            return function(name)
        except StageError as error:
            return error

    names = list(names)
    with ThreadPoolExecutor(threads()) as pool:
        found = list(pool.map(tried, names))
    bad = [(name, error) for name, error in zip(names, found) if isinstance(error, StageError)]
    if bad:
        more = f"; nor can {', '.join(name for name, _ in bad[1:6])}" if len(bad) > 1 else ""
        raise StageError(f"{bad[0][1]}{more}{f' and {len(bad) - 6} more' if len(bad) > 6 else ''}")
    return [result for result in found if not isinstance(result, StageError)]


def below_folder(names: list[str]) -> list[str]:
    """A note where photos (paths below their folder) lie in folders below it: previews and masks may be among them."""
    return [f"{in_folders(names)}"] if any("/" in name for name in names) else []


def photo_notes(photos: list[Photo]) -> list[str]:
    """What a person should know about a list of photos: odd sizes."""
    sizes = {(p.width, p.height) for p in photos}
    return [f"the photos have {len(sizes)} different sizes"] if len(sizes) > 1 else []


def write_photos(
    path: Path, photos: list[Photo], folder: Path, kind: str, notes: list[str], **more: dict[str, Any]
) -> None:
    """Write photos.json, and print its notes; `kind` is "photos" or "video", `more` are further quantities."""
    for note in notes:
        print(f"note: {note}", flush=True)
    content = {
        "folder": folder,
        "kind": quantity(kind, ""),
        "count": quantity(len(photos), "1"),
        "with_gps": quantity(sum(p.has_gps for p in photos), "1"),
        "notes": quantity(notes, ""),
        **more,
        "photos": [asdict(p) for p in photos],
    }
    write_json(path, content)


def read_photos(path: Path) -> list[Photo]:
    """The photos that photos.json lists."""
    return [Photo(**entry) for entry in read_json(path)["photos"]]


def gps_positions(photos: list[Photo]) -> tuple[list[str], NDArray[np.float64]]:
    """Names and (N, 3) WGS84 latitude (deg), longitude (deg), altitude (m) of the photos that have a position.

    A missing altitude is NaN.
    """
    known = [p for p in photos if p.has_gps]
    rows = [(p.latitude_deg, p.longitude_deg, np.nan if p.altitude_m is None else p.altitude_m) for p in known]
    return [p.name for p in known], np.array(rows, dtype=np.float64).reshape(-1, 3)


def gps_accuracies(photos: list[Photo], otherwise_m: float) -> NDArray[np.float64]:
    """(N, 2) standard deviations in metres, horizontal and vertical, of the photos that have a position."""
    known = [(p.horizontal_sd_m, p.vertical_sd_m) for p in photos if p.has_gps]
    return np.array([[h or otherwise_m, v or h or otherwise_m] for h, v in known]).reshape(-1, 2)


def _position(gps: dict[int, Any]) -> tuple[float | None, float | None, float | None]:
    """Latitude and longitude in degrees, altitude in metres, from EXIF's GPS block."""
    latitude, longitude = _degrees(gps.get(2)), _degrees(gps.get(4))
    valid = latitude is not None and longitude is not None and (latitude, longitude) != (0.0, 0.0)
    if not valid or latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None, None, None
    if _text(gps.get(1)).upper().startswith("S"):
        latitude = -latitude
    if _text(gps.get(3)).upper().startswith("W"):
        longitude = -longitude
    altitude = _number(gps.get(6))
    if altitude is not None and gps.get(5) in (1, b"\x01"):
        altitude = -altitude
    return latitude, longitude, altitude


def _degrees(value: Any) -> float | None:
    """Degrees from EXIF's (degrees, minutes, seconds)."""
    try:
        parts = [float(v) for v in value]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    degrees = sum(part / 60.0**power for power, part in enumerate(parts[:3]))
    return degrees if len(parts) >= 1 and np.isfinite(degrees) else None


def _number(value: Any) -> float | None:
    """A finite float, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) else None


def _text(value: Any) -> str:
    """EXIF text without the zero bytes that some cameras pad it with."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    return str(value or "").split("\x00")[0].strip()
