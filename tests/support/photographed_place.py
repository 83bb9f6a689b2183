"""A place with an object in it, and what two sets of photos of it show: features at pixels, without any picture.

Lengths are metres, z is up, and the object stands about the origin.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import open3d as o3d
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.planted import SHAPES

from demo.objects import Part, box, grid, join
from scenefuse.core.transforms import Array, Sim3, look_at

Kind = Literal["grid", "orbit", "row"]
Rows = NDArray[np.int64]
# SIFT matches a feature within some 40 degrees and a factor of 2.5 of scale: half of either about its best view.
HALF_ANGLE_DEG, HALF_SCALE_LOG = 20.0, np.log(2.5) / 2
# Share of the photos that could show a feature and do; features of a photo at most; the steepest view of a surface.
REPEATED, MOST_PER_PHOTO, LEAST_COSINE = 0.8, 800, 0.2
# A feature is hidden where a surface lies farther than this before it, diagonals of the object.
HIDDEN = 0.005
# Share of the features on fronts that belong to a window; windows are cells of this many metres, and look alike.
WINDOWS, WINDOW_M, FEATURES_PER_WINDOW = 0.6, (2.5, 3.0), 12


@dataclass(frozen=True)
class Place:
    """What stands there.

    Attributes:
        rays: ray caster of all meshes.
        owner: what each of its meshes is: ground, object, twin or building.
        twin_from_object: where a second copy of the object stands, or None.
        diagonal: of the object's bounding box.
    """

    rays: o3d.t.geometry.RaycastingScene
    owner: NDArray[np.str_]
    twin_from_object: Sim3 | None
    diagonal: float

    def cast(self, origins: Array, directions: Array) -> tuple[Array, Rows, Array]:
        """Distances (N,) along unit directions or inf, the mesh hit or -1, and its normal towards the eye."""
        hit = self.rays.cast_rays(o3d.core.Tensor.from_numpy(np.hstack([origins, directions]).astype(np.float32)), 1)
        mesh = hit["geometry_ids"].numpy().astype(np.int64)
        normal = hit["primitive_normals"].numpy().astype(np.float64)
        normal *= -np.sign((normal * directions).sum(1))[:, None]
        return hit["t_hit"].numpy().astype(np.float64), np.where(mesh < len(self.owner), mesh, -1), normal


@dataclass(frozen=True)
class Photo:
    """A true pose: cam_from_world (3, 3) and the centre (3,) in the world."""

    rotation: Array
    centre: Array


@dataclass(frozen=True)
class Features:
    """P true points on surfaces, each found in photos from about one direction and distance.

    Attributes:
        x: (P, 3) where.
        towards: (P, 3) unit direction of the best view.
        size: (P,) metres per pixel of the best view.
        normal: (P, 3).
        look: (P,) number of the look; features of windows in a row, and of the object's twin, share it.
        owner: (P,) what it is on.
    """

    x: Array
    towards: Array
    size: Array
    normal: Array
    look: Rows
    owner: NDArray[np.str_]


@dataclass(frozen=True)
class Capture:
    """One side's photos, its true camera, and the features that each photo shows at which pixels, without noise."""

    camera: pycolmap.Camera
    photos: list[Photo]
    shown: list[Rows]
    pixels: list[Array]

    def seen_twice(self, count: int) -> NDArray[np.bool_]:
        """(P,) whether a feature is shown by two photos or more."""
        return np.bincount(np.concatenate(self.shown), minlength=count) >= 2


def place(rng: np.random.Generator, kind: Kind, twin: bool) -> Place:
    """An object of 2 to 12 metres among buildings, on ground that is flat or not; a row needs a front behind it."""
    part = join(SHAPES[str(rng.choice(list(SHAPES)))].parts())
    low, high = part.vertices.min(0), part.vertices.max(0)
    diagonal = float(np.exp(rng.uniform(np.log(2), np.log(12))))
    body = (part.vertices - [*(low + high)[:2] / 2, low[2]]) * diagonal / np.linalg.norm(high - low)
    angle = rng.uniform(0, 2 * np.pi)
    away = diagonal * rng.uniform(2.5, 4) * np.array([np.cos(angle), np.sin(angle), 0])
    if kind == "row":
        away = np.array([rng.choice([-1, 1]) * diagonal * rng.uniform(1.5, 2.5), 0, 0])
    twin_from_object = Sim3(1.0, Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix(), away)
    meshes = [("ground", _ground(rng, diagonal)), ("object", Part(body, part.triangles, 0))]
    if twin:
        meshes.append(("twin", Part(twin_from_object.apply(body), part.triangles, 0)))
    meshes += [("building", b) for b in _buildings(rng, kind, diagonal)]
    rays = o3d.t.geometry.RaycastingScene(1)
    for _, mesh in meshes:
        rays.add_triangles(
            o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
        )
    owner = np.array([name for name, _ in meshes])
    return Place(rays, owner, twin_from_object if twin else None, diagonal)


