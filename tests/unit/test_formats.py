"""Cloud files of other programs: what was written comes back, in float64, or one sentence says why not."""

import sys

import laspy
import numpy as np
import open3d as o3d
import pye57
import pytest
from pye57 import libe57
from scipy.spatial.transform import Rotation
from support.cloud_files import UTM, write_e57, write_pcd

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.readers.columns import bytes_of
from scenefuse.cloud.readers.las import las_crs
from scenefuse.cloud.readers.text import read_text, text_notes
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError


@pytest.fixture
def cloud() -> Cloud:
    """40 points at UTM coordinates with sub-millimetre digits."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = rng.integers(0, 256, (40, 3)).astype(np.uint8)
    return Cloud(rng.uniform(0, 1, (40, 3)) + UTM, normals.astype(np.float32), colors)


@pytest.mark.parametrize("data", ["binary", "ascii"])
def test_pcd_keeps_doubles_colours_and_normals(tmp_path, cloud, data):
    write_pcd(tmp_path / "a.pcd", cloud, data)
    found = read_cloud(tmp_path / "a.pcd")
    assert np.array_equal(found.points, cloud.points) and np.array_equal(found.colors, cloud.colors)
    assert np.allclose(found.normals, cloud.normals, atol=1e-7)


def test_a_ply_of_text_keeps_the_digits_that_it_shows(tmp_path, cloud):
    """Many programs call a position of metres in UTM a float, and print it whole."""
    rows = "\n".join(f"{x:.4f} {y:.4f} {z:.4f} {k % 256}" for k, (x, y, z) in enumerate(cloud.points))
    names = "".join(f"property float {name}\n" for name in "xyz") + "property uchar label\n"
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 40\n{names}end_header\n{rows}\n")
    found = read_cloud(tmp_path / "a.ply")
    assert np.abs(found.points - cloud.points).max() < 1e-4
    assert found.fields["label"].tolist() == list(range(40)) and found.fields["label"].dtype == np.uint8


def test_compressed_pcd_reads_as_its_writer_reads_it(tmp_path):
    grid = np.stack(np.meshgrid(*[np.arange(16) / 8] * 3), axis=-1).reshape(-1, 3)
    written = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(grid))
    written.colors = o3d.utility.Vector3dVector(np.round(grid / 2 * 255) / 255)
    o3d.io.write_point_cloud(str(tmp_path / "a.pcd"), written, compressed=True)
    read = o3d.io.read_point_cloud(str(tmp_path / "a.pcd"))
    found = read_cloud(tmp_path / "a.pcd")
    assert (tmp_path / "a.pcd").stat().st_size < 8 * len(grid)
    assert np.array_equal(found.points, np.asarray(read.points))
    assert np.array_equal(found.colors, np.rint(np.asarray(read.colors) * 255))


def test_a_library_that_is_not_installed_is_no_fault_of_the_file(tmp_path, monkeypatch, cloud):
    write_e57(tmp_path / "a.e57", [(cloud.points, cloud.colors, None, None)])
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(ModuleNotFoundError, match="pye57"):
        read_cloud(tmp_path / "a.e57")


def test_e57_scans_are_moved_by_their_poses_and_joined(tmp_path, cloud):
    turn = Rotation.from_euler("xyz", [20, -30, 50], degrees=True)
    local = turn.inv().apply(cloud.points - UTM).astype(np.float32)
    x, y, z, w = turn.as_quat()
    scans = [(local[part], cloud.colors[part], np.array([w, x, y, z]), UTM) for part in (slice(0, 25), slice(25, 40))]
    write_e57(tmp_path / "a.e57", scans)
    found = read_cloud(tmp_path / "a.e57")
    assert np.abs(found.points - cloud.points).max() < 1e-6
    assert np.array_equal(found.colors, cloud.colors)


def test_e57_points_that_are_marked_invalid_are_left_out(tmp_path, cloud):
    state = (np.arange(40) % 4 == 0).astype(np.int8)
    still = np.array([1.0, 0, 0, 0])
    write_e57(tmp_path / "a.e57", [(cloud.points - UTM, cloud.colors, still, UTM)], cartesianInvalidState=state)
    found = read_cloud(tmp_path / "a.e57")
    assert np.array_equal(found.colors, cloud.colors[state == 0])


def test_intensities_of_e57_are_read(tmp_path, cloud):
    bright, still = np.linspace(0, 1, 40).astype(np.float32), np.array([1.0, 0, 0, 0])
    write_e57(tmp_path / "a.e57", [(cloud.points - UTM, cloud.colors, still, UTM)], intensity=bright)
    assert np.allclose(read_cloud(tmp_path / "a.e57").fields["intensity"], bright)


@pytest.mark.parametrize("most", [65535, 255, 1])
def test_e57_in_spherical_coordinates_with_colours_of_sixteen_bits_or_as_real_numbers(tmp_path, most):
    rng = np.random.default_rng(0)
    columns = {
        "sphericalRange": rng.uniform(1, 50, 30),
        "sphericalAzimuth": rng.uniform(-np.pi, np.pi, 30),
        "sphericalElevation": rng.uniform(-1.5, 1.5, 30),
        **{f"color{name}": rng.uniform(0, most, 30) for name in ("Red", "Green", "Blue")},
    }
    if most > 1:
        columns |= {name: np.rint(values) for name, values in columns.items() if name.startswith("color")}
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    image = file.image_file
    prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
    for name, values in columns.items():
        whole = name.startswith("color") and most > 255
        node = libe57.IntegerNode(image, 0, 0, 65535) if whole else libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)
        prototype.set(name, node)
        buffers.append(libe57.SourceDestBuffer(image, name, values, 30, True, True))
    scan = libe57.StructureNode(image)
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    file.data3d.append(scan)
    points.writer(buffers).write(30)
    file.close()
    found = read_cloud(tmp_path / "a.e57")
    x, y, z = found.points.T
    assert np.allclose(np.linalg.norm(found.points, axis=1), columns["sphericalRange"])
    assert np.allclose(np.arctan2(y, x), columns["sphericalAzimuth"])
    assert np.allclose(np.arcsin(z / columns["sphericalRange"]), columns["sphericalElevation"])
    assert np.array_equal(found.colors[:, 1], np.rint(columns["colorGreen"] * (255 / most)))


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_at_utm_coordinates_keeps_a_millimetre_and_its_crs(tmp_path, cloud, ending):
    near = Cloud(cloud.points - UTM, None, cloud.colors, {"intensity": np.linspace(0, 1, 40, dtype=np.float32)})
    write_laz(tmp_path / f"a.{ending}", near, UTM, "EPSG:32632")
    found = read_cloud(tmp_path / f"a.{ending}")
    assert np.abs(found.points - cloud.points).max() <= 0.5e-3 + 1e-9
    assert np.array_equal(found.colors, cloud.colors)
    assert np.array_equal(found.fields["intensity_"], near.fields["intensity"])
    assert las_crs(tmp_path / f"a.{ending}").to_epsg() == 32632


def test_las_without_colours_has_none_and_degrees_are_refused(tmp_path, cloud):
    write_laz(tmp_path / "a.las", Cloud(cloud.points - UTM), UTM, None)
    assert read_cloud(tmp_path / "a.las").colors is None and las_crs(tmp_path / "a.las") is None
    write_laz(tmp_path / "b.las", Cloud(cloud.points - UTM), np.zeros(3), "EPSG:4326")
    with pytest.raises(StageError, match=r"b\.las is in degrees"):
        read_cloud(tmp_path / "b.las")
    write_laz(tmp_path / "c.las", Cloud(cloud.points - UTM), UTM, "EPSG:3857+5703")
    with pytest.raises(StageError, match=r"c\.las is in Mercator's projection, whose metres are no metres"):
        read_cloud(tmp_path / "c.las")


def test_las_of_eight_bit_colours_is_not_darkened(tmp_path):
    las = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    las.x, las.y, las.z = np.random.default_rng(0).random((3, 5))
    las.red = las.green = las.blue = np.array([0, 50, 100, 200, 255], np.uint16)
    las.write(str(tmp_path / "a.las"))
    assert read_cloud(tmp_path / "a.las").colors[:, 0].tolist() == [0, 50, 100, 200, 255]


@pytest.mark.parametrize(
    ("ending", "above", "columns", "mark"),
    [
        ("xyz", "", "p", " "),
        ("xyz", "", "pc", " "),
        ("txt", "", "pcn", "\t"),
        ("asc", "", "pnc", " "),
        ("csv", "X,Y,Z,Red,Green,Blue\n", "pc", ","),
        ("csv", "exported by hand\nnx;ny;nz;x;y;z\n", "np", ";"),
        ("txt", "//X Y Z R G B Nx Ny Nz\n", "pcn", " "),
        ("pts", "40\n", "pic", " "),
        ("pts", "40\n", "pi", " "),
        ("xyz", "\n# a comment\n\n", "pc", "   "),
    ],
)
def test_text_of_any_layout(tmp_path, cloud, ending, above, columns, mark):
    parts = {"p": cloud.points, "c": cloud.colors, "n": cloud.normals, "i": np.arange(40)[:, None] - 20}
    rows = zip(*[parts[c].tolist() for c in columns])
    path = tmp_path / f"a.{ending}"
    path.write_text(above + "\n".join(mark.join(repr(v) for part in row for v in part) for row in rows) + "\n")
    found = read_cloud(path)
    assert np.array_equal(found.points, cloud.points)
    assert (found.colors is not None) == ("c" in columns) and (found.normals is not None) == ("n" in columns)
    assert found.colors is None or np.array_equal(found.colors, cloud.colors)
    assert ("intensity" in found.fields) == ("i" in columns)
    assert found.normals is None or np.array_equal(found.normals, cloud.normals)


@pytest.mark.parametrize(("order", "where"), [("pic", "5 to 7"), ("pci", "4 to 6")])
def test_an_intensity_before_or_behind_the_colours_is_told_from_them(tmp_path, order, where):
    rng = np.random.default_rng(0)
    points, grey = rng.uniform(0, 9, (500, 3)), rng.uniform(30, 220, (500, 1))
    colors = np.rint(grey + rng.normal(0, 10, (500, 3))).clip(0, 255)
    parts = {"p": points, "c": colors, "i": np.rint(rng.uniform(0, 255, (500, 1)))}
    np.savetxt(tmp_path / "a.txt", np.hstack([parts[part] for part in order]), fmt="%.3f")
    assert np.array_equal(read_cloud(tmp_path / "a.txt").colors, colors)
    assert f"columns {where} are taken for red, green and blue" in "".join(text_notes(tmp_path / "a.txt"))


def test_where_colours_cannot_be_told_from_other_columns_there_are_none(tmp_path):
    rng = np.random.default_rng(0)
    np.savetxt(tmp_path / "a.txt", np.hstack([rng.uniform(0, 9, (500, 3)), rng.integers(0, 255, (500, 4))]), fmt="%.3f")
    assert read_cloud(tmp_path / "a.txt").colors is None
    assert "which columns are colours cannot be told" in "".join(text_notes(tmp_path / "a.txt"))
    np.savetxt(tmp_path / "b.txt", np.hstack([rng.uniform(0, 9, (500, 3)), rng.normal(0, 99, (500, 3))]), fmt="%.3f")
    assert read_cloud(tmp_path / "b.txt").colors is None
    assert "3 of its columns have no names and are left out" in "".join(text_notes(tmp_path / "b.txt"))


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("Northing,Easting,Elevation", "{y},{x},{z}"),
        ("Point,Northing,Easting,Elevation,Code", "{k},{y},{x},{z},7"),
        ("Punkt;Rechtswert;Hochwert;Höhe", "P{k};{x};{y};{z}"),
        ("E N H", "{x} {y} {z}"),
        ("Northing;Easting;Elevation", "{y};{x};{z};"),
        ("Northing,Easting,Elevation,", "{y},{x},{z}"),
        ("Northing\tEasting\tElevation\t", "{y}\t{x}\t{z}"),
        ("Northing,Easting,Elevation", "{y} {x} {z}"),
        ("Northing Easting Elevation", "{y},{x},{z}"),
        ("Northing Easting Elevation", "P{k} {y} {x} {z}"),
        ("N [m] E [m] H [m]", "{y} {x} {z}"),
        ("Northing,Easting,Elevation\nm,m,m", "{y},{x},{z}"),
        ("Northing (m)\tEasting (m)\tElevation (m)\tPoint Code", "{y}\t{x}\t{z}\ttree top"),
        ("Norte;Este;Cota", "{y};{x};{z}"),
        ("Est;Nord;Quota", "{x};{y};{z}"),
    ],
)
def test_columns_by_their_surveyors_names(tmp_path, header, row):
    points = np.random.default_rng(0).uniform(100, 900, (20, 3)).round(3)
    lines = [row.format(k=k, x=x, y=y, z=z) for k, (x, y, z) in enumerate(points.tolist(), 1)]
    (tmp_path / "a.csv").write_text("\n".join([header, *lines]))
    assert np.array_equal(read_cloud(tmp_path / "a.csv").points, points)
    assert "y is " in "".join(text_notes(tmp_path / "a.csv"))


def test_names_in_another_order_that_do_not_fit_the_rows_are_refused(tmp_path):
    (tmp_path / "a.xyz").write_text("Y X Z\n" + "5 1.5 2 9\n" * 4)
    with pytest.raises(StageError, match=r"'Y X Z' names 3 columns, but the rows have 4; give each column one name"):
        read_cloud(tmp_path / "a.xyz")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            "Punkt;Y-Koordinate;X-Koordinate;Höhe\n".encode() + b"P1;1.5;2;3\n" * 4,
            "column Y-Koordinate is the easting or",
        ),
        (b"X Koordinate\tY Koordinate\tZ\n" + b"1.5\t2\t3\n" * 4, "column X Koordinate is the easting or"),
        (b"Nr;Y;X;H\n" + b"1;431000.5;5400000.5;2\n" * 4, "column X is the easting or"),
        (b"Y coord\tX coord\tZ coord\n" + b"1.5\t2\t3\n" * 4, "column X coord is the easting or"),
        (b"Punto;Norte;Este;Cota ortom\n" + b"1;5400000.5;431000.5;2\n" * 4, "does not say which three columns"),
        (b"ncols 4\nnrows 2\nxllcorner 1\nyllcorner 2\ncellsize 1\n1 2 3 4\n5 6 7 8\n", "is a raster of heights"),
        (b"DSAA\r\n4 2\r\n0 3\r\n0 1\r\n1 8\r\n1 2 3 4\r\n5 6 7 8\r\n", "is a raster of heights"),
        (b"1\n1\n" + b"0 0 0\n" * 4 + b"1 0 0 0\n" * 4 + b"1 2 3 0.5\n", "is PTX, whose scans have poses"),
        (b'x,y,z,r,g,b\n"431,000.1","5,400,000.2",2,1,2,3\n', r"\('431,000.1' is no number: write it without units"),
        (b"431'000.1 5'400'000.2 200.1\n", r'"431\'000.1" is no number'),
        (b"1.5 m;2.5 m;3.5 m\n", "'1.5 m' is no number"),
        (b"(1.5, 2.5, 3.5)\n", r"'\(1.5' is no number"),
        (b"431000 5400000 200,5\n", "commas as decimal points"),
        (b"PK\3\4" + bytes(range(256)), r"\(it is a workbook or an archive, not text\)"),
    ],
)
def test_text_that_holds_no_rows_of_points_is_called_what_it_is(tmp_path, content, said):
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(StageError, match=said):
        read_cloud(tmp_path / "a.txt")


def test_a_header_that_is_not_understood_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("left,right,up\n1,2,3\n4,5,6\n")
    assert read_cloud(tmp_path / "a.csv").points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert "'left,right,up' names no columns x, y, z; the first three are these" in "".join(
        text_notes(tmp_path / "a.csv")
    )


def test_rows_that_are_not_finite_are_dropped_and_counted(tmp_path, capsys, cloud):
    points = cloud.points.copy()
    points[3, 1], points[7, 0] = np.nan, np.inf
    write_cloud(tmp_path / "a.ply", Cloud(points, None, cloud.colors, {"views": np.arange(40)}))
    found = read_cloud(tmp_path / "a.ply")
    assert "2 of 40 rows" in capsys.readouterr().out
    assert np.array_equal(found.fields["views"], np.delete(np.arange(40), [3, 7]))
    (tmp_path / "b.xyz").write_text("1 2 nan\nnan nan nan\n")
    with pytest.raises(StageError, match=r"b\.xyz holds no point with a finite position"):
        read_cloud(tmp_path / "b.xyz")


def test_colours_as_fractions_bytes_or_sixteen_bits():
    assert bytes_of(np.array([[0.0, 0.5, 1.0]])).tolist() == [[0, 128, 255]]
    assert bytes_of(np.array([[0, 1, 255]])).tolist() == [[0, 1, 255]]
    assert bytes_of(np.array([[0, 257, 65535]], np.uint16)).tolist() == [[0, 1, 255]]


@pytest.mark.parametrize("ending", ["ply", "las", "laz", "e57", "pcd", "xyz", "csv"])
@pytest.mark.parametrize("content", [b"", b"no cloud at all\n" * 40, bytes(range(256)) * 8])
def test_damaged_files_are_named_in_one_line(tmp_path, ending, content):
    path = tmp_path / f"bad.{ending}"
    path.write_bytes(content)
    with pytest.raises(StageError) as caught:
        read_cloud(path)
    assert f"bad.{ending}" in str(caught.value) and "\n" not in str(caught.value)


def test_truncated_files_are_refused(tmp_path, cloud):
    write_laz(tmp_path / "a.laz", Cloud(cloud.points - UTM, None, cloud.colors), UTM, "EPSG:32632")
    write_pcd(tmp_path / "a.pcd", cloud, "binary")
    write_e57(tmp_path / "a.e57", [(cloud.points - UTM, cloud.colors, np.array([1.0, 0, 0, 0]), UTM)])
    for path in sorted(tmp_path.iterdir()):
        content = path.read_bytes()
        path.write_bytes(content[: int(0.7 * len(content))])
        with pytest.raises(StageError, match=path.name):
            read_cloud(path)


def test_an_unknown_ending_lists_the_known_ones(tmp_path):
    with pytest.raises(StageError, match=r"\.abc.*\.ply, \.obj, \.glb, \.gltf, \.las, \.laz, \.e57, \.pcd, \.xyz"):
        read_cloud(tmp_path / "a.abc")


def test_a_column_that_counts_the_rows_is_no_coordinate(tmp_path):
    points = np.random.default_rng(0).uniform(-5, 5, (20, 3)).round(3)
    np.savetxt(tmp_path / "list.txt", np.column_stack([np.arange(1, 21), points]), fmt="%.3f")
    np.testing.assert_allclose(read_cloud(tmp_path / "list.txt").points, points)
    np.savetxt(tmp_path / "grid.xyz", np.column_stack([np.arange(20) % 10, points]), fmt="%.3f")
    np.testing.assert_allclose(read_cloud(tmp_path / "grid.xyz").points[:, 0], np.arange(20) % 10)


def test_numbers_and_names_of_points_are_no_coordinates_and_that_is_said(tmp_path):
    points = np.random.default_rng(0).uniform(-5, 5, (20, 3)).round(3)
    numbers = np.random.default_rng(1).permutation(100)[:20]
    np.savetxt(tmp_path / "thinned.txt", np.column_stack([numbers, points]), fmt="%.3f")
    rows = [f"P{n} {x} {y} {z} 0.5" for n, (x, y, z) in zip(numbers, points)]
    (tmp_path / "named.txt").write_text("Survey of 1 2 2026\n" + "\n".join(rows))
    for name in ("thinned.txt", "named.txt"):
        np.testing.assert_allclose(read_cloud(tmp_path / name).points, points)
        assert f"{name}: its first column names or numbers the points" in "".join(text_notes(tmp_path / name))
    np.savetxt(tmp_path / "more.xyz", np.column_stack([points, numbers]), fmt="%.3f")
    np.testing.assert_allclose(read_cloud(tmp_path / "more.xyz").points, points)
    assert "1 of its columns have no names" in "".join(text_notes(tmp_path / "more.xyz"))


@pytest.mark.parametrize(
    "further", ["colours", "intensity and colours", "intensity", "share", "share and colours", "none"]
)
def test_rows_and_columns_of_a_scanners_grid_are_no_coordinates_and_that_is_said(tmp_path, further):
    rng, places = np.random.default_rng(0), np.arange(40)
    points, colors = rng.uniform(0, 50, (40, 3)).round(3) + 5e5 + 0.0004, rng.integers(0, 256, (40, 3))
    bright = rng.integers(0, 2048, (40, 1))
    behind = [bright] if "intensity" in further else [bright / 2048] if "share" in further else []
    behind += [colors] if "colours" in further else []
    rows = np.column_stack([places // 8, places % 8, points, *behind])
    np.savetxt(tmp_path / "faro.xyz", rows, fmt="%.4f")
    found = read_cloud(tmp_path / "faro.xyz")
    np.testing.assert_allclose(found.points, points)
    assert "first two columns are rows and columns of a scan" in "".join(text_notes(tmp_path / "faro.xyz"))
    assert further not in ("colours", "share and colours") or np.array_equal(found.colors, colors)


def test_a_grid_of_heights_with_whole_eastings_and_northings_is_no_scanners(tmp_path):
    rng, places = np.random.default_rng(0), np.arange(40)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    far = np.column_stack([places // 8 + 5e5, places % 8 + 5.4e6, rng.uniform(1, 9, 40), rng.random((40, 2))])
    near, shares = (np.column_stack([places // 8, places % 8, far[:, 2], three]) for three in (normals, abs(normals)))
    for rows in (far, near, shares / [1, 1, 1, 1.1, 1.1, 1.1]):
        np.savetxt(tmp_path / "grid.xyz", rows, fmt="%.4f")
        np.testing.assert_allclose(read_cloud(tmp_path / "grid.xyz").points, rows[:, :3], atol=1e-4)


def test_whole_coordinates_are_no_numbers_of_points(tmp_path):
    rng = np.random.default_rng(0)
    x, yz, colors = 5 * np.arange(20.0), rng.uniform(-5, 5, (20, 2)).round(3) + 0.0005, rng.integers(0, 256, (20, 3))
    for name, further in (("profile.xyz", colors), ("measured.xyz", colors[:, :1])):
        np.savetxt(tmp_path / name, np.column_stack([x, yz, further]), fmt="%.4f")
        np.testing.assert_allclose(read_cloud(tmp_path / name).points, np.column_stack([x, yz]))


def test_rows_of_other_lengths_are_an_error_and_lines_above_are_no_points(tmp_path):
    (tmp_path / "a.txt").write_text("1.5 2.5 3.5\n" + "1.5 2.5 3.5 9 9 9\n" * 9)
    (tmp_path / "b.txt").write_text("P1 1.5 2.5 3.5\nP2 1.5 2.5 3.5\nP3 1.5 2.5 3.5 9\n")
    for name in ("a.txt", "b.txt"):
        with pytest.raises(StageError, match="line ., has . columns, the first row .*correct that line"):
            read_cloud(tmp_path / name)
    rows = "".join(f"P{k} {k}.5 2.5 3.5 9 9 9\n" for k in range(9))
    (tmp_path / "c.txt").write_text("Origin 500000 5000000 0\n" + rows)
    assert len(read_cloud(tmp_path / "c.txt")) == 9
    (tmp_path / "d.csv").write_text('"","x","z","y"\n' + "".join(f'"{k}",1,{k}.5,2\n' for k in range(1, 6)))
    assert read_cloud(tmp_path / "d.csv").points[0].tolist() == [1, 2, 1.5]


def test_decimal_commas_are_named(tmp_path):
    (tmp_path / "one.txt").write_text("0,5;200;300\n1,5;210;310\n")
    with pytest.raises(StageError, match="commas as decimal points"):
        read_cloud(tmp_path / "one.txt")
    (tmp_path / "a.txt").write_text("1,25;2,5;3,75\n2,25;3,5;4,75\n")
    with pytest.raises(StageError, match=r"commas as decimal points: '2,25;3,5;4,75'"):
        read_cloud(tmp_path / "a.txt")
    (tmp_path / "b.csv").write_text("125,25,375\n225,35,475\n")
    assert read_cloud(tmp_path / "b.csv").points.tolist() == [[125, 25, 375], [225, 35, 475]]


def test_a_table_in_degrees_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("Longitude,Latitude,Height\n8.1,47.2,400\n8.2,47.1,401\n8.3,47.3,402\n")
    with pytest.raises(StageError, match=r"is in degrees \(column Longitude\)"):
        read_cloud(tmp_path / "a.csv")


def test_text_is_read_in_parts_and_a_bad_row_is_counted_from_its_part(tmp_path, monkeypatch):
    monkeypatch.setattr("scenefuse.cloud.readers.text.MAX_HEAD_LINES", 10)
    monkeypatch.setattr("scenefuse.cloud.readers.text.TOGETHER", 5)
    points = np.random.default_rng(0).uniform(-5, 5, (25, 3)).round(3)
    np.savetxt(tmp_path / "a.xyz", points, fmt="%.3f", header="x y z\n")
    parts = list(read_text(tmp_path / "a.xyz", 10))
    assert [len(part["x"]) for part in parts] == [10, 10, 5]
    np.testing.assert_allclose(np.concatenate([np.column_stack(list(part.values())) for part in parts]), points)
    lines = (tmp_path / "a.xyz").read_text().splitlines()
    (tmp_path / "b.xyz").write_text("\n".join([*lines[:-1], "1 2"]) + "\n")
    with pytest.raises(StageError, match="line 27, has 2 columns, the first row 3: '1 2'"):
        list(read_text(tmp_path / "b.xyz", 10))


@pytest.mark.parametrize(
    ("content", "colored"),
    [
        ("//X Y Z R G B Scalar Nx Ny Nz\n4\n" + "1 2 3 10 20 30 0.5 0 0 1\n" * 4, True),  # CloudCompare's, with a count
        ("ID,N [m],E [m],H [m]\n" + "".join(f"P{k},2,1,3\n" for k in range(4)), False),
        ("x,y,z,red,green,blue,\n" + "1,2,3,10,20,30,\n" * 4, True),
        ("X,Y,Z,Rf,Gf,Bf,\n" + "1,2,3,0.0392,0.0784,0.1176\n" * 4, True),
    ],
)
def test_text_as_programs_write_it(tmp_path, content, colored):
    (tmp_path / "a.csv").write_text(content)
    found = read_cloud(tmp_path / "a.csv")
    assert found.points.tolist() == [[1, 2, 3]] * 4
    assert (found.colors is not None) == colored and (not colored or found.colors[0].tolist() == [10, 20, 30])


def test_pts_of_several_scans_is_one_cloud(tmp_path):
    (tmp_path / "a.pts").write_text(("2\n1 2 3 -900 10 20 30\n4 5 6 -800 10 20 30\n") * 3)
    assert read_cloud(tmp_path / "a.pts").points.tolist() == [[1, 2, 3], [4, 5, 6]] * 3


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_text_in_other_encodings(tmp_path, encoding):
    (tmp_path / "a.csv").write_text("Punkt;Rechtswert;Hochwert;Höhe\n" + "7;1;2;3\n9;4;5;6\n" * 2, encoding=encoding)
    assert read_cloud(tmp_path / "a.csv").points.tolist() == [[1, 2, 3], [4, 5, 6]] * 2
