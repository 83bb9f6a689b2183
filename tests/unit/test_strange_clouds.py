"""Cloud files as people have them: situations of public complaints about other programs (docs/inputs.md), read
right."""

import io
import json
import re
import struct
from base64 import b64encode
from pathlib import Path

import laspy
import numpy as np
import pye57
import pyproj
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr
from PIL import Image
from plyfile import PlyData, PlyElement
from pye57 import libe57
from support.glb_file import write_square as glb

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.crs import has_place, mixed_units, to_wgs84
from scenefuse.cloud.formats import columns_in_parts
from scenefuse.cloud.import_cloud import import_scene_cloud
from scenefuse.cloud.readers.las import las_crs
from scenefuse.core.stage import StageError, read_json, value

GRID = [[float(x), float(y), x * y / 7] for x in range(1, 9) for y in range(1, 6)]
COLORS = [[10 * x, 20 * y, 255 - 10 * x] for x in range(1, 9) for y in range(1, 6)]
HEAD = "ply\nformat ascii 1.0\nelement vertex {}\n" + "".join(f"property float {axis}\n" for axis in "xyz")


def rows(separator=" ", *columns):
    """The grid's points and some columns, a line each."""
    return [separator.join(map(str, row)) for row in zip(*zip(*GRID), *columns)]


def reds(cloud):
    return None if cloud.colors is None else cloud.colors[:, 0].tolist()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("blank.xyz", "\n\n".join(rows())),
        ("blank_crlf.ply", HEAD.format(40) + "end_header\n\r\n" + "\r\n\r\n".join(rows())),
        ("mark.ply", "\ufeff" + HEAD.format(40) + "end_header\n\ufeff" + "\n".join(rows())),
        ("carriage.xyz", "\r".join(rows())),
        ("joined.xyz", "\r".join(rows()[:9]) + "\r" + "\n".join(rows()[9:])),
        ("dos.xyz", "\r\n".join([*rows(), "\x1a"])),
        ("quoted.csv", "x,y,z\n" + "\n".join('"' + '","'.join(map(str, row)) + '"' for row in GRID)),
        ("spaced.csv", "x , y , z\n" + "\n".join(rows(" , "))),
        ("pipes.txt", "x|y|z\n" + "\n".join(rows("|"))),
        ("tabs.txt", "x\ty\tcode\tz\n" + "\n".join(f"{x}\t{y}\t\t{z}" for x, y, z in GRID)),
        (
            "empty.csv",
            "x,y,z,code\n" + "\n".join(line + ("," if k % 2 else ",tree") for k, line in enumerate(rows(","))),
        ),
        ("quoted_words.csv", "x,y,z,what\n" + "\n".join(line + ',"tree, small"' for line in rows(","))),
        (
            "trimmed.csv",
            "x,y,z,code\n" + "\n".join(line + (",7" if k % 2 == 0 else "") for k, line in enumerate(rows(","))),
        ),
        ("fortran.txt", "\n".join(f"{x}D+00 {y}d0 {z}" for x, y, z in GRID)),
        ("comment.txt", "# Maß\n" + "\n".join(line + " # nach Süden" for line in rows())),
        ("paraview.csv", "Points:0,Points:1,Points:2\n" + "\n".join(rows(","))),
        ("pts.pts", "x y z\n" + "\n".join(rows())),
        ("point.ply", HEAD.format(40).replace("float x", "int x") + "end_header\n" + "\n".join(rows())),
        (
            "comment_ü.ply",
            HEAD.format(40).replace("element", "comment Maßstab\nelement", 1) + "end_header\n" + "\n".join(rows()),
        ),
        (
            "pcd.pcd",
            "# Gerät\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 40\nHEIGHT 1\nDATA ascii\n" + "\n\n".join(rows()),
        ),
        ("old.pcd", "COLUMNS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 40\nDATA ASCII\n" + "\n".join(rows())),
        (
            "views.ply",
            HEAD.format(40).replace("property", "property list uchar uint before\nproperty", 1)
            + "property list uchar uint view_indices\nend_header\n"
            + "\n".join(f"2 7 8 {line} {k % 3}" + " 9" * (k % 3) for k, line in enumerate(rows())),
        ),
    ],
    ids=lambda text: text[:20] if text.isprintable() else "",
)
def test_numbers_are_read_whatever_stands_around_them(tmp_path, name, content):
    (tmp_path / name).write_bytes(content.encode())
    np.testing.assert_allclose(read_cloud(tmp_path / name).points, GRID)


@pytest.mark.parametrize(
    "missing", ["nan", "-nan(ind)", "NULL", "NA", "n/a", "", "None", "1.#QNAN", "-1.#IND", "#N/A", "-"]
)
def test_rows_whose_number_is_missing_are_left_out_and_counted(tmp_path, missing):
    lines = rows(",")
    lines[3], lines[7] = f"{missing},1,2", f'1,"{missing}",2'
    (tmp_path / "a.csv").write_text("x,y,z\n" + "\n".join([*lines[:5], "x,y,z", "-- page 2 --", *lines[5:]]))
    read = CloudFile.of(tmp_path / "a.csv")
    np.testing.assert_allclose(read.part.points, np.delete(GRID, [3, 7], axis=0))
    assert any("4 rows without a finite position" in note for note in read.notes)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.xyz", "\n".join([*rows()[:-1], "1 2"]), "a.xyz is cut short: it ends within a row, line 40; copy it again"),
        ("a.xyz", "\n".join(["1 2 3 4", *rows()]), "line 2, has 3 columns, the first row 4: .*; correct that line, or"),
        ("a.ply", HEAD.format(41) + "end_header\n" + "\n".join(rows()), "cut short: its last 1 points are missing"),
        ("a.pts", "\n".join(["30", *rows()[:30], "12", *rows()[30:]]), "cut short: its last 2 points are missing"),
        ("a.ply", HEAD.format(10**12) + "end_header\n" + "\n".join(rows()), "its last 999999999960 points are missing"),
        (
            "a.ply",
            HEAD.format(40) + "property uint64 t\nend_header\n" + "\n".join(rows()),
            r"\(its property t is of type uint64, which PLY does not have: leave it out\)",
        ),
        ("a.pcd", "SIZE 4 4 4\nTYPE F F F\nWIDTH 9\nHEIGHT 1\nDATA binary\n", "does not say what its rows hold"),
        ("a.ply", HEAD.format(-1) + "end_header\n", "its header counts less than no rows"),
        (
            "a.ply",
            HEAD.replace("ascii", "binary_little_endian").format(10**12) + "end_header\n",
            "10{12} points are mis",
        ),
        (
            "a.pcd",
            "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1000000\nHEIGHT 1000000\nDATA binary\n",
            "10{12} points are",
        ),
        (
            "a.pcd",
            "FIELDS x y z\nSIZE 4 4\nTYPE F F F\nWIDTH 9\nHEIGHT 1\nDATA binary\n",
            "does not say what its rows hold",
        ),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "vertices that it does not have.; export it again"),
    ],
)
def test_a_cut_file_is_told_from_a_strange_one(tmp_path, name, content, sentence):
    (tmp_path / name).write_text(content)
    with pytest.raises(StageError, match=sentence):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("content", ["", "ply\n", HEAD.format(41) + "end_header\n" + "\n".join(rows())])
