import sys

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from scenefuse.cloud import cloud_file, clouds
from scenefuse.cloud.cloud_file import CloudFile, normals_fault, strays
from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, spacing, voxel_downsample, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.surface import normals_at


def cloud(count: int = 50) -> Cloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    return Cloud(
        rng.uniform(0, 1, (count, 3)) + [500_000.123456, 5_572_094.155, 300.0],
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        {"source": np.arange(count, dtype=np.uint8), "confidence": rng.random(count).astype(np.float32)},
    )


def test_ply_keeps_every_bit(tmp_path):
    before = cloud()
    write_cloud(tmp_path / "a.ply", before)
    after = read_cloud(tmp_path / "a.ply")
    assert np.array_equal(before.points, after.points)
    assert np.array_equal(before.normals, after.normals) and np.array_equal(before.colors, after.colors)
    assert np.array_equal(before.fields["source"], after.fields["source"])
    assert after.fields["source"].dtype == np.uint8


def test_fields_have_names_that_cloudcompare_loads_and_older_names_are_read(tmp_path):
    write_cloud(tmp_path / "a.ply", cloud())
    content = (tmp_path / "a.ply").read_bytes()
    assert b"property uchar scalar_source\n" in content and b"property double x\n" in content
    (tmp_path / "a.ply").write_bytes(content.replace(b"scalar_source", b"source"))
    assert set(read_cloud(tmp_path / "a.ply").fields) == {"source", "confidence"}


def test_laz_round_trip_at_utm_coordinates_is_a_millimetre(tmp_path):
    import laspy

    local = Cloud(cloud().points - [500_000, 5_572_094.155, 300.0], None, cloud().colors, cloud().fields)
    write_laz(tmp_path / "a.laz", local, np.array([500_000, 5_572_094.155, 300.0]), "EPSG:32632")
    las = laspy.read(tmp_path / "a.laz")
    assert np.abs(np.stack([las.x, las.y, las.z], axis=1) - cloud().points).max() <= 1e-3
    assert las.header.parse_crs().to_epsg() == 32632
    assert np.array_equal(las["source"], cloud().fields["source"])
    described = las.header.point_format.dimension_by_name("source").description
    assert described == "0 scene, n the n-th object"


def test_columns_of_any_name_are_written_and_the_new_names_told(tmp_path, capsys):
    rows, long = cloud(3).points, "a name that is longer than thirty-two letters"
    fields = {
        name: np.arange(3.0) + k for k, name in enumerate(["scan angle", "scan_angle", "Höhe", long, "scan  angle"])
    }
    write_cloud(tmp_path / "a.ply", Cloud(rows, fields=fields))
    assert "'scan angle' is 'scan_angle'" in capsys.readouterr().out
    after = read_cloud(tmp_path / "a.ply")
    names = ["scan_angle", "scan_angle_", "H_he", "a_name_that_is_longer_than_thirt", "scan_angle_2"]
    assert np.array_equal(after.points, rows) and list(after.fields) == names
    assert [after.fields[name][0] for name in names] == [0, 1, 2, 3, 4]
    write_laz(tmp_path / "a.laz", Cloud(rows, fields=fields), np.zeros(3), None)
    assert len(CloudFile.of(tmp_path / "a.laz").part.fields) == 5


@pytest.mark.parametrize("content", [b"not a cloud", b"ply\nformat ascii 1.0\nend_header\n"])
def test_unreadable_cloud_is_named(tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(StageError, match=r"bad\.ply"):
        read_cloud(tmp_path / "bad.ply")
    with pytest.raises(StageError, match="does not exist"):
        read_cloud(tmp_path / "none.ply")


def test_voxel_downsample_keeps_measured_points_one_per_voxel():
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    points = np.concatenate([grid, grid + 0.01, grid - 0.01])
    thin = voxel_downsample(Cloud(points + 0.5, fields={"index": np.arange(len(points))}), 1.0)
    assert len(thin) == 64
    assert np.array_equal(points[thin.fields["index"]] + 0.5, thin.points)


def test_spacing_of_a_grid_is_its_step():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.25] * 3), axis=-1).reshape(-1, 3)
    assert spacing(grid) == pytest.approx(0.25)


def test_of_points_that_coincide_the_spacing_is_that_between_different_places():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.25] * 3), axis=-1).reshape(-1, 3)
    assert spacing(np.concatenate([grid, grid])) == pytest.approx(0.25)
    fine = np.random.default_rng(0).random((20_000, 3)) * [1, 1, 0]
    assert spacing(np.round(fine, 1)) == pytest.approx(0.1)
    assert spacing(np.concatenate([grid, grid[:5]]), quantile=0.0) == pytest.approx(0.25)
    assert spacing(np.zeros((9, 3))) == spacing(grid[:1]) == 0


def on_sphere(count, radius, middle, rng):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * radius + middle