def _ground(rng: np.random.Generator, diagonal: float) -> Part:
    """Waves of up to 0.3 diagonals, level at the object."""
    x, y = np.meshgrid(*[np.linspace(-25, 25, 101) * diagonal] * 2, indexing="ij")
    waves, phase = rng.normal(0, 0.5 / diagonal, (4, 2)), rng.uniform(0, 6.28, 4)
    height = np.sin(np.stack([x, y], -1) @ waves.T + phase).mean(-1)
    level = 1 - np.exp(-(x**2 + y**2) / (2 * diagonal) ** 2)
    return grid(np.stack([x, y, rng.uniform(0, 0.3) * diagonal * level * height], -1), 0)


def _buildings(rng: np.random.Generator, kind: Kind, diagonal: float) -> list[Part]:
    """A front behind the object for a row; boxes around it otherwise."""
    if kind == "row":
        depth, high = rng.uniform(0.8, 1.5), rng.uniform(1.2, 2.5)
        front = [box((-8, depth, -2), (8, depth + 3, high), 0)]
        bays = rng.uniform(-5, 5, (3, 1)) * [1, 0, 0] + [0, depth, -2]
        front += [box(tuple(b - [0.4, rng.uniform(0.1, 0.4), 0]), tuple(b + [0.4, 1, high + 1.5]), 0) for b in bays]
        return [Part(diagonal * b.vertices, b.triangles, 0) for b in front]
    built = []
    for _ in range(rng.integers(3, 10)):
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2.5, 7)
        half = np.array([*rng.uniform(0.5, 1.5, 2), 0])
        foot = distance * np.array([np.cos(angle), np.sin(angle), 0]) + [0, 0, -1]
        b = box(tuple(-half), tuple(half + [0, 0, 1 + rng.uniform(0.4, 1.3)]), 0)
        turned = b.turned(Rotation.from_euler("z", rng.uniform(0, 90), degrees=True).as_matrix())
        built.append(Part(diagonal * (turned.vertices + foot), turned.triangles, 0))
    return built


def lens(rng: np.random.Generator, width: int, height: int, bend: float) -> pycolmap.Camera:
    """A true camera: principal point up to 1.5 % off the middle and OPENCV's distortion, both times `bend`."""
    focal = width * rng.uniform(0.7, 1.1)
    off = bend * rng.uniform(-0.015, 0.015, 2) * width
    distortion = bend * rng.normal(0, [0.04, 0.015, 7e-4, 7e-4])
    parameters = [focal, focal, width / 2 + off[0], height / 2 + off[1], *distortion]
    return pycolmap.Camera(model="OPENCV", width=width, height=height, params=parameters, camera_id=1)


def scene_photos(
    rng: np.random.Generator, where: Place, kind: Kind, count: int, camera: pycolmap.Camera
) -> list[Photo]:
    """A grid or an orbit flown, or a row of photos by hand along the front, near and far."""
    far = where.diagonal * rng.uniform(1.5, 3)
    if kind == "grid":
        across = int(np.ceil(np.sqrt(count)))
        step = far * camera.width / camera.mean_focal_length() * rng.uniform(0.13, 0.22)
        i, j = np.divmod(np.arange(count), across)
        middle = rng.uniform(-0.3, 0.3, 2) * across
        eyes = np.stack([step * (i - across / 2 + middle[0]), step * (j - across / 2 + middle[1]), far + 0 * i], 1)
        # Lines look ahead, down, back, down, ...: lines that only look ahead and back share too few features.
        tilt = np.tan(np.radians(rng.uniform(15, 30)))
        ahead = np.array([1, 0, -1, 0])[i % 4][:, None] * [0, tilt * far, 0]
        targets = eyes * [1, 1, 0] + ahead
    elif kind == "orbit":
        angle = 2 * np.pi * np.arange(count) / count * (1 + (rng.random() < 0.5))
        high = far * rng.uniform(0.5, 1.1) * np.where(np.arange(count) < count / 2, 1, rng.uniform(0.7, 1.4))
        middle = rng.uniform(-0.3, 0.3, 2) * far
        eyes = np.stack([far * np.cos(angle) + middle[0], far * np.sin(angle) + middle[1], high], 1)
        targets = np.zeros((count, 3)) + [*middle / 2, 0]
    else:
        rear = np.arange(count) % 2
        along = np.linspace(-1, 1, count) * far * rng.uniform(0.8, 1.6)
        eyes = np.stack([along, -far * (0.8 + 0.5 * rear), where.diagonal * rng.uniform(0.15, 0.6) + 0 * along], 1)
        targets = eyes * [1, 0, 1] + [0, where.diagonal, 0.1 * where.diagonal]
    return _taken(rng, where, eyes, targets, jitter=0.04 * far)


