"""Point clouds in memory and on disk: any known format in; PLY with float64 positions, LAS and LAZ with a CRS out."""

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree

from scenefuse.cloud.formats import LAS_DIMENSIONS, bytes_of, read_columns
from scenefuse.cloud.readers.columns import COLOR, NORMAL, POSITION, Columns, positions
from scenefuse.core.stage import StageError, atomic_file, threads
from scenefuse.core.transforms import Sim3
from scenefuse.core.version import VERSION

LAS_DESCRIPTIONS = {
    "source": "0 scene, n the n-th object",
    "photos": "photos that confirm the point",
    "match": "their mean correlation, -1 to 1",
    "deviation": "sd on the line of sight",
    "world_deviation": "the same with the pose's",
    "evidence": "1 measured; 0, 2, 3 not (README)",
}
"""What fields mean, in the header of a LAS file: 32 bytes at most."""
LENGTHS = {"deviation", "world_deviation"}
"""Fields that are lengths, in the unit of the points."""


FAR = 10.0
"""Sizes of a cloud; what lies so far from it is none of it."""


STEP_SPACINGS = 0.25
"""Of the spacing of points, from which the steps of their coordinates show."""


NEIGHBOURS, ALONE, LONELY, FEW = 8, 0.02, 10.0, 0.1
"""Of `strays`: neighbours of a point; how far they are from a lonely one, of the diagonal and beside most points; the
largest share of all points that strays are."""


EVENLY, COARSE = 0.02, 0.25
"""Of `strays`, in sizes of the box: the cubes in which a point counts once; those in which more points than a lonely
one has neighbours are a part of the cloud, and by which a box has to grow."""


AT_ONCE = 1 << 18
"""Points whose neighbours are held at once."""


COINCIDING = 0.1
"""Share of points that lie where others do, from which it is told."""


UNIT_TOLERANCE = 0.05
"""Normals may be this far from unit length."""


@dataclass(frozen=True)
class Cloud:
    """A point cloud in one frame.

    Attributes:
        points: (N, 3) float64 positions.
        normals: (N, 3) float32 unit vectors, or None.
        colors: (N, 3) uint8 RGB, or None.
        fields: further values per point, name -> (N,) array (`source`, `confidence`, `views`, ...).
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | None = None
    fields: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: NDArray[Any]) -> "Cloud":
        """The points that a mask or an index array selects."""
        return Cloud(
            self.points[index],
            None if self.normals is None else self.normals[index],
            None if self.colors is None else self.colors[index],
            {name: values[index] for name, values in self.fields.items()},
        )

    def transformed(self, b_from_a: Sim3) -> "Cloud":
        """The same points in frame b; normals turn, fields stay."""
        normals = None if self.normals is None else b_from_a.rotate(self.normals).astype(np.float32)
        return replace(self, points=b_from_a.apply(self.points), normals=normals)

    @property
    def diagonal(self) -> float:
        """Length of the axis-aligned bounding box's diagonal."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0))) if len(self) else 0.0


def concatenate(clouds: list[Cloud]) -> Cloud:
    """One cloud after the other; normals, colours and fields are kept where every cloud has them."""
    names = set.intersection(*(set(c.fields) for c in clouds))
    normals = [c.normals for c in clouds if c.normals is not None]
    colors = [c.colors for c in clouds if c.colors is not None]
    return Cloud(
        np.concatenate([c.points for c in clouds]),
        np.concatenate(normals) if len(normals) == len(clouds) else None,
        np.concatenate(colors) if len(colors) == len(clouds) else None,
        {name: np.concatenate([c.fields[name] for c in clouds]) for name in sorted(names)},
    )


def voxel_downsample(cloud: Cloud, voxel: float, mean_colors: bool = False) -> Cloud:
    """One point per occupied voxel: the one nearest to the voxel's mean, so that every field stays a measured value.

    With `mean_colors` its colour is the mean of the voxel's: for pictures, where one in many would be a speckle.
    """
    if len(cloud) == 0:
        return cloud
    group, counts = _voxels(cloud.points, voxel)
    means = _group_means(cloud.points, group, counts)
    distance = ((cloud.points - means[group]) ** 2).sum(1)
    order = np.lexsort((distance, group))
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chosen = np.sort(order[first])
    kept = cloud[chosen]
    if mean_colors and cloud.colors is not None:
        colors = np.rint(_group_means(cloud.colors, group, counts)[group[chosen]])
        kept = replace(kept, colors=colors.astype(cloud.colors.dtype))
    return kept


