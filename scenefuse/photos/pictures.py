"""Pictures on disk, their pixels as they are stored, and maps of depth, normals and confidence in COLMAP's binary
format, which its own tools read."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.photos.photo_files import JPEG, open_picture

# Grey levels (one standard deviation) that a photo's pixels are off at least.
NOISE = 1.5
# Loses nothing that SIFT or a mask would notice.
JPEG_QUALITY = 97
# Photos and cameras differ in shape by no more than what rounding to whole pixels does.
SHAPE_TOLERANCE = 0.01
# Cameras belong to the pixels as they are stored; photos are turned upright once, when they enter (photos.photos).
_STORED = cv2.IMREAD_IGNORE_ORIENTATION


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB; StageError when the file is missing or no picture."""
    return np.asarray(cv2.cvtColor(_read(path, cv2.IMREAD_COLOR | _STORED), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_gray(path: Path) -> NDArray[np.uint8]:
    """(H, W) uint8; StageError when the file is missing or no picture."""
    return np.asarray(_read(path, cv2.IMREAD_GRAYSCALE | _STORED), dtype=np.uint8)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W), True above 127; StageError when the file is missing or no picture."""
    return read_gray(path) > 127


def read_raw(path: Path) -> NDArray[Any]:
    """The picture with its depth, channels (BGR, BGRA) and alpha as stored; StageError when it cannot be read."""
    return _read(path, cv2.IMREAD_UNCHANGED)


def matte_of(picture: NDArray[Any]) -> NDArray[np.bool_]:
    """A mask picture as (H, W) bool: alpha where it divides the picture, else brightness, above half its largest value.

    Raises:
        StageError: most of what it shows is grey, as of a photo, cut out on black or not, or it has areas of several
            values or colours, as of labels: of two where these are as bright as each other.
    """
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() <= picture[..., 3].max() / 2:
        picture = picture[..., 3]
    elif picture.ndim == 3:
        picture = picture[..., :3]
    channel = picture.max(2) if picture.ndim == 3 else picture
    top = max(1, channel.max())
    mask, shades = np.asarray(channel > top / 2), channel[::4, ::4] / top
    if (areas := _even_areas(picture, top)) > 2 - mask.all():
        raise StageError(f"it has areas of {areas} values, as labels of several things have: give the object's alone")
    grey, white = np.abs(shades - 0.5) < 0.4, shades >= 0.9
    # Soft edges are less: three times what is white of a mask feathered far, a fiftieth of the picture of a thin thing.
    if grey.mean() > np.clip(3 * white.mean(), 0.02, 0.5):
        raise StageError("it is no mask: most of what it shows is grey")
    return mask


def require_white_object(masks: Iterable[NDArray[np.bool_]], source: object) -> None:
    """StageError where most of some masks (H, W) are white along most of their edge and black in the middle."""
    borders = ((mask, np.concatenate([*mask[[0, -1]], *mask[:, [0, -1]].T])) for mask in masks)
    holes = [border.mean() > 0.5 and not mask[len(mask) // 2, mask.shape[1] // 2] for mask, border in borders]
    if 2 * np.sum(holes) > len(holes):
        raise StageError(f"the masks in {source} are black on the object; invert them: it has to be white")


def read_supplied_mask(file: Path, size: tuple[int, int], quarters: int = 0) -> NDArray[np.bool_]:
    """A mask (H, W), of any size, of a photo of this (width, height); turned by these clockwise quarters, as its photo
    was, where it has the shape of before, and by two in any case.

    Raises:
        StageError: it cannot be read, or is of another picture.
    """
    try:
        mask = matte_of(read_raw(file))
    except StageError as error:
        raise StageError(
            f"the mask {file} cannot be read ({str(error).split(';')[0]}); export it again as PNG, white on"
            " the object and black elsewhere"
        ) from None
    if quarters == 2 or quarters and same_shape(mask.shape, size) and not same_shape(mask.shape, size[::-1]):
        mask = np.rot90(mask, -quarters)
    (height, width), (photo_width, photo_height) = mask.shape, size
    if not same_shape((width, height), size):
        raise StageError(
            f"the mask {file} is {width} x {height} pixels, its photo {photo_width} x {photo_height}; export it at the"
            " photo's size"
        )
    return mask


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether pictures of these (width, height) may be copies of each other."""
    return bool(abs(one[0] / one[1] * other[1] / other[0] - 1) <= SHAPE_TOLERANCE)


def _even_areas(picture: NDArray[Any], top: int) -> int:
    """How many values or colours, told apart in fifteenths of the largest, fill areas: a 500th of a picture or more.

    Soft edges, and the noise of JPEG, are no areas: their neighbouring pixels differ."""
    planes = np.atleast_3d(picture)
    corner = planes[:-1, :-1]
    even = ((corner == planes[1:, :-1]) & (corner == planes[:-1, 1:]) & (corner == planes[1:, 1:])).all(2)
    steps = np.rint(corner[even] / top * 15).astype(np.int64) @ 16 ** np.arange(planes.shape[2])
    return int(np.count_nonzero(500 * np.bincount(steps) >= even.size))


def stretched(pixels: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Pixels of 8 or 16 bits, shifted to the left by some bits, as uint8; what is brighter than white is white."""
    shifted = pixels.astype(np.uint32) << bits >> 8 * (pixels.itemsize - 1)
    return np.minimum(shifted, 255).astype(np.uint8)


def write_picture(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write (H, W) grey or (H, W, 3) RGB pixels in the format of the path's suffix.

    Raises:
        StageError: OpenCV does not know the suffix.
        OSError: the file could not be written. (OpenCV itself writes a part of it on a full disk, and says nothing.)
    """
    path = Path(path)
    stored = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    jpeg = path.suffix.lower() in JPEG
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if jpeg else []
    try:
        content = cv2.imencode(JPEG[0] if jpeg else path.suffix, stored, options)[1]
    except cv2.error:
        raise StageError(f"{path} has an ending of no known picture; give .png or .jpg") from None
    path.write_bytes(content.tobytes())


def _read(path: Path, flags: int) -> NDArray[Any]:
    if not Path(path).is_file():
        raise StageError(f"{path} does not exist; rerun the stage that writes it")
    with open_picture(path) as image:
        kind, orientation = image.format, image.getexif().get(0x0112, 1)
    turned = orientation - 1 if kind == "TIFF" and orientation in range(1, 9) else 0
    # By name OpenCV reads no TIFF that lies on its side; all others it stands upright, whatever is asked.
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if pixels is None:
        raise StageError(f"{path} is no readable picture; rerun the stage that writes it")
    pixels = pixels[:: -1 if turned % 4 > 1 else 1, :: -1 if turned % 4 in (1, 2) else 1]
    return np.ascontiguousarray(pixels.swapaxes(0, 1) if turned > 3 else pixels)


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write an (H, W) float32 map of depths along the camera's z axis; 0 marks pixels without a depth."""
    _write_map(path, depth[None])


def _write_map(path: Path, planes: NDArray[np.float32]) -> None:
    """Write (C, H, W) as COLMAP does, which itself says nothing where the disk is full."""
    count, height, width = planes.shape
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(f"{width}&{height}&{count}&".encode() + np.ascontiguousarray(planes, dtype="<f4").tobytes())


def read_depth(path: Path) -> NDArray[np.float32]:
    """Read an (H, W) float32 map (depth or confidence); StageError when the file is missing or damaged."""
    return _read_map(path, 1)[..., 0]


def write_normals(path: Path, normals: NDArray[np.float32]) -> None:
    """Write an (H, W, 3) float32 map of unit normals in the camera frame; zeros mark pixels without a normal.

    COLMAP's files hold all x, then all y, then all z. pycolmap.NormalMap (4.2) takes and gives arrays in the order of
    the file, which mixes the three up, so it is not used here.
    """
    _write_map(path, np.moveaxis(normals, 2, 0))


def read_normals(path: Path) -> NDArray[np.float32]:
    """Read an (H, W, 3) float32 normal map; StageError when the file is missing or damaged."""
    return _read_map(path, 3)


def _read_map(path: Path, channels: int) -> NDArray[np.float32]:
    """Read an (H, W, channels) map. COLMAP's own reader takes what a file that is cut short lacks for zeros."""
    try:
        width, height, planes, values = path.read_bytes().split(b"&", 3)
        pixels = np.frombuffer(values, dtype="<f4").reshape(channels, int(height), int(width))
        if int(planes) != channels:
            raise ValueError(f"it has {int(planes)} channels, not {channels}")
    except FileNotFoundError:
        raise StageError(f"{path} does not exist; {_made_again(path)}") from None
    except (OSError, ValueError) as error:
        raise StageError(f"{path} is cut short or damaged ({error}); {_made_again(path)}") from None
    # A copy, which can be written to: kernels are compiled once more for arrays that cannot.
    return np.array(np.moveaxis(pixels, 0, 2), np.float32, order="C")


def _made_again(path: Path) -> str:
    """How to get the maps of a stage again; Snakemake looks at their folder, not into it."""
    stage = next((folder.parent for folder in path.parents if folder.name.endswith("_maps")), path.parent)
    return f"delete {stage} and run again"
