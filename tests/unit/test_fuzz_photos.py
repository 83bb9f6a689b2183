"""Photos, cameras, tables and settings of any content: read, or refused in one sentence, in seconds and little memory.

A few dozen each here; a thousand each by `make fuzz`.
"""

import io
import json
import resource
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_table
from scenefuse.georef.control import read_control
from scenefuse.marks.clicks import read_points
from scenefuse.marks.triangulation import read_ends
from scenefuse.photos.cameras.read_cameras import place_of, read_posed_photos
from scenefuse.photos.photo_files import photos_by_name
from scenefuse.photos.photos import inspect_photo, save_upright
from scenefuse.photos.positions import positions_of, read_geo, stated_position
from scenefuse.photos.subtitles import positions_in_subtitles
from scenefuse.sfm.features import read_calibration

MAX_SECONDS, MAX_BYTES = 10.0, 2 << 30
ODD = ["", " ", "\n", "\0", "\ufeff", "nan", "-1", "1e999", "99999999999999999999", "9" * 5000, "0/0", "ü", "\\", "../"]
ODD += [
    "[" * 20000,
    "{",
    "}",
    '"',
    "<",
    "<!DOCTYPE a [<!ENTITY b 'c'>]>",
    "&b;",
    "!!python/object:os.system",
    "&a [*a]",
]
ODD += ["2024-99-99", "null", "true", "#", ",", "\t", ";", "--help", "𝕏", "1_000", "0x1f", "Infinity", "*", "? :", "%"]


def within_limits(function, *arguments):
    """Calls a reader as commands do; anything but a result or one sentence fails."""
    start, limits = time.process_time(), resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MAX_BYTES, limits[1]))
    try:
        return function(*arguments)
    except StageError as error:
        assert "\n" not in str(error) and len(str(error)) > 20
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        assert time.process_time() - start < MAX_SECONDS


@st.composite
def mutated(draw, text):
    """A text, cut, overwritten or with something odd in it at up to four places."""
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        gone = draw(st.sampled_from([0, 0, 1, 3, 40, len(text)]))
        new = draw(st.one_of(st.sampled_from(ODD), st.text(max_size=5), st.integers(-9, 9).map(str)))
        text = text[:at] + new + text[at + gone :]
    return text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("fuzz")
    (place / "photos").mkdir()
    for name in ("a b.jpg", "c.JPG"):
        Image.new("RGB", (40, 30), (99, 120, 140)).save(place / "photos" / name, format="JPEG")
    return place


def written(path, text):
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return path


NUMBERS = st.one_of(
    st.integers(), st.floats(), st.builds(TiffImagePlugin.IFDRational, st.integers(-99, 99), st.just(0))
)
NUMBERS |= st.builds(TiffImagePlugin.IFDRational, st.integers(0, 2**32 - 1), st.integers(1, 10**6))
VALUES = st.one_of(st.none(), NUMBERS, st.lists(NUMBERS, max_size=4).map(tuple), st.binary(max_size=12))
VALUES |= st.text(max_size=12) | st.sampled_from(ODD) | st.from_regex(r"-?\d{1,3}[ ,/]\d{1,2}[NSEW]?", fullmatch=True)
XMP = '<x drone-dji:GpsLatitude="{}" drone-dji:GpsLongtitude="{}" drone-dji:RtkStdLon="{}" exif:GPSAltitude="{}"/>'


@pytest.mark.slow
@given(st.dictionaries(st.integers(1, 6), VALUES), st.lists(st.sampled_from(ODD) | NUMBERS.map(str), min_size=4))
def test_positions_of_exif_and_xmp(gps, words):
    position, note = within_limits(stated_position, gps, XMP.format(*words).encode("utf-8", "surrogatepass"))
    if position.latitude_deg is None:
        assert position.longitude_deg is None
    else:
        assert abs(position.latitude_deg) <= 90 and abs(position.longitude_deg) <= 180
    assert position.altitude_m is None or np.isfinite(position.altitude_m)
    assert isinstance(note, str)