def voxel_average(cloud: Cloud, voxel: float) -> Cloud:
    """One point per occupied voxel: the mean of its points, normals and colours, less noisy than any of them.

    Normals whose mean vanishes (two sides of a thin sheet) are those of one of the points. Fields are left out.
    """
    group, counts = _voxels(cloud.points, voxel)
    normals, colors = cloud.normals, cloud.colors
    if normals is not None:
        mean = _group_means(normals, group, counts)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        anyone = normals[np.unique(group, return_index=True)[1]]
        normals = np.where(length > 0.2, mean / np.maximum(length, 1e-12), anyone).astype(np.float32)
    if colors is not None:
        colors = np.rint(_group_means(colors, group, counts)).astype(np.uint8)
    return Cloud(_group_means(cloud.points, group, counts), normals, colors)


def occupied_voxels(points: NDArray[np.float64], voxel: float) -> int:
    """How many points `voxel_downsample` would leave."""
    return len(_voxels(points, voxel)[1])


def _voxels(points: NDArray[np.float64], voxel: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The occupied voxel of every point (N,), numbered from 0, and the points in each."""
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cells.max(0) + 1
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, group, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return group, counts


def _group_means(rows: NDArray[Any], group: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.stack([np.bincount(group, rows[:, k]) / counts for k in range(rows.shape[1])], axis=1)


def spacing(points: NDArray[np.float64], sample: int = 5000, seed: int = 0, quantile: float = 0.5) -> float:
    """Median (or other quantile) distance from a point to its nearest neighbour elsewhere, by a seeded sample; 0 where
    all are in one place. Of points that coincide, as in a scan that was merged twice, one counts."""
    distance = _to_nearest(points, sample, seed)
    if np.count_nonzero(distance == 0) > COINCIDING * len(distance):
        distance = _to_nearest(np.unique(points, axis=0), sample, seed)
    distance = distance[distance > 0]
    return float(np.quantile(distance, quantile)) if len(distance) else 0.0


def _to_nearest(points: NDArray[np.float64], sample: int = 5000, seed: int = 0) -> NDArray[np.float64]:
    """Distances from some of (N, 3) points to their nearest neighbours; none for one point."""
    if len(points) < 2:
        return np.zeros(0)
    chosen = np.random.default_rng(seed).choice(len(points), min(sample, len(points)), replace=False)
    return np.asarray(cKDTree(points).query(points[chosen], k=2)[0][:, 1])


def plane_normals(points: NDArray[np.float64], neighbours: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals (M, 3) of the planes through rows (M, K) of points (N, 3), on either side."""
    local = points[neighbours]
    local = local - local.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]


def sampled(points: NDArray[np.float64], most: int, seed: int) -> NDArray[np.float64]:
    """At most that many of (N, 3) points, drawn evenly."""
    return points if len(points) <= most else points[sampled_rows(len(points), most, seed)]


def sampled_rows(count: int, most: int, seed: int) -> NDArray[np.int64]:
    """At most that many of `count` rows, drawn evenly."""
    if count <= most:
        return np.arange(count)
    return np.random.default_rng(seed).choice(count, most, replace=False)


def read_cloud(path: Path) -> Cloud:
    """Read PLY, LAS, LAZ, E57, PCD, text (XYZ, PTS, TXT, ASC, CSV), or a mesh (PLY, OBJ, GLB) as points on its faces.

    Rows without a finite position are left out.

    Raises:
        StageError: the file is missing, damaged, of an unknown ending, or holds no points.
    """
    return read_counted(path)[0]


def read_counted(path: Path) -> tuple[Cloud, int]:
    """`read_cloud`, and how many rows without a finite position were left out."""
    columns, left_out = finite_rows(read_columns(Path(path)))
    if left_out:
        count = left_out + len(columns["x"])
        print(f"{path}: {left_out} of {count} rows have no finite position and are left out", flush=True)
        if left_out == count:
            raise StageError(f"{path} holds no point with a finite position; look at what wrote it")
    return cloud_of(columns), left_out


def finite_rows(columns: Columns) -> tuple[Columns, int]:
    """The rows with a finite position, and how many were left out."""
    return chosen_rows(columns, np.isfinite(np.stack([columns[k] for k in POSITION])).all(0))


