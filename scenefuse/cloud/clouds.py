"""Point clouds in memory: any known format in, PLY with float64 positions out (LAS: write_las)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.cloud.formats import columns_in_parts
from scenefuse.cloud.readers.columns import (
    AT_ONCE,
    COLOR,
    MAX_ODD_SHARE,
    NORMAL,
    POSITION,
    Columns,
    bytes_of,
    colors_of,
    joined,
    positions,
)
from scenefuse.cloud.readers.ply import Element, header_of
from scenefuse.core.stage import StageError, atomic_file, threads
from scenefuse.core.transforms import Array, Sim3

# Share of the spacing of points, from which the steps of their coordinates show.
MAX_STEP = 0.25
# Neighbours of a point that has company.
NEIGHBOURS = 8
# A point is dropped where the mean distance of its neighbours, in pixels of its photo, is more than so many times the
# cloud's median.
OUTLIER_RATIO = 4.0


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
    def known_normals(self) -> NDArray[np.float32]:
        """(N, 3) the normals of a cloud that was given some."""
        assert self.normals is not None
        return self.normals

    @cached_property
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
    group, counts = voxels(cloud.points, voxel)
    means = _group_means(cloud.points, group, counts)
    distance = ((cloud.points - means[group]) ** 2).sum(1)
    least = np.full(len(counts), np.inf)
    np.minimum.at(least, group, distance)
    nearest = np.flatnonzero(distance == least[group])
    chosen = nearest[np.sort(np.unique(group[nearest], return_index=True)[1])]
    kept = cloud[chosen]
    if mean_colors and cloud.colors is not None:
        colors = np.rint(_group_means(cloud.colors, group, counts)[group[chosen]])
        kept = replace(kept, colors=colors.astype(cloud.colors.dtype))
    return kept


def voxel_average(cloud: Cloud, voxel: float) -> Cloud:
    """One point per occupied voxel: the mean of its points, normals and colours, less noisy than any of them.

    Normals whose mean vanishes (two sides of a thin sheet) are those of one of the points. Fields are left out.
    """
    group, counts = voxels(cloud.points, voxel)
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
    return len(voxels(points, voxel)[1])


def voxels(points: NDArray[np.float64], voxel: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The occupied voxel of every point (N,), numbered from 0, and the points in each."""
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cells.max(0) + 1
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, group, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return group, counts