@pytest.mark.slow
def test_a_sparse_body_under_a_dense_head_is_none_of_the_strays_which_still_are():
    rng = np.random.default_rng(0)
    head = on_sphere(300_000, 0.12, [0, 0, 1.7], rng)
    body = on_sphere(5500, [0.3, 0.2, 0.8], [0, 0, 0.8], rng)
    lost = np.array([[0, 0, 90.0], [5, -9, 2], [5, -9, 2.1], [-3, 0, 1], [0.5, 0.9, 0.1]])
    found = strays(np.concatenate([head, body, lost]))
    assert not found[: -len(lost)].any() and found[-len(lost) :].all()


def test_scattered_points_around_an_even_surface_are_strays():
    rng = np.random.default_rng(0)
    surface, scattered = on_sphere(30_000, 1.0, 0.0, rng), rng.uniform(-4, 4, (300, 3))
    off = np.abs(np.linalg.norm(scattered, axis=1) - 1)
    found = strays(np.concatenate([surface, scattered]))
    assert not found[:30_000].any() and found[30_000:][off > 0.3].all()


def test_transform_turns_normals_and_keeps_fields():
    quarter = Sim3(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    one = Cloud(np.array([[1.0, 0, 0]]), np.array([[1, 0, 0]], dtype=np.float32), None, {"views": np.array([3])})
    moved = one.transformed(quarter)
    assert np.allclose(moved.points, [[0, 2, 0]]) and np.allclose(moved.normals, [[0, 1, 0]])
    assert moved.fields["views"] == [3]


def test_concatenate_keeps_what_all_clouds_have():
    joined = concatenate(
        [cloud(), Cloud(cloud(3).points, colors=cloud(3).colors, fields={"source": np.ones(3, np.uint8)})]
    )
    assert len(joined) == 53 and joined.normals is None and joined.colors is not None
    assert list(joined.fields) == ["source"]


def test_a_laz_in_a_crs_has_steps_as_fine_as_its_points_are_dense(tmp_path):
    grid = np.stack(np.meshgrid(*[np.arange(20) * 0.0005] * 2, [0.0]), axis=-1).reshape(-1, 3)
    for name, times, step in (("fine", 1, 0.0001), ("coarse", 100, 0.001)):
        write_laz(tmp_path / f"{name}.laz", Cloud(grid * times), np.array([5e5, 5.5e6, 300]), "EPSG:32632")
        assert laspy.open(tmp_path / f"{name}.laz").header.scales == pytest.approx([step] * 3)


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
def test_a_laz_file_that_does_not_fit_is_one_sentence_and_leaves_nothing(tmp_path):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(StageError, match=r"a\.laz could not be written .* GB of its disk are free: free"):
            write_laz(tmp_path / "a.laz", Cloud(np.random.default_rng(0).random((200_000, 3))), np.zeros(3), None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_downsampled_cloud_may_have_the_mean_colors_of_its_voxels():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [0.2, 0.1, 0.1], [5.0, 0, 0]])
    colors = np.array([[0, 0, 0], [90, 60, 30], [30, 0, 0], [7, 8, 9]], np.uint8)
    thin, mean = (voxel_downsample(Cloud(points, colors=colors), 1.0, mean_colors) for mean_colors in (False, True))
    assert thin.colors.tolist() == [[30, 0, 0], [7, 8, 9]] and mean.colors.tolist() == [[40, 20, 10], [7, 8, 9]]
    np.testing.assert_array_equal(thin.points, mean.points)


def test_of_a_dense_cloud_few_points_are_asked_for_their_neighbours(monkeypatch):
    """Of 50 million points each is a quarter of an hour."""
    asked = list[int]()

    class Counting(cKDTree):
        def query(self, x, *further, **named):
            asked.append(len(x))
            return super().query(x, *further, **named)

    for module in (cloud_file, clouds):
        monkeypatch.setattr(module, "cKDTree", Counting, raising=False)
    rng = np.random.default_rng(0)
    surface = np.column_stack([rng.uniform(0, 10, (100_000, 2)), rng.normal(0, 0.01, 100_000)])
    found = strays(np.concatenate([surface, rng.uniform(2, 9, (20, 3))]))
    assert not found[:-20].any() and found[-20:].all() and 0 < sum(asked) < 10_000


def test_normals_that_face_either_side_are_told_from_those_that_all_face_in_or_out():
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    of_planes = normals_at(points, points)  # fitted, and turned to no side
    at_random = points * np.random.default_rng(1).choice([-1, 1], (3000, 1))
    few = np.where(np.arange(3000)[:, None] % 20, points, -points)
    faults = ((points, ""), (-points, ""), (few, ""), (of_planes, "side"), (at_random, "side"), (0 * points, "length"))
    for normals, fault in faults:
        found = normals_fault(Cloud(points, normals.astype(np.float32)))
        assert fault in found and bool(fault) == bool(found)
    assert normals_fault(Cloud(points[:1], points[:1].astype(np.float32))) == normals_fault(Cloud(points)) == ""