def exif_bytes():
    exif = Image.Exif()
    exif[0x010F], exif[0x0112], exif[0x8769] = "Maker", 6, {0xA405: 24, 0x920A: 8.8}
    exif[0x8825] = {1: "N", 2: (33.0, 30.0, 0.0), 3: "E", 4: (70.0, 15.0, 0.0), 5: b"\0", 6: 77.0}
    return exif.tobytes()


@given(st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=4)), min_size=1, max_size=4))
def test_blocks_of_exif(folder, edits):
    block = bytearray(exif_bytes())
    for at, new in edits:
        block[at % len(block) : at % len(block) + len(new)] = new
    stream = io.BytesIO()
    Image.new("RGB", (40, 30), (99, 120, 140)).save(stream, format="JPEG", exif=bytes(block))
    (folder / "exif").mkdir(exist_ok=True)
    (folder / "exif/a.jpg").write_bytes(stream.getvalue())
    photo = within_limits(inspect_photo, folder / "exif", "a.jpg")
    if photo is not None:
        within_limits(save_upright, folder / "exif", photo, folder / "upright.jpg")


IMAGES = "# Image list\n1 1 0 0 0 0 0 5 1 a b.jpg\n1.5 2.5 -1\n2 0.7 0.1 0 0.7 1 2 5 1 c.JPG\n\n"
MATRIX = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
FRAMES = [{"file_path": f"images/{name}", "transform_matrix": MATRIX} for name in ("a b.jpg", "c.JPG")]
TRANSFORMS = {"w": 40, "h": 30, "fl_x": 50.0, "k1": 0.1, "camera_model": "OPENCV", "frames": FRAMES}
SHOT = {"rotation": [0.1, 0.2, 0.3], "translation": [1.0, 2.0, 3.0], "camera": "c"}
LENS = {"projection_type": "perspective", "width": 40, "height": 30, "focal": 0.9, "k1": 0.0, "k2": 0.0}
OPENSFM = [{"cameras": {"c": LENS}, "shots": {"a b.jpg": SHOT, "c.JPG": SHOT}}]
METASHAPE = (
    '<document><chunk><sensors><sensor id="0" type="frame"><resolution width="40" height="30"/><calibration'
    ' class="adjusted"><f>50</f><k1>0.1</k1><b2>0.1</b2></calibration></sensor></sensors><cameras><camera id="0"'
    ' sensor_id="0" label="c"><transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform></camera></cameras>'
    "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><scale>2</scale></transform></chunk></document>"
)
BUNDLER = "# Bundle file v0.3\n2 0\n" + "50 0 0\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n" * 2
CALIBRATION = "1 PINHOLE 40 30 50 50 20 15\n"
CAMERAS = {
    "model/images.txt": IMAGES,
    "model/cameras.txt": CALIBRATION,
    "transforms.json": json.dumps(TRANSFORMS),
    "reconstruction.json": json.dumps(OPENSFM),
    "cameras.xml": METASHAPE,
    "bundle.out": BUNDLER,
    "list.txt": "a b.jpg 0 50.0\nC:\\x\\c.JPG\n",
}


