"""Planted trials of shared photos: two captures of one place as sparse models, bent by mapping as real ones are."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.photographed_place import (
    Capture,
    Features,
    Kind,
    Rows,
    captured,
    features,
    lens,
    object_photos,
    place,
    scene_photos,
)

from scenefuse.core.transforms import Array, Sim3, fit_sim3
from scenefuse.georef.landmarks import Landmarks, landmarks_of
from scenefuse.sfm.colmap import adjust, drop_outliers
from scenefuse.sfm.lens import HELD, Choice, choose_lens

OUTLIERS = 0.05
# Points that a truth is fitted to, and photos of a side, at least.
LEAST_POINTS, LEAST_PHOTOS = 80, 8
MOST_DRAWS = 50
# Length of the noise in a descriptor, over the descriptor's.
LOOK_NOISE = 0.45
# Relative change of the cost at which the robust adjustment ends; mapping's own follows.
ROBUST_TOLERANCE = 1e-4


@dataclass
class Side:
    """One capture as mapping leaves it, and what is true about it.

    Attributes:
        capture: true camera and photos.
        model: the sparse model. Ids of its points are 1 + the row of the true feature; ids of its images are 1 + the
            row of the photo.
        looks: (P, 128) unit descriptors of the features on this side.
        seed: of the noise in the descriptors of its photos.
    """

    capture: Capture
    model: pycolmap.Reconstruction
    looks: NDArray[np.float32]
    seed: int

    def landmarks(self) -> Landmarks:
        """What the alignment reads from a model and its database."""
        return landmarks_of(self.model, self._descriptors)

    def _descriptors(self, image: pycolmap.Image) -> NDArray[np.float32]:
        look = self.looks[self.capture.shown[image.image_id - 1]]
        noise = np.random.default_rng([self.seed, image.image_id]).normal(0, LOOK_NOISE / np.sqrt(128), look.shape)
        return look + noise.astype(np.float32)

    def points(self) -> tuple[Rows, Array, Rows]:
        """Rows (N,) of the true features in the model, where the model has them (N, 3), and in how many photos."""
        ids = np.array(sorted(self.model.points3D), dtype=np.int64)
        points = [self.model.points3D[i] for i in ids]
        x = np.array([p.xyz for p in points]).reshape(-1, 3)
        return ids - 1, x, np.array([p.track.length() for p in points], dtype=np.int64)

    def world_from_model(self) -> Sim3:
        """By all camera centres, as an evaluation with true cameras has it."""
        images = sorted(self.model.images)
        centres = np.array([self.model.images[i].projection_center() for i in images])
        return fit_sim3(centres, np.array([self.capture.photos[i - 1].centre for i in images]))

    def move(self, transform: Sim3) -> None:
        """Give the model another frame."""
        self.model.transform(pycolmap.Sim3d(transform.matrix[:3]))


@dataclass(frozen=True)
class PhotoTrial:
    """The object's and the scene's side, before mapping's last adjustment, and what is true.

    Attributes:
        obj, scene: the two sides; both models in the world's frame and unit.
        features: true points.
        diagonal: of the object, in the world.
        alike: features that both sides show twice or more and that look the same on both.
    """

    obj: Side
    scene: Side
    features: Features
    diagonal: float
    alike: int


@dataclass(frozen=True)
class Plan:
    """What a trial is to be like.

    Attributes:
        kind: how the scene was photographed.
        scene_photos, object_photos: how many photos are planned; fewer where something stands before them.
        alike: features that look the same on both sides, at most.
        strange: features of the object that look like another of the scene, as a share of those alike.
        twin: whether a second copy of the object stands elsewhere.
        bend: 1: true cameras as different from what mapping assumes as real ones are; 0: not different.
        noise_px: of the observations of the object's and of the scene's photos.
        points: features made for the object's and for the scene's photos.
        apart_px: how far off, along the surface and in pixels of the scene's nearest photo, close-ups find a feature.
    """

    kind: Kind = "orbit"
    scene_photos: int = 30
    object_photos: int = 20
    alike: int = 200
    strange: float = 0.2
    twin: bool = False
    bend: float = 1.0
    noise_px: tuple[float, float] = (0.5, 0.5)
    points: tuple[int, int] = (3600, 4500)
    apart_px: float = 0.0


def plant_photos(seed: int, plan: Plan) -> PhotoTrial:
    """Make one trial; where photos show too little of the object, of rods for instance, the place is drawn again.

    Raises:
        ValueError: fifty places show too little.
    """
    rng = np.random.default_rng(seed)
    drawn = (_photographed(rng, plan) for _ in range(MOST_DRAWS))
    kept = next((one for one in drawn if _tells(*one)), None)
    if kept is None:
        raise ValueError(f"none of {MOST_DRAWS} places shows the object in enough photos and points; plan more of them")
    diagonal, found, captures = kept
    looks = _unit(rng, int(found.look.max()) + 1)
    looks_of_object, alike = _changed(rng, found.look, looks, captures, plan)
    obj, scene = (
        Side(capture, _first_model(rng, capture, found, noise, plan.bend), look, int(rng.integers(2**31)))
        for capture, noise, look in zip(captures, plan.noise_px, (looks_of_object, looks[found.look]))
    )
    return PhotoTrial(obj, scene, found, diagonal, alike)


def _photographed(rng: np.random.Generator, plan: Plan) -> tuple[float, Features, list[Capture]]:
    """A place: the diagonal of its object, its features, and the object's and the scene's captures of them."""
    where = place(rng, plan.kind, plan.twin)
    cameras = [lens(rng, *size, plan.bend) for size in ((1600, 1200), (2000, 1500))]
    photos = [
        object_photos(rng, where, plan.kind, plan.object_photos),
        scene_photos(rng, where, plan.kind, plan.scene_photos, cameras[1]),
    ]
    found = features(rng, where, list(zip(cameras, photos, plan.points)))
    captures = [captured(rng, where, found, c, p) for c, p in zip(cameras, photos)]
    if plan.apart_px:
        captures[0] = _elsewhere(captures[0], found, plan.apart_px * _pixel(found, captures[1]))
    return where.diagonal, found, captures


def _pixel(found: Features, capture: Capture) -> Array:
    """(P,) what a pixel of the nearest photo covers at each feature."""
    centres = np.array([photo.centre for photo in capture.photos]).reshape(-1, 3)
    distance = np.min([np.linalg.norm(found.x - c, axis=1) for c in centres], axis=0, initial=np.inf)
    return distance / capture.camera.mean_focal_length()


def _elsewhere(capture: Capture, found: Features, by: Array) -> Capture:
    """A capture that finds each feature a little off, `by` (P,) metres along its surface, the same in all photos."""
    step = np.random.default_rng(len(found.x)).normal(0, 1, found.x.shape) * by[:, None]
    moved = found.x + step - (step * found.normal).sum(1, keepdims=True) * found.normal
    pixels = []
    for photo, rows in zip(capture.photos, capture.shown):
        local = (moved[rows] - photo.centre) @ photo.rotation.T
        pixels.append(np.asarray(capture.camera.img_from_cam(local)).reshape(-1, 2))
    return replace(capture, pixels=pixels)


def _tells(diagonal: float, found: Features, captures: list[Capture]) -> bool:
    """Whether enough photos show enough for a truth: the object's of the object, the scene's of it and around it."""
    near = np.linalg.norm(found.x, axis=1) < diagonal
    counts = [
        (capture.seen_twice(len(found.x)) & shown).sum()
        for capture, shown in zip(captures, (found.owner == "object", near))
    ]
    return min(counts) >= LEAST_POINTS and min(len(capture.photos) for capture in captures) >= LEAST_PHOTOS


def _unit(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    looks = rng.normal(0, 1, (count, 128)).astype(np.float32)
    return looks / np.linalg.norm(looks, axis=1, keepdims=True)


def _changed(
    rng: np.random.Generator, look: Rows, looks: NDArray[np.float32], captures: list[Capture], plan: Plan
) -> tuple[NDArray[np.float32], int]:
    """The descriptors (P, 128) on the object's side: as on the scene's for some features, changed or wrong for others.

    Of what both sides show as many features stay as the plan says, and the same share of those whose look the scene
    shows elsewhere, on the twin or in another window.
    """
    obj, scene = (capture.seen_twice(len(look)) for capture in captures)
    both = rng.permutation(np.flatnonzero(obj & scene))
    alike = both[: plan.alike]
    elsewhere = obj & ~scene & np.isin(look, look[scene])
    stay = ~(obj & scene) & ~(elsewhere & (rng.random(len(look)) >= len(alike) / max(len(both), 1)))
    stay[alike] = True
    result = np.where(stay[:, None], looks[look], _unit(rng, len(look)))
    others = obj.copy()
    others[alike] = False
    friends = rng.permutation(np.flatnonzero(others))[: round(plan.strange * len(alike))]
    result[friends] = looks[look[rng.choice(np.flatnonzero(scene), len(friends))]]
    return result, len(alike)


def _first_model(
    rng: np.random.Generator, capture: Capture, found: Features, noise_px: float, bend: float
) -> pycolmap.Reconstruction:
    """The truth with errors of some percent, as SIMPLE_RADIAL with its principal point in the middle."""
    true = capture.camera
    focal = true.mean_focal_length() * (1 + 0.02 * bend * rng.normal())
    middle = [true.width / 2, true.height / 2]
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=true.width, height=true.height, params=[focal, *middle, 0.0], camera_id=1
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for k, (photo, rows, pixels) in enumerate(zip(capture.photos, capture.shown, capture.pixels), 1):
        observed = pixels + rng.normal(0, noise_px, pixels.shape)
        wrong = rng.random(len(rows)) < OUTLIERS
        observed[wrong] += rng.uniform(-40, 40, (wrong.sum(), 2))
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.3, 3))).as_matrix() @ photo.rotation
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ photo.centre)
        points = [pycolmap.Point2D(p) for p in observed]
        image = pycolmap.Image(name=f"{k}.jpg", camera_id=1, image_id=k, points2D=points)
        model.add_image_with_trivial_frame(image, pose)
        for j, row in enumerate(rows):
            tracks.setdefault(int(row), []).append(pycolmap.TrackElement(k, j))
    for row, track in sorted(tracks.items()):
        if len(track) >= 2:
            about = found.x[row] + 5 * found.size[row] * rng.normal(0, 1, 3)
            model.add_point3D_with_id(row + 1, pycolmap.Point3D(xyz=about, track=pycolmap.Track(track)))
    return model


def mapped(side: Side) -> None:
    """Adjust a side's model in place, with the lens that the mapper assumes: wrong observations go."""
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.function_tolerance = ROBUST_TOLERANCE
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.print_summary = False
    pycolmap.bundle_adjustment(side.model, options)
    drop_outliers(side.model)
    adjust(side.model, HELD.freedom)
    drop_outliers(side.model)


