"""Cameras of other programs in the place of mapping: written by the test, read back, and triangulated."""

import json
import re
from dataclasses import replace
from html import escape
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from support.surveyed import FOCAL, HEIGHT, WIDTH, fly

from scenefuse.core.stage import StageError, quantity, read_json, value
from scenefuse.georef.georeference import camera_poses
from scenefuse.photos.cameras.given import PosedPhoto, stood_upright
from scenefuse.photos.cameras.read_cameras import place_of, read_posed_photos
from scenefuse.photos.photo_files import camera_files
from scenefuse.photos.photos import write_photos
from scenefuse.photos.workspace import View, write_model
from scenefuse.sfm.mapping import MappingSettings, map_photos

FLIGHT = fly(rows=3, columns=3)


def with_database(folder, views=FLIGHT.views):
    """A database of exact observations and verified matches, and the list of photos; their names and sizes."""
    write_photos(folder / "photos.json", FLIGHT.photos(), folder, "photos", [])
    (folder / "photos").mkdir()
    with pycolmap.Database.open(folder / "database.db") as database:
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[500.0, 400, 300, 0])
        number = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
        rig_id, rows = database.write_rig(rig), []
        for view in views:
            (folder / "photos" / view.name).write_bytes(b"")
            image = database.write_image(pycolmap.Image(name=view.name, camera_id=number))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            data = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number), image)
            frame.add_data_id(data)
            database.write_frame(frame)
            seen, pixels, _ = view.visible(FLIGHT.ground)
            database.write_keypoints(image, view.project(FLIGHT.ground[seen])[0].astype(np.float32))
            rows.append((image, {int(point): k for k, point in enumerate(seen)}))
        for k, (first, a) in enumerate(rows):
            for second, b in rows[k + 1 :]:
                both = sorted(a.keys() & b.keys())
                if len(both) >= 15:
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = np.array([[a[p], b[p]] for p in both], dtype=np.uint32)
                    database.write_two_view_geometry(first, second, geometry)


def colmap(folder):
    (folder / "given/sparse").mkdir(parents=True)
    write_model(folder / "given/sparse", FLIGHT.views)
    return folder / "given"


def rational(folder):
    """A lens whose coefficients are large and cancel, as ours may have."""
    sparse = colmap(folder) / "sparse"
    model = pycolmap.Reconstruction(sparse)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.FULL_OPENCV
        camera.params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 2, -5, 0, 0, 22, 2, -5, 22]
    model.write(sparse)
    return folder / "given"


def nerfstudio(folder, views=FLIGHT.views):
    frames = []
    for view in views:
        pose = view.world_from_cam @ np.diag([1.0, -1, -1, 1])
        own = {} if views is FLIGHT.views else {"fl_x": view.intrinsics[0, 0], "fl_y": view.intrinsics[1, 1]}
        frames.append({"file_path": f"photos/{view.name}", "transform_matrix": pose.tolist(), **own})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder / "transforms.json"


def opensfm(folder, kind="perspective", bent=None):
    lens = {"projection_type": kind, "width": 2 * WIDTH, "height": 2 * HEIGHT, "k1": 0.0, "k2": 0.0}
    lens |= {"focal": FOCAL / WIDTH, "focal_x": FOCAL / WIDTH, "focal_y": FOCAL / WIDTH, "c_x": 0.0, "c_y": 0.0}
    lens |= {"p1": 0.0, "p2": 0.0, "k3": 0.0} if bent is None else bent
    shots = {}
    for view in FLIGHT.views:
        turn = Rotation.from_matrix(view.cam_from_world[:3, :3]).as_rotvec().tolist()
        shots[view.name] = {"rotation": turn, "translation": view.cam_from_world[:3, 3].tolist(), "camera": "c"}
    (folder / "opensfm").mkdir(exist_ok=True)
    (folder / "opensfm/reconstruction.json").write_text(json.dumps([{"cameras": {"c": lens}, "shots": shots}]))
    return folder


LENS = {"f": FOCAL, "cx": 0.0, "cy": 0.0}


PLACED = "<transform><translation>4.2e6 6e5 4.75e6</translation><scale>3</scale></transform>"
EARTH = f"<reference>{escape(pyproj.CRS(4326).to_wkt('WKT1_GDAL'))}</reference>{PLACED}"


