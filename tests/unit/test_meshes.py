"""Meshes are read as points spread evenly over their faces, with the faces' normals and colours."""

import json
import os
import tracemalloc
import weakref
from functools import partial

import cv2
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.cloud_files import UTM

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.clouds import read_cloud
from scenefuse.cloud.formats import with_named
from scenefuse.cloud.readers import meshes
from scenefuse.cloud.readers.meshes import MESH_POINTS, Material, Mesh, sampled_columns
from scenefuse.core.stage import StageError

# A roof: a large face that looks west and up, a small one that looks east.
CORNERS = np.array([[0, 0, 0], [0, 4, 0], [4, 4, 4], [4, 0, 4], [5, 0, 0], [5, 4, 0]], dtype=np.float64)
QUADS = [[0, 3, 2, 1], [3, 4, 5, 2]]
PAINT = np.array([[255, 0, 0], [255, 0, 0], [0, 0, 255], [0, 0, 255], [0, 255, 0], [0, 255, 0]], dtype=np.uint8)


def write_ply(path, corners=CORNERS, faces=QUADS):
    vertex = np.empty(len(corners), [*((k, "f8") for k in "xyz"), *((k, "u1") for k in ("red", "green", "blue"))])
    for k, values in zip(vertex.dtype.names, [*corners.T, *PAINT.T]):
        vertex[k] = values
    face = np.empty(len(faces), [("vertex_indices", object)])
    face["vertex_indices"] = [np.array(one, np.int32) for one in faces]
    PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]).write(path)


def write_obj(path, corners=CORNERS, picture=True):
    """Each face shows the whole picture: its lower half is red, its upper half blue."""
    square = np.zeros((20, 20, 3), np.uint8)
    square[:10], square[10:] = (255, 0, 0), (0, 0, 255)  # OpenCV's order: blue above, red below
    cv2.imwrite(str(path.with_suffix(".png")), square)
    lines = [f"mtllib {path.stem}.mtl", *(f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist())]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl paint"]
    lines += ["f " + " ".join(f"{row + 1}/{k + 1}" for k, row in enumerate(quad)) for quad in QUADS]
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text("newmtl paint\nKd 0.5 0.5 0.5\n" + f"map_Kd {path.stem}.png\n" * picture)


def write_glb(path, extensions=(), corners=CORNERS):
    """The roof with y up, as glTF has it, at twice its size, moved by a node; faces as triangles."""
    y_up = (corners @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T).astype("<f4")
    index = np.array([[a, b, c] for a, b, c, _ in QUADS] + [[a, c, d] for a, _, c, d in QUADS], "<u2")
    blob = y_up.tobytes() + index.tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [10, 0, 0]}, {"mesh": 0, "scale": [2, 2, 2]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(y_up), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": index.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": y_up.nbytes},
            {"buffer": 0, "byteOffset": y_up.nbytes, "byteLength": index.nbytes},
        ],
        "extensionsUsed": list(extensions),
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(blob).to_bytes(4, "little") + b"BIN\0" + blob
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks)


def on_roof(points):
    """Which points lie on the large face and on the small one."""
    x, z = points[:, 0], points[:, 2]
    return np.abs(z - x) < 1e-6, np.abs(z - 4 * (5 - x)) < 1e-5


def test_a_ply_mesh_gives_points_on_its_faces_by_their_area_and_not_its_vertices(tmp_path):
    write_ply(tmp_path / "roof.ply")
    cloud = read_cloud(tmp_path / "roof.ply")
    large, small = on_roof(cloud.points)
    areas = 4 * np.sqrt([32, 17])
    assert len(cloud) == MESH_POINTS and (large | small).all()
    assert large.mean() == pytest.approx(areas[0] / areas.sum(), abs=1e-4)
    assert np.allclose(cloud.normals[large], np.array([-1, 0, 1]) / np.sqrt(2), atol=1e-6)
    assert np.allclose(cloud.normals[small & ~large], np.array([4, 0, 1]) / np.sqrt(17), atol=1e-6)
    # The ends of the large face are red and blue, and the colours run from one to the other.
    share = cloud.points[large, 0] / 4
    assert np.abs(cloud.colors[large] - np.outer(1 - share, [255, 0, 0]) - np.outer(share, [0, 0, 255])).max() <= 1