def _group_means(rows: NDArray[Any], group: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.stack([np.bincount(group, rows[:, k]) / counts for k in range(rows.shape[1])], axis=1)


def within(points: NDArray[np.float64], others: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """(N,) which of (N, D) points have one of (M, D) others within reach."""
    away = cKDTree(others).query(points, distance_upper_bound=np.nextafter(reach, np.inf), workers=threads())[0]
    return np.isfinite(away)


def near_others(points: Array, pixel: Array | float = 1.0) -> NDArray[np.bool_]:
    """(N,) True where a point's neighbours are about as near as they are for the others, in sizes of its pixel (N,)."""
    if len(points) <= NEIGHBOURS:
        return np.ones(len(points), dtype=bool)
    tree, distance = cKDTree(points), np.empty(len(points))
    for rows in np.array_split(np.arange(len(points)), -(-len(points) // AT_ONCE)):
        distance[rows] = tree.query(points[rows], k=NEIGHBOURS + 1, workers=threads())[0][:, 1:].mean(1)
    distance /= pixel
    return distance <= OUTLIER_RATIO * np.median(distance)


def spacing(points: NDArray[np.float64], seed: int = 0, quantile: float = 0.5, cell: float = 0.0) -> float:
    """Median (or other quantile) distance from a point to its nearest neighbour elsewhere, by a seeded sample; 0 where
    all are in one place. Of points that coincide, as in a scan that was merged twice, one counts; of the points in a
    cell, where its edge is given, too: then what was measured densely does not stand for all."""
    distance = _to_nearest(points, seed, cell)
    if np.count_nonzero(distance == 0) > MAX_ODD_SHARE * len(distance):
        distance = _to_nearest(np.unique(points, axis=0), seed, cell)
    distance = distance[distance > 0]
    return float(np.quantile(distance, quantile)) if len(distance) else 0.0


def _to_nearest(points: NDArray[np.float64], seed: int = 0, cell: float = 0.0) -> NDArray[np.float64]:
    """Distances from up to 5000 of (N, 3) points, of one in each cell, to their nearest neighbours; none for one
    point."""
    if len(points) < 2:
        return np.zeros(0)
    one = np.unique(voxels(points, cell)[0], return_index=True)[1] if cell else np.arange(len(points))
    chosen = np.random.default_rng(seed).choice(one, min(5000, len(one)), replace=False)
    return np.asarray(quick_tree(points).query(points[chosen], k=2)[0][:, 1])


def quick_tree(points: NDArray[np.float64]) -> cKDTree:
    """A tree of (N, 3) points that is built in a third of the time: for few queries."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def parts(points: NDArray[np.float64], link: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The connected part of each point, of points closer than about `link`, and how many points each part has."""
    cells, cell_of = np.unique(np.floor(points / link).astype(np.int64), axis=0, return_inverse=True)
    touching = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), shape=(len(cells), len(cells)))
    part_of = connected_components(graph, directed=False)[1][cell_of.ravel()]
    return part_of, np.bincount(part_of)


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
    """Read PLY, LAS, LAZ, E57, PCD, text (XYZ, PTS, TXT, ASC, CSV), or a mesh (PLY, OBJ, glTF) as points on its faces.

    Rows without a finite position are left out. `CloudFile` has more of what a user's file may need.

    Raises:
        StageError: the file is missing, damaged, of an unknown ending, or holds no points.
    """
    path = Path(path)
    columns, left_out = finite_rows(joined(columns_in_parts(path)()))
    count = left_out + len(columns["x"])
    if not count:
        raise StageError(f"{path} holds no points; look at what wrote it")
    if left_out:
        print(f"{path}: {left_out} of {count} rows have no finite position and are left out", flush=True)
        if left_out == count:
            raise StageError(f"{path} holds no point with a finite position; look at what wrote it")
    return cloud_of(columns)


def finite_rows(columns: Columns) -> tuple[Columns, int]:
    """The rows with a finite position, and how many were left out."""
    return chosen_rows(columns, np.isfinite(np.stack([columns[k] for k in POSITION])).all(0))


def chosen_rows(columns: Columns, chosen: NDArray[np.bool_]) -> tuple[Columns, int]:
    """Some rows (a mask (N,)), and how many are left out."""
    if chosen.all():
        return columns, 0
    return {name: values[chosen] for name, values in columns.items()}, int(np.sum(~chosen))


def precision_note(path: Path, points: NDArray[np.float64], step: float) -> list[str]:
    """What to say of coordinates in single precision, whose steps are not small beside the spacing `step`."""
    farthest = float(np.abs(points).max(initial=0))
    coarse = float(np.spacing(np.float32(farthest)))
    if not step or coarse < MAX_STEP * step or not (points == points.astype(np.float32)).all():
        return []
    return [
        f"{path.name} has coordinates up to {farthest:.6g} in single precision, which knows them in steps of"
        f" {coarse:.3g}, and its points are {step:.3g} apart: export it in double precision, or shifted to near zero"
    ]


def coincidence_note(path: Path, points: NDArray[np.float64]) -> list[str]:
    """What to say of a file where many of (N, 3) points lie in the place of others."""
    distance = _to_nearest(points)
    same = np.count_nonzero(distance == 0) / max(len(distance), 1)
    if same <= MAX_ODD_SHARE:
        return []
    return [
        f"{same:.0%} of the points of {path.name} lie exactly where others do, as in a scan that was merged twice or"
        " was written in too coarse steps: their spacing is that between different places"
    ]


def cloud_of(columns: Columns, white: float | None = None) -> Cloud:
    """The cloud of a file's columns; `white` is the number of white in the whole file where this is a part."""
    normals = np.stack([columns[k] for k in NORMAL], axis=1) if set(NORMAL) <= set(columns) else None
    colors = colors_of(columns)
    return Cloud(
        positions(columns),
        None if normals is None else np.nan_to_num(normals.astype(np.float32)),
        None if colors is None else bytes_of(colors, white),
        {name: values for name, values in columns.items() if name not in {*POSITION, *NORMAL, *COLOR}},
    )


def write_cloud(path: Path, cloud: Cloud, comments: Sequence[str] = ()) -> None:
    """Write a binary PLY atomically: positions as float64, normals float32, colours uint8, fields as they are.

    Fields are `scalar_NAME` in it. PLY allows no spaces in a name: they become underscores. Comments are lines of its
    header.
    """
    vertex = records_of(cloud, path)
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        file.write(header_of([Element("vertex", len(vertex), vertex.dtype)], comments))
        file.write(vertex.tobytes())


def records_of(cloud: Cloud, path: Path) -> NDArray[Any]:
    """(N,) rows of a PLY, as `write_cloud` has them; `path` is for the note of a field that is called otherwise."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.points.astype(np.float64).T))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.astype(np.float32).T))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colors.astype(np.uint8).T))
    names = file_names(path, list(cloud.fields), set(columns))
    for name, values in cloud.fields.items():
        # PLY knows no integers of 64 bits; a float64 holds them up to 2^53.
        columns[names[name]] = values.astype(np.float64) if values.dtype in (np.int64, np.uint64) else values
    vertex = np.empty(len(cloud), dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        vertex[name] = values
    return vertex


def file_names(path: Path, names: list[str], taken: set[str]) -> dict[str, str]:
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