def metashape(folder, lens=LENS, placed=EARTH, kind="frame"):
    """As Metashape exports it: labels without ending, a group, a photo that was not aligned."""
    inside = "".join(f"<{name}>{number}</{name}>" for name, number in lens.items())
    cameras = "".join(
        f'<camera id="{k}" sensor_id="0" label="{view.name.rsplit(".", 1)[0]}">'
        f"<transform>{' '.join(map(repr, view.world_from_cam.ravel().tolist()))}</transform></camera>"
        for k, view in enumerate(FLIGHT.views)
    )
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    calibration = f'<calibration type="{kind}" class="adjusted">{size}{inside}</calibration>'
    (folder / "cameras.xml").write_text(
        f'<document><chunk><sensors><sensor id="0" type="{kind}">{size}{calibration}</sensor></sensors>'
        f'<cameras><group id="0">{cameras}</group><camera id="99" sensor_id="0" label="lost"/></cameras>'
        f"{placed}</chunk></document>"
    )
    return folder / "cameras.xml"


def bundler(folder, views=FLIGHT.views):
    """As RealityCapture exports it: full paths of another machine, and a photo without a camera."""
    lines = ["# Bundle file v0.3", f"{len(FLIGHT.views) + 1} 0", *["0 0 0"] * 5]
    for view in views:
        cv2.imwrite(str(folder / "photos" / view.name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        flipped = np.diag([1.0, -1, -1]) @ view.cam_from_world[:3]
        rows = [[FOCAL, 0.0, 0.0], *flipped[:, :3], flipped[:, 3]]
        lines += [" ".join(repr(float(number)) for number in row) for row in rows]
    (folder / "bundle.out").write_text("\n".join(lines))
    names = ["lost.jpg", *(f"C:\\my photos\\{view.name} 0 500.0" for view in FLIGHT.views)]
    (folder / "list.txt").write_text("\n".join(names))
    return folder / "bundle.out"


def mapped(folder, cameras):
    map_photos(
        folder=folder / "photos",
        photos=folder / "photos.json",
        database=folder / "database.db",
        sparse=folder / "sparse",
        report=folder / "sparse.json",
        cameras=cameras,
        settings=MappingSettings(),
        seed=0,
    )
    return read_json(folder / "sparse.json"), pycolmap.Reconstruction(folder / "sparse")


@pytest.mark.parametrize(
    "write", [colmap, rational, nerfstudio, opensfm, lambda folder: opensfm(folder, "brown"), metashape, bundler]
)
def test_cameras_of_other_programs_are_taken_as_they_are(tmp_path, write):
    with_database(tmp_path)
    report, model = mapped(tmp_path, write(tmp_path))
    names, _, centres = camera_poses(model)
    assert names == FLIGHT.names
    np.testing.assert_allclose(centres, FLIGHT.centres, atol=1e-6)
    camera = next(iter(model.cameras.values()))
    assert (camera.width, camera.height) == (WIDTH, HEIGHT) and camera.mean_focal_length() == pytest.approx(FOCAL)
    assert value(report, "registered") == 9 and value(report, "lens") == "known"
    assert value(report, "points") > 150 and value(report, "mean_reprojection_error_px") < 0.01
    # Every point lies on one that the photos show.
    places = np.array([model.points3D[p].xyz for p in sorted(model.point3D_ids())])
    nearest = np.linalg.norm(places[:, None] - FLIGHT.ground[None], axis=2).min(1)
    assert nearest.max() < 1e-3


def test_photos_of_one_camera_may_have_lenses_of_their_own(tmp_path):
    focal = {view.name: FOCAL * (1 + 0.03 * (k % 3)) for k, view in enumerate(FLIGHT.views)}
    views = [
        replace(
            view, intrinsics=np.array([[focal[view.name], 0, WIDTH / 2], [0, focal[view.name], HEIGHT / 2], [0, 0, 1]])
        )
        for view in FLIGHT.views
    ]
    with_database(tmp_path, views)
    report, model = mapped(tmp_path, nerfstudio(tmp_path, views))
    np.testing.assert_allclose(camera_poses(model)[2], FLIGHT.centres, atol=1e-6)
    found = {image.name: model.cameras[image.camera_id].mean_focal_length() for image in model.images.values()}
    assert found == pytest.approx(focal) and len(model.cameras) == 3
    assert value(report, "points") > 150 and value(report, "mean_reprojection_error_px") < 0.01


@pytest.mark.parametrize("write", [bundler, nerfstudio])
def test_cameras_that_do_not_say_how_large_their_photos_were_are_of_the_originals_of_frames(tmp_path, write):
    with_database(tmp_path)
    cameras = write(tmp_path)
    origin = {name: {"width": 2 * WIDTH, "height": 2 * HEIGHT} for name in FLIGHT.names}
    write_photos(tmp_path / "photos.json", FLIGHT.photos(), tmp_path, "photos", [], origin=quantity(origin, ""))
    text = re.sub(rf"\b{FOCAL}", str(2 * FOCAL), cameras.read_text())
    cameras.write_text(re.sub(r'"(w|h|cx|cy)": [0-9.]+, ', "", text))
    report, model = mapped(tmp_path, cameras)
    np.testing.assert_allclose(camera_poses(model)[2], FLIGHT.centres, atol=1e-6)
    assert next(iter(model.cameras.values())).mean_focal_length() == pytest.approx(FOCAL)
    assert value(report, "points") > 150 and value(report, "mean_reprojection_error_px") < 0.01


@pytest.mark.parametrize("flat", [False, True], ids=["scene", "frames"])
def test_photos_of_one_name_in_two_folders_have_the_cameras_of_their_paths(tmp_path, flat):
    with_database(tmp_path)
    named = {view.name: f"{100 + k // 5}MEDIA/{k % 5}.jpg" for k, view in enumerate(FLIGHT.views)}
    ours = {old: new.replace("/", "_") if flat else new for old, new in named.items()}
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for image in database.read_all_images():
            image.name = ours[image.name]
            database.update_image(image)
    for new in ours.values():
        (tmp_path / "photos" / new).parent.mkdir(exist_ok=True)
        (tmp_path / "photos" / new).write_bytes(b"")
    photos = [replace(photo, name=ours[photo.name]) for photo in FLIGHT.photos()]
    write_photos(tmp_path / "photos.json", photos, tmp_path, "photos", [])
    (tmp_path / "given/sparse").mkdir(parents=True)
    write_model(tmp_path / "given/sparse", [replace(view, name=named[view.name]) for view in FLIGHT.views])
    _, model = mapped(tmp_path, tmp_path / "given")
    np.testing.assert_allclose(camera_poses(model)[2], FLIGHT.centres, atol=1e-6)
    if not flat:  # Metashape names no folders, and only five photos were aligned: they may be of either
        cameras = metashape(tmp_path)
        kept = re.sub(r'<camera id="[5-8]".*?</camera>', "", cameras.read_text())
        for k, view in enumerate(FLIGHT.views[:5]):
            kept = kept.replace(f'label="{Path(view.name).stem}"', f'label="{k}.jpg"')
        cameras.write_text(kept)
        with pytest.raises(
            StageError,
            match="0.jpg may be any of 2 photos .100MEDIA/0.jpg, 101MEDIA/0.jpg, .*or every photo a name of its own",
        ):
            mapped(tmp_path, cameras)


def as_stored(view, quarters):
    """The view of a photo that so many clockwise quarter turns stand upright, before these."""
    for _ in range(quarters):
        (focal, _, cx), (_, _, cy), _ = view.intrinsics
        turned = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # right is what was down
        intrinsics = np.array([[focal, 0, cy], [0, focal, view.width - cx], [0, 0, 1]])
        view = View(view.name, intrinsics, turned @ view.cam_from_world, view.height, view.width)
    return view


@pytest.mark.parametrize(("orientation", "quarters"), [(6, 1), (3, 2), (8, 3)])
def test_cameras_of_photos_as_stored_are_turned_with_what_exif_turns(tmp_path, orientation, quarters):
    with_database(tmp_path)
    names = [view.name for view in FLIGHT.views]
    turned = dict.fromkeys(names[::2], orientation)
    write_photos(tmp_path / "photos.json", FLIGHT.photos(), tmp_path, "photos", [], turned=quantity(turned, ""))
    (tmp_path / "given/sparse").mkdir(parents=True)
    views = [as_stored(view, quarters if view.name in turned else 0) for view in FLIGHT.views]
    write_model(tmp_path / "given/sparse", views)
    report, model = mapped(tmp_path, tmp_path / "given")
    np.testing.assert_allclose(camera_poses(model)[2], FLIGHT.centres, atol=1e-6)
    assert value(report, "points") > 150 and value(report, "mean_reprojection_error_px") < 0.01
    said = value(report, "notes")[1]
    if quarters % 2:
        assert said == f"the cameras of {len(turned)} photos were turned, as EXIF rotates these photos"
    else:
        assert "does not say whether its cameras are for them as they are stored: they are taken as stored" in said


@pytest.mark.parametrize(("orientation", "quarters"), [(1, 0), (6, 1), (8, 3)])
def test_cameras_without_the_shape_of_their_photos_are_tried_as_of_stored_ones_too(tmp_path, orientation, quarters):
    with_database(tmp_path)
    turned = dict.fromkeys([view.name for view in FLIGHT.views][::2], 6 if orientation == 1 else orientation)
    write_photos(tmp_path / "photos.json", FLIGHT.photos(), tmp_path, "photos", [], turned=quantity(turned, ""))
    views = [as_stored(view, quarters if view.name in turned else 0) for view in FLIGHT.views]
    report, model = mapped(tmp_path, bundler(tmp_path, views))
    np.testing.assert_allclose(camera_poses(model)[2], FLIGHT.centres, atol=1e-6)
    assert value(report, "points") > 150 and value(report, "mean_reprojection_error_px") < 0.01
    assert f"they are taken as {'stored' if quarters else 'upright'}, whose matches" in value(report, "notes")[-1]


@pytest.mark.parametrize(
    ("lens", "bent"),
    [
        ("OPENCV", [0.1, -0.05, 0.01, -0.02]),
        ("THIN_PRISM_FISHEYE", [0.1, -0.05, 0.01, -0.02, 0.01, 0.02, 0.03, -0.04]),
        ("FOV", [0.6]),
        ("EUCM", [0.6, 1.1]),
    ],
)
def test_a_turned_lens_bends_as_before(lens, bent):
    camera = pycolmap.Camera(model=lens, width=400, height=300, params=[500, 510, 190, 160, *bent])
    before = PosedPhoto("a", Path("a.jpg"), camera, np.eye(4), None, False)
    after = stood_upright(before, 1)
    rays = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3)) + [0, 0, 1]
    pixels = camera.img_from_cam(rays)
    turned = after.camera.img_from_cam(rays @ np.linalg.inv(after.object_from_cam)[:3, :3].T)
    np.testing.assert_allclose(turned, np.stack([300 - pixels[:, 1], pixels[:, 0]], axis=1), atol=1e-9)
    assert (after.camera.width, after.camera.height) == (300, 400)
    name, params = "RAD_TAN_THIN_PRISM_FISHEYE", [500, 500, 200, 150, *[0.0] * 12]
    with pytest.raises(StageError, match=rf"a\.jpg is rotated by EXIF, and its camera, a {name}, cannot be turned"):
        stood_upright(replace(before, camera=pycolmap.Camera(model=name, width=400, height=300, params=params)), 1)