def test_of_a_damaged_cloud_that_the_workflow_made_it_is_said_that_it_will_be_made_again(
    tmp_path, monkeypatch, content
):
    monkeypatch.chdir(tmp_path)
    for path, advice in (
        (Path("results/object.ply"), "delete it and run again"),
        (Path("own.ply"), "(copy|export|copy or export) it"),
    ):
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
        with pytest.raises(StageError, match=rf"^{path}[^;]*; {advice}") as error:
            read_cloud(path)
        assert ("delete" in str(error.value)) == path.is_relative_to("results")


@pytest.mark.parametrize(
    "names",
    ["r,g,b", "R[0-255],G[0-255],B[0-255]", "Rot,Grün,Blau", "rouge,vert,bleu", "rojo,verde,azul", "rgb_r,rgb_g,rgb_b",
     "RGB:0,RGB:1,RGB:2", "RGBA_0,RGBA_1,RGBA_2", "diffuse_red,diffuse_green,diffuse_blue",
     "Color.R,Color.G,Color.B", "scalar_red,scalar_green,scalar_blue"],
)  # fmt: skip
def test_colours_are_found_by_their_names(tmp_path, names):
    (tmp_path / "a.csv").write_text(f"X[m],Y[m],Z[m],{names}\n" + "\n".join(rows(",", *zip(*COLORS))), "utf-8")
    assert read_cloud(tmp_path / "a.csv").colors.tolist() == COLORS


def test_gaussian_splats_have_the_colours_of_their_first_harmonic(tmp_path):
    harmonics = ((np.array(COLORS) / 255 - 0.5) / 0.28209479177387814).T
    names = "".join(f"property float f_dc_{k}\n" for k in range(3))
    (tmp_path / "a.ply").write_text(HEAD.format(40) + names + "end_header\n" + "\n".join(rows(" ", *harmonics)))
    assert read_cloud(tmp_path / "a.ply").colors.tolist() == COLORS


def test_one_name_of_a_colour_alone_is_none(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,vert,h,b\n" + "\n".join(rows(",", *zip(*COLORS))))
    read = read_cloud(tmp_path / "a.csv")
    assert read.colors is None and set(read.fields) == {"vert", "h", "b"}


def test_of_two_columns_of_one_name_the_first_is_meant(tmp_path):
    """CloudCompare writes what coordinates and normals were before a cloud was moved as further columns."""
    names = ["nx", "ny", "nz", *(f"scalar_{name}" for name in ("X", "Y", "Z", "Nx", "Ny", "Nz"))]
    further = [np.full(40, number) for number in (0, 0, 1, 5, 6, 7, 1, 0, 0)]
    head = HEAD.format(40) + "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (tmp_path / "a.ply").write_text(head + "\n".join(rows(" ", *further)))
    read = read_cloud(tmp_path / "a.ply")
    assert read.points.tolist() == GRID and (read.normals == [0, 0, 1]).all()
    assert {"X", "Y", "Z", "Nx", "Ny", "Nz"} == set(read.fields)


def test_columns_without_names_are_colours_only_where_they_must_be(tmp_path):
    rng = np.random.default_rng(0)
    bright, back, kind = rng.integers(0, 1000, 40), rng.integers(1, 4, 40), np.full(40, 2)
    (tmp_path / "flown.txt").write_text("\n".join(rows(" ", bright, back, kind)))
    read = CloudFile.of(tmp_path / "flown.txt")
    assert read.part.colors is None and any("3 of its columns have no names" in note for note in read.notes)
    (tmp_path / "shares.txt").write_text("\n".join(rows(" ", *rng.random((3, 40)))))
    assert read_cloud(tmp_path / "shares.txt").colors is None
    (tmp_path / "photo.txt").write_text("\n".join(rows(" ", *zip(*COLORS))))
    read = CloudFile.of(tmp_path / "photo.txt")
    assert read.part.colors.tolist() == COLORS
    assert any("columns 4 to 6 are taken for red, green and blue" in note for note in read.notes)


def test_colours_behind_normals_that_are_0_0_0_are_found(tmp_path):
    (tmp_path / "a.txt").write_text("\n".join(rows(" ", *np.zeros((3, 40)), *zip(*COLORS))))
    assert read_cloud(tmp_path / "a.txt").colors.tolist() == COLORS


@pytest.mark.parametrize("most", [1.0, 255.0])
def test_real_colours_that_overshoot_a_little_are_clipped(tmp_path, most):
    share = np.linspace(0, 1, 40)
    share[[7, 8]] = 1.05, -0.02
    colors = "".join(f"property float {name}\n" for name in ("red", "green", "blue"))
    lines = rows(" ", *[share * most] * 3)
    (tmp_path / "a.ply").write_text(HEAD.format(40) + colors + "end_header\n" + "\n".join(lines))
    (tmp_path / "a.obj").write_text("".join(f"v {line}\n" for line in lines))
    wanted = np.rint(255 * share.clip(0, 1))
    assert reds(read_cloud(tmp_path / "a.ply")) == reds(CloudFile.of(tmp_path / "a.obj").part) == wanted.tolist()


@pytest.mark.parametrize(("factor", "stray"), [(1, 0), (1, 60_000), (256, 0), (257, 0)])
def test_colours_of_las_are_those_of_the_bits_that_all_points_use(tmp_path, factor, stray):
    las = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    las.x, las.y, las.z = np.random.default_rng(0).random((3, 256))
    las.red = las.green = las.blue = (np.arange(256) * factor).astype(np.uint16)
    las.red[3] = stray or las.red[3]
    las.write(str(tmp_path / "a.las"))
    found = CloudFile.of(tmp_path / "a.las").part.colors[:, 1]
    assert np.abs(found - np.arange(256.0)).max() <= 1


def e57(path, columns, prototype, build=lambda image, scan: None):
    """One scan: columns of numbers, their nodes, and what `build` adds to it."""
    file = pye57.E57(str(path), mode="w")
    image = file.image_file
    kinds, buffers, held = libe57.StructureNode(image), libe57.VectorSourceDestBuffer(), []
    count = len(columns["cartesianX"])
    for name, values in columns.items():
        kinds.set(name, prototype(image, name))
        held.append(np.array(values, float))
        buffers.append(libe57.SourceDestBuffer(image, name, held[-1], count, True, True))
    scan = libe57.StructureNode(image)
    points = libe57.CompressedVectorNode(image, kinds, libe57.VectorNode(image, True))
    build(image, scan)
    scan.set("points", points)
    file.data3d.append(scan)
    points.writer(buffers).write(count)
    file.close()


def structure(image, **numbers):
    node = libe57.StructureNode(image)
    for name, number in numbers.items():
        node.set(name, libe57.FloatNode(image, float(number)))
    return node


def real(image, name):
    return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)


