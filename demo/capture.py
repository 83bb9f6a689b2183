"""The demo capture: photos of a mapping flight and of an orbit around each object, with exact truth beside them."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from demo import bodies, textures
from demo.bodies import Body, Exposure, draw_exposure, expose
from demo.truth import Cameras, cameras_json, pinhole
from demo.world import MAPPED, ORIGIN, SUN, World, build_world, openness
from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, threads, write_json
from scenefuse.core.transforms import look_at


@dataclass(frozen=True)
class FlightSettings:
    """The mapping flight."""

    columns: int = setting(7, least=0)
    """Strips of the grid of photos that look down, west to east."""
    rows: int = setting(7, least=0)
    """Photos in a strip, south to north."""
    obliques: int = setting(11, least=0)
    """Photos that look obliquely, from the south and from the east."""
    altitude: float = setting(40, unit="m", least=0)
    """Height above the ground."""
    width_px: int = setting(800, unit="px", least=0)
    """Columns of a photo."""
    supersampling: int = 2
    """Samples along each side of a pixel."""
    gps_noise_horizontal: float = 0.5
    """Standard deviation of the EXIF position, east and north, metres."""
    gps_noise_vertical: float = 1.0
    """Standard deviation of the EXIF height, metres."""


@dataclass(frozen=True)
class OrbitSettings:
    """The photos around one object."""

    views: int = setting(40, least=0)
    """Number of photos, shared out among the rings."""
    elevations_deg: tuple[float, ...] = setting((5, 34), unit="deg")
    """One ring of photos for each: how high the camera stands above the object's middle."""
    fill: float = 0.65
    """Share of the photo's height that the object fills."""
    width_px: int = setting(640, unit="px", least=0)
    """Columns of a photo."""
    supersampling: int = 2
    """Samples along each side of a pixel."""


def height_px(width_px: int) -> int:
    """Rows of a photo, which is four to three."""
    return round(0.75 * width_px)


def focal_px(width_px: int) -> float:
    """Focal length of a photo."""
    return 0.875 * width_px


def render_scene(*, photos: Path, truth: Path, settings: FlightSettings, camera: bodies.Kind, seed: int) -> None:
    """Render the mapping flight: JPEG photos with noisy GPS in their EXIF, and its truth.

    The truth folder holds cameras.json (intrinsics in pixels, distortion k1, k2, p1, p2 as in COLMAP's OPENCV,
    cam_from_world rotations, centres in metres in a local east-north-up frame; its origin; each photo's exposure; each
    object's middle and diagonal) and meshes/: world.ply (terrain and clutter) and one mesh for each object.

    Args:
        photos: output folder of JPEG photos.
        truth: output folder, for evaluation only.
        settings: the flight.
        camera: a drone's, or an ideal one.
        seed: of the world, the flight's jitter, the GPS and what differs from photo to photo; every job of one demo
            uses the same.

    Raises:
        StageError: a flight without photos, or photos without pixels.
    """
    _check(settings.columns * settings.rows + settings.obliques, settings.width_px)
    world = build_world(seed)
    body = bodies.FLIGHT[camera]
    cameras = flight(world, settings, body, seed)
    offsets = np.random.default_rng([seed, 2]).normal(size=cameras.centres.shape)
    offsets *= [settings.gps_noise_horizontal, settings.gps_noise_horizontal, settings.gps_noise_vertical]
    gps = pycolmap.GPSTransform().enu_to_ellipsoid(cameras.centres + offsets, *ORIGIN)
    with atomic_directory(photos) as folder:
        exposures, _ = _render_all(world, cameras, body, folder, settings.supersampling, seed, gps=gps)
    with atomic_directory(truth) as folder:
        for owner, name in enumerate(["world", *world.names]):
            _write_mesh(folder / "meshes" / f"{name}.ply", world, owner)
        content = cameras_json(cameras) | _exposures_json(cameras, exposures)
        content["origin"] = quantity(list(ORIGIN), "degrees north, degrees east, m")
        content["ground_sampling_distance"] = quantity(settings.altitude / focal_px(settings.width_px), "m")
        content["mapped_area"] = quantity([[-MAPPED[0], -MAPPED[1]], [MAPPED[0], MAPPED[1]]], "m")
        content["objects"] = {name: _extent(world, name) for name in world.names}
        write_json(folder / "cameras.json", content)