def test_wrong_cameras_are_named(tmp_path):
    with_database(tmp_path)
    with pytest.raises(StageError, match="do not exist"):
        mapped(tmp_path, tmp_path / "none")
    path = nerfstudio(tmp_path)
    content = json.loads(path.read_text())
    for frame, other in zip(content["frames"], json.loads(path.read_text())["frames"][::-1]):
        frame["transform_matrix"] = other["transform_matrix"]
    path.write_text(json.dumps(content))
    with pytest.raises(StageError, match="do not fit the photos"):
        mapped(tmp_path, path)
    opensfm(tmp_path, "dual")
    with pytest.raises(StageError, match="of the kind dual, which is not read; undistort"):
        read_posed_photos(tmp_path / "opensfm/reconstruction.json", tmp_path / "photos")
    (tmp_path / "opensfm/reconstruction.json").write_text("{}")
    with pytest.raises(StageError, match="holds no cameras of OpenSfM that can be read"):
        read_posed_photos(tmp_path / "opensfm/reconstruction.json", tmp_path / "photos")


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("project.psx", "", "it is Metashape's project; in Metashape, export the cameras as Agisoft XML"),
        (
            "block.xml",
            "<?xml?>\n<BlocksExchange version='2.1'>",
            "ContextCapture's .*; import it into Metashape",
        ),
        ("model.nvm", "NVM_V3\n", "VisualSFM's NVM; export the reconstruction as Bundler's"),
        ("a_calibrated_camera_parameters.txt", "fileName imageWidth", "Pix4D's; export OPF"),
        ("sfm.json", '{"version": ["1"], "featuresFolders": []}', "Meshroom's; convert it to COLMAP"),
        ("synth_0.out", "drews 1.0\n1 0\n0.9 0 0\n", "MVE's; give the cameras of COLMAP"),
        ("sfm_data.json", '{"sfm_data_version": "0.3"}', "OpenMVG's; convert it to COLMAP"),
        ("cameras.json", '[{"id": 0, "img_name": "a"}]', "a list of Gaussian splatting; give the model of COLMAP"),
        ("images.txt", "# Image list", "part of COLMAP's project; give the folder"),
        ("database.db", "SQLite format 3\0", "part of COLMAP's project; give the folder"),
        ("poses.csv", "#name,x,y,alt,heading,pitch,roll\n", "RealityCapture's; in RealityCapture, export"),
        ("IMG_1.xmp", '<x:xmpmeta><rdf:RDF><rdf:Description xcr:Version="3"', "RealityCapture's; in RealityCapture"),
        (
            "cams.txt",
            "# Cameras (2)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa\n",
            "a list of poses without lenses; export",
        ),
        (
            "cameras.json",
            '{"v2 dji": {"projection_type": "brown"}}',
            r"no cameras in a known format; give sparse/ .*\.out",
        ),
        ("cameras.kml", "<kml/>", r"no cameras in a known format; give sparse/ .*Bundler's \.out with list\.txt"),
    ],
)
def test_cameras_in_no_format_that_is_read_are_named_with_what_is_read(tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)
    with pytest.raises(StageError, match=f"{name} .*{sentence}"):
        read_posed_photos(tmp_path / name, tmp_path)
    # So they are in a folder, among files of no program.
    (tmp_path / "notes.txt").write_text("windy")
    with pytest.raises(StageError, match="cameras.txt" if name == "images.txt" else sentence):
        read_posed_photos(tmp_path, tmp_path)