AXES = ("cartesianX", "cartesianY", "cartesianZ")


@pytest.mark.parametrize("parts", [("rotation",), ("translation",), ("rotation", "translation"), ()])
@pytest.mark.parametrize("zero", [False, True])
def test_parts_of_a_pose_that_are_absent_change_nothing_and_rays_without_return_are_left_out(tmp_path, parts, zero):
    def build(image, scan):
        pose = libe57.StructureNode(image)
        if "rotation" in parts:  # a quarter turn about z, or no turn at all
            pose.set("rotation", structure(image, w=0 if zero else 0.5**0.5, x=0, y=0, z=0 if zero else 0.5**0.5))
        if "translation" in parts:
            pose.set("translation", structure(image, x=100, y=200, z=300))
        scan.set("pose", pose)

    points = np.vstack([GRID, np.zeros((6, 3))])
    e57(tmp_path / "a.e57", dict(zip(AXES, points.T)), real, build)
    read = CloudFile.of(tmp_path / "a.e57")
    wanted = np.array(GRID)
    if "rotation" in parts and not zero:
        wanted = np.column_stack([-wanted[:, 1], wanted[:, 0], wanted[:, 2]])
    wanted = wanted + ([100, 200, 300] if "translation" in parts else [0, 0, 0])
    np.testing.assert_allclose(read.part.points, wanted, atol=1e-12)
    assert any("6 rows without a finite position" in note for note in read.notes)


@pytest.mark.parametrize(("low", "high"), [(0, 1023), (0, 4095), (0, 255), (100, 300)])
def test_colours_of_e57_have_the_scan_s_limits(tmp_path, low, high):
    def build(image, scan):
        ends = {
            f"color{c}{end}": n for c in ("Red", "Green", "Blue") for end, n in (("Minimum", low), ("Maximum", high))
        }
        scan.set("colorLimits", structure(image, **ends))

    share = np.linspace(0, 0.2, 40)  # a dark scan
    columns = dict(zip(AXES, np.array(GRID).T)) | {
        f"color{c}": low + share * (high - low) for c in ("Red", "Green", "Blue")
    }
    e57(tmp_path / "a.e57", columns, real, build)
    assert reds(read_cloud(tmp_path / "a.e57")) == np.rint(255 * share).tolist()


def test_points_of_e57_that_a_flag_says_have_no_colours_are_counted(tmp_path, capsys):
    colors = dict(zip(("colorRed", "colorGreen", "colorBlue"), np.array(COLORS).T / 255))
    flagged = {"isColorInvalid": np.arange(40) < 7}
    e57(tmp_path / "a.e57", dict(zip(AXES, np.array(GRID).T)) | colors | flagged, real)
    assert len(read_cloud(tmp_path / "a.e57").colors) == 40
    assert "7 points of a scan have no colours" in capsys.readouterr().out
    e57(tmp_path / "b.e57", dict(zip(AXES, np.array(GRID).T)) | flagged, real)
    assert read_cloud(tmp_path / "b.e57").colors is None and capsys.readouterr().out == ""


def test_scaled_integers_of_e57_are_scaled(tmp_path):
    def node(image, name):
        return libe57.ScaledIntegerNode(image, 0, -(10**9), 10**9, 0.001, 0.0)

    e57(tmp_path / "a.e57", dict(zip(AXES, np.array(GRID).T)), node)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.e57").points, GRID, atol=0.0005)


@pytest.mark.parametrize("data", ["ascii", "binary"])
@pytest.mark.parametrize("kind", ["F", "U", "F, written as an integer", "F, written as a signed integer"])
def test_packed_colours_of_pcd_as_a_real_number_or_an_integer(tmp_path, data, kind):
    kind, _, integer = kind.partition(", written as ")
    opaque = 255 << 24 if integer else 0
    packed = np.array([opaque | r << 16 | g << 8 | b for r, g, b in COLORS], np.uint32)
    table = np.empty(40, [("xyz", "<f4", 3), ("pad", "u1", 5), ("rgb", "<u4")])
    table["xyz"], table["rgb"] = GRID, packed
    shown = packed.view(np.int32).tolist() if "signed" in integer else packed.tolist()
    if kind == "F" and not integer:
        shown = [repr(float(n)) for n in packed.view(np.float32).astype(np.float64)]
    head = f"FIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U {kind}\nCOUNT 1 1 1 5 1\nWIDTH 8\nHEIGHT 5\nDATA {data}\n"
    text = "\n".join(rows(" ", *[[0] * 40] * 5, shown)).encode()
    (tmp_path / "a.pcd").write_bytes(head.encode() + (text if data == "ascii" else table.tobytes()))
    read = read_cloud(tmp_path / "a.pcd")
    assert read.colors.tolist() == COLORS and not read.fields