def render_object(
    *, name: str, photos: Path, truth: Path, settings: OrbitSettings, camera: bodies.Kind, seed: int
) -> None:
    """Render the photos around one object: JPEG without GPS, and its truth.

    The truth folder holds cameras.json (as for the flight, and the object's middle and diagonal), mesh.ply (the
    object's surface in the world) and masks/{photo}.png (255 where the photo, distorted as it is, shows the object).

    Args:
        name: house, balloon or sculpture.
        photos: output folder of JPEG photos.
        truth: output folder, for evaluation only.
        settings: the orbit.
        camera: a phone's, or an ideal one.
        seed: as for the flight.

    Raises:
        StageError: an unknown object, an orbit without photos, or photos without pixels.
    """
    _check(settings.views, settings.width_px)
    if not settings.elevations_deg or not 0 < settings.fill <= 1:
        raise StageError(
            f"an orbit needs an elevation and a fill in 0..1, not {settings.elevations_deg} and {settings.fill}"
        )
    world = build_world(seed)
    owner = world.owner(name)
    body = bodies.ORBIT[camera]
    cameras = orbit(world, name, settings, body, seed)
    with atomic_directory(photos) as folder, atomic_directory(truth) as truth_folder:
        (truth_folder / "masks").mkdir()
        exposures, masks = _render_all(world, cameras, body, folder, settings.supersampling, seed, owner=owner)
        for photo, mask in zip(cameras.names, masks):
            cv2.imwrite(str(truth_folder / "masks" / f"{Path(photo).stem}.png"), mask)
        _write_mesh(truth_folder / "mesh.ply", world, owner)
        content = cameras_json(cameras) | _exposures_json(cameras, exposures)
        write_json(truth_folder / "cameras.json", content | {"object": _extent(world, name)})


def flight(world: World, settings: FlightSettings, body: Body, seed: int) -> Cameras:
    """A grid of photos that look down, then a strip from the south and one from the east that look obliquely."""
    rng = np.random.default_rng([seed, 1])
    footprint = (
        np.array([settings.width_px, height_px(settings.width_px)]) * settings.altitude / focal_px(settings.width_px)
    )
    reach = np.maximum(np.array(MAPPED) - 0.27 * footprint, 5.0)
    rotations, centres = [], []
    for k, x in enumerate(np.linspace(-reach[0], reach[0], settings.columns)):
        for y in np.linspace(-reach[1], reach[1], settings.rows)[:: 1 if k % 2 == 0 else -1]:
            centre = np.array([x, y, settings.altitude]) + rng.normal(size=3) * [0.7, 0.7, 0.5]
            tilt, heading = rng.normal(0.0, 2.5, 2), rng.normal(0.0, 4.0) + (0.0 if k % 2 == 0 else 180.0)
            below = centre + [np.tan(np.radians(tilt[0])), np.tan(np.radians(tilt[1])), -1.0]
            north = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading)), 0.0])
            rotations.append(look_at(centre, below, north))
            centres.append(centre)
    south = (settings.obliques + 1) // 2
    for k in range(settings.obliques):
        from_south = k < south
        count, index = (south, k) if from_south else (settings.obliques - south, k - south)
        along = (index + 0.5) / count * 2 - 1
        low = 0.75 * settings.altitude
        if from_south:
            centre, target = np.array([36.0 * along, -48.0, low]), np.array([28.0 * along, -10.0, 0.0])
        else:
            centre, target = np.array([52.0, 32.0 * along, low]), np.array([14.0, 22.0 * along, 0.0])
        centre, target = centre + rng.normal(0, 0.8, 3), target + rng.normal(0, 1.5, 3)
        rotations.append(look_at(centre, target, np.array([0.0, 0.0, 1.0])))
        centres.append(centre)
    names = [f"flight_{k + 1:04d}.jpg" for k in range(len(centres))]
    return _capture(names, settings, body, rotations, centres)


def orbit(world: World, name: str, settings: OrbitSettings, body: Body, seed: int) -> Cameras:
    """Rings of photos around an object; a ring's photos stand between those of the ring below."""
    rng = np.random.default_rng([seed, 10 + world.owner(name)])
    low, high = world.bounds(name)
    middle = (low + high) / 2
    tall, wide = float((high - low)[2]), float((high - low)[:2].max())
    rings = len(settings.elevations_deg)
    rotations, centres = [], []
    for ring, elevation_deg in enumerate(settings.elevations_deg):
        count = len(range(ring, settings.views, rings))
        distance = _distance(settings, tall, wide, np.radians(elevation_deg))
        for k in range(count):
            azimuth = 2 * np.pi * (k + ring / rings) / count + rng.normal(0, 0.025)
            elevation = np.radians(elevation_deg + rng.normal(0, 1.0))
            away = distance * rng.uniform(0.96, 1.04)
            flat = away * np.cos(elevation)
            centre = middle + [flat * np.cos(azimuth), flat * np.sin(azimuth), away * np.sin(elevation)]
            ground = _ground_height(world, centre)
            centre[2] = max(centre[2], ground + 1.6)
            target = middle + rng.normal(0, 0.02 * distance, 3)
            rotations.append(look_at(centre, target, np.array([0.03 * rng.normal(), 0.03 * rng.normal(), 1.0])))
            centres.append(centre)
    names = [f"{name}_{k + 1:04d}.jpg" for k in range(len(centres))]
    return _capture(names, settings, body, rotations, centres)