def test_the_points_are_more_even_than_chance(tmp_path):
    write_ply(tmp_path / "roof.ply")
    cloud = read_cloud(tmp_path / "roof.ply")
    large = cloud.points[on_roof(cloud.points)[0]]
    counts = np.histogram2d(large[:, 0], large[:, 1], bins=100)[0]
    assert counts.min() > 0 and counts.var() < 0.5 * counts.mean()  # drawn by chance, both are alike


def test_a_ply_without_faces_is_its_vertices(tmp_path):
    write_ply(tmp_path / "roof.ply", faces=[])
    assert np.array_equal(read_cloud(tmp_path / "roof.ply").points, CORNERS)


def test_an_obj_at_utm_coordinates_keeps_millimetres_and_takes_its_texture(tmp_path):
    write_obj(tmp_path / "roof.obj", CORNERS + UTM)
    cloud = read_cloud(tmp_path / "roof.obj")
    large, small = on_roof(cloud.points - UTM)
    assert (large | small).all()
    # The first face's edge from corner 0 to 3 is the picture's lower one: red.
    y = cloud.points[:, 1] - UTM[1]
    assert np.array_equal(np.unique(cloud.colors[large & (y < 1.9)], axis=0), [[255, 0, 0]])
    assert np.array_equal(np.unique(cloud.colors[large & (y > 2.1)], axis=0), [[0, 0, 255]])


def test_an_obj_whose_texture_is_lost_has_its_materials_colour_and_that_is_said(tmp_path, capsys):
    write_obj(tmp_path / "roof.obj")
    (tmp_path / "roof.png").unlink()
    assert np.array_equal(np.unique(read_cloud(tmp_path / "roof.obj").colors, axis=0), [[128, 128, 128]])
    assert "roof.png cannot be read" in capsys.readouterr().out


def test_what_a_mesh_names_is_known_whether_it_is_there_or_not(tmp_path):
    write_obj(tmp_path / "roof.obj")
    (tmp_path / "roof.png").unlink()
    (tmp_path / "a.gltf").write_text(
        '{"buffers": [{"uri": "my%20a.bin"}], "images": [{"uri": "data:,"}, {"uri": "a.PNG"}]}'
    )
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\ncomment TextureFile t 1.png\nend_header\n")
    (tmp_path / "bad.gltf").write_text("{")
    found = {name: [path.name for path in with_named(tmp_path / name)[1:]] for name in os.listdir(tmp_path)}
    assert {name: named for name, named in found.items() if named} == {
        "roof.obj": ["roof.mtl", "roof.png"],
        "a.gltf": ["my a.bin", "a.PNG"],
        "a.ply": ["t 1.png"],
    }
    assert with_named(tmp_path / "gone.obj") == [tmp_path / "gone.obj"]


def test_an_obj_counts_vertices_from_the_end_where_it_says_so(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n")
    cloud = read_cloud(tmp_path / "a.obj")
    assert np.allclose(cloud.normals, [0, 0, 1]) and cloud.points.sum(1).max() <= 1 and cloud.colors is None


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("first", [1, -1])
def test_a_concave_face_leaves_its_notch_empty(tmp_path, axis, first):
    corners = np.array([[0, 0], [1, 0], [1, 1], [0.5, 0.2], [0, 1]])[::first]
    in_space = np.roll(np.column_stack([corners, np.zeros(5)]), axis, axis=1)
    lines = [f"v {x} {y} {z}" for x, y, z in in_space] + ["f 1 2 3 4 5"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    read = read_cloud(tmp_path / "a.obj")
    u, v, _ = np.roll(read.points, -axis, axis=1).T
    assert (v <= 0.2 + 1.6 * abs(u - 0.5) + 1e-9).all() and np.allclose(read.normals, first * np.roll([0, 0, 1], axis))
    assert [np.mean(u < 0.5), np.mean(v < 0.2)] == pytest.approx([0.5, 0.2 / 0.6], abs=0.001)


@pytest.mark.slow
def test_a_glb_stands_upright_at_its_place(tmp_path):
    write_glb(tmp_path / "roof.glb")
    cloud = read_cloud(tmp_path / "roof.glb")
    large, small = on_roof((cloud.points - [10, 0, 0]) / 2)
    assert (large | small).all() and large.any() and small.any()
    assert np.array_equal(np.unique(cloud.colors, axis=0), [[0, 255, 0]])
    said = "roof.glb is turned so that z is up: what is x, y, z here is x, -z, y there"
    assert CloudFile.of(tmp_path / "roof.glb").notes == [said]


@pytest.mark.parametrize(
    "name, content, sentence",
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "not a readable OBJ cloud .*vertices that it does not have"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "none of its faces has an area"),
        ("a.obj", "", r"is empty \(0 bytes\)"),
        ("a.glb", "solid", "not a readable GLB cloud .*does not begin as glTF does"),
        ("a.zip", "x", r"'\.zip' is no cloud's ending; unpack or convert it to one of \.ply, \.obj, \.glb"),
    ],
    ids=["no such vertex", "no area", "empty", "no GLB", "unknown ending"],
)
def test_a_bad_mesh_is_one_sentence(tmp_path, name, content, sentence):
    (tmp_path / name).write_text(content)
    with pytest.raises(StageError, match=sentence):
        read_cloud(tmp_path / name)