@pytest.mark.parametrize("upper", [False, True])
@pytest.mark.parametrize("write", [metashape, bundler])
def test_a_folder_may_hold_the_cameras_of_metashape_or_bundler(tmp_path, write, upper):
    (tmp_path / "photos").mkdir()
    for view in FLIGHT.views:
        (tmp_path / "photos" / view.name).touch()
    write(tmp_path)
    (tmp_path / "doc").mkdir()
    (tmp_path / "nohup.out").write_text("done\n")
    (tmp_path / "log.xml").write_text("<log/>")
    files = [file for name in ("cameras.xml", "bundle.out", "list.txt") if (file := tmp_path / name).is_file()]
    if upper:
        files = [file.rename(file.with_name(file.name.upper())) for file in files]
    assert camera_files(tmp_path) == files
    found, program, _ = read_posed_photos(tmp_path, tmp_path / "photos")
    assert len(found) == 9 and program.casefold() == write.__name__
    (tmp_path / "other.XML").write_text("<document><chunk/></document>")
    with pytest.raises(StageError, match=r"holds cameras in .* and in .*; give one of these files"):
        read_posed_photos(tmp_path, tmp_path / "photos")


def test_where_cameras_were_given_the_advice_is_about_these(tmp_path):
    with_database(tmp_path)
    path = nerfstudio(tmp_path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"frames": content["frames"][:4]}))
    with pytest.raises(StageError, match=r"only 4 of 9 photos have a camera in .*Export the cameras of all") as error:
        mapped(tmp_path, path)
    assert not re.search("overlap|blur|texture", str(error.value))