def calibrated(side: Side) -> Choice:
    """Choose the lens of a mapped side as mapping does, and adjust its model with it."""
    choice = choose_lens(side.model)
    side.model = choice.lens.fit(side.model)
    drop_outliers(side.model)
    return choice


@dataclass(frozen=True)
class Truth:
    """What is true of a pair of models.

    Attributes:
        scene_from_object: from the object's points to where they truly are, in the frame that the scene's cameras fix.
        here: the same, moved to where the scene's model has its own points on and around the object.
        centre: (3,) of the object's points, in the object's model.
        misfit: median distance that `here` leaves between the scene's points there and the truth, over the object's
            diagonal; where it is large the scene's model is torn or doubled there, and no similarity is right.
    """

    scene_from_object: Sim3
    here: Sim3
    centre: Array
    misfit: float


def truth(trial: PhotoTrial) -> Truth:
    """The true similarity between two mapped models in any frames."""
    x = trial.features.x
    rows, points, photos = trial.obj.points()
    mine = trial.features.owner[rows] == "object"
    world_from_object = fitted(points[mine], x[rows[mine]], photos[mine])
    centre = np.median(points[mine], axis=0)
    rows, points, photos = trial.scene.points()
    near = np.linalg.norm(x[rows], axis=1) < trial.diagonal
    here = fitted(x[rows[near]], points[near], photos[near])
    misfit = np.median(np.linalg.norm(here.inverse().apply(points[near]) - x[rows[near]], axis=1)) / trial.diagonal
    scene_from_object = trial.scene.world_from_model().inverse() @ world_from_object
    return Truth(scene_from_object, here @ world_from_object, centre, float(misfit))


def fitted(a: Array, b: Array, photos: Rows) -> Sim3:
    """The similarity b_from_a, without pairs that are off by more than three medians; the more photos, the more weight.

    A point in two photos has a weight of 1, because they leave it one observation more than it has coordinates.
    """
    keep, weights = np.ones(len(a), bool), (photos - 1).astype(np.float64)
    for _ in range(5):
        pose = fit_sim3(a[keep], b[keep], weights[keep])
        error = np.linalg.norm(pose.apply(a) - b, axis=1)
        keep = error <= 3 * np.median(error)
    return pose