def object_photos(rng: np.random.Generator, where: Place, kind: Kind, count: int) -> list[Photo]:
    """Close-ups on an arc, or an orbit; before a front only an arc."""
    width = np.pi * (rng.uniform(0.5, 0.9) if kind == "row" or rng.random() < 0.5 else 2)
    facing = -np.pi / 2 if kind == "row" else rng.uniform(0, 2 * np.pi)
    angle = facing + width * (np.arange(count) / count - 0.5)
    distance = where.diagonal * rng.uniform(1, 1.6) * np.where(np.arange(count) % 3 == 2, rng.uniform(1, 1.7), 1)
    # A grid sees little of what is seen from the ground, so that its object is photographed from higher up.
    high = rng.uniform(0.2, 1.6 if kind == "grid" else 0.8) + rng.uniform(0, 0.8) * (np.arange(count) % 4 == 3)
    eyes = np.stack([distance * np.cos(angle), distance * np.sin(angle), where.diagonal * high], 1)
    return _taken(rng, where, eyes, np.zeros((count, 3)) + [0, 0, 0.3 * where.diagonal], jitter=0.06 * where.diagonal)


def _taken(rng: np.random.Generator, where: Place, eyes: Array, targets: Array, jitter: float) -> list[Photo]:
    """Photos from about these places to about these targets, without those that something stands close before."""
    eyes, targets = eyes + rng.normal(0, jitter, eyes.shape), targets + rng.normal(0, jitter, eyes.shape)
    photos = []
    for eye, target in zip(eyes, targets):
        roll = Rotation.from_euler("z", rng.normal(0, 3), degrees=True).as_matrix()
        photo = Photo(roll @ look_at(eye, target, np.array([0.0, 0.02, 1.0])), eye)
        if where.cast(eye[None], photo.rotation[2][None])[0][0] > 0.4 * np.linalg.norm(target - eye):
            photos.append(photo)
    return photos