@pytest.mark.parametrize("name", ["rgb", "RGBA"])
@pytest.mark.parametrize("kind", ["a.csv", "a.txt", "integers.ply", "reals.ply"])
def test_packed_colours_are_read_of_text_and_ply(tmp_path, name, kind):
    packed = np.array([r << 16 | g << 8 | b for r, g, b in COLORS], np.uint32)
    if kind == "a.csv":
        (tmp_path / kind).write_text(f"x,y,z,{name}\n" + "\n".join(rows(",", packed)))
    elif kind == "a.txt":  # the real numbers of these bits
        (tmp_path / kind).write_text(f"x y z {name}\n" + "\n".join(rows(" ", packed.view(np.float32).astype(float))))
    else:
        vertex = np.zeros(40, [(axis, "f4") for axis in "xyz"] + [(name, "u4" if kind == "integers.ply" else "f4")])
        vertex["x"], vertex["y"], vertex["z"] = np.array(GRID).T
        vertex[name] = packed.view(vertex[name].dtype)
        PlyData([PlyElement.describe(vertex, "vertex")]).write(tmp_path / kind)
    read = read_cloud(tmp_path / kind)
    assert read.colors.tolist() == COLORS and not read.fields
    (tmp_path / "shares.csv").write_text(f"x,y,z,{name}\n" + "\n".join(rows(",", np.linspace(0, 0.9, 40))))
    assert read_cloud(tmp_path / "shares.csv").colors is None


def write_las(path, form, count):
    """The grid as LAS or LAZ, whose header counts so many points."""
    las = laspy.LasData(laspy.LasHeader(point_format=form, version="1.2" if form < 6 else "1.4"))
    las.x, las.y, las.z = np.array(GRID).T
    las.write(str(path))
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 107, count if form < 6 else 0)
    if form >= 6:
        struct.pack_into("<Q", content, 247, count)
    path.write_bytes(content)


@pytest.mark.parametrize("count", [0, 25])
@pytest.mark.parametrize("name", ["a.las", "b.las", "b.laz", "text.ply", "binary.ply", "ascii.pcd", "binary.pcd"])
def test_a_file_that_holds_more_points_than_its_header_counts_is_refused(tmp_path, name, count):
    path, points = tmp_path / name, np.array(GRID, "<f4")
    if path.suffix in (".las", ".laz"):
        write_las(path, 6 if path.stem == "b" else 0, count)
    elif path.suffix == ".ply":
        form = {"text": "ascii", "binary": "binary_little_endian"}[path.stem]
        head = HEAD.format(count).replace("ascii", form) + "end_header\n"
        path.write_bytes(head.encode() + ("\n".join(rows()).encode() if form == "ascii" else points.tobytes()))
    else:
        head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\nDATA {path.stem}\n"
        path.write_bytes(head.encode() + ("\n".join(rows()).encode() if path.stem == "ascii" else points.tobytes()))
    with pytest.raises(StageError, match=f"{name} holds more points than the {count} that its header counts; export"):
        CloudFile.of(path)


def test_bytes_behind_all_points_of_las_that_are_no_rows_are_none(tmp_path):
    write_las(tmp_path / "a.las", 0, 40)
    with open(tmp_path / "a.las", "ab") as file:
        file.write(bytes(7))
    assert len(CloudFile.of(tmp_path / "a.las").part) == 40


@pytest.mark.parametrize(("name", "right"), [("PNEZD", True), ("penz", True), ("ENZ", True), ("points", False)])
def test_a_row_of_a_surveyor_that_one_word_names(tmp_path, name, right):
    letters = [letter for letter in name.upper() if letter in "PNEZD"] if right else list("PNEZD")
    table = dict(zip("ENZ", np.array(GRID).T)) | {"P": np.arange(7, 47), "D": ["tree"] * 40}
    lines = [",".join(map(str, row)) for row in zip(*(table[letter] for letter in letters))]
    (tmp_path / "a.csv").write_text(f"{name}\n" + "\n".join(lines))
    if right:
        np.testing.assert_allclose(CloudFile.of(tmp_path / "a.csv").part.points, GRID)
    else:
        with pytest.raises(StageError, match="cannot be told; write PENZD or PNEZD as its first line"):
            CloudFile.of(tmp_path / "a.csv")


@pytest.mark.parametrize("nothing", [-9999, -32767, "-3.4028235e+38"])
def test_cells_of_a_raster_that_hold_nothing_are_left_out_and_counted(tmp_path, nothing):
    lines = rows()
    lines[::4] = [f"{x} {y} {nothing}" for x, y, _ in GRID[::4]]
    (tmp_path / "dem.xyz").write_text("\n".join(lines))
    read = CloudFile.of(tmp_path / "dem.xyz")
    assert len(read.part) == 30 and read.part.points[:, 2].min() >= 0
    assert read.notes == ["10 rows without a finite position of dem.xyz were left out"]


def test_coordinates_in_different_units_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("X [m],Y [m],Z [mm]\n" + "\n".join(rows(",")))
    with pytest.raises(StageError, match="has x, y and z in m, mm; export all three in one unit"):
        read_cloud(tmp_path / "a.csv")


def test_returns_at_the_scanner_s_own_place_are_no_points(tmp_path):
    around = np.vstack([np.array(GRID) - [4, 3, 2], np.zeros((12, 3))])
    write_cloud(tmp_path / "lidar.ply", Cloud(around))
    read = CloudFile.of(tmp_path / "lidar.ply")
    assert len(read.part) == 40 and any("12 points at exactly 0 0 0" in note for note in read.notes)


