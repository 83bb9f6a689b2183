"""Photos as the reconstruction reads them: checked, upright, and what their EXIF says."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from scenefuse.core.stage import StageError, quantity, read_json, sha256, threads, value, write_json
from scenefuse.photos.photo_files import FORMATS, JPEG, in_folders, open_picture
from scenefuse.photos.pictures import JPEG_QUALITY, read_raw, same_shape, stretched
from scenefuse.photos.positions import exif_number, exif_text, stated_position

# SIFT finds next to nothing in photos that use so much fewer bits than their files have: 12 of 16, or the dark 6 of 8.
MIN_UNUSED_BITS = 2
# Share of the pixels that may be brighter than what counts as the photo's brightest: hot ones, lamps.
HOT_SHARE = 0.001

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Photo:
    """One photo as later stages need to know it.

    Attributes:
        name: path relative to its folder, with forward slashes.
        width: columns as stored; as people see them where `orientation` is 1.
        height: rows, likewise.
        sha256: of the file's bytes.
        latitude_deg: WGS84 latitude from EXIF, geo.txt or a video's subtitles, or None.
        longitude_deg: WGS84 longitude, likewise.
        altitude_m: altitude, likewise.
        focal_px: focal length that EXIF's 35 mm equivalent gives, or None.
        camera: maker and model from EXIF, and the digital zoom where there is one, or "".
        orientation: EXIF orientation; 1 is upright.
        horizontal_sd_m: standard deviation of the position, east and north, from XMP or geo.txt, or None.
        vertical_sd_m: of the altitude, likewise.
        focal_mm: EXIF's focal length as it is, or None.
        position_note: why there is no position though EXIF or XMP give one, or what was assumed of it, or "".
        unused_bits: leading bits of its pixels, of 8 or 16, that are 0 in all but a few hot ones.
        cropped: whether EXIF gives the size of a picture of another shape; its principal point may be anywhere then.
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
    position_note: str = ""
    unused_bits: int = 0
    cropped: bool = False

    @property
    def has_gps(self) -> bool:
        """Whether a position is known."""
        return self.latitude_deg is not None and self.longitude_deg is not None


def orientations_in(content: Mapping[str, Any]) -> dict[str, int]:
    """The EXIF orientation that photos had before they were stood upright, by name, from the content of photos.json."""
    turned: dict[str, int] = value(content, "turned") if "turned" in content else {}
    return turned


def bits_to_stretch(photos: list[Photo]) -> int:
    """By how many bits the pixels of all photos are shifted to the left, so that the brightest has all of its bits."""
    unused = min((photo.unused_bits for photo in photos), default=0)
    return unused if unused >= MIN_UNUSED_BITS else 0


def unused_bits(pixels: NDArray[Any]) -> int:
    """Leading bits of pixels of 8 or 16 bits that are 0 in all but a few hot ones."""
    brightest = int(np.quantile(pixels[::4, ::4], 1 - HOT_SHARE, method="lower"))
    return 8 * pixels.itemsize - max(brightest.bit_length(), 1)


def stays(folder: Path, photo: Photo, bits: int) -> bool:
    """Whether a photo's file is used as it is: upright, not to be made brighter, and in a format that COLMAP reads."""
    with open_picture(folder / photo.name) as image:
        return photo.orientation == 1 and not bits and image.format in FORMATS