def _capture(
    names: list[str],
    settings: FlightSettings | OrbitSettings,
    body: Body,
    rotations: list[NDArray[np.float64]],
    centres: list[NDArray[np.float64]],
) -> Cameras:
    """Photos of a body at many poses."""
    width, height = settings.width_px, height_px(settings.width_px)
    k_matrix = pinhole(focal_px(width), width, height, body.shift)
    return Cameras(names, k_matrix, width, height, np.array(rotations), np.array(centres), np.array(body.distortion))


def _distance(settings: OrbitSettings, tall: float, wide: float, elevation: float) -> float:
    """How far away an object fills its share of the height, and all of it stays inside the photo."""
    projected = tall * np.cos(elevation) + wide * np.sin(elevation)
    shares = (
        tall / (settings.fill * height_px(settings.width_px)),
        wide / (0.85 * settings.width_px),
        projected / (0.9 * height_px(settings.width_px)),
    )
    # The near side of a wide object is closer than its middle.
    return focal_px(settings.width_px) * max(shares) + 0.3 * wide


def _check(count: int, width: int) -> None:
    if count <= 0:
        raise StageError("a capture without photos; set at least one photo in the demo's settings")
    if height_px(width) < 16:
        raise StageError(f"the demo's photos would be {width} x {height_px(width)} pixels; use at least 16 x 16")


def _extent(world: World, name: str) -> dict[str, dict[str, object]]:
    low, high = world.bounds(name)
    return {
        "middle": quantity((low + high) / 2, "m"),
        "diagonal": quantity(float(np.linalg.norm(high - low)), "m"),
    }


def _ground_height(world: World, point: NDArray[np.float64]) -> float:
    ray = np.array([[point[0], point[1], 200.0, 0.0, 0.0, -1.0]], dtype=np.float32)
    return 200.0 - float(world.scene.cast_rays(o3d.core.Tensor.from_numpy(ray))["t_hit"].numpy()[0])


def _write_mesh(path: Path, world: World, owner: int) -> None:
    vertices, triangles = world.mesh(owner)
    path.parent.mkdir(exist_ok=True)
    mesh = o3d.t.geometry.TriangleMesh(*(o3d.core.Tensor.from_numpy(a) for a in (vertices, triangles)))
    o3d.t.io.write_triangle_mesh(path, mesh)


def _render_all(
    world: World,
    cameras: Cameras,
    body: Body,
    folder: Path,
    supersampling: int,
    seed: int,
    *,
    gps: NDArray[np.float64] | None = None,
    owner: int = 0,
) -> tuple[list[Exposure], list[NDArray[np.uint8]]]:
    """Write every photo; returns its exposure and the mask of `owner`."""
    textures.set_threads(threads())
    open_sky, in_cam = openness(world, 24, seed), cameras.rays(supersampling)
    exposures, masks = [], []
    for k, name in enumerate(cameras.names):
        rng = np.random.default_rng([seed, 20 + owner, k])
        light, owners = render(world, cameras, k, in_cam, open_sky, body.haze)
        exposures.append(draw_exposure(body, rng))
        picture = expose(light, body, exposures[-1], cameras, rng)
        exif = _exif(cameras, k, None if gps is None else gps[k])
        file = folder / name
        Image.fromarray(picture).save(file, quality=body.quality, subsampling=body.subsampling, exif=exif)
        masks.append(((owners == owner).mean(-1) >= 0.5).astype(np.uint8) * 255)
        if (k + 1) % 10 == 0 or k + 1 == len(cameras.names):
            print(f"{k + 1} of {len(cameras.names)} photos", flush=True)
    return exposures, masks


def _exposures_json(cameras: Cameras, exposures: list[Exposure]) -> dict[str, object]:
    return {"exposures": {name: exposure.as_json() for name, exposure in zip(cameras.names, exposures)}}


