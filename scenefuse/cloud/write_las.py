"""LAS and LAZ 1.4 written: whole clouds or in parts, in steps as fine as the points need."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import MAX_STEP, Cloud, file_names, spacing
from scenefuse.cloud.readers.las import LAS_DIMENSIONS
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.version import VERSION

# What fields mean, in the header of a LAS file: 32 bytes at most.
LAS_DESCRIPTIONS = {
    "source": "0 scene, n the n-th object",
    "photos": "photos that confirm the point",
    "match": "their mean correlation, -1 to 1",
    "deviation": "sd on the line of sight",
    "world_deviation": "the same with the pose's",
    "evidence": "1 measured, 4 plain; others not",
}
# Fields that are lengths, in the unit of the points.
LENGTHS = {"deviation", "world_deviation"}


def write_laz(path: Path, cloud: Cloud, origin: NDArray[np.float64], crs: Any) -> None:
    """Write LAZ 1.4, coordinates to a millimetre, or finer where the points ask for it; without a CRS to 1e-8 of the
    cloud's diagonal.

    Args:
        path: output, .laz or .las.
        cloud: with the axes of the CRS, relative to `origin`, which is added.
        origin: (3,) coordinates of the cloud's local origin.
        crs: anything pyproj understands, "EPSG:32632" for instance; None when the coordinates are in no CRS.
    """
    ends = cloud.points.min(0, initial=np.inf), cloud.points.max(0, initial=-np.inf)
    ends, apart = ends if len(cloud) else (np.zeros(3), np.zeros(3)), spacing(cloud.points)
    layout = LasLayout.of(path, cloud, ends, origin, crs, apart)
    with las_writer(path, layout.header) as writer:
        writer.write_points(layout.records(cloud))


@dataclass(frozen=True)
class LasLayout:
    """How points are written as LAS 1.4: steps, offsets, CRS and further columns.

    Attributes:
        header: with the columns, the steps and the CRS; counts and boxes are not filled in.
        names: what the clouds' fields are called in it.
        origin: (3,) coordinates of the clouds' local origin.
    """

    header: Any
    names: dict[str, str]
    origin: NDArray[np.float64]

    @classmethod
    def of(
        cls, path: Path, like: Cloud, box: tuple[NDArray[np.float64], NDArray[np.float64]],
        origin: NDArray[np.float64], crs: Any, apart: float,
    ) -> "LasLayout":  # fmt: skip
        """For clouds of `like`'s columns in a box between two corners (3,) relative to `origin`; much closer than a
        millimetre, points that lie `apart` ask for finer steps."""
        import laspy
        import pyproj

        header = laspy.LasHeader(point_format=6 if like.colors is None else 7, version="1.4")
        header.generating_software = f"scenefuse {VERSION}"
        low, high = box
        if crs is not None:
            step, offset = _step_of(path, np.maximum(np.abs(low), np.abs(high)), apart), np.floor(origin)
        else:  # LAS counts steps from the offset in 32 bits, and the points may lie anywhere
            step, offset = (float(np.linalg.norm(high - low)) or 1.0) * 1e-8, origin + (low + high) / 2
        header.scales, header.offsets = np.full(3, step), offset
        header.global_encoding.wkt = True  # LAS 1.4 asks it of these columns, with or without a CRS
        if crs is not None:
            named = pyproj.CRS.from_user_input(crs)
            header.add_crs(named)
            with suppress(pyproj.exceptions.CRSError):  # LAS asks for WKT 1, which does not know every CRS
                # Of axes that begin with the north PROJ writes none, and no longer knows the CRS.
                if pyproj.CRS.from_wkt(older := named.to_wkt("WKT1_GDAL")) == named:
                    header.vlrs.get("WktCoordinateSystemVlr")[0].string = older
        # Classes and intensities of LAS stay what they are; of other fields none takes their names.
        own = [name for name, kind in LAS_DIMENSIONS.items() if name in like.fields and like.fields[name].dtype == kind]
        further = [name for name in like.fields if name not in own]
        names = dict(zip(own, own)) | file_names(path, further, set(header.point_format.dimension_names))
        for name in further:
            values = like.fields[name]
            kind = f"{values.dtype.kind}{values.dtype.itemsize}"
            header.add_extra_dim(laspy.ExtraBytesParams(names[name], kind, LAS_DESCRIPTIONS.get(name, "")))
        return cls(header, names, origin)

    def records(self, part: Cloud) -> Any:
        """A `laspy.ScaleAwarePointRecord` of some points."""
        import laspy

        points = laspy.ScaleAwarePointRecord.zeros(len(part), header=self.header)
        points.x, points.y, points.z = (part.points + self.origin).T
        points.return_number = points.number_of_returns = np.ones(len(part), np.uint8)
        if part.colors is not None:
            points.red, points.green, points.blue = part.colors.astype(np.uint16).T * 257
        for name, values in part.fields.items():
            points[self.names[name]] = values
        return points


def finer(step: float, apart: float, fits: Callable[[float], bool]) -> float:
    """A step of coordinates, or the tenth of it, or of that, ..., that points which lie `apart` need, as far as `fits`
    says that integers count so far."""
    while step > MAX_STEP * apart > 0 and fits(step / 10):
        step /= 10
    return step


def _step_of(path: Path, farthest: NDArray[np.float64], apart: float) -> float:
    """A thousandth of the CRS's unit; less where points are dense; more where 32 bits do not count as far as strays
    lie.

    Args:
        path: for the note.
        farthest: (3,) largest distance from the origin along each axis; the factor of 4 is for turned axes and feet.
        apart: spacing of the points.
    """

    def fits(step: float) -> bool:
        return bool(4 * np.linalg.norm(farthest) / step < 1 << 31)

    step = finer(0.001, apart, fits)
    while not fits(step):
        step *= 10
    if step > 0.001:
        print(
            f"note: points lie up to {farthest.max():.3g} from the origin, so {path.name} counts in {step:g} of its"
            " CRS's unit: take these strays out of the scene's cloud, and it counts in 0.001",
            flush=True,
        )
    return step


@contextmanager
def las_writer(path: Path, header: Any) -> Iterator[Any]:
    """A `laspy.LasWriter` of a file that appears when all is written.

    Raises:
        StageError: the disk is full.
    """
    import laspy
    import lazrs

    with atomic_file(path) as temporary:
        try:
            with laspy.open(temporary, mode="w", header=header) as writer:
                yield writer
        except lazrs.LazrsError as error:  # it does not say why, and only writing can fail
            left = shutil.disk_usage(temporary.parent).free / 1e9
            raise StageError(
                f"{path} could not be written ({error}); {left:.3g} GB of its disk are free: free some space and run"
                " this again"
            ) from None
