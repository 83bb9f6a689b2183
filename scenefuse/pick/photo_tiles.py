"""Photos as the page shows them: upright, as a pyramid of tiles, and as thumbnails with their sharpness."""

import hashlib
import math
import threading
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.photos.frames import sharpness

TILE_PX = 256
THUMB_PX = 320
"""Longer side of a thumbnail."""
COARSE_PX = 1280
"""Tiles of levels no larger than this are cut from a copy that a JPEG gives ten times as fast as itself."""
PYRAMIDS, COARSE_PYRAMIDS = 2, 30
"""Photos kept decoded, 200 MB each at 50 megapixels, and coarse copies, 5 MB each."""
JPEG_QUALITY = 88
BACKGROUND = 32
"""Grey value beyond the photo's edges, as the page has it."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Picture:
    """A photo that may be shown.

    Attributes:
        name: as tables name it.
        path: of the file.
        width, height: the pixels that clicks are in.
        scale: pixels of the file per pixel that clicks are in; 1 but for frames of a video that were scaled down.
    """

    name: str
    path: Path
    width: int
    height: int
    scale: float = 1.0

    @property
    def depth(self) -> int:
        """Zoom at which a pixel of the file is one of the screen, where the whole world of zoom 0 is one tile."""
        return max(0, math.ceil(math.log2(max(self.width, self.height) * self.scale / TILE_PX)))

    def size_at(self, level: int) -> tuple[int, int]:
        """Width and height of the file's picture halved so often."""
        sides = (round(self.width * self.scale) / 2**level, round(self.height * self.scale) / 2**level)
        return max(1, math.ceil(sides[0])), max(1, math.ceil(sides[1]))

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude (degrees) of a pixel, in Web Mercator: the map widget's own coordinates, which make a
        pyramid of tiles exact."""
        world = TILE_PX * 2**self.depth / self.scale
        return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * y / world)))), 360 * x / world - 180

    def pixel(self, latitude: float, longitude: float) -> tuple[float, float]:
        """The pixel of a place; the inverse of `place`."""
        world = TILE_PX * 2**self.depth / self.scale
        return (longitude + 180) / 360 * world, (1 - math.asinh(math.tan(math.radians(latitude))) / math.pi) / 2 * world


def read_upright(path: Path, least_px: int | None = None) -> Pixels:
    """(H, W, 3) uint8 RGB of a photo as people see it.

    Args:
        path: of the photo.
        least_px: the longer side may be smaller than the photo's, but not than this: a JPEG is then decoded faster.
    """
    try:
        # By handle: opened by name, Pillow 13 scrambles rotated TIFF files that are not RGB.
        with open(path, "rb") as file, Image.open(file) as stored:
            if least_px is not None:
                stored.draft("RGB", (least_px, least_px))
            image = ImageOps.exif_transpose(stored)
            # Sixteen-bit grey is not scaled by Pillow's conversion.
            if image.mode.startswith("I;16"):
                image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise StageError(f"{path} cannot be read as a picture ({error}); replace it, or take it away") from None


def at_most(pixels: Pixels, side_px: int) -> Pixels:
    """The picture, its longer side at most `side_px`."""
    scale = min(1.0, side_px / max(pixels.shape[:2]))
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8) if scale < 1 else pixels


class Tiles:
    """Tiles of photos, cut from pyramids of those that were looked at last."""

    def __init__(self) -> None:
        self._fine, self._coarse = _Kept(PYRAMIDS), _Kept(COARSE_PYRAMIDS)

    def tile(self, picture: Picture, zoom: int, column: int, row: int) -> bytes:
        """A tile of 256 x 256 pixels, as JPEG; grey beyond the photo's right and lower edge.

        Raises:
            IndexError: the photo has no such tile.
            StageError: it cannot be read.
        """
        if not 0 <= zoom <= picture.depth or column < 0 or row < 0:
            raise IndexError
        level = picture.depth - zoom
        width, height = picture.size_at(level)
        if column * TILE_PX >= width or row * TILE_PX >= height:
            raise IndexError
        first = next(k for k in range(picture.depth + 1) if max(picture.size_at(k)) <= COARSE_PX or k == picture.depth)
        if level >= first > 0:
            pixels = self._coarse.get(picture, first)[level - first]
        else:
            pixels = self._fine.get(picture, 0)[level]
        part = pixels[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
        full = np.full((TILE_PX, TILE_PX, 3), BACKGROUND, dtype=np.uint8)
        full[: part.shape[0], : part.shape[1]] = part
        return jpeg(full)


class _Kept:
    """Pyramids of the photos that were asked for last; each is read once, whoever asks."""

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, threading.Lock()
        self._pyramids: OrderedDict[Path, list[Pixels]] = OrderedDict()
        self._reading: dict[Path, threading.Lock] = {}

    def get(self, picture: Picture, first: int) -> list[Pixels]:
        """A photo at its size halved `first` times, and so on down to a tile."""
        with self._lock:
            reading = self._reading.setdefault(picture.path, threading.Lock())
        with reading:
            levels = self._pyramids.get(picture.path)
            if levels is None:
                levels = [_resized(read_upright(picture.path, max(picture.size_at(first))), picture.size_at(first))]
                for level in range(first + 1, picture.depth + 1):
                    levels.append(_resized(levels[-1], picture.size_at(level)))
            with self._lock:
                self._pyramids[picture.path] = levels
                self._pyramids.move_to_end(picture.path)
                while len(self._pyramids) > self._most:
                    self._pyramids.popitem(last=False)
            return levels


class Thumbnails:
    """Thumbnails and sharpness of photos, computed once and kept in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known = {path.stem.split("_")[0]: path for path in folder.glob("*_*.jpg")}
        self._failed: set[Path] = set()
        self._lock = threading.Lock()

    def fail(self, picture: Picture) -> None:
        """Note that a photo cannot be read."""
        self._failed.add(picture.path)

    def failed(self, picture: Picture) -> bool:
        """Whether it could not be read."""
        return picture.path in self._failed

    def get(self, picture: Picture) -> tuple[Path, float]:
        """The file of a photo's thumbnail, and how sharp the photo is (variance of the Laplacian).

        Raises:
            StageError: the photo cannot be read.
        """
        key = self._key(picture)
        if key not in self._known:
            pixels = read_upright(picture.path, 2 * THUMB_PX)
            sharp = sharpness(np.ascontiguousarray(pixels[..., ::-1]))
            path = self._folder / f"{key}_{sharp:.2f}.jpg"
            with self._lock:
                with atomic_file(path) as temporary:
                    temporary.write_bytes(jpeg(at_most(pixels, THUMB_PX)))
                self._known[key] = path
        return self._known[key], float(self._known[key].stem.split("_")[1])

    def sharpness(self, picture: Picture) -> float | None:
        """How sharp a photo is, where that is known already."""
        try:
            path = self._known.get(self._key(picture))
        except OSError:
            return None
        return None if path is None else float(path.stem.split("_")[1])

    def sharpest_first(self, pictures: Iterable[Picture]) -> list[Picture]:
        """The photos, those first whose sharpness is known, from sharp to blurred."""
        known = {p.name: self.sharpness(p) for p in pictures}
        return sorted(pictures, key=lambda p: (known[p.name] is None, -(known[p.name] or 0.0), p.name))

    def _key(self, picture: Picture) -> str:
        state = picture.path.stat()
        about = f"{picture.path.resolve()}\0{state.st_size}\0{state.st_mtime_ns}"
        return hashlib.sha256(about.encode()).hexdigest()[:24]


def jpeg(pixels: Pixels) -> bytes:
    """RGB pixels as JPEG."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), options)[1].tobytes()


def _resized(pixels: Pixels, size: tuple[int, int]) -> Pixels:
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
