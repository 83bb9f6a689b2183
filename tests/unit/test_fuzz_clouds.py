"""Cloud files of any content: read, or refused in one sentence, in seconds and little memory.

A few dozen each here; a thousand each by `make fuzz`.
"""

import copy
import resource
import struct
import time
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.glb_file import write_square

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.formats import check_not_degrees
from scenefuse.core.stage import StageError

MAX_SECONDS, MAX_BYTES = 10.0, 2 << 30
COUNTS = st.sampled_from(["0", "1", "3", "4", "-1", "1e3", "x", "1000000", "1000000000000", "99999999999999999999", ""])
NUMBERS = st.one_of(
    st.integers(-9, 9).map(str),
    st.floats().map(repr),
    st.sampled_from(
        ['"1"', "nan", "NULL", "", "1.", "255.0", "1e999", "tree", "ü", "#", "0x1f", "\0", "1,5", '"', "-"]
    ),
)


def read(folder: Path, name: str, content: bytes) -> None:
    """Reads a file as the commands do; anything but a cloud or one sentence fails."""
    path = folder / name
    path.write_bytes(content)
    start, limits = time.process_time(), resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MAX_BYTES, limits[1]))
    try:
        check_not_degrees(path, CloudFile.of(path).part.points)
    except StageError as error:
        assert name in str(error) and "\n" not in str(error)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - start < MAX_SECONDS


@pytest.fixture(autouse=True)
def few_points_of_a_mesh(monkeypatch):
    monkeypatch.setattr("scenefuse.cloud.readers.meshes.MESH_POINTS", 1000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def rows(marks=" "):
    """Lines of cells, mostly of one length."""
    return (
        st.sampled_from(marks)
        .flatmap(
            lambda one: st.integers(1, 7).flatmap(
                lambda width: st.lists(
                    st.one_of(
                        st.lists(NUMBERS, min_size=width, max_size=width).map(one.join),
                        st.lists(st.integers(0, 99).map(str), min_size=width, max_size=width).map(one.join),
                        st.sampled_from(["", "# comment", "end", "1 2", '"'] + ["x y z"] * 2),
                    ),
                    max_size=12,
                )
            )
        )
        .map("\n".join)
    )


TYPES = st.sampled_from(["float", "double", "uchar", "int", "ushort", "list uchar int", "list int float", "word", ""])
COLUMN_NAMES = st.sampled_from(["x", "y", "z", "red", "green", "blue", "nx", "vertex_indices", "", "ü", "x"])
ELEMENTS = st.lists(
    st.tuples(
        st.sampled_from(["vertex", "face", "tile", ""]), COUNTS, st.lists(st.tuples(TYPES, COLUMN_NAMES), max_size=5)
    ),
    max_size=3,
)
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


@given(
    st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian", "text", ""]),
    st.one_of(
        st.tuples(COUNTS, st.sampled_from(["", "property uchar red\n", FACES]))
        .map(lambda two: f"element vertex {two[0]}\n{XYZ}{two[1]}"),
        ELEMENTS.map(
            lambda some: "".join(
                f"element {name} {count}\n" + "".join(f"property {kind} {own}\n" for kind, own in columns)
                for name, count, columns in some
            )
        ),
    ),
    st.one_of(rows().map(str.encode), st.binary(max_size=200)),
)  # fmt: skip
def test_any_ply_is_read_or_refused(folder, form, header, body):
    read(folder, "a.ply", f"ply\nformat {form} 1.0\n{header}end_header\n".encode() + body)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "#", ""]),
            st.one_of(COUNTS, st.sampled_from(["x y z", "4 4 4", "F F F", "1 1 1", "x y z rgb", "8 8 8 4", "F F F U"])),
        ),
        max_size=3,
    ),
    st.tuples(COUNTS, COUNTS),
    st.sampled_from(["ascii", "binary", "binary_compressed", "other", ""]),
    st.one_of(rows().map(str.encode), st.binary(max_size=200)),
)  # fmt: skip
def test_any_pcd_is_read_or_refused(folder, changed, extent, data, body):
    lines = {"FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"} | dict(changed)
    lines = dict(zip(("WIDTH", "HEIGHT"), extent)) | lines
    header = "".join(f"{word} {content}\n" for word, content in lines.items())
    read(folder, "a.pcd", f"{header}DATA {data}\n".encode() + body)