def chosen_rows(columns: Columns, chosen: NDArray[np.bool_]) -> tuple[Columns, int]:
    """Some rows (a mask (N,)), and how many are left out."""
    if chosen.all():
        return columns, 0
    return {name: values[chosen] for name, values in columns.items()}, int(np.sum(~chosen))


def is_nothing_at_zero(others: NDArray[np.float64]) -> bool:
    """Whether points at 0 0 0 are none of a cloud, as all its other points (N, 3) but strays lie far from there:
    scanners write so what returned nothing."""
    if not len(others):
        return False
    low, high = np.percentile(others, [1, 99], axis=0)
    away = np.linalg.norm(np.maximum(np.maximum(low, -high), 0))
    return bool(away > FAR * np.linalg.norm(high - low))


def strays(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of (N, 3) points lie far from all others, N as many as one looks through at once.

    Outside the box around most of them, grown by its size on each side; or with the eighth neighbour farther away than
    2 % of that box's diagonal, and ten times as far as the median of points on an even grid, so that a part which was
    measured densely does not stand for all. None, if they are many.
    """
    low, high, near, together = _box_of_most(points)
    far, size = np.ones(len(points), dtype=bool), float((high - low).max())
    far[near] = False
    if len(near) > NEIGHBOURS and size:
        tree, parts = cKDTree(points[near]), np.array_split(points[near], 1 + len(near) // AT_ONCE)
        away = np.concatenate([tree.query(part, k=NEIGHBOURS + 1, workers=threads())[0][:, -1] for part in parts])
        evenly = voxel_downsample(Cloud(points[near], fields={"away": away})[together], EVENLY * size)
        usual = float(np.median(evenly.fields["away"])) if len(evenly) else np.inf
        far[near] = away > max(ALONE * float(np.linalg.norm(high - low)), LONELY * usual)
    return far if far.mean() <= FEW else np.zeros(len(points), dtype=bool)


def _box_of_most(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Corners (3,) of the box around most of (N, 3) points, the rows (M,) in the box grown by its size on each side,
    and which of these lie among others.

    It begins as that of the middle 98 %, which may all lie in a part that was measured densely; while there are clearly
    larger ones, it becomes the box of those in the grown box that lie among others.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    while True:
        size = float((high - low).max())
        near = np.flatnonzero(((points >= low - size) & (points <= high + size)).all(1))
        group, counts = _voxels(points[near], COARSE * size or 1.0)
        together = counts[group] > NEIGHBOURS
        part = points[near[together]]
        ends = part.min(0, initial=np.inf), part.max(0, initial=-np.inf)
        if np.maximum(low - ends[0], ends[1] - high).max() <= COARSE * size:
            return low, high, near, together
        low, high = np.minimum(low, ends[0]), np.maximum(high, ends[1])


def without_strays(cloud: Cloud, what: str) -> tuple[Cloud, list[str]]:
    """The cloud without its strays, and a note, if there are any, in which the cloud is called `what`."""
    far = strays(cloud.points)
    if not far.any():
        return cloud, []
    return cloud[np.flatnonzero(~far)], [f"{far.sum()} points of {what}, far from all others, are left out"]


def has_unit_normals(cloud: Cloud) -> bool:
    """Whether all normals have unit length; other ones say nothing of the surface."""
    return cloud.normals is None or bool((np.abs(np.linalg.norm(cloud.normals, axis=1) - 1) <= UNIT_TOLERANCE).all())


def precision_note(path: Path, points: NDArray[np.float64], step: float) -> list[str]:
    """What to say of coordinates in single precision, whose steps are not small beside the spacing `step`."""
    farthest = float(np.abs(points).max(initial=0))
    coarse = float(np.spacing(np.float32(farthest)))
    if coarse < STEP_SPACINGS * step or not (points == points.astype(np.float32)).all():
        return []
    return [
        f"{path.name} has coordinates up to {farthest:.6g} in single precision, which knows them in steps of"
        f" {coarse:.3g}, and its points are {step:.3g} apart: export it in double precision, or shifted to near zero"
    ]


def coincidence_note(path: Path, points: NDArray[np.float64]) -> list[str]:
    """What to say of a file where many of (N, 3) points lie in the place of others."""
    distance = _to_nearest(points)
    same = np.count_nonzero(distance == 0) / max(len(distance), 1)
    if same <= COINCIDING:
        return []
    return [
        f"{same:.0%} of the points of {path.name} lie exactly where others do, as in a scan that was merged twice or"
        " was written in too coarse steps: their spacing is that between different places"
    ]


def cloud_of(columns: Columns, most_color: float | None = None) -> Cloud:
    """The cloud of a file's columns; `most_color` is the greatest colour of the whole file where this is a part."""
    normals = np.stack([columns[k] for k in NORMAL], axis=1) if set(NORMAL) <= set(columns) else None
    colors = np.stack([columns[k] for k in COLOR], axis=1) if set(COLOR) <= set(columns) else None
    return Cloud(
        positions(columns),
        None if normals is None else np.nan_to_num(normals.astype(np.float32)),
        None if colors is None else bytes_of(colors, most_color),
        {name: values for name, values in columns.items() if name not in {*POSITION, *NORMAL, *COLOR}},
    )


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write a binary PLY atomically: positions as float64, normals float32, colours uint8, fields as they are.

    PLY allows no spaces in a field's name: they become underscores.
    """
    vertex = records_of(cloud, path)
    with atomic_file(path) as temporary:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(temporary)


def records_of(cloud: Cloud, path: Path) -> NDArray[Any]:
    """(N,) rows of a PLY, as `write_cloud` has them; `path` is for the note of a field that is called otherwise."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.points.astype(np.float64).T))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.astype(np.float32).T))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colors.astype(np.uint8).T))
    names = _file_names(path, list(cloud.fields), set(columns))
    for name, values in cloud.fields.items():
        # PLY knows no integers of 64 bits; a float64 holds them up to 2^53.
        columns[names[name]] = values.astype(np.float64) if values.dtype in (np.int64, np.uint64) else values
    vertex = np.empty(len(cloud), dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        vertex[name] = values
    return vertex


def write_laz(path: Path, cloud: Cloud, origin: NDArray[np.float64], crs: str | None) -> None:
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
    with laz_in_parts(path, cloud, ends, origin, crs, apart) as append:
        append(cloud)


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
        origin: NDArray[np.float64], crs: str | None, apart: float,
    ) -> "LasLayout":  # fmt: skip
        """For clouds of `like`'s columns; see `laz_in_parts`."""
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
            header.add_crs(pyproj.CRS.from_user_input(crs))
        # Classes and intensities of LAS stay what they are; of other fields none takes their names.
        own = [name for name, kind in LAS_DIMENSIONS.items() if name in like.fields and like.fields[name].dtype == kind]
        further = [name for name in like.fields if name not in own]
        names = dict(zip(own, own)) | _file_names(path, further, set(header.point_format.dimension_names))
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
    while step > STEP_SPACINGS * apart > 0 and fits(step / 10):
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
def laz_in_parts(
    path: Path, like: Cloud, box: tuple[NDArray[np.float64], NDArray[np.float64]], origin: NDArray[np.float64],
    crs: str | None, apart: float = np.inf,
) -> Iterator[Callable[[Cloud], None]]:  # fmt: skip
    """`write_laz` for clouds of any size: gives a function that appends a part.

    Args:
        path: output, .laz or .las; it appears when all parts are written.
        like: a cloud, perhaps empty, with the columns that all parts have.
        box: two opposite corners (3,) of a box around all points, relative to `origin`.
        origin: see `write_laz`.
        crs: see `write_laz`.
        apart: spacing of the points; much closer than a millimetre it asks for finer steps.

    Raises:
        StageError: the disk is full.
    """
    layout = LasLayout.of(path, like, box, origin, crs, apart)
    with las_writer(path, layout.header) as writer:
        yield lambda part: writer.write_points(layout.records(part))


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


def _file_names(path: Path, names: list[str], taken: set[str]) -> dict[str, str]:
    """What fields are called in a file: PLY separates by blanks, both formats know ASCII alone, LAS 32 letters."""
    called: dict[str, str] = {}
    for name in names:
        plain = wanted = re.sub(r"[^!-~]+", "_", name)[:32]
        number = 1
        while plain in taken or plain in called.values():
            plain, number = f"{wanted[:28]}_{'' if number == 1 else number}", number + 1
        called[name] = plain
    changed = [f"'{name}' is '{plain}'" for name, plain in called.items() if name != plain]
    if changed:
        print(f"note: in {path.name}, the column {', '.join(changed)}", flush=True)
    return called
