"""Posed photos of three formats: a known point lands on the known pixel in each, and bad input is one sentence."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation
from support.painted_sphere import CENTER, RADIUS, sphere_views

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.mvs.undistort import UndistortSettings
from scenefuse.nerf.object_cloud import CloudGates
from scenefuse.nerf.posed_photos import import_photos
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.render import RenderedView
from scenefuse.nerf.rendered_maps import RenderedMapSettings, measure_quality
from scenefuse.nerf.train_nerf import TrainingOptions, nerf_settings, train_nerf
from scenefuse.nerf.training import NerfRecipe
from scenefuse.nerf.volume import cube_from_cameras, silhouettes, visual_hull
from scenefuse.photos.cameras.read_cameras import read_posed_photos
from scenefuse.photos.pictures import matte_of, read_raw
from scenefuse.photos.views import load_views

LEGO = Path(__file__).resolve().parents[3] / "shared/data/lego"
WIDTH, HEIGHT = 96, 64
LENS = np.array([[80.0, 0, 50], [0, 84, 30], [0, 0, 1]])
BENT = {"k1": -0.12, "k2": 0.02, "p1": 0.003, "p2": -0.002}
SPOT = np.array([0.3, -0.2, 0.15])


def poses(count=5):
    """object_from_cam (4, 4) of cameras around the origin that look at it, one of them rolled; OpenCV axes."""
    for i in range(count):
        position = 3 * np.array([np.cos(1.1 * i), np.sin(1.1 * i), 0.3 + 0.2 * i])
        z = -position / np.linalg.norm(position)
        x = np.cross(z, [0.2 * (i == 2), 0, 1.0])
        x /= np.linalg.norm(x)
        yield np.vstack([np.column_stack([x, np.cross(z, x), z, position]), [0, 0, 0, 1]])


def seen(pose, lens, bent=None):
    """The pixel (centres at +0.5) on which a camera shows SPOT, by the definition of OpenCV's distortion."""
    x, y, z = pose[:3, :3].T @ (SPOT - pose[:3, 3])
    x, y = x / z, y / z
    k = bent or dict.fromkeys(BENT, 0.0)
    r2 = x * x + y * y
    radial = 1 + k["k1"] * r2 + k["k2"] * r2 * r2
    x, y = (
        x * radial + 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x),
        y * radial + k["p1"] * (r2 + 2 * y * y) + 2 * k["p2"] * x * y,
    )
    return lens[0, 0] * x + lens[0, 2], lens[1, 1] * y + lens[1, 2]


def blob(pixel, width=WIDTH, height=HEIGHT):
    """A picture (H, W, 3) uint8 with a soft white blob on a pixel."""
    v, u = np.indices((height, width)) + 0.5
    near = np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / (2 * 2.0**2))
    return np.repeat((near * 255 + 0.5).astype(np.uint8)[..., None], 3, axis=2)


def middle(picture):
    """The brightness-weighted mean pixel of a picture."""
    weight = picture.astype(np.float64)
    v, u = np.indices(weight.shape) + 0.5
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def opengl(pose):
    return (pose @ np.diag([1.0, -1, -1, 1])).tolist()