def features(rng: np.random.Generator, where: Place, sides: list[tuple[pycolmap.Camera, list[Photo], int]]) -> Features:
    """At most as many features for each side as is said: where rays through pixels of its photos meet surfaces."""
    each = [(camera, photo, count // len(photos)) for camera, photos, count in sides for photo in photos]
    met = _joined([_met(rng, where, *one) for one in each])
    met = _in_windows(rng, replace(met, look=np.arange(len(met.x))))
    if where.twin_from_object is None:
        return met
    there, back = where.twin_from_object, where.twin_from_object.inverse()
    return _joined([met, _copied(met, "object", "twin", there), _copied(met, "twin", "object", back)])


def _copied(f: Features, owner: str, copy: str, move: Sim3) -> Features:
    """The features on one of the twins, on the other."""
    f = _rows(f, f.owner == owner)
    return replace(
        f,
        x=move.apply(f.x),
        towards=move.rotate(f.towards),
        normal=move.rotate(f.normal),
        owner=np.full(len(f.x), copy),
    )


def _joined(parts: list[Features]) -> Features:
    return Features(*(np.concatenate([getattr(f, name) for f in parts]) for name in Features.__dataclass_fields__))


def _rows(f: Features, chosen: NDArray) -> Features:
    return Features(*(getattr(f, name)[chosen] for name in Features.__dataclass_fields__))


def _met(rng: np.random.Generator, where: Place, camera: pycolmap.Camera, photo: Photo, count: int) -> Features:
    """Features where a photo's rays meet surfaces, their best view about this one."""
    pixels = rng.uniform(0, 1, (count, 2)) * [camera.width, camera.height]
    local = np.hstack([np.asarray(camera.cam_from_img(pixels)), np.ones((count, 1))])
    ahead = local / np.linalg.norm(local, axis=1, keepdims=True) @ photo.rotation
    distance, mesh, normal = where.cast(np.broadcast_to(photo.centre, ahead.shape), ahead)
    fine = (mesh >= 0) & (distance < 15 * where.diagonal) & (-(ahead * normal).sum(1) > LEAST_COSINE)
    distance, ahead = distance[fine], ahead[fine]
    towards = -ahead + rng.normal(0, 0.25, ahead.shape)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    size = distance / camera.mean_focal_length() * np.exp(rng.uniform(-HALF_SCALE_LOG, HALF_SCALE_LOG, len(distance)))
    return Features(
        photo.centre + distance[:, None] * ahead,
        towards,
        size,
        normal[fine],
        np.zeros(len(size), np.int64),
        where.owner[mesh[fine]],
    )


def _in_windows(rng: np.random.Generator, f: Features) -> Features:
    """Most features on fronts moved to where windows have them: in every cell alike, and one at each place."""
    front = np.flatnonzero((f.owner == "building") & (np.abs(f.normal[:, 2]) < 0.5) & (rng.random(len(f.x)) < WINDOWS))
    if not len(front):
        return f
    along = np.cross([0, 0, 1.0], f.normal[front])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    which = rng.integers(0, FEATURES_PER_WINDOW, len(front))
    template = rng.uniform(0.1, 0.9, (FEATURES_PER_WINDOW, 2)) * WINDOW_M
    at = np.stack([(f.x[front] * along).sum(1), f.x[front][:, 2]], 1)
    cell = np.floor(at / WINDOW_M)
    step = cell * WINDOW_M + template[which] - at
    x, look = f.x.copy(), f.look.copy()
    x[front] += step[:, :1] * along + step[:, 1:] * [0, 0, 1]
    look[front] = len(f.x) + which
    place_of = np.round(np.hstack([x[front], f.normal[front]]), 2)
    first = np.unique(place_of, axis=0, return_index=True)[1]
    keep = np.ones(len(x), bool)
    keep[np.delete(front, first)] = False
    return _rows(replace(f, x=x, look=look), keep)


def captured(
    rng: np.random.Generator, where: Place, f: Features, camera: pycolmap.Camera, photos: list[Photo]
) -> Capture:
    """Which features each photo shows, by angle, scale, frame and what stands before, and where."""
    seen = [_shown(rng, where, f, camera, photo) for photo in photos]
    return Capture(camera, photos, [rows for rows, _ in seen], [pixels for _, pixels in seen])


def _shown(
    rng: np.random.Generator, where: Place, f: Features, camera: pycolmap.Camera, photo: Photo
) -> tuple[Rows, Array]:
    """The features (N,) that one photo shows, and at which pixels (N, 2)."""
    focal, size = camera.mean_focal_length(), np.array([camera.width, camera.height])
    to_eye = photo.centre - f.x
    distance = np.linalg.norm(to_eye, axis=1)
    to_eye /= distance[:, None]
    local = (f.x - photo.centre) @ photo.rotation.T
    able = (
        (local[:, 2] > 0.1)
        & ((to_eye * f.towards).sum(1) > np.cos(np.radians(HALF_ANGLE_DEG)))
        & ((to_eye * f.normal).sum(1) > LEAST_COSINE)
        & (np.abs(np.log(distance / focal / f.size)) < HALF_SCALE_LOG)
        # The distortion of a point far outside may lead back into the frame.
        & (np.abs(local[:, :2]) < 0.8 * camera.width / focal * local[:, 2:]).all(1)
        & (rng.random(len(f.x)) < REPEATED)
    )
    rows = np.flatnonzero(able)
    at = np.asarray(camera.img_from_cam(local[rows])).reshape(-1, 2)
    first = where.cast(np.broadcast_to(photo.centre, (len(rows), 3)), -to_eye[rows])[0]
    good = ((at > 5) & (at < size - 5)).all(1) & (np.abs(first - distance[rows]) < HIDDEN * where.diagonal)
    chosen = rng.permutation(np.flatnonzero(good))[:MOST_PER_PHOTO]
    return rows[chosen], at[chosen]