def cameras_and_place(path, photos):
    photos, _, notes = read_posed_photos(path, photos)
    for photo in photos:
        assert np.isfinite(photo.object_from_cam).all() and photo.file.parent.name == "photos"
        assert min(photo.camera.width, photo.camera.height) > 0 and np.isfinite(photo.camera.params).all()
    place_of(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
@given(data=st.data())
def test_cameras_of_other_programs(folder, name, data):
    for other, text in CAMERAS.items():
        written(folder / other, data.draw(mutated(text)) if other == name else text)
    given_to = {"list.txt": "bundle.out"}.get(name, name)
    path = folder / given_to
    within_limits(cameras_and_place, path.parent if path.suffix == ".txt" else path, folder / "photos")


@given(st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=1, max_size=8)), max_size=4), st.integers(0, 300))
def test_binary_models_of_colmap(folder, edits, cut):
    (folder / "binary").mkdir(exist_ok=True)
    (folder / "binary/cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 40, 30, 50, 50, 20, 15))
    images = struct.pack("<Q", 2)
    for number, name in enumerate((b"a b.jpg", b"c.JPG"), 1):
        images += struct.pack("<I7dI", number, 1, 0, 0, 0, 0, 0, 5, 1) + name + b"\0" + struct.pack("<QddQ", 1, 1, 2, 7)
    damaged = {name: bytearray((folder / "binary" / name).read_bytes()) for name in ("cameras.bin",)}
    damaged["images.bin"] = bytearray(images)
    for at, new in edits:
        block = damaged[("cameras.bin", "images.bin")[at % 2]]
        block[at % len(block) : at % len(block) + len(new)] = new
    for name, block in damaged.items():
        (folder / "binary" / name).write_bytes(block[: len(block) - cut % 40 * (cut > 200)])
    within_limits(cameras_and_place, folder / "binary", folder / "photos")


CLICKS = "point\tphoto\tx_px\ty_px\na\tc.JPG\t3.5\t4\na\ta b.jpg\t5\t6\n"
LENGTHS = "length\tmetres\tend\tphoto\tx_px\ty_px\nbar\t1.5\ta\tc.JPG\t3\t4\nbar\t1.5\tb\tc.JPG\t5\t6\n"
CONTROL = "EPSG:32632\n466000 5246000 430 12 13 c.JPG a\n466010 5246000 431 12 13 c.JPG b 0.1\n"
SUBTITLES = "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 50.1] [longtitude : 8.6] [rel_alt: 1.5 abs_alt: 99.1]\n\n"
SUBTITLES += "2\n00:00:01,000 --> 00:00:02,000\nHOME(8.7,50.2)\nGPS(8.6101,50.1102,14M) BAROMETER:8.8 H 3.50m\n"
TABLES = {
    "points.tsv": (CLICKS, read_points),
    "labels.tsv": ("label\tphoto\tx_px\ty_px\ninside\tc.JPG\t3\t4\nbox\tc.JPG\t1\t2\n", read_points),
    "places.txt": ("point x y z\na 1 2 3\nb 4 5 6\n", read_points),
    "lengths.tsv": (LENGTHS, read_ends),
    "gcp_list.txt": (CONTROL, read_control),
    "geo.txt": (
        "EPSG:4326\nc.JPG 8.5 47.5 400 0 0 0 0.1\na b.jpg\t8.6\t47.5\n",
        lambda path: positions_of(["a b.jpg", "c.JPG"], read_geo(path), path),
    ),
    "flight.srt": (SUBTITLES, lambda path: positions_in_subtitles(path, [0.0, 0.5, 1.5, 9.0])),
    "calibration.txt": (CALIBRATION, read_calibration),
    "scenes.tsv": ('scene\tphotos\tcrs\n"yard"\t~/p\tEPSG:25832\n# no\nb\t\n', lambda path: read_table(path, "scene")),
    "config.yaml": ("object: {nerf: {width_px: 1600}}\nseed: 3\nscenes: a.tsv\n", read_settings),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
@given(data=st.data())
def test_tables_and_settings(folder, name, data):
    text, reader = TABLES[name]
    within_limits(reader, written(folder / name, data.draw(mutated(text))))


def test_settings_whose_aliases_expand_without_end_are_refused(tmp_path):
    lists = ["&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lists += [f"&a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    for text in (f"seed: [{', '.join(lists)}]", "seed: &a [*a]"):
        with pytest.raises(StageError, match="bomb.yaml, aliases of YAML expand without end"):
            read_settings(written(tmp_path / "bomb.yaml", text))


NAMES = st.lists(st.text(alphabet="aAbB/\\._ 1äÄ\u0308jpgJPG", max_size=12), max_size=6)


@given(NAMES, NAMES)
def test_names_lead_to_known_photos_alone_and_each_to_one(wanted, known):
    found = within_limits(photos_by_name, wanted, known, "the list of photos")
    if found is not None:
        assert set(found) <= set(wanted) and set(found.values()) <= set(known)
        assert len(set(found.values())) == len(found)