def save_upright(folder: Path, photo: Photo, target: Path, bits: int = 0, max_width_px: int | None = None) -> Photo:
    """Write a photo as people see it, its pixels shifted by some bits, at most `max_width_px` wide; as it is then."""
    path = folder / photo.name
    with open_picture(path) as image:
        exif = Image.Exif()
        exif.update({tag: text for tag in (Base.Make, Base.Model) if (text := exif_text(image.getexif().get(tag)))})
        equivalent_mm = 36.0 * (photo.focal_px or 0.0) / max(photo.width, photo.height)
        focal = {Base.FocalLength: photo.focal_mm, Base.FocalLengthIn35mmFilm: min(round(equivalent_mm), 65535)}
        exif[IFD.Exif] = {tag: number for tag, number in focal.items() if number}
        upright = ImageOps.exif_transpose(brightened(image, path, bits) if bits else image)
        width, height = upright.size
        if max_width_px is not None and width > max_width_px:
            size = max_width_px, max(round(height * max_width_px / width), 1)
            upright = upright.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
        # libtiff, which compresses, does not write this EXIF; a PNG may be called JPEG.
        coded: dict[str, Any] = {"compression": "raw"}
        if target.suffix.lower() in JPEG:
            upright = upright if upright.mode in ("L", "RGB", "CMYK") else upright.convert("RGB")
            coded = {"quality": JPEG_QUALITY, "subsampling": 0}
        upright.save(target, exif=exif.tobytes(), **coded)
    focal_px = photo.focal_px and photo.focal_px * max(upright.size) / max(width, height)
    seen: dict[str, Any] = {"width": upright.width, "height": upright.height, "sha256": sha256(target)}
    return replace(photo, **seen, focal_px=focal_px, orientation=1, unused_bits=photo.unused_bits - bits)


def brightened(image: Image.Image, path: Path, bits: int) -> Image.Image:
    """A picture, opened by Pillow, its pixels shifted by some bits and 8 of them kept."""
    brighter = Image.fromarray(stretched(pixels_of(image, path), bits))
    brighter.getexif()[Base.Orientation] = image.getexif().get(Base.Orientation, 1)
    return brighter


def has_16_bits(path: Path) -> bool:
    """Whether a picture's pixels are of 16 bits; Pillow drops half of those of colours."""
    with open_picture(path) as image:
        return image.mode.startswith("I;16") or ";16" in str(getattr(image, "tile", ""))


def pixels_of(image: Image.Image, path: Path) -> NDArray[Any]:
    """(H, W) or (H, W, 3) RGB pixels of a picture, opened by Pillow, of 8 or 16 bits: as stored, or as people see them
    where the picture forgets then how it is turned."""
    if image.mode.startswith("I;16"):
        return np.asarray(image)
    if has_16_bits(path):
        return np.ascontiguousarray(read_raw(path)[..., 2::-1])
    return np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"))


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
    with open_picture(folder / name) as image:
        exif = image.getexif()
        # Decoding a TIFF turns it upright and forgets the tag.
        orientation = exif_number(exif.get(Base.Orientation)) or 1
        xmp = image.info.get("xmp", b"")
        xmp = xmp if isinstance(xmp, bytes) else str(xmp).encode()
        position, note = stated_position(exif.get_ifd(IFD.GPSInfo), xmp)
        taken = exif.get_ifd(IFD.Exif)
        equivalent_mm, focal_mm = (
            max(exif_number(taken.get(tag)) or 0.0, 0.0) for tag in (Base.FocalLengthIn35mmFilm, Base.FocalLength)
        )
        if b"BandName" in xmp and len(image.getbands()) == 1:
            raise ValueError("it is one band of a multispectral camera, and no photo in colours")
        # The widest cameras take pictures of 65 to 24; 6 is what iPhones write into panoramas.
        panorama = b"GPano:ProjectionType" in xmp or taken.get(Base.CustomRendered) == 6
        if panorama or max(image.size) > 3 * min(image.size):
            raise ValueError("it is a panorama, to which no lens is fitted: cut it into views")
        if image.mode in ("F", "I"):
            raise ValueError("its pixels are 32-bit measurements, as a thermal camera's, and no picture")
        bits = unused_bits(pixels_of(image, folder / name))
        # It crops what the lens shows, and focal lengths in EXIF often do not count it; 0 is for none.
        zoom = f"{exif_number(taken.get(Base.DigitalZoomRatio)) or 1:.2f}"
        width, height = image.size
        # Either way round, for programs that turn a photo may leave these as they were.
        across, down = (int(exif_number(taken.get(tag)) or 0) for tag in (Base.ExifImageWidth, Base.ExifImageHeight))
        cropped = across * down > 0 and not any(same_shape(image.size, s) for s in ((across, down), (down, across)))
        return Photo(
            name,
            width,
            height,
            sha256(folder / name),
            # A 35 mm frame is 36 mm wide; COLMAP takes its prior from the longer side in the same way.
            focal_px=None if cropped else equivalent_mm / 36.0 * max(width, height) or None,
            cropped=cropped,
            camera=f"{exif_text(exif.get(Base.Make))} {exif_text(exif.get(Base.Model))}".strip()
            + (f" zoomed {zoom} times" if zoom != "1.00" else ""),
            orientation=int(orientation) if orientation in range(1, 9) else 1,
            focal_mm=focal_mm or None,
            position_note=note,
            unused_bits=bits,
            **asdict(position),
        )


