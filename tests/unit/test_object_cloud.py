"""Fusing depth maps of a sphere into a cloud; cleaning; the sentences for bad input."""

import tracemalloc

import numpy as np
import pytest
from support.painted_sphere import CENTER, RADIUS, sphere_views
from support.textured_plane import plane_views

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import StageError
from scenefuse.nerf.object_cloud import (
    CloudGates,
    CloudInputs,
    CloudSettings,
    SurfaceMaps,
    clean,
    fuse_depths,
    make_object_cloud,
    read_maps,
    with_plane_normals,
)
from scenefuse.photos.pictures import write_depth, write_normals
from scenefuse.photos.views import Views

SETTINGS = CloudSettings(min_views=3, spacing=0.01, gates=CloudGates(point_agreement=0.02, min_component=0.02))


def _views():
    images, masks, k, poses, depths = sphere_views()
    empty = [np.zeros(0, np.int64)] * len(images)
    names = [f"{i}.png" for i in range(len(images))]
    held_out = np.zeros(len(images), bool)
    mattes = masks.astype(np.uint8) * 255
    views = Views(names, images, mattes, np.zeros(mattes.shape, bool), k, poses, held_out, np.zeros((0, 3)), empty)
    return views, depths.astype(np.float32)


def test_fused_points_lie_on_the_sphere_and_floaters_are_carved():
    views, depths = _views()
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(views.masks[0])
    spoiled = rng.choice(len(rows), 60, replace=False)
    damaged = depths.copy()
    damaged[0, rows[spoiled], columns[spoiled]] *= 0.8
    normals = np.zeros((*depths.shape, 3), np.float16)
    maps = SurfaceMaps(damaged, ((depths > 0) * 0.8).astype(np.float32), normals)
    cloud, diagonal = fuse_depths(views, maps, SETTINGS)
    distance = np.abs(np.linalg.norm(cloud.points - CENTER, axis=1) - RADIUS)
    assert len(cloud) > 1000
    assert distance.max() < 0.02 * diagonal
    assert np.median(distance) < 0.005 * diagonal
    assert cloud.fields["views"].min() >= 3 and cloud.fields["views"].dtype == np.int32
    assert cloud.colors is not None and cloud.normals is not None
    outward = (cloud.points - CENTER) / RADIUS
    planes = with_plane_normals(cloud).normals
    assert np.median((planes * outward).sum(1)) > 0.98


def test_maps_are_read_into_their_places_without_a_second_copy_of_all(tmp_path):
    views, depths = _views()
    sure = np.where(np.indices(depths.shape)[2] > 20, 0.9, 0.1).astype(np.float32)
    normals = np.random.default_rng(0).normal(size=(*depths.shape, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=3, keepdims=True)
    for k, name in enumerate(views.names):
        write_depth(tmp_path / f"depth_maps/{name}.bin", depths[k] + 1)
        write_depth(tmp_path / f"confidence_maps/{name}.bin", sure[k])
        # One smaller than its picture.
        write_normals(tmp_path / f"normal_maps/{name}.bin", normals[k] if k else normals[k, :40, :30])
    assert views.masks.any()
    tracemalloc.start()
    maps = read_maps(tmp_path, views, 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    held = maps.depths.nbytes + maps.confidence.nbytes + maps.normals.nbytes
    assert peak < 1.4 * held and held <= 14 * depths.size
    np.testing.assert_array_equal(maps.depths, np.where(views.masks & (sure > 0.5), depths + 1, 0))
    np.testing.assert_allclose(maps.normals[1:], normals[1:], atol=1e-3)
    assert maps.normals[0, :40, :30].any() and not maps.normals[0, 40:].any() and not maps.normals[0, :, 30:].any()


def test_cleaning_drops_a_small_group_and_far_points():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    island = grid[:4] + [100.0, 0.0, 0.0]
    far_off = np.array([[10.0, 10.0, 60.0]])
    cleaned = clean(Cloud(np.concatenate([grid, island, far_off])), 0.02, 1.0)
    assert len(cleaned) == len(grid) and cleaned.points[:, 2].max() == 0 and cleaned.points[:, 0].max() < 20


def test_what_close_ups_do_not_show_stays_beside_what_they_do():
    """A statue's body, with pixels ten times as large as those of its head."""
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), -1).reshape(-1, 3)
    body, stray = 10 * grid[:800] + [45.0, 0, 0], np.array([[100.0, 100, 90]])
    points, pixel = np.concatenate([grid, body, stray]), np.repeat([1.0, 10.0, 10.0], [len(grid), len(body), 1])
    cleaned = clean(Cloud(points, fields={"pixel": pixel}), 0.02, 1.0)
    assert len(cleaned) == len(points) - 1 and cleaned.points[:, 2].max() == 0 and not cleaned.fields


def test_photos_from_afar_make_the_points_of_close_ups_no_less_exact():
    def error(distances):
        views, depths = plane_views(12, 160, 120, distances=distances)
        depths = (depths * (1 + 0.002 * np.random.default_rng(0).normal(size=depths.shape))).astype(np.float32)
        maps = SurfaceMaps(depths, np.ones_like(depths), np.zeros((*depths.shape, 3), np.float16))
        points = fuse_depths(views, maps, CloudSettings())[0].points
        x, y, z = points[(np.abs(points[:, :2]) < 0.05).all(1)].T
        return np.sqrt(((z - 3 - 0.3 * x) ** 2).mean())

    assert error((3.0, 0.3)) < 2 * error((0.3,))


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(StageError, match="model.pt does not exist; run the NeRF stage first"):
        make_object_cloud(
            inputs=CloudInputs(
                workspace=tmp_path,
                workspace_json=tmp_path / "undistorted.json",
                masks=tmp_path,
                stage=tmp_path / "stage4",
                stage_json=tmp_path / "stage4.json",
            ),
            cloud=tmp_path / "object.ply",
            report=tmp_path / "object.json",
            settings=SETTINGS,
            seed=0,
        )
    assert not (tmp_path / "object.ply").exists()
