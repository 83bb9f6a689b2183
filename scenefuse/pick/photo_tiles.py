"""Photos as the page shows them: upright, as a pyramid of tiles, and as thumbnails with their sharpness."""

import hashlib
import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ImageOps

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.photos.frames import sharpness
from scenefuse.photos.photo_files import open_picture
from scenefuse.photos.photos import MIN_UNUSED_BITS, brightened, has_16_bits, pixels_of, unused_bits

TILE_PX = 256
# Longer side of a thumbnail.
THUMBNAIL_PX = 320
# Longer side of the photos that masks are made and shown in; SAM 2 sees no more.
MASK_PX = 1024
# Beyond the photo's edges.
BACKGROUND = "#202020"

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


def read_upright(path: Path, min_px: int) -> Pixels:
    """(H, W, 3) uint8 RGB of a photo as people see it, as bright as the workflow makes photos that use few bits.

    Args:
        path: of the photo.
        min_px: the longer side may be smaller than the photo's, but not than this: a JPEG is then decoded faster.

    Raises:
        StageError: it cannot be read.
    """
    with open_picture(path) as stored:
        stored.draft("RGB", (min_px, min_px))
        bits = unused_bits(pixels_of(stored, path))
        image = brightened(stored, path, bits) if bits >= MIN_UNUSED_BITS or has_16_bits(path) else stored
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def at_most(pixels: Pixels, side_px: int) -> Pixels:
    """The picture, its longer side at most `side_px`."""
    scale = min(1.0, side_px / max(pixels.shape[:2]))
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return _resized(pixels, size) if scale < 1 else pixels


class Tiles:
    """Tiles of photos, cut from pyramids of those that were looked at last."""

    def __init__(self) -> None:
        # A decoded photo of 50 megapixels takes 200 MB.
        self._read, self._lock = lru_cache(3)(_pyramid), threading.Lock()

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
        # A JPEG gives a small copy of itself ten times as fast.
        coarse = next(k for k in range(picture.depth + 1) if max(picture.size_at(k)) <= MASK_PX or k == picture.depth)
        first = coarse if level >= coarse else 0
        # Each photo is read once, however many threads want it.
        with self._lock:
            pixels = self._read(picture, first)[level - first]
        part = pixels[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
        full = np.full((TILE_PX, TILE_PX, 3), tuple(bytes.fromhex(BACKGROUND[1:])), dtype=np.uint8)
        full[: part.shape[0], : part.shape[1]] = part
        return jpeg(full)


def _pyramid(picture: Picture, first: int) -> list[Pixels]:
    """A photo at its size halved `first` times, and so on down to a tile."""
    levels = [_resized(read_upright(picture.path, max(picture.size_at(first))), picture.size_at(first))]
    for level in range(first + 1, picture.depth + 1):
        levels.append(_resized(levels[-1], picture.size_at(level)))
    return levels


class Thumbnails:
    """Thumbnails and sharpness of photos, computed once and kept in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known = {path.stem.split("_")[0]: path for path in folder.glob("*_*.jpg")}
        self._failed: set[Path] = set()
        self._lock = threading.Lock()

    def get(self, picture: Picture) -> tuple[Path, float]:
        """The file of a photo's thumbnail, and how sharp the photo is (variance of the Laplacian).

        Raises:
            StageError: the photo cannot be read.
        """
        try:
            key = self._key(picture)
            if key not in self._known or not self._known[key].is_file():
                pixels = read_upright(picture.path, 2 * THUMBNAIL_PX)
                sharp = sharpness(np.ascontiguousarray(pixels[..., ::-1]))
                path = self._folder / f"{key}_{sharp:.2f}.jpg"
                with self._lock:
                    with atomic_file(path) as temporary:
                        temporary.write_bytes(jpeg(at_most(pixels, THUMBNAIL_PX)))
                    self._known[key] = path
        except (StageError, OSError) as error:
            self._failed.add(picture.path)
            raise StageError(str(error)) from None
        return self._known[key], float(self._known[key].stem.split("_")[1])

    def sharpness(self, picture: Picture) -> float | None:
        """How sharp a photo is, where that is known already."""
        try:
            path = self._known.get(self._key(picture))
        except OSError:
            return None
        return None if path is None else float(path.stem.split("_")[1])

    def is_missing(self, picture: Picture) -> bool:
        """Whether a thumbnail is still to be made."""
        return picture.path not in self._failed and self.sharpness(picture) is None

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
    return cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes()


def _resized(pixels: Pixels, size: tuple[int, int]) -> Pixels:
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