def test_a_folder_of_tiles_is_one_sentence(tmp_path):
    with pytest.raises(StageError, match="is a folder; give one cloud, its tiles merged into a file"):
        read_cloud(tmp_path)


def test_a_compressed_glb_says_so(tmp_path):
    write_glb(tmp_path / "roof.glb", ["KHR_draco_mesh_compression"])
    with pytest.raises(StageError, match="compressed by KHR_draco_mesh_compression: export them without"):
        read_cloud(tmp_path / "roof.glb")


def test_a_mesh_whose_materials_say_nothing_has_no_colours(tmp_path, capsys):
    (tmp_path / "a.mtl").write_text("newmtl grey\nNs 10\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv\t0 0 0\nv\t1 0 0\nv\t0 1 0\nusemtl grey\nf 1 2 3\n")
    assert read_cloud(tmp_path / "a.obj").colors is None
    assert "neither pictures nor colours" in capsys.readouterr().out


def test_a_picture_behind_options_is_found(tmp_path):
    cv2.imwrite(str(tmp_path / "my tex.png"), np.full((4, 4, 3), 40, np.uint8))
    (tmp_path / "a.mtl").write_text('newmtl m\nmap_Kd -s 1 1 1 -clamp on "my tex.png"\n')
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3\n")
    assert (read_cloud(tmp_path / "a.obj").colors == 40).all()


def test_one_picture_of_a_mesh_s_materials_is_held(tmp_path):
    """Twenty of 8192 x 8192 are 4 GB."""
    held = list[weakref.ref]()

    def picture(number):
        assert all(other() is None for other in held)
        found = np.full((4, 4, 3), number, np.uint8)
        held.append(weakref.ref(found))
        return found

    corners, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.tile(np.arange(3), (5, 1))
    materials = tuple(Material(partial(picture, number)) for number in range(5))
    mesh = Mesh(corners, faces, None, np.tile(corners[None, :, :2], (5, 1, 1)), np.arange(5), materials)
    assert set(sampled_columns(mesh)["red"].tolist()) == set(range(5)) and len(held) == 5


@pytest.mark.parametrize(("ending", "most"), [("ply", 400), ("obj", 600)])
def test_a_large_mesh_takes_memory_by_its_numbers_alone(tmp_path, monkeypatch, ending, most):
    """Objects of Python for each face were 10 GB for 20 million of them."""
    monkeypatch.setattr(meshes, "MESH_POINTS", 1000)
    x, y = (numbers.ravel() for numbers in np.meshgrid(np.arange(50.0), np.arange(50.0)))
    first = (np.arange(49)[:, None] * 50 + np.arange(49)).ravel()
    faces = np.concatenate([first[:, None] + [0, 1, 51], first[:, None] + [0, 51, 50]])
    corners, path = np.stack([x, y, 0 * x], axis=1), tmp_path / f"a.{ending}"
    if ending == "obj":
        lines = [" ".join(["v", *map(str, one)]) for one in corners] + [
            " ".join(["f", *map(str, f)]) for f in faces + 1
        ]
        path.write_text("\n".join(lines))
    else:
        rows = np.zeros(len(faces), [("vertex_indices", "i4", (3,))])
        rows["vertex_indices"] = faces
        table = np.array(list(map(tuple, corners)), [(axis, "f4") for axis in "xyz"])
        PlyData([PlyElement.describe(table, "vertex"), PlyElement.describe(rows, "face")]).write(path)
    read_cloud(path)
    tracemalloc.start()
    assert (read_cloud(path).normals == [0, 0, 1]).all()
    assert tracemalloc.get_traced_memory()[1] < most * len(faces)
    tracemalloc.stop()
