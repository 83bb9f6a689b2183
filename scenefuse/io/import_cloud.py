"""A user's cloud or mesh in the place of photos: a scene's dense cloud, or an object's."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.io.clouds import Cloud, read_counted, spacing, write_cloud
from scenefuse.io.formats import las_crs
from scenefuse.stage import StageError, quantity, write_json
from scenefuse.transforms import Array, Sim3

# Fewer different points give no features to register by.
LEAST_POINTS = 200
# Positions below this share of the points, and above the same share, are strays: they do not move the origin.
STRAY_PERCENT = 1.0
# Normals may be this far from unit length.
UNIT_TOLERANCE = 0.05


def import_scene_cloud(*, source: Path, cloud: Path, report: Path, georeference_json: Path) -> None:
    """Take a cloud for a scene. The scene's frame has its axes, and z is up; its origin is near the points.

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, GLB) that points are drawn from.
        cloud: output PLY in the scene's frame.
        report: output JSON: points, spacing, notes.
        georeference_json: output JSON: `crs` (null where the file names none), `length_unit`, `origin_in_crs` and
            `crs_from_scene`, the shift back into the file's coordinates.

    Raises:
        StageError: the file is missing, damaged, in degrees, of an unknown ending, or has too few different points.
    """
    own, content = _imported(source)
    crs = las_crs(source)
    unit, name = "scene units", None
    if crs is not None:
        unit, name = unit_and_name(crs)
    origin = near_origin(own.points)
    shift = Sim3(1.0, np.eye(3), origin)
    placed = replace(own, points=own.points - origin)
    write_cloud(cloud, placed)
    write_json(report, _report(placed, unit, content) | {"backend": quantity("imported", "")})
    place = {
        "length_unit": quantity(unit, ""),
        "crs": quantity(name, ""),
        "origin_in_crs": quantity(origin, unit),
        "crs_from_scene": quantity(shift.matrix, unit),
    }
    write_json(georeference_json, place)


def import_object_cloud(*, source: Path, cloud: Path, report: Path) -> None:
    """Take a cloud for an object, in any frame and unit.

    Args:
        source: as of `import_scene_cloud`.
        cloud: output PLY; the file's axes and unit, relative to an origin near the points.
        report: output JSON: points, spacing, notes, and the shift `object_from_file`.

    Raises:
        StageError: as of `import_scene_cloud`.
    """
    own, content = _imported(source)
    origin = near_origin(own.points)
    placed = replace(own, points=own.points - origin)
    write_cloud(cloud, placed)
    shift = Sim3(1.0, np.eye(3), -origin)
    write_json(
        report, _report(placed, "object units", content) | {"object_from_file": quantity(shift.matrix, "object units")}
    )


def near_origin(points: Array) -> Array:
    """A round place (3,) near points (N, 3): their middle, rounded to the next power of ten above their extent.

    Relative to it, float32 is a hundredth of a millimetre in a hundred metres. Points near zero keep their coordinates.
    """
    low, middle, high = np.percentile(points, [STRAY_PERCENT, 50, 100 - STRAY_PERCENT], axis=0)
    step = 10.0 ** np.ceil(np.log10(max(float((high - low).max()), 1e-12)))
    return np.asarray(np.round(middle / step) * step + 0.0)


def _imported(source: Path) -> tuple[Cloud, dict[str, Any]]:
    """A user's cloud with unit normals or none and without further fields, and what became of the rest."""
    cloud, left_out = read_counted(source)
    different = len(np.unique(cloud.points, axis=0))
    if different < LEAST_POINTS:
        raise StageError(
            f"{source} has only {different} different positions among its {len(cloud)} points; {LEAST_POINTS} or more"
            " are needed to place it"
        )
    notes = [f"{left_out} rows without a finite position were left out"] if left_out else []
    normals = cloud.normals
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if (np.abs(length - 1) > UNIT_TOLERANCE).any():
            notes.append("its normals are not all of unit length and were left out: they are estimated from the points")
            normals = None
        else:
            normals = (normals / length).astype(np.float32)
    for note in notes:
        print(note, flush=True)
    if cloud.fields:
        print(f"not used: the columns {', '.join(sorted(cloud.fields))}", flush=True)
    content = {
        "source": quantity(source.name, ""),
        "columns_not_used": quantity(sorted(cloud.fields), ""),
        "has_colors": quantity(cloud.colors is not None, ""),
        "has_normals": quantity(normals is not None, ""),
        "notes": quantity(notes, ""),
    }
    return Cloud(cloud.points, normals, cloud.colors), content


def _report(cloud: Cloud, unit: str, content: dict[str, Any]) -> dict[str, Any]:
    return {
        "points": quantity(len(cloud), "1"),
        "spacing": quantity(spacing(cloud.points), unit),
        "diagonal": quantity(cloud.diagonal, unit),
    } | content


def unit_and_name(crs: str) -> tuple[str, str]:
    """The unit of a projected CRS, "m" for metres, and its name: an EPSG code where it has one, else its WKT."""
    import pyproj

    known = pyproj.CRS.from_user_input(crs)
    unit = known.axis_info[0].unit_name if known.axis_info else "metre"
    return "m" if unit in ("metre", "meter") else unit, known.to_string()
