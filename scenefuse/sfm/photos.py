"""A folder of photos: which files they are, whether each can be decoded, and what their EXIF says."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import IFD, Base

from scenefuse.sfm.photo_files import photo_files
from scenefuse.stage import StageError, quantity, read_json, sha256, threads, write_json


@dataclass(frozen=True)
class Photo:
    """One photo as later stages need to know it.

    Attributes:
        name: path relative to its folder, with forward slashes.
        width: columns as stored, before any EXIF rotation.
        height: rows as stored.
        sha256: of the file's bytes.
        latitude_deg: WGS84 latitude from EXIF, or None.
        longitude_deg: WGS84 longitude from EXIF, or None.
        altitude_m: altitude from EXIF, or None.
        focal_px: focal length that EXIF's 35 mm equivalent gives, or None.
        camera: maker and model from EXIF, or "".
        orientation: EXIF orientation; 1 is upright.
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

    @property
    def has_gps(self) -> bool:
        """Whether EXIF held a position."""
        return self.latitude_deg is not None and self.longitude_deg is not None


def list_photos(*, folder: Path, photos: Path) -> None:
    """List the photos of a folder and its subfolders, and check that every one can be decoded.

    Args:
        folder: folder of photos; JPEG, PNG, TIFF or BMP.
        photos: output, JSON with name, size in pixels, SHA-256, position and focal length of each photo.

    Raises:
        StageError: the folder is missing or holds no photo, or a photo cannot be decoded.
    """
    names = photo_names(folder)
    with ThreadPoolExecutor(threads()) as pool:
        listed = list(pool.map(lambda name: inspect_photo(folder, name), names))
    notes = photo_notes(listed)
    with_gps = sum(p.has_gps for p in listed)
    print(f"{len(listed)} photos in {folder}, {with_gps} with a GPS position", flush=True)
    for note in notes:
        print(f"note: {note}", flush=True)
    write_photos(photos, listed, folder, kind="photos", notes=notes)


def photo_names(folder: Path) -> list[str]:
    """Relative names of all photos below a folder, sorted; see `photo_files`."""
    names = [file.relative_to(folder).as_posix() for file in photo_files(folder)]
    spaced = next((name for name in names if any(c.isspace() for c in name)), None)
    if spaced is not None:
        raise StageError(f"'{spaced}' in {folder} has a space in its name, which COLMAP's lists cannot hold; rename it")
    return names


def inspect_photo(folder: Path, name: str) -> Photo:
    """Decode one photo completely and read its EXIF; StageError names a photo that cannot be decoded."""
    path = folder / name
    try:
        with Image.open(path) as image:
            image.load()
            width, height = image.size
            exif = image.getexif()
    except Exception as error:
        raise StageError(
            f"the photo {path} cannot be decoded ({str(error) or type(error).__name__}); "
            f"replace it or remove it from the folder"
        ) from None
    latitude, longitude, altitude = _position(exif.get_ifd(IFD.GPSInfo))
    equivalent_mm = _number(exif.get_ifd(IFD.Exif).get(Base.FocalLengthIn35mmFilm))
    # A 35 mm frame is 36 mm wide; COLMAP takes its prior from the longer side in the same way.
    focal_px = equivalent_mm / 36.0 * max(width, height) if equivalent_mm else None
    camera = f"{_text(exif.get(Base.Make))} {_text(exif.get(Base.Model))}".strip()
    orientation = int(exif.get(Base.Orientation, 1) or 1)
    return Photo(
        name,
        width,
        height,
        sha256(path),
        latitude,
        longitude,
        altitude,
        focal_px,
        camera,
        orientation,
    )


def photo_notes(photos: list[Photo]) -> list[str]:
    """What a person should know about a list of photos: repeated files, rotated files, odd sizes."""
    notes = []
    first_of: dict[str, str] = {}
    for photo in photos:
        if photo.sha256 in first_of:
            notes.append(f"{photo.name} is a copy of {first_of[photo.sha256]}")
        first_of.setdefault(photo.sha256, photo.name)
    rotated = [p.name for p in photos if p.orientation != 1]
    if rotated:
        notes.append(
            f"{len(rotated)} photos ({rotated[0]}, ...) carry an EXIF rotation, which is not applied: "
            f"pixel coordinates count in the file as stored"
        )
    sizes = {(p.width, p.height) for p in photos}
    if len(sizes) > 1:
        notes.append(f"the photos have {len(sizes)} different sizes")
    return notes


def write_photos(
    path: Path, photos: list[Photo], folder: Path, kind: str, notes: list[str], **more: dict[str, Any]
) -> None:
    """Write photos.json; `kind` is "photos" or "video", `more` are further quantities."""
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

    A missing altitude becomes the median of the others, or 0.
    """
    known = [p for p in photos if p.has_gps]
    altitudes = [p.altitude_m for p in known if p.altitude_m is not None]
    middle = float(np.median(altitudes)) if altitudes else 0.0
    rows = [(p.latitude_deg, p.longitude_deg, middle if p.altitude_m is None else p.altitude_m) for p in known]
    return [p.name for p in known], np.array(rows, dtype=np.float64).reshape(-1, 3)


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