def write(folder, i, picture, matte=None, ending=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    whole = picture if matte is None else np.dstack([picture, matte])
    cv2.imwrite(str(folder / f"{i:02d}{ending}"), whole)


def ellipse(pixel):
    """A mask (H, W), 0 or 255, around a pixel."""
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    return np.where(((u - pixel[0]) / 9) ** 2 + ((v - pixel[1]) / 7) ** 2 < 1, 255, 0).astype(np.uint8)


def nerfstudio(root, bent=None, masks=True, **extra):
    """A folder with transforms.json, images/ and masks/."""
    frames = []
    for i, pose in enumerate(poses()):
        pixel = seen(pose, LENS, bent)
        write(root / "images", i, blob(pixel))
        write(root / "masks", i, ellipse(pixel))
        frame = {"file_path": f"images/{i:02d}.png", "transform_matrix": opengl(pose)}
        frames.append(frame | ({"mask_path": f"masks/{i:02d}.png"} if masks else {}))
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": LENS[0, 0], "fl_y": LENS[1, 1], "cx": LENS[0, 2], "cy": LENS[1, 2]}
    content = lens | (bent or {}) | {"camera_model": "OPENCV", "frames": frames} | extra
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def blender(root):
    """A folder with transforms_train.json and transforms_test.json; alpha, file_path without ending."""
    angle, lens = 0.9, np.array([[0.5 * WIDTH / np.tan(0.45), 0, WIDTH / 2], [0, 0, HEIGHT / 2], [0, 0, 1]])
    lens[1, 1] = lens[0, 0]
    for split, chosen in (("train", (0, 1, 2)), ("test", (3, 4))):
        frames = []
        for i, pose in enumerate(poses()):
            if i in chosen:
                pixel = seen(pose, lens)
                write(root / split, i, blob(pixel), blob(pixel)[..., 0])
                frames.append({"file_path": f"./{split}/{i:02d}", "rotation": 0.1, "transform_matrix": opengl(pose)})
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return root


def colmap(root, bent=None, sparse="sparse/0"):
    """A COLMAP folder as COLMAP's own programs write it, and masks/ beside it."""
    (root / sparse).mkdir(parents=True)
    rows = []
    for i, pose in enumerate(poses()):
        pixel = seen(pose, LENS, bent)
        write(root / "images/walk", i, blob(pixel))
        write(root / "masks/walk", i, ellipse(pixel))
        back = np.linalg.inv(pose)
        numbers = *np.roll(Rotation.from_matrix(back[:3, :3]).as_quat(), 1), *back[:3, 3]
        rows.append(f"{i + 1} {' '.join(f'{n:.15g}' for n in numbers)} 1 walk/{i:02d}.png\n\n")
    lens = f"{LENS[0, 0]} {LENS[1, 1]} {LENS[0, 2]} {LENS[1, 2]}"
    model = f"OPENCV {WIDTH} {HEIGHT} {lens} {' '.join(map(str, bent.values()))}" if bent else ""
    (root / sparse / "cameras.txt").write_text(f"1 {model or f'PINHOLE {WIDTH} {HEIGHT} {lens}'}\n")
    (root / sparse / "images.txt").write_text("".join(rows))
    (root / sparse / "points3D.txt").write_text("")
    return root


def imported(data, out, images=None, masks=None):
    import_photos(
        data=data,
        images=images,
        masks=masks,
        workspace=out / "undistorted",
        mattes=out / "masks",
        report=out / "photos.json",
        settings=UndistortSettings(max_size_px=1600),
    )
    return load_views(out / "undistorted", out / "masks", WIDTH, 0), read_json(out / "photos.json")


def misses(views):
    """Distances in pixels between where a camera says that SPOT is and where its photo, and its mask, show it."""
    for picture, matte, lens, pose in zip(views.images, views.mattes, views.intrinsics, views.object_from_cam):
        x = lens @ pose[:3, :3].T @ (SPOT - pose[:3, 3])
        yield [np.linalg.norm(middle(p) - x[:2] / x[2]) for p in (picture[..., 0], matte)]


@pytest.mark.parametrize("bent", [None, BENT], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("form", ["nerfstudio", "colmap"])
def test_a_known_point_lands_on_its_pixel(tmp_path, form, bent):
    if form == "nerfstudio":
        views, report = imported(nerfstudio(tmp_path / "in", bent), tmp_path)
    else:
        data = colmap(tmp_path / "in", bent)
        views, report = imported(data, tmp_path, masks=data / "masks")
    assert len(views.names) == 5 and value(report, "undistorted") == (5 if bent else 0)
    assert np.max([*misses(views)]) < 0.15
    assert np.abs(views.object_from_cam - np.stack([*poses()])).max() < 1e-9
    assert set(np.unique(views.mattes)) == {0, 255} or bent


def test_a_fisheye_of_colmap_is_straightened(tmp_path):
    lens = pycolmap.Camera(model="OPENCV_FISHEYE", width=WIDTH, height=HEIGHT, params=[60, 61, 50, 30, 0.02, 0, 0, 0])
    data = colmap(tmp_path / "in")
    (data / "sparse/0/cameras.txt").write_text(f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} {' '.join(map(str, lens.params))}\n")
    for i, pose in enumerate(poses()):
        pixel = lens.img_from_cam(pose[:3, :3].T @ (SPOT - pose[:3, 3]))
        write(data / "images/walk", i, blob(pixel))
        write(data / "masks/walk", i, ellipse(pixel))
    views, report = imported(data, tmp_path, masks=data / "masks")
    assert value(report, "undistorted") == 5 and np.max([*misses(views)]) < 0.15


def test_blender_reads_alpha_as_it_is_and_holds_the_test_photos_out(tmp_path):
    views, report = imported(blender(tmp_path / "in"), tmp_path)
    assert views.names == ["test_03.png", "test_04.png", "train_00.png", "train_01.png", "train_02.png"]
    assert views.held_out.tolist() == [True, True, False, False, False]
    assert np.max([*misses(views)], axis=0)[1] < 0.05
    alpha = cv2.imread(str(tmp_path / "in/test/03.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(views.mattes[0], alpha[..., 3]) and len(np.unique(views.mattes[0])) > 20
    opaque = alpha[..., 3] > 0
    assert np.array_equal(views.images[0][opaque], alpha[..., 2::-1][opaque])
    beside = cv2.dilate(opaque.astype(np.uint8), np.ones((3, 3))).astype(bool) & ~opaque
    assert views.images[0][beside].min() > 0, "transparent pixels have the colour of their neighbours"
    assert value(report, "masks_exact") is True and value(report, "format") == "Blender"


def test_smaller_copies_of_the_photos_serve(tmp_path):
    data = colmap(tmp_path / "in", sparse="sparse")
    for i, pose in enumerate(poses()):
        u, v = seen(pose, LENS)
        write(data / "images_2/walk", i, blob((u / 2, v / 2), WIDTH // 2, HEIGHT // 2))
    views, _ = imported(data, tmp_path, images=data / "images_2", masks=data / "masks")
    assert views.images.shape[1:3] == (HEIGHT // 2, WIDTH // 2) and np.max([*misses(views)]) < 0.15


def test_photos_of_two_sizes_meet_at_any_width(tmp_path):
    data = nerfstudio(tmp_path / "in")
    u, v = seen(next(poses()), LENS)
    write(data / "images", 0, blob((u / 2, v / 2), WIDTH // 2, HEIGHT // 2))
    imported(data, tmp_path)
    for width, miss_px in ((WIDTH, 0.3), (WIDTH // 2, 0.15)):
        views = load_views(tmp_path / "undistorted", tmp_path / "masks", width, 0)
        assert views.images.shape[2] == width and not views.beyond.any() and np.max([*misses(views)]) < miss_px


def test_an_exif_orientation_turns_no_photo(tmp_path):
    from PIL import Image

    data = nerfstudio(tmp_path / "in")
    for path in (data / "images").iterdir():
        picture = Image.open(path).copy()
        tags = picture.getexif()
        tags[0x0112] = 6
        picture.save(path, exif=tags)
    views, _ = imported(data, tmp_path)
    assert np.max([*misses(views)]) < 0.15


def test_cameras_calibrated_photo_by_photo_cut_nothing_off_each_other(tmp_path):
    data = nerfstudio(tmp_path / "in", BENT)
    content = json.loads((data / "transforms.json").read_text())
    for i, (frame, pose) in enumerate(zip(content["frames"], poses())):
        # The last one has no distortion, and keeps its size.
        own = dict.fromkeys(BENT, 0.0) if i == 4 else BENT | {"k1": 0.1 - 0.1 * i}
        frame |= own
        write(data / "images", i, blob(seen(pose, LENS, own)))
        write(data / "masks", i, ellipse(seen(pose, LENS, own)))
    (data / "transforms.json").write_text(json.dumps(content))
    views, _ = imported(data, tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "undistorted/sparse")
    widths = [model.cameras[model.images[number].camera_id].width for number in sorted(model.images)]
    assert len(set(widths)) > 2 and widths[4] == WIDTH and np.max([*misses(views)]) < 0.15


def test_photos_without_a_mask_are_left_out_and_named(tmp_path):
    data = colmap(tmp_path / "in")
    (data / "masks/walk/03.png").unlink()
    (data / "masks/walk/01.png").rename(data / "masks/walk/01.png.png")
    # A photo in which the object is absent: its emptiness proves nothing, and measures no quality.
    write(data / "masks/walk", 4, np.zeros((HEIGHT, WIDTH), np.uint8))
    views, report = imported(data, tmp_path, masks=data / "masks")
    assert len(views.names) == 3 and value(report, "left_out_without_mask") == ["walk_03.png", "walk_04.png"]


def test_held_out_photos_that_the_json_names(tmp_path):
    data = nerfstudio(tmp_path / "in", test_filenames=["images/01.png"], val_filenames=["images/04.png"])
    views, report = imported(data, tmp_path)
    assert views.held_out.tolist() == [False, True, False, False, True]
    assert value(report, "held_out_by_the_data") == ["01.png", "04.png"]


def edit(**changes):
    """A change of transforms.json: of its first frame where a name begins with frame_."""

    def apply(root):
        content = json.loads((root / "transforms.json").read_text())
        for key, new in changes.items():
            if key.startswith("frame_"):
                content["frames"][0][key.removeprefix("frame_")] = new
            else:
                content[key] = new
        (root / "transforms.json").write_text(json.dumps(content))

    return apply


def shrink(file, size):
    return lambda root: cv2.imwrite(str(root / file), np.full((*size, 3), 255, np.uint8))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda root: (root / "transforms.json").unlink(), "no cameras in a known format"),
        (lambda root: (root / "transforms.json").write_text("{"), "holds no cameras of nerfstudio that can be read"),
        (lambda root: (root / "transforms.json").write_text("[]"), "no list of frames"),
        (lambda root: (root / "images/02.png").write_text("no picture"), "images/02.png cannot be decoded"),
        (lambda root: (root / "masks/02.png").unlink(), r"frame 2 .*its mask masks/02.png does not exist"),
        (
            lambda root: (root / "masks/02.png").write_text("no picture"),
            r"masks/02.png cannot be read \(.*\); export",
        ),
        (edit(camera_model="THIN_PRISM_FISHEYE"), "camera model THIN_PRISM_FISHEYE is not read; undistort"),
        (edit(camera_model="OPENCV_FISHEYE", fl_x=None, camera_angle_x=1.0), "no focal length; give fl_x"),
        (edit(w=None, h=None, cx=96.0, cy=64.0), r"principal point, \(96.0, 64.0\), lies outside its 96 x 64 pixels"),
        (edit(frame_transform_matrix=(np.eye(4) + np.eye(4, k=-3)).tolist()), "last row of transform_matrix is not 0"),
        (edit(frame_camera_model="EQUIRECTANGULAR"), r"frame 0 .*EQUIRECTANGULAR is not read"),
        (edit(k4=0.1), "distortion with k4 is not read"),
        (edit(fl_x=None), "no focal length; give fl_x"),
        (edit(fl_x=-80), "a focal length is -80; it counts in pixels, of which there are 96 x 64"),
        (edit(fl_x=0.9), "a focal length is 0.9; it counts in pixels"),
        (edit(fl_x="wide"), "have to be numbers"),
        (edit(frame_transform_matrix=[[1, 0], [0, 1]]), "has to be 4 x 4 numbers"),
        (edit(frame_transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "is no rotation"),
        (edit(frame_transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), "is no rotation"),
        (edit(frame_file_path="images/01.png"), "two photos .* are both called 01"),
        (shrink("images/02.png", (64, 64)), "02.png has 64 x 64 pixels, but its camera 96 x 64"),
        (shrink("masks/02.png", (64, 64)), "the mask .*02.png is 64 x 64 pixels, its photo 96 x 64"),
        (edit(frames=[]), "no list of frames"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, damage, words):
    damage(nerfstudio(tmp_path / "in"))
    with pytest.raises(StageError, match=words):
        imported(tmp_path / "in", tmp_path)
    assert not (tmp_path / "undistorted").exists() and not (tmp_path / "masks").exists()


@pytest.mark.parametrize("cut_out", [False, True])
def test_a_photo_is_no_mask_and_neither_is_what_is_cut_out_of_it(tmp_path, cut_out):
    data = nerfstudio(tmp_path / "in")
    grey = np.random.default_rng(0).integers(60, 200, (64, 96)).astype(np.uint8)
    if cut_out:
        grey[np.hypot(*np.mgrid[-32:32, -48:48]) > 15] = 0
    cv2.imwrite(str(data / "masks/02.png"), grey)
    with pytest.raises(StageError, match=r"02.png cannot be read \(it is no mask: most of what it shows is grey\); ex"):
        imported(data, tmp_path)


def test_masks_that_are_black_on_the_object_are_an_error(tmp_path):
    data = nerfstudio(tmp_path / "in")
    for mask in (data / "masks").iterdir():
        cv2.imwrite(str(mask), np.where(np.hypot(*np.mgrid[-32:32, -48:48]) < 25, 0, 255))
    with pytest.raises(StageError, match="the masks in .*in are black on the object; invert them"):
        imported(data, tmp_path)
    assert not (tmp_path / "masks").exists()


def test_an_arch_that_is_cut_out_of_its_photos_is_no_object_in_black(tmp_path):
    data = nerfstudio(tmp_path / "in", masks=False)
    opening = np.hypot(*np.mgrid[-32:32, -48:48]) < 25
    for photo in (data / "images").iterdir():
        matte = np.where(opening, 0, 255).astype(np.uint8)
        cv2.imwrite(str(photo), np.dstack([cv2.imread(str(photo)), matte]))
    imported(data, tmp_path)
    assert all((cv2.imread(str(mask), 0) == 0).mean() > 0.2 for mask in (tmp_path / "masks").iterdir())


def test_two_colours_as_bright_as_each_other_are_no_mask(tmp_path):
    labels = np.full((64, 96, 3), (0, 0, 255), np.uint8)
    labels[20:40, 30:60] = 0, 255, 0
    with pytest.raises(StageError, match="it has areas of 2 values"):
        matte_of(labels)
    assert matte_of(np.full((64, 96), 255, np.uint8)).all()


@pytest.mark.parametrize("values", [(1, 2, 3), (60, 120, 200), ((255, 0, 0), (0, 255, 0), (0, 0, 255))])
def test_labels_of_several_things_are_no_mask(tmp_path, values):
    data = nerfstudio(tmp_path / "in")
    labels = np.zeros((64, 96, *np.shape(values)[1:]), np.uint8)
    for k, value_ in enumerate(values):
        labels[10 + 15 * k : 20 + 15 * k, 30:50] = value_
    cv2.imwrite(str(data / "masks/02.png"), labels)
    with pytest.raises(StageError, match=r"02.png cannot be read \(it has areas of 4 values, as labels of several"):
        imported(data, tmp_path)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_a_mask_with_a_soft_edge_or_of_one_label_is_one(tmp_path, ending):
    disc = np.hypot(*np.mgrid[-200:200, -300:300]) < 100
    soft = cv2.GaussianBlur(255 * disc.astype(np.uint8), (0, 0), 8)
    low = cv2.resize(cv2.resize(soft, (30, 20), interpolation=cv2.INTER_AREA), (600, 400))
    for mask in (soft, low, disc.astype(np.uint8), np.dstack([np.zeros_like(soft), np.zeros_like(soft), 200 * disc])):
        cv2.imwrite(str(tmp_path / f"a.{ending}"), mask)
        if ending == "png" or mask.max() > 1:
            assert np.mean(matte_of(read_raw(tmp_path / f"a.{ending}")) != disc) < 0.01
    opaque = np.full(disc.shape, 254, np.uint8)
    opaque[0] = 255
    assert (matte_of(np.dstack([soft, soft, soft, opaque])) == (soft > 127)).all()


def test_the_angles_of_view_give_focal_lengths_across_and_upwards(tmp_path):
    angles = {f"camera_angle_{axis}": 2 * np.arctan(side / 2 / focal) for axis, side, focal in
              (("x", WIDTH, LENS[0, 0]), ("y", HEIGHT, 1.3 * LENS[1, 1]))}  # fmt: skip
    data = nerfstudio(tmp_path / "in", fl_x=None, fl_y=None, **angles)
    photos, _, _ = read_posed_photos(data, None)
    assert photos[0].camera.params[:2].tolist() == pytest.approx([LENS[0, 0], 1.3 * LENS[1, 1]])


def test_no_masks_says_what_to_give(tmp_path):
    data = nerfstudio(tmp_path / "in", masks=False)
    with pytest.raises(StageError, match="no masks; give a folder of masks with --masks"):
        imported(data, tmp_path)
    for path in (data / "masks").iterdir():
        path.rename(path.with_stem(f"other{path.stem}"))
    with pytest.raises(StageError, match="match no photo: 5 masks .*other00.png"):
        imported(data, tmp_path, masks=data / "masks")


def test_of_cameras_without_their_photo_the_others_are_used_and_these_named(tmp_path):
    data = nerfstudio(tmp_path / "in")
    (data / "images/02.png").unlink()
    views, report = imported(data, tmp_path)
    assert len(views.names) == 4 and np.max([*misses(views)]) < 0.15
    assert value(report, "notes")[0].startswith("1 of 5 cameras are of photos that are not in")
    for path in (data / "images").iterdir():
        path.unlink()
    with pytest.raises(StageError, match="holds cameras of none of the photos in .*; it names images/00.png"):
        imported(data, tmp_path)


def test_a_colmap_model_without_its_photos_asks_for_them(tmp_path):
    data = colmap(tmp_path / "in")
    (data / "images").rename(data / "elsewhere")
    with pytest.raises(
        StageError,
        match="may be any of 2 photos .elsewhere/walk/00.png, .* give the folder that holds the photos alone",
    ):
        imported(data, tmp_path, masks=data / "masks")
    views, _ = imported(data, tmp_path, images=data / "elsewhere", masks=data / "masks")
    assert len(views.names) == 5
    (data / "sparse/0/cameras.txt").write_text("1 PINHOLE")
    with pytest.raises(StageError, match="holds no cameras of COLMAP that can be read"):
        imported(data, tmp_path, images=data / "elsewhere", masks=data / "masks")


def test_a_perfect_render_of_a_grey_matte_scores_as_perfect(tmp_path):
    views, _ = imported(blender(tmp_path / "in"), tmp_path)
    opacity = torch.from_numpy(views.mattes).float() / 255
    colors = torch.from_numpy(views.images).float() / 255 * opacity[..., None]
    perfect = [RenderedView(c, o, o, o) for c, o in zip(colors, opacity)]
    quality = measure_quality(views, perfect, np.arange(len(perfect)) < 2, exact=True)
    assert value(quality, "psnr_held_out") > 80 and value(quality, "psnr_held_out_masked_photo") > 80


QUICK = {
    "hold_out_every": 12,
    "nerf": {"levels": 6, "log2_table": 12, "finest": 64, "width": 16, "width_px": 48, "device": "cpu"}
    | {"rays_per_epoch": 80 * 512, "hull_tolerance": 0},
    "cloud": {"min_views": 2, "spacing": 0.01},
}
OPTIONS = TrainingOptions(
    recipe=NerfRecipe(
        images_per_batch=8,
        rays_per_image=64,
        warmup_epochs=0.2,
        learning_rate=1e-2,
        grid_learning_rate=2e-2,
        occupancy_cells=32,
    ),
    losses=LossWeights(),
    maps=RenderedMapSettings(map_agreement=0.03),
    gates=CloudGates(point_agreement=0.05, min_confidence=0.0, through_share=0.5, mask_share=0.3),
)


@pytest.fixture
def quick(tmp_path):
    (tmp_path / "quick.yaml").write_text(yaml.safe_dump({"object": QUICK}))
    return tmp_path / "quick.yaml"


def sphere_on_disk(root):
    """The painted sphere as a COLMAP model with masks."""
    images, masks, k, object_from_cam, _ = sphere_views(24)
    rows = []
    for i, (image, mask, pose) in enumerate(zip(images, masks, object_from_cam)):
        write(root / "images", i, image[..., ::-1])
        write(root / "masks", i, mask.astype(np.uint8) * 255)
        back = np.linalg.inv(pose)
        numbers = *np.roll(Rotation.from_matrix(back[:3, :3]).as_quat(), 1), *back[:3, 3]
        rows.append(f"{i + 1} {' '.join(f'{n:.15g}' for n in numbers)} 1 {i:02d}.png\n\n")
    (root / "sparse").mkdir()
    (root / "sparse/cameras.txt").write_text(f"1 PINHOLE 48 48 {k[0, 0, 0]} {k[0, 1, 1]} 24 24\n")
    (root / "sparse/images.txt").write_text("".join(rows))
    return root


@pytest.mark.slow
def test_a_sphere_from_the_files_to_its_cloud_and_a_nerf_without_a_cloud(tmp_path, quick, monkeypatch):
    data, out = sphere_on_disk(tmp_path / "in"), tmp_path / "out"
    trained = {"data": data, "out": out, "masks": data / "masks", "config": quick, "epochs": 3}
    assert train_nerf(**trained, options=OPTIONS) == 0
    report = read_json(out / "report.json")
    assert value(report["nerf"], "photos_measured") == 2 and value(report["nerf"], "psnr_held_out") > 15
    assert value(report, "settings")["nerf"]["recipe"]["mask_band_px"] == 2
    distance = np.linalg.norm(read_cloud(out / "object.ply").points - CENTER, axis=1)
    assert np.median(np.abs(distance - RADIUS)) < 0.1
    assert sorted(p.name for p in out.iterdir()) == sorted(
        ["masks", "nerf", "object.ply", "renders.png", "report.json", "steps", "undistorted"]
    )
    assert (out / "renders.png").stat().st_size > 5000
    # The same NeRF again, on no point of which all photos agree.
    monkeypatch.setattr("scenefuse.nerf.train_nerf.train_object_nerf", lambda **_: None)
    quick.write_text(yaml.safe_dump({"object": QUICK | {"cloud": QUICK["cloud"] | {"min_views": 24}}}))
    strict = replace(OPTIONS, gates=replace(OPTIONS.gates, min_confidence=1.0))
    assert train_nerf(**trained, options=strict) == 3
    assert "no surface found" in value(read_json(out / "report.json"), "no_cloud_because")
    assert not (out / "object.ply").exists()


def test_exact_masks_have_no_band_that_is_left_out():
    wanted = read_settings(None)["object"]
    assert [nerf_settings(wanted, OPTIONS, 4, exact).recipe.mask_band_px for exact in (True, False)] == [0, 2]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"data": Path("nowhere")}, "the cameras nowhere do not exist"),
        ({"out": Path("file.txt")}, "is a file"),
        ({"masks": Path("none")}, "--masks none is no folder"),
        ({"config": Path("typo.yaml")}, "'levls' is unknown; did you mean 'levels'"),
        ({"seed": -1}, "--seed: -1 is less than the minimum of 0; correct it"),
        ({"epochs": 0}, "--epochs: 0 is less than the minimum of 1; correct it"),
    ],
)
def test_wrong_flags_are_one_sentence(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    nerfstudio(tmp_path / "in")
    Path("file.txt").write_text("")
    Path("typo.yaml").write_text("object: {nerf: {levls: 3}}")
    with pytest.raises(StageError, match=words):
        train_nerf(**({"data": Path("in"), "out": Path("out")} | options))
    assert not Path("out").exists()


def test_masks_of_a_user_are_not_replaced(tmp_path):
    data = nerfstudio(tmp_path / "in")
    before = sorted(path.read_bytes() for path in (data / "masks").iterdir())
    with pytest.raises(StageError, match="in holds masks/, which a run would replace"):
        train_nerf(data=data, out=data)
    assert sorted(path.read_bytes() for path in (data / "masks").iterdir()) == before


@pytest.mark.skipif(not LEGO.is_dir(), reason="only where the Lego photos are")
def test_lego_masks_agree_on_a_hull(tmp_path):
    views, _ = imported(LEGO, tmp_path)
    assert views.held_out.sum() == 25 and len(views.names) == 125
    some = np.flatnonzero(~views.held_out)[::5]
    outlines = silhouettes(views.masks[some], None, views.intrinsics[some], views.object_from_cam[some])
    assert visual_hull(outlines, cube_from_cameras([outline.view for outline in outlines]), 64, 0.0).mean() > 0.01