@pytest.mark.parametrize("counts", ["uchar int", "ushort uint", "int int"])
def test_a_mesh_in_ply_of_text_with_blank_lines_and_numbers_with_a_point(tmp_path, counts):
    head = HEAD.format(4) + "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
    text = head + f"property uchar flags\nproperty list {counts} vertex_indices\n"
    text += "property list uchar float texcoord\nend_header\n"
    text += "0 0 0 255.0 0.0 0\n\n1 0 0 255.0 0 0\n1 1 0 255 0 0\n0 1 0 255 0 0\n\n"
    text += "0 3 0 1 2 6 0 0 0 0 0 0\n\n0 3 0 2 3 6 0 0 0 0 0 0\n"
    (tmp_path / "a.ply").write_text(text)
    read = read_cloud(tmp_path / "a.ply")
    assert np.allclose(read.normals, [0, 0, 1]) and (read.colors == [255, 0, 0]).all()
    assert np.ptp(read.points, axis=0).round(2).tolist() == [1, 1, 0]


@pytest.mark.parametrize("text", [True, False])
def test_strips_of_triangles_in_ply_are_faces_that_look_outwards(tmp_path, text):
    vertex = np.zeros(6, [(axis, "f4") for axis in "xyz"])
    vertex["x"], vertex["y"] = np.repeat([0, 1, 2], 2), [0, 1] * 3
    strips = np.empty(1, [("vertex_indices", "O")])
    strips["vertex_indices"][0] = np.array([0, 2, 1, 3, -1, 2, 4, 3, 5], np.int32)
    elements = [PlyElement.describe(vertex, "vertex")]
    elements.append(PlyElement.describe(strips, "tristrips", val_types={"vertex_indices": "i4"}))
    PlyData(elements, text).write(tmp_path / "a.ply")
    read = read_cloud(tmp_path / "a.ply")
    assert len(read) == 500_000 and np.allclose(read.normals, [0, 0, 1])
    assert np.allclose(read.points.mean(0), [1, 0.5, 0], atol=1e-3)


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def halves(path):
    """A picture whose left half is red, its right half blue."""
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, :4, 0], picture[:, 4:, 2] = 255, 255
    Image.fromarray(picture).save(path, None if isinstance(path, Path) else "PNG")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "picture", "material"),
    [
        ("f 1/1 2/2 3/3 \\\n4/4", "t.png", "map_Kd t.png"),
        ("f 1/1 2/2 3/3 4/4 # wall", "t.png", "MAP_KD C:\\Bilder\\T.PNG"),
        ("f -4/-4 -3/-3 -2/-2 -1/-1", "t.tga", "map_Kd t.tga"),
        ("f 1/1/1 2/2/2 3/3/3 4/4/4", "my t.png", 'map_Kd -o 0.0 -7.0 0.0 -clamp on "my t.png"'),
    ],
)
@pytest.mark.parametrize("libraries", ["a.mtl b.mtl", "all of it.mtl"])
def test_lines_of_obj_that_go_on_have_comments_or_name_files_elsewhere(tmp_path, line, picture, material, libraries):
    halves(tmp_path / picture)
    (tmp_path / "a.mtl").write_text("newmtl other\nKd 0 1 0 # green\n")
    (tmp_path / ("b.mtl" if "b.mtl" in libraries else libraries)).write_text(f"newmtl m\n{material}\n")
    (tmp_path / "a.obj").write_text(f"# mtllib none.mtl\nmtllib {libraries}\n{SQUARE}usemtl m\n{line}\nl 1 2\n")
    read = read_cloud(tmp_path / "a.obj")
    left = read.points[:, 0] < 0.49
    assert (read.colors[left] == [255, 0, 0]).all() and (read.colors[read.points[:, 0] > 0.51] == [0, 0, 255]).all()