@given(
    st.sampled_from(["a.xyz", "a.csv", "a.pts", "a.txt"]),
    st.sampled_from(["", "x,y,z\n", "x y z r g b\n", "E;N;H\n", "3\n", "\ufeff", "lon,lat,h\n"]),
    rows(" ,;\t|"),
    st.sampled_from(["utf-8", "utf-16", "cp1252"]),
)
def test_any_rows_of_text_are_read_or_refused(folder, name, header, body, encoding):
    read(folder, name, (header + body).encode(encoding, "replace"))


@given(
    st.sampled_from(["a.xyz", "a.csv", "a.ply", "a.pcd", "a.obj", "a.glb", "a.las", "a.laz"]), st.binary(max_size=400)
)
def test_any_bytes_are_read_or_refused(folder, name, content):
    read(folder, name, content)


@given(
    st.lists(
        st.one_of(
            st.lists(st.integers(-9, 9).map(str), min_size=3, max_size=3).map(lambda cells: "v " + " ".join(cells)),
            st.lists(st.integers(-4, 4).map(str), min_size=2, max_size=5).map(lambda cells: "f " + " ".join(cells)),
            st.tuples(
                st.sampled_from(["v", "vt", "vn", "f", "usemtl", "mtllib", "o", "l", ""]), st.lists(NUMBERS, max_size=7)
            ).map(lambda two: " ".join([two[0], *two[1]])),
            st.sampled_from(["f 1/1 2/2 3/3", "f 1//1 2//1 3//1", "f 1/2/3/4 2 3", "v 1 2 \\", "mtllib ..", "\\"]),
        ),
        max_size=15,
    ).map("\n".join)
)
def test_any_obj_is_read_or_refused(folder, content):
    read(folder, "a.obj", content.encode())


@pytest.fixture(scope="module", params=["las", "laz"])
def survey(request, folder):
    las = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
    las.x, las.y, las.z = np.random.default_rng(0).random((3, 20))
    las.write(str(folder / f"whole.{request.param}"))
    return f"a.{request.param}", (folder / f"whole.{request.param}").read_bytes()


@given(
    st.lists(st.tuples(st.integers(0, 366), st.sampled_from("BHIQ"), st.integers(0, 2**64 - 1)), max_size=3),
    st.integers(0, 3000),
)  # fmt: skip
def test_any_header_of_las_is_read_or_refused(folder, survey, changes, length):
    name, whole = survey
    content = bytearray(whole)
    for at, kind, number in changes:
        struct.pack_into(f"<{kind}", content, at, number % 256 ** struct.calcsize(kind))
    read(folder, name, bytes(content[: length if length % 3 == 0 else None]))


def places(node, path=()):
    """The ways to all values of a document."""
    for key, child in node.items() if isinstance(node, dict) else enumerate(node):
        yield (*path, key)
        yield from places(child, (*path, key)) if isinstance(child, (dict, list)) else ()


VALUES = st.sampled_from([-1, 0, 1, 2, 3, 5, 6, 7, 5121, 2**40, 0.5, "x", None, [], {}, [0, 0, 0]])


@given(st.lists(st.tuples(st.integers(0, 999), VALUES), max_size=3))
def test_any_glb_is_read_or_refused(folder, changes):
    def change(document):
        document["nodes"][0]["extensions"] = {
            "EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 4, "ROTATION": 5}}
        }
        sparse = {"count": 1, "indices": {"bufferView": 6, "componentType": 5125}, "values": {"bufferView": 7}}
        document["accessors"][0]["sparse"] = sparse
        for number, value in changes:
            ways = list(places(document))
            *path, last = ways[number % len(ways)]
            node = document
            for key in path:
                node = node[key]
            node[last] = copy.deepcopy(value)

    write_square(folder / "made.glb", change)
    read(folder, "a.glb", (folder / "made.glb").read_bytes())