def render(
    world: World,
    cameras: Cameras,
    photo: int,
    in_cam: NDArray[np.float64],
    open_sky: NDArray[np.float32],
    haze: float,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The light that reaches one photo: (H, W, 3) linear RGB, and the owner each sample hit, -1 for the sky.

    Args:
        world: what is photographed.
        cameras: from where.
        photo: which of them.
        in_cam: (H * W * S, 2) the rays of `Cameras.rays`, S samples for each pixel.
        open_sky: (V,) of `demo.world.openness`.
        haze: share of white in the sky.

    Returns:
        (H, W, 3) light and (H, W, S) owners.
    """
    rays = np.empty((len(in_cam), 6), dtype=np.float32)
    world_from_cam = np.ascontiguousarray(cameras.cam_from_world[photo].T)
    textures.world_rays(rays, cameras.centres[photo], world_from_cam, in_cam)
    shape = cameras.height, cameras.width
    light, owners, _ = light_of(world, rays, shape, open_sky, 1.0 / cameras.intrinsics[0, 0], haze)
    return light, owners


def light_of(
    world: World,
    rays: NDArray[np.float32],
    shape: tuple[int, int],
    open_sky: NDArray[np.float32],
    pixel_angle: float,
    haze: float,
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float32]]:
    """What rays (H * W * S, 6) of a picture of a shape (H, W) meet, S of a pixel next to each other.

    Args:
        world: what is shown.
        rays: origins and unit directions.
        shape: of the picture.
        open_sky: (V,) of `demo.world.openness`.
        pixel_angle: radians that a pixel covers.
        haze: share of white in the sky.

    Returns:
        (H, W, 3) linear light, and (H, W, S) owners, -1 for the sky, and distances in metres.
    """
    height, width = shape
    samples = len(rays) // (height * width)
    hits = world.scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=threads())
    distance, normals, uv = (hits[key].numpy() for key in ("t_hit", "primitive_normals", "primitive_uvs"))
    triangle = hits["primitive_ids"].numpy().view(np.int32)
    to_sun, facing = np.empty_like(rays), np.empty(len(rays), dtype=bool)
    textures.sun_rays(to_sun, facing, rays, distance, normals, triangle, _sun_disc(samples))
    lit = np.zeros(len(rays), dtype=bool)
    chosen = np.flatnonzero(facing)
    shaded = world.scene.test_occlusions(o3d.core.Tensor.from_numpy(to_sun[chosen]), nthreads=threads())
    lit[chosen] = ~shaded.numpy()
    light = np.empty((height, width, 3))
    textures.shade(
        light, rays, distance, normals, triangle, uv, lit, world.materials, world.owners, world.triangles,
        open_sky, world.frames, SUN, pixel_angle, haze,
    )  # fmt: skip
    owners = np.where(triangle >= 0, world.owners[np.maximum(triangle, 0)], -1)
    return light, owners.reshape(height, width, samples), distance.reshape(height, width, samples)


def _sun_disc(samples: int) -> NDArray[np.float64]:
    """(samples, 3) directions spread over the sun's disc, half a degree wide in radius for a soft edge."""
    x = np.cross(SUN, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    angle = 2.4 * np.arange(samples)[:, None]
    radius = np.radians(0.5) * np.sqrt((np.arange(samples)[:, None] + 0.5) / samples)
    directions = SUN + radius * (np.cos(angle) * x + np.sin(angle) * np.cross(SUN, x))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _exif(cameras: Cameras, photo: int, gps: NDArray[np.float64] | None) -> Image.Exif:
    """Maker, model, focal length as a 35 mm equivalent, time, and the position where it is known."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "scenefuse", f"demo camera {cameras.width}x{cameras.height}"
    stamp = f"2024:06:01 {9 + photo // 1800:02d}:{photo // 30 % 60:02d}:{photo % 30 * 2:02d}"
    exif[0x0132] = stamp
    details = exif.get_ifd(0x8769)
    details[0x9003] = stamp
    # The 35 mm film's diagonal is 43.27 mm, and the focal length that gives the same diagonal angle of view is meant.
    details[0xA405] = round(float(cameras.intrinsics[0, 0]) * 43.267 / float(np.hypot(cameras.width, cameras.height)))
    if gps is not None:
        latitude, longitude, altitude = (float(v) for v in gps)
        position = exif.get_ifd(0x8825)
        position[0] = b"\x02\x03\x00\x00"
        position[1], position[2] = "N" if latitude >= 0 else "S", _sexagesimal(latitude)
        position[3], position[4] = "E" if longitude >= 0 else "W", _sexagesimal(longitude)
        position[5], position[6] = b"\x00" if altitude >= 0 else b"\x01", Fraction(round(abs(altitude) * 1000), 1000)
    return exif


def _sexagesimal(angle_deg: float) -> tuple[Fraction, Fraction, Fraction]:
    """Degrees, minutes and seconds, to a ten-thousandth of a second: 3 mm on the ground."""
    ticks = round(abs(angle_deg) * 3600 * 10_000)
    degrees, rest = divmod(ticks, 3600 * 10_000)
    minutes, seconds = divmod(rest, 60 * 10_000)
    return Fraction(degrees, 1), Fraction(minutes, 1), Fraction(seconds, 10_000)