def test_cameras_of_metashape_lie_where_a_chunk_in_local_coordinates_was_placed(tmp_path):
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    inside = f"<rotation>{' '.join(map(repr, turn.ravel().tolist()))}</rotation><translation>1 2 3</translation>"
    placed = f'<components><component id="0"><transform>{inside}<scale>2.5</scale></transform></component></components>'
    (tmp_path / "photos").mkdir()
    for view in FLIGHT.views:
        cv2.imwrite(str(tmp_path / "photos" / view.name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    for reference in ("", "<reference>LOCAL_CS[&quot;Local Coordinates (m)&quot;]</reference>"):
        found, _, _ = read_posed_photos(metashape(tmp_path, placed=reference + placed), tmp_path / "photos")
        for photo, view in zip(found, FLIGHT.views, strict=True):
            pose = view.world_from_cam
            np.testing.assert_allclose(photo.object_from_cam[:3, 3], 2.5 * turn @ pose[:3, 3] + [1, 2, 3], atol=1e-9)
            np.testing.assert_allclose(photo.object_from_cam[:3, :3], turn @ pose[:3, :3], atol=1e-9)


def test_where_a_project_lies_on_the_earth_is_read(tmp_path):
    """Metashape's chunk about the earth's centre, OpenDroneMap's cameras less an offset in the CRS."""
    utm = pyproj.CRS(32632).to_wkt("WKT1_GDAL").replace("PRIMEM", "TOWGS84[0,0,0,0,0,0,0],PRIMEM", 1)
    place = place_of(metashape(tmp_path, placed=f"<reference>{escape(utm)}</reference>{PLACED}"))
    assert place.crs == pyproj.CRS(32632) and place.geocentric
    to_geocentric = pyproj.Transformer.from_crs(32632, 4978, always_xy=True)
    x_in_chunk = np.array([[10.0, 20.0, 30.0], [-5.0, 0.0, 2.0]])
    earth = np.stack(to_geocentric.transform(*place.in_crs(x_in_chunk).T), axis=1)
    np.testing.assert_allclose(earth, 3 * x_in_chunk + [4.2e6, 6e5, 4.75e6], atol=1e-3)
    np.testing.assert_allclose(place.model_from(place.in_crs(x_in_chunk), place.crs), x_in_chunk, atol=1e-6)
    assert place_of(metashape(tmp_path, placed="<transform><scale>3</scale></transform>")) is None
    with pytest.raises(StageError, match="PROJ does not know its coordinate system"):
        place_of(metashape(tmp_path, placed=EARTH.replace("GEOGCS", "GEOG")))
    path = opensfm(tmp_path)
    assert place_of(path) is None
    (path / "opensfm/reconstruction.topocentric.json").write_text("[]")
    (tmp_path / "odm_georeferencing").mkdir()
    coords = tmp_path / "odm_georeferencing/coords.txt"
    coords.write_text("WGS84 UTM 32N\n466000 5246000\n12.5 8.1 430.0\n")
    place = place_of(path)
    assert place.crs == pyproj.CRS(32632)
    np.testing.assert_allclose(place.in_crs(np.ones((1, 3))), [[466001, 5246001, 1]])
    for text, message in (
        ("WGS84 UTM 32N\n", "is damaged"),
        ("WGS84 UTM 32N\n466000\n", "is damaged"),
        ("WGS84 UTM 32N\n12.3 45.6 78.9\n", "is damaged"),
        ("WGS84 UTM 32N\nnan nan\n", "is damaged"),
        ("WGS84 UTM 0N\n466000 5246000\n", "names no coordinate reference system"),
        ("EPSG:4326\n8.5 47.5\n", "is in degrees"),
        ("EPSG:2263\n980000 200000\n", "does not count in metres"),
    ):
        coords.write_text(text)
        with pytest.raises(StageError, match=message):
            place_of(path)


def test_of_a_chunk_of_metashape_the_active_component_is_taken(tmp_path):
    (tmp_path / "photos").mkdir()
    for view in FLIGHT.views:
        (tmp_path / "photos" / view.name).write_bytes(b"")
    other = "<transform><scale>7</scale></transform>"
    parts = f'<component id="1">{other}</component><component id="0">{PLACED}</component>'
    utm = escape(pyproj.CRS(32632).to_wkt("WKT1_GDAL"))
    path = metashape(tmp_path, placed=f'<components active_id="0">{parts}</components><reference>{utm}</reference>')
    text = path.read_text().replace('<camera id="0" ', '<camera id="0" component_id="1" ')
    path.write_text(text.replace('<camera id="1" ', '<camera id="1" enabled="false" '))
    assert place_of(path).earth_from_model.scale == 3
    found, _, _ = read_posed_photos(path, tmp_path / "photos")
    assert [photo.name for photo in found] == [n[:-4] for n in FLIGHT.names[2:]]


@pytest.mark.parametrize("small", ["before", "after", "disabled"])
def test_of_several_chunks_of_metashape_the_largest_that_is_enabled_is_taken_and_said(tmp_path, small):
    (tmp_path / "photos").mkdir()
    for view in FLIGHT.views:
        (tmp_path / "photos" / view.name).write_bytes(b"")
    text = (path := metashape(tmp_path, placed="<transform><scale>3</scale></transform>")).read_text()
    inside = text[text.index("<chunk") : text.index("</document>")]
    other = re.sub(r"<camera .*?</camera>", "", inside, count=2, flags=re.DOTALL).replace("<scale>3", "<scale>7")
    other = other.replace("<chunk", '<chunk label="North"', 1)
    chunks = [other, inside] if small == "before" else [inside, other]
    if small == "disabled":
        chunks[0] = inside.replace("<chunk", '<chunk enabled="false"', 1)
    path.write_text(text.replace(inside, "".join(chunks)))
    found, _, notes = read_posed_photos(path, tmp_path / "photos")
    scale, count = (7, 7) if small == "disabled" else (3, 9)
    assert len(found) == count
    np.testing.assert_allclose(
        found[-1].object_from_cam[:3, 3], scale * FLIGHT.views[-1].world_from_cam[:3, 3], rtol=1e-9
    )
    said = {"before": "2 (chunk) is taken, with 9 photos, and not 1 (North) with 7", "disabled": None}
    said["after"] = "1 (chunk) is taken, with 9 photos, and not 2 (North) with 7"
    assert notes == ([f"the model {said[small]}"] if said[small] else [])


def test_where_a_chunk_of_metashape_lies_has_to_be_known(tmp_path):
    (tmp_path / "photos").mkdir()
    for view in FLIGHT.views:
        (tmp_path / "photos" / view.name).write_bytes(b"")
    with pytest.raises(StageError, match="lies on the earth, but names no CRS"):
        read_posed_photos(metashape(tmp_path, placed=PLACED), tmp_path / "photos")
    turned = "<transform><rotation>0 1 0 -1 0 0 0 0 1</rotation></transform>"
    assert place_of(metashape(tmp_path, placed=EARTH.split("<transform>")[0] + turned)) is None
    for code, message in ((2263, "does not count in metres"), (27572, "degrees from Greenwich")):
        wkt = escape(pyproj.CRS(code).to_wkt("WKT1_GDAL"))
        with pytest.raises(StageError, match=message):
            place_of(metashape(tmp_path, placed=f"<reference>{wkt}</reference>{PLACED}"))
    with pytest.raises(StageError, match="the scale of its transform is 0"):
        read_posed_photos(metashape(tmp_path, placed="<transform><scale>0</scale></transform>"), tmp_path / "photos")


def test_a_lens_of_metashape_projects_as_its_manual_says(tmp_path):
    """A real camera's: swapped decentring, affinity, a fourth radial coefficient and skew."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/00.jpg").write_bytes(b"")
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (200, 2)) * np.array([WIDTH, HEIGHT]) / FOCAL
    exact = {"f": FOCAL, "cx": 4.0, "cy": -7.0, "b1": 0.5, "k1": -0.09, "k2": -0.07, "k3": 0.1, "p1": 3e-3, "p2": -1e-3}
    x, y = rays.T
    r2 = x**2 + y**2
    for lens, most in ((exact, 1e-6), (exact | {"k4": -0.07, "b2": -0.3}, 0.3)):
        camera = read_posed_photos(metashape(tmp_path, lens), tmp_path / "photos")[0][0].camera
        radial = 1 - 0.09 * r2 - 0.07 * r2**2 + 0.1 * r2**3 + lens.get("k4", 0) * r2**4
        u = x * radial + 3e-3 * (r2 + 2 * x**2) - 2 * 1e-3 * x * y
        v = y * radial - 1e-3 * (r2 + 2 * y**2) + 2 * 3e-3 * x * y
        there = [WIDTH / 2 + 4 + u * (FOCAL + 0.5) + v * lens.get("b2", 0), HEIGHT / 2 - 7 + v * FOCAL]
        off = camera.img_from_cam(np.column_stack([rays, np.ones(200)])) - np.stack(there, 1)
        assert np.linalg.norm(off, axis=1).max() < most


FISHEYE = {"k1": -0.05, "k2": 0.01, "k3": 0.002, "k4": -0.001}


@pytest.mark.parametrize("program", ["OpenSfM", "OpenSfM, OpenCV's", "nerfstudio", "Metashape"])
def test_a_fisheye_projects_as_programs_say(tmp_path, program):
    """The angle to the axis, in radians, takes the place of its tangent, and is bent."""
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos/00.jpg"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    bent, skewed = dict(FISHEYE), {"p1": 0.0, "p2": 0.0}
    if program == "Metashape":
        skewed = {"p1": 2e-3, "p2": -1e-3}
        given = metashape(tmp_path, LENS | bent | skewed, kind="fisheye")
    elif program == "nerfstudio":
        given = nerfstudio(tmp_path)
        given.write_text(json.dumps(json.loads(given.read_text()) | bent | {"camera_model": "OPENCV_FISHEYE"}))
    elif program == "OpenSfM":
        bent = {"k1": -0.05, "k2": 0.01}
        given = opensfm(tmp_path, "fisheye", bent) / "opensfm/reconstruction.json"
    else:
        given = opensfm(tmp_path, "fisheye_opencv", bent) / "opensfm/reconstruction.json"
    camera = read_posed_photos(given, tmp_path / "photos")[0][0].camera
    rays = np.random.default_rng(0).uniform(-2, 2, (200, 2))
    far = np.linalg.norm(rays, axis=1)
    x, y = (rays / far[:, None] * np.arctan(far)[:, None]).T
    r2 = x**2 + y**2
    radial = 1 + sum(bent[f"k{k}"] * r2**k for k in range(1, len(bent) + 1))
    u = x * radial + skewed["p1"] * (r2 + 2 * x**2) + 2 * skewed["p2"] * x * y
    v = y * radial + skewed["p2"] * (r2 + 2 * y**2) + 2 * skewed["p1"] * x * y
    scale = camera.width / WIDTH  # OpenSfM's is for a larger original
    there = scale * (np.array([WIDTH, HEIGHT]) / 2 + FOCAL * np.stack([u, v], axis=1))
    np.testing.assert_allclose(camera.img_from_cam(np.column_stack([rays, np.ones(200)])), there, atol=1e-6)


@pytest.mark.parametrize("kind", ["simple_radial", "radial", None])
def test_lenses_of_opensfm_without_some_coefficients_are_read(tmp_path, kind):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/00.jpg").write_bytes(b"")
    given = opensfm(tmp_path, kind, {"k1": -0.1, "c_x": 0.01}) / "opensfm/reconstruction.json"
    given.write_text(given.read_text().replace('"projection_type": null, ', ""))
    camera = read_posed_photos(given, tmp_path / "photos")[0][0].camera
    pixel = camera.img_from_cam(np.array([[0.3, 0.4, 1.0]]))[0]
    there = 2 * (np.array([WIDTH, HEIGHT]) / 2 + [0.01 * WIDTH, 0] + FOCAL * (1 - 0.1 * 0.25) * np.array([0.3, 0.4]))
    assert pixel == pytest.approx(there)


def test_wrong_files_of_metashape_and_bundler_are_named(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    path = bundler(tmp_path)
    (tmp_path / "list.txt").write_text("a.jpg\n")
    with pytest.raises(StageError, match="10 cameras, its list names 1 photos"):
        read_posed_photos(path, photos)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(StageError, match=r"put it beside it as list\.txt"):
        read_posed_photos(path, photos)
    (tmp_path / "list.txt").write_text("a.jpg\n" * 10)
    path.write_text("# Bundle file v0.3\n2 0\n500 0 0\n1 0\n")
    with pytest.raises(StageError, match="holds no cameras of Bundler"):
        read_posed_photos(path, photos)
    with pytest.raises(StageError, match=r"COLMAP's full OpenCV lens is up to .* px off"):
        read_posed_photos(metashape(tmp_path, LENS | {"b2": -40.0}), photos)
    with pytest.raises(StageError, match="is a fisheye with b2, p3 or p4"):
        read_posed_photos(metashape(tmp_path, LENS | {"p3": 0.1}, kind="fisheye"), photos)
    path = metashape(tmp_path)
    for text, message in (
        (path.read_text().replace('sensor id="0" type="frame"', 'sensor id="0" type="spherical"'), "kind spherical"),
        (path.read_text().replace("adjusted", "none"), "has no calibration"),
        (path.read_text()[:200], "holds no cameras of Metashape"),
        ("<document/>", "it has no chunk that is enabled"),
    ):
        path.write_text(text)
        with pytest.raises(StageError, match=message):
            read_posed_photos(path, photos)