def test_a_texture_is_scaled_and_moved_as_its_material_says(tmp_path):
    halves(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd -s 2 1 1 -o 0.5 0 t.png\n")
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{SQUARE}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    read = read_cloud(tmp_path / "a.obj")
    place = (2 * read.points[:, 0] + 0.5) % 1
    inside = np.abs(place % 0.5 - 0.25) < 0.24
    assert ((read.colors[:, 2] > 0) == (place > 0.5))[inside].all()


def sides(path):
    """Of a square: mean x of its red and of its blue points, its normals and its extent."""
    read = read_cloud(path)
    red = read.colors[:, 0] > read.colors[:, 2]
    return (
        read.points[red][:, 0].mean(),
        read.points[~red][:, 0].mean(),
        read.normals.mean(0),
        np.ptp(read.points, axis=0),
    )


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("of", ["corners", "vertices", "faces"])
def test_a_mesh_in_ply_has_the_colours_of_its_textures_or_faces(tmp_path, text, of):
    halves(tmp_path / "T 1.PNG")
    vertex = np.zeros(4, [(name, "f4") for name in ("x", "y", "z", "s", "t")][: 5 if of == "vertices" else 3])
    for name, values in zip("xyzst", CORNERS[:, [0, 1, 2, 0, 1]].T):
        if name in vertex.dtype.names:
            vertex[name] = values
    faces, kind = [([0, 1, 2, 3], [], 0)], [("vertex_index", "i4", (4,)), ("texcoord", "f4", (8,)), ("red", "u1")]
    if of == "corners":
        faces = [([0, 1, 2, 3], CORNERS[:, :2].ravel(), 0)]
    elif of == "faces":  # each half a face of its own
        vertex = np.concatenate([vertex, vertex[:2]])
        vertex["x"][4:], vertex["y"][4:] = 0.5, (0, 1)
        faces = [([0, 4, 5, 3], [], 255), ([4, 1, 2, 5], [], 0)]
        kind += [("green", "u1"), ("blue", "u1")]
    face = np.empty(len(faces), [(name, "O" if rest else code) for name, code, *rest in kind])
    for row, (corners, places, red) in zip(face, faces):
        row["vertex_index"], row["texcoord"], row["red"] = np.array(corners), np.array(places, np.float32), red
        if of == "faces":
            row["green"], row["blue"] = 0, 255 - red
    elements = [PlyElement.describe(vertex, "vertex")]
    elements.append(
        PlyElement.describe(
            face, "face", len_types={"texcoord": "u1"}, val_types={"vertex_index": "i4", "texcoord": "f4"}
        )
    )
    PlyData(elements, text, comments=["TextureFile t 1.png"]).write(tmp_path / "a.ply")
    left, right, normal, _ = sides(tmp_path / "a.ply")
    assert (left, right) == pytest.approx((0.25, 0.75), abs=0.01) and normal == pytest.approx([0, 0, 1])


def paint(document, primitive, color):
    """Give the four corners of a glTF's primitive a colour."""
    data = b64encode(np.full((4, 3), color, "<f4").tobytes()).decode()
    document["buffers"] = [{"byteLength": 0}, {"byteLength": 48, "uri": f"data:;base64,{data}"}]
    document["bufferViews"].append({"buffer": 1, "byteLength": 48})
    view = len(document["bufferViews"]) - 1
    document["accessors"].append({"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"})
    primitive["attributes"]["COLOR_0"] = len(document["accessors"]) - 1


@pytest.mark.parametrize("form", ["obj", "glb"])
def test_of_a_mesh_s_parts_each_has_its_colours_of_vertices_texture_or_material(tmp_path, form):
    path = tmp_path / f"a.{form}"
    if form == "obj":
        halves(tmp_path / "t.png")
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\nnewmtl k\nKd 0 1 0\n")
        text = f"mtllib a.mtl\n{SQUARE}usemtl m\nf 1/1 2/2 3/3 4/4\n"
        text += "".join(f"v {x + 10} {y} 0 0 1 1\n" for x, y, _ in CORNERS) + "usemtl none\nf 5 6 7 8\n"
        text += "".join(f"v {x + 20} {y} 0\n" for x, y, _ in CORNERS) + "usemtl k\nf 9 10 11 12\n"
        path.write_text(text)
    else:

        def change(document):
            for k, material in enumerate([{"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}, {}], 1):
                plain = {"attributes": {"POSITION": 0}, "indices": 2, "material": k}
                document["materials"].append(material)
                document["meshes"].append({"primitives": [plain]})
                document["nodes"].append({"mesh": k, "translation": [30 - 10 * k, 0, 0]})
            paint(document, document["meshes"][2]["primitives"][0], (0, 1, 1))
            document["scenes"] = [{"nodes": [0, 1, 2]}]

        glb(path, change)
    read = read_cloud(path)
    part = (read.points[:, 0] // 10).astype(int)
    assert np.array_equal(np.unique(read.colors[part == 0], axis=0), [[0, 0, 255], [255, 0, 0]])
    assert (read.colors[part == 1] == [0, 255, 255]).all() and (read.colors[part == 2] == [0, 255, 0]).all()


def test_materials_that_are_not_there_leave_the_colours_of_vertices(tmp_path):
    corners = "".join(f"v {x} {y} 0 0 1 1\n" for x, y, _ in CORNERS)
    (tmp_path / "a.obj").write_text(f"mtllib gone.mtl\n{corners}usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n")
    assert (read_cloud(tmp_path / "a.obj").colors == [0, 255, 255]).all()


@pytest.mark.parametrize("form", ["obj", "ply", "glb"])
def test_a_texture_is_not_hidden_by_vertices_that_are_white(tmp_path, form):
    halves(tmp_path / "t.png")
    path = tmp_path / f"a.{form}"
    if form == "obj":
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
        white = re.sub("(v [^v]*)\n", r"\1 1 1 1\n", SQUARE)
        path.write_text(f"mtllib a.mtl\n{white}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    elif form == "ply":
        rows = "".join(f"{x:g} {y:g} 0 {x:g} {y:g} 255 255 255\n" for x, y, _ in CORNERS)
        more = "property float s\nproperty float t\n"
        more += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        faces = "element face 1\nproperty list uchar int vertex_indices\ncomment TextureFile t.png\nend_header\n"
        path.write_text(HEAD.format(4) + more + faces + rows + "4 0 1 2 3\n")
    else:
        glb(path, lambda document: paint(document, document["meshes"][0]["primitives"][0], (1, 1, 1)))
    assert sides(path)[:2] == pytest.approx([0.25, 0.75], abs=0.01)


@pytest.mark.parametrize("faces", [True, False])
def test_numbers_of_a_big_endian_ply_are_written_as_they_were(tmp_path, faces):
    vertex = np.zeros(40, [(axis, ">f8") for axis in "xyz"] + [("scalar_quality", ">f4"), ("class", ">i4")])
    for axis, values in zip("xyz", np.array(GRID).T):
        vertex[axis] = values
    vertex["scalar_quality"], vertex["class"] = 0.5, 7
    elements = [PlyElement.describe(vertex, "vertex")]
    if faces:  # none, but their lists are read otherwise
        empty = np.empty(0, [("vertex_indices", "O")])
        elements.insert(0, PlyElement.describe(empty, "face", val_types={"vertex_indices": "i4"}))
    PlyData(elements, byte_order=">").write(tmp_path / "a.ply")
    write_cloud(tmp_path / "b.ply", read_cloud(tmp_path / "a.ply"))
    written = read_cloud(tmp_path / "b.ply")
    np.testing.assert_allclose(written.points, GRID)
    assert (written.fields["quality"] == 0.5).all() and (written.fields["class"] == 7).all()


@pytest.mark.parametrize("inside", [True, False])
def test_a_gltf_has_its_buffer_and_picture_in_files_beside_it_or_in_itself(tmp_path, inside):
    kept = {}

    def change(document):
        view = document["bufferViews"][3]
        document["images"] = [{"uri": "my%20picture.png"}]
        document["buffers"] = [{"uri": "square.bin", "byteLength": view["byteOffset"] + view["byteLength"]}]
        kept.update(document)

    glb(tmp_path / "a.glb", change)
    content = (tmp_path / "a.glb").read_bytes()
    blob = content[28 + int.from_bytes(content[12:16], "little") :]
    halves(tmp_path / "my picture.png")
    if inside:
        kept["buffers"][0]["uri"] = "data:application/octet-stream;base64," + b64encode(blob).decode()
    (tmp_path / "a.gltf").write_text(json.dumps(kept))
    if not inside:
        with pytest.raises(StageError, match="a.gltf: its square.bin is missing or cut short; put it beside it"):
            read_cloud(tmp_path / "a.gltf")
        (tmp_path / "square.bin").write_bytes(blob)
    assert sides(tmp_path / "a.gltf")[:2] == pytest.approx([0.25, 0.75], abs=0.01)


@pytest.mark.parametrize("kind", ["diffuse", "emissive", "data"])
def test_a_glb_has_the_colours_of_older_and_of_shining_materials(tmp_path, kind, capsys):
    def change(document):
        material = document["materials"][0]
        if kind == "data":
            view = document["bufferViews"][3]
            stream = io.BytesIO()
            halves(stream)
            document["images"] = [{"uri": "data:image/png;base64," + b64encode(stream.getvalue()).decode()}]
            view["byteLength"] = 4
            return
        texture = material["pbrMetallicRoughness"].pop("baseColorTexture")
        material["pbrMetallicRoughness"]["baseColorFactor"] = [0, 0, 0, 1]
        if kind == "emissive":
            material |= {"emissiveTexture": texture, "emissiveFactor": [1, 1, 1]}
        else:
            material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": texture}}
            document["extensionsUsed"] = ["KHR_materials_pbrSpecularGlossiness"]

    glb(tmp_path / "a.glb", change)
    assert sides(tmp_path / "a.glb")[:2] == pytest.approx([0.25, 0.75], abs=0.01)
    assert "not read" not in capsys.readouterr().out


def test_the_colour_of_a_glb_s_material_is_light_and_brighter_in_pictures(tmp_path):
    """Blender writes middle grey, 128 in a picture, as 0.216 (glTF 2.0, 3.9.2)."""
    grey = {"pbrMetallicRoughness": {"baseColorFactor": [0.2158605, 1, 0, 1]}}
    glb(tmp_path / "a.glb", lambda document: document.update(materials=[grey]))
    assert (read_cloud(tmp_path / "a.glb").colors == [128, 255, 0]).all()


def test_a_glb_whose_texture_is_webp_alone(tmp_path):
    def change(document):
        document["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
        document["extensionsUsed"] = ["EXT_texture_webp"]

    glb(tmp_path / "a.glb", change, "WEBP")
    assert sides(tmp_path / "a.glb")[:2] == pytest.approx([0.25, 0.75], abs=0.01)


def test_a_texture_in_a_form_that_is_not_read_is_named_and_no_other_picture_is_taken(tmp_path, capsys):
    def change(document):
        document["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
        document["extensionsUsed"] = document["extensionsRequired"] = ["KHR_texture_basisu"]

    glb(tmp_path / "a.glb", change)
    assert read_cloud(tmp_path / "a.glb").colors is None
    said = capsys.readouterr().out
    assert "uses KHR_texture_basisu, which is not read" in said and "cannot be read" in said


@pytest.mark.parametrize(
    ("transform", "ends"),
    [({"offset": [0.5, 0]}, (0.75, 0.25)), ({"scale": [-1, 1]}, (0.75, 0.25)), ({"rotation": np.pi}, (0.75, 0.25))],
)
def test_a_texture_is_placed_by_its_transform(tmp_path, transform, ends):
    def change(document):
        texture = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        texture["extensions"] = {"KHR_texture_transform": transform}

    glb(tmp_path / "a.glb", change)
    assert sides(tmp_path / "a.glb")[:2] == pytest.approx(ends, abs=0.01)


def test_a_further_set_of_texture_coordinates_is_the_one_that_a_material_names(tmp_path):
    def change(document):
        names = document["meshes"][0]["primitives"][0]["attributes"]
        names["TEXCOORD_1"] = names.pop("TEXCOORD_0")
        document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1

    glb(tmp_path / "a.glb", change)
    assert sides(tmp_path / "a.glb")[:2] == pytest.approx([0.25, 0.75], abs=0.01)


def test_a_mirrored_node_keeps_its_outside_and_its_texture(tmp_path):
    glb(tmp_path / "a.glb", lambda document: document["nodes"][0].update(scale=[-1, 1, 1]))
    red, blue, normal, _ = sides(tmp_path / "a.glb")
    assert (red, blue) == pytest.approx([-0.25, -0.75], abs=0.01) and np.allclose(normal, [0, -1, 0])


def test_a_glb_of_points_alone_is_its_points(tmp_path):
    glb(tmp_path / "a.glb", lambda document: document["meshes"][0]["primitives"][0].update(mode=0))
    assert read_cloud(tmp_path / "a.glb").points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]


def test_children_of_a_glb_without_scenes_are_there_once(tmp_path):
    def change(document):
        document.pop("scenes")
        document.update(nodes=[{"mesh": 0}, {"children": [0], "translation": [5, 0, 0]}])

    glb(tmp_path / "a.glb", change)
    assert read_cloud(tmp_path / "a.glb").points[:, 0].min() >= 5


def test_instances_strips_fans_and_sparse_corners_of_glb(tmp_path):
    def instances(document):
        about = {"attributes": {"TRANSLATION": 4, "ROTATION": 5}}
        document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": about}

    def fan(document):
        primitive = document["meshes"][0]["primitives"][0]
        primitive["mode"] = 6
        del primitive["indices"]

    def sparse(document):
        about = {"count": 1, "indices": {"bufferView": 6, "componentType": 5125}, "values": {"bufferView": 7}}
        document["accessors"][0]["sparse"] = about

    for change, extent in ((instances, [6, 0, 1]), (fan, [1, 0, 1]), (sparse, [3, 0, 1])):
        glb(tmp_path / "a.glb", change)
        assert sides(tmp_path / "a.glb")[3] == pytest.approx(extent, abs=0.01), change
    glb(tmp_path / "a.glb")
    (tmp_path / "cut.glb").write_bytes((tmp_path / "a.glb").read_bytes()[:-9])
    with pytest.raises(StageError, match="cut short: its last 9 bytes are missing"):
        read_cloud(tmp_path / "cut.glb")


def survey(path, keys=None, wkt=None):
    """A LAS file with GeoTIFF keys (key -> code), or with WKT."""
    las = laspy.LasData(laspy.LasHeader(point_format=1 if keys else 6, version="1.2" if keys else "1.4"))
    las.header.scales, las.header.offsets = np.full(3, 0.001), [500_000, 4_500_000, 0]
    las.x, las.y, las.z = (np.array(GRID * 6).T * np.linspace(1, 2, 240)) + [[500_000], [4_500_000], [0]]
    if keys:
        body = struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(
            struct.pack("<4H", k, 0, 1, n) for k, n in keys.items()
        )
        record = GeoKeyDirectoryVlr()
        record.parse_record_data(body)
        las.header.vlrs.append(record)
    elif wkt:
        las.header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las.write(str(path))


@pytest.mark.parametrize(
    ("keys", "code", "units"),
    [
        ({3072: 2260, 4096: 5703}, "EPSG:2260+5703", "US survey foot and metre"),
        ({3072: 26918, 4096: 5703, 4099: 9003}, None, "US survey foot and metre"),
        ({3072: 26918, 4099: 9002}, None, "foot and metre"),
        ({3072: 26918, 4096: 5703}, "EPSG:26918+5703", None),
        ({3072: 2260, 4099: 9002}, None, None),  # both feet: 2 parts in a million
    ],
)
def test_heights_are_known_by_geotiff_keys_as_by_wkt(tmp_path, keys, code, units):
    survey(tmp_path / "keys.las", keys)
    found = las_crs(tmp_path / "keys.las")
    assert mixed_units(found) == units
    if code:
        wanted = pyproj.CRS.from_user_input(code)
        survey(tmp_path / "wkt.las", wkt=wanted.to_wkt("WKT1_GDAL"))
        assert found.sub_crs_list == wanted.sub_crs_list
        assert mixed_units(las_crs(tmp_path / "wkt.las")) == units


def test_a_plane_counts_in_the_unit_that_its_keys_name(tmp_path):
    survey(tmp_path / "feet.las", {3072: 26918, 3076: 9002})
    found = las_crs(tmp_path / "feet.las")
    at = np.array([[500_000 / 0.3048, 4_500_000 / 0.3048, 100.0]])
    wanted = to_wgs84(pyproj.CRS("EPSG:26918"), at * 0.3048, "")
    np.testing.assert_allclose(to_wgs84(found, at, ""), wanted, atol=1e-9)


def test_a_projection_that_keys_do_not_number_is_not_taken_for_its_datum_in_degrees(tmp_path, capsys):
    survey(tmp_path / "county.las", {1024: 1, 2048: 4269, 3072: 32767, 3076: 9003})
    assert las_crs(tmp_path / "county.las") is None and len(read_cloud(tmp_path / "county.las")) == 240
    assert "its keys name no number of a projected one, only its datum, NAD83" in capsys.readouterr().out
    survey(tmp_path / "globe.las", {1024: 2, 2048: 4269})
    with pytest.raises(StageError, match="is in degrees"):
        read_cloud(tmp_path / "globe.las")


@pytest.mark.parametrize("name", ["metre", "m", "Meter"])
def test_a_site_s_own_system_is_taken_as_such(tmp_path, name):
    survey(tmp_path / "site.las", wkt=f'LOCAL_CS["works",UNIT["{name}",1.0],AXIS["E",EAST],AXIS["N",NORTH]]')
    outputs = {"cloud": tmp_path / "a.ply", "report": tmp_path / "a.json", "georeference_json": tmp_path / "place.json"}
    import_scene_cloud(source=tmp_path / "site.las", **outputs)
    place = read_json(tmp_path / "place.json")
    assert value(place, "length_unit") == "m" and "works" in value(place, "crs") and not has_place(value(place, "crs"))
    with pytest.raises(StageError, match="works is a site's own system, which has no place on the earth"):
        to_wgs84(pyproj.CRS.from_wkt(value(place, "crs")), np.zeros((1, 3)), "photos")


@pytest.mark.parametrize("step", [0.0, np.nan])
def test_a_las_header_whose_coordinates_count_in_no_steps_is_refused(tmp_path, step):
    survey(tmp_path / "a.las", wkt=pyproj.CRS("EPSG:26918").to_wkt())
    content = bytearray((tmp_path / "a.las").read_bytes())
    struct.pack_into("<d", content, 131, step)
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(StageError, match="its coordinates count in steps of"):
        CloudFile.of(tmp_path / "a.las")


def test_coordinates_of_las_that_were_cut_off_where_32_bits_end_are_none(tmp_path):
    las = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    las.header.scales, las.header.offsets = [0.001] * 3, [0, 0, 0]  # CloudCompare 2.14 leaves out the offset
    las.x, las.y, las.z = np.array(GRID).T
    las.Y[5], las.Y[6] = -(2**31), 2**31 - 1
    las.write(tmp_path / "a.las")
    file = CloudFile.of(tmp_path / "a.las")
    assert np.allclose(file.part.points, np.delete(GRID, [5, 6], axis=0), atol=1e-3)
    assert "2 rows without a finite position of a.las were left out" in file.notes
    las.Y[:] = -(2**31)
    las.write(tmp_path / "a.las")
    with pytest.raises(StageError, match="holds no point of a surface .40 rows without a finite position"):
        CloudFile.of(tmp_path / "a.las")


@pytest.mark.parametrize(
    ("at", "kind", "number"), [(100, "<I", 2**32 - 1), (247, "<Q", 2**40), (105, "<H", 3), (243, "<I", 1)]
)
def test_a_las_header_that_counts_more_than_there_is_is_refused_at_once(tmp_path, at, kind, number):
    survey(tmp_path / "a.las", wkt=pyproj.CRS("EPSG:26918").to_wkt())
    content = bytearray((tmp_path / "a.las").read_bytes())
    struct.pack_into(kind, content, at, number)
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(StageError, match="counts more records than it holds|(points|records) are missing"):
        list(columns_in_parts(tmp_path / "a.las")())
