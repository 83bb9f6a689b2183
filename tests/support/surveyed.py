"""A flight over a hilly field whose true cameras and points are known, as a sparse model that mapping bent."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pyproj
from scipy.spatial.transform import Rotation

from scenefuse.core.stage import quantity, write_json
from scenefuse.core.transforms import Array, Sim3, box_corners, fit_sim3
from scenefuse.photos.cameras.given import Place
from scenefuse.photos.geodesy import LocalFrame
from scenefuse.photos.photos import Photo, write_photos
from scenefuse.photos.workspace import View
from scenefuse.sfm.colmap import adjust
from scenefuse.sfm.lens import HELD

FRAME = LocalFrame(47.37, 8.55, 430.0)
WIDTH, HEIGHT, FOCAL = 800, 600, 700.0
MODEL_FROM_LOCAL = Sim3(
    0.13, Rotation.from_euler("xyz", [150, 20, -80], degrees=True).as_matrix(), np.array([3.0, -1.2, 5.5])
)


@dataclass(frozen=True)
class Flight:
    """The truth of a flight, east, north and up in metres.

    Attributes:
        names: of N photos.
        views: their cameras.
        ground: (G, 3) places on the ground that photos show, far from each other.
    """

    names: list[str]
    views: list[View]
    ground: Array

    @property
    def centres(self) -> Array:
        """(N, 3) camera centres."""
        return np.array([view.centre for view in self.views])

    def clicks(self, place: Array, noise_px: float = 0.0, seed: int = 0) -> list[tuple[str, Array]]:
        """Where photos show a place (3,): photo and pixel."""
        rng = np.random.default_rng(seed)
        found = []
        for name, view in zip(self.names, self.views):
            rows, _, _ = view.visible(place[None])
            if len(rows):
                found.append((name, view.project(place[None])[0][0] + rng.normal(0, noise_px, 2)))
        return found

    def photos(self, noise_m: float = 0.0, sd_m: float | None = None, seed: int = 0) -> list[Photo]:
        """The photos as they would be listed, with noisy positions; `sd_m` is the accuracy that they state."""
        rng = np.random.default_rng(seed)
        positions = FRAME.inverse(self.centres + rng.normal(0, noise_m, self.centres.shape)).tolist()
        rest = {"horizontal_sd_m": sd_m, "vertical_sd_m": sd_m}
        return [Photo(n, WIDTH, HEIGHT, "", *p, **rest) for n, p in zip(self.names, positions)]

    def model(self, noise_px: float = 0.3, off_centre_px: float = 0.0, seed: int = 0) -> pycolmap.Reconstruction:
        """Cameras and 300 points as mapping leaves them, in a frame of its own.

        The model holds the principal point in the middle; where it is not, the model is bent.
        """
        rng = np.random.default_rng(seed)
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0]
        )
        camera.camera_id = 1
        model.add_camera_with_trivial_rig(camera)
        tracks = [pycolmap.Track() for _ in self.ground]
        for number, view in enumerate(self.views, 1):
            rows, _, _ = view.visible(self.ground)
            pixels = view.project(self.ground[rows])[0] + rng.normal(0, noise_px, (len(rows), 2)) + [off_centre_px, 0]
            image = pycolmap.Image(name=view.name, keypoints=pixels, camera_id=1, image_id=number)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
            for k, row in enumerate(rows):
                tracks[row].add_element(number, k)
        for place, track in zip(self.ground, tracks):
            if track.length() > 1:
                model.add_point3D(place, track)
        adjust(model, HELD.freedom)
        t = MODEL_FROM_LOCAL
        model.transform(pycolmap.Sim3d(t.scale, pycolmap.Rotation3d(t.rotation), t.translation))
        return model


def fly(rows: int = 4, columns: int = 6, seed: int = 0) -> Flight:
    """A grid of photos 60 m above a hilly field, nearly looking down."""
    rng = np.random.default_rng(seed)
    views = []
    for k in range(rows * columns):
        centre = np.array([(k % columns - 2.5) * 14.0, (k // columns - 1.5) * 16.0, 60.0]) + rng.normal(0, 1.0, 3)
        lean = Rotation.from_euler("xyz", [*rng.normal(0, 4, 2), 180 * (k // columns % 2)], degrees=True).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1, -1]) @ lean
        pose[:3, 3] = -pose[:3, :3] @ centre
        intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
        views.append(View(f"{k:02d}.jpg", intrinsics, pose, WIDTH, HEIGHT))
    x, y = rng.uniform(-45, 45, 300), rng.uniform(-30, 30, 300)
    ground = np.stack([x, y, 3 * np.sin(x / 15) + 2 * np.cos(y / 11)], axis=1)
    return Flight([view.name for view in views], views, ground)


def write_inputs(folder: Path, model: pycolmap.Reconstruction, photos: list[Photo]) -> None:
    """Write what georeferencing reads: sparse/, sparse.json, photos.json."""
    (folder / "sparse").mkdir()
    model.write(folder / "sparse")
    write_json(folder / "sparse.json", {"lens": quantity("held", "")})
    write_photos(folder / "photos.json", photos, folder, "photos", [])


def gcp_lines(
    flight: Flight, places: Array, names: list[str], crs: str = "EPSG:32632", noise_px: float = 0.0, most: int = 5
) -> list[str]:
    """Lines of a gcp_list.txt for true places (P, 3), each clicked in up to `most` photos."""
    lines = [crs]
    for k, (place, name) in enumerate(zip(places, names)):
        x, y, z = in_crs(place, crs)
        for photo, pixel in flight.clicks(place, noise_px, k)[:most]:
            lines.append(f"{x:.12g}\t{y:.12g}\t{z:.12g}\t{pixel[0]:.4f}\t{pixel[1]:.4f}\t{photo}\t{name}")
    return lines


def in_crs(place: Array, crs: str) -> tuple[float, float, float]:
    """A place (3,) of the flight in a CRS, x first; its height in metres above WGS84."""
    latitude, longitude, height = FRAME.inverse(place[None])[0]
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    return x, y, height


def on_earth(kind: str) -> Place:
    """Where the flight's model lies on the earth, as programs say it: about its centre, or in UTM less an offset.

    In the latter the model itself is in these coordinates.
    """
    crs = pyproj.CRS("EPSG:32632")
    if kind == "offset":
        return Place(Sim3(1.0, np.eye(3), np.array([466_000.0, 5_246_000.0, 0.0])), False, crs)
    corners = box_corners(np.full(3, -100.0), np.full(3, 100.0))
    latitude, longitude, height = FRAME.inverse(corners).T
    to_geocentric = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    earth = np.stack(to_geocentric.transform(longitude, latitude, height), axis=1)
    return Place(fit_sim3(MODEL_FROM_LOCAL.apply(corners), earth), True, crs)