def each_photo(function: Callable[[Item], Result], photos: Iterable[Item]) -> list[Result]:
    """What a function gives for each photo or name, in parallel.

    Raises:
        StageError: of the first photo that it fails for, which names the others.
    """

    def tried(photo: Item) -> Result | StageError:
        try:
            return function(photo)
        except StageError as error:
            return error

    photos = list(photos)
    with ThreadPoolExecutor(threads()) as pool:
        found = list(pool.map(tried, photos))
    names = [photo.name if isinstance(photo, Photo) else str(photo) for photo in photos]
    bad = [(name, error) for name, error in zip(names, found) if isinstance(error, StageError)]
    if bad:
        more = f"; nor can {', '.join(name for name, _ in bad[1:6])}" if len(bad) > 1 else ""
        raise StageError(f"{bad[0][1]}{more}{f' and {len(bad) - 6} more' if len(bad) > 6 else ''}")
    return [result for result in found if not isinstance(result, StageError)]


def below_folder(names: list[str]) -> list[str]:
    """A note where photos (paths below their folder) lie in folders below it: previews and masks may be among them."""
    return [f"{in_folders(names)}"] if any("/" in name for name in names) else []


def photo_notes(photos: list[Photo], bits: int) -> list[str]:
    """What a person should know about photos: odd sizes, odd positions, and pixels that were shifted by some bits."""
    sizes = {(p.width, p.height) for p in photos}
    notes = [f"the photos have {len(sizes)} different sizes"] if len(sizes) > 1 else []
    odd = [p for p in photos if p.position_note]
    if odd:
        notes.append(f"the GPS positions of {len(odd)} photos: {odd[0].position_note} (of {odd[0].name}, for one)")
    if cropped := sum(p.cropped for p in photos):
        notes.append(f"{cropped} photos were cropped, by the size in EXIF: each has a principal point of its own")
    return notes + stretch_notes(bits)


def stretch_notes(bits: int) -> list[str]:
    """A note on pixels that were shifted by some bits."""
    why = f"the photos are dark, or have fewer bits than their files: pixels are {2**bits} times as bright here"
    return [why] if bits else []


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

    A missing altitude is NaN; so is one of exactly 0, which receivers write that have none.
    """
    known = [p for p in photos if p.has_gps]
    rows = [(p.latitude_deg, p.longitude_deg, p.altitude_m or np.nan) for p in known]
    return [p.name for p in known], np.array(rows, dtype=np.float64).reshape(-1, 3)


def gps_accuracies(photos: list[Photo], otherwise_m: float) -> NDArray[np.float64]:
    """(N, 2) standard deviations in metres, horizontal and vertical, of the photos that have a position."""
    known = [(p.horizontal_sd_m, p.vertical_sd_m) for p in photos if p.has_gps]
    return np.array([[h or otherwise_m, v or h or otherwise_m] for h, v in known]).reshape(-1, 2)
