"""Pictures of point clouds without OpenGL: discs splatted into a z-buffer, blended and shaded, on any headless machine.

Every point is a disc whose radius follows the local spacing, so that a sampled surface closes and a hole stays a hole;
it lies in the surface where the cloud has normals and faces the camera where it has none. A first pass keeps the
nearest depth of each pixel, a second blends the discs that lie on that surface (surface splatting: Zwicker et al. 2001,
Botsch et al. 2005). Shading is eye-dome lighting on the depth buffer (Boucheny 2009) and a head light on the normals.
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import threads
from scenefuse.core.transforms import look_at

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

# Points of a scene that are drawn or shown; of a larger scene every n-th, so that there are no more.
MAX_DRAWN = 2_000_000
# Samples along each side of a pixel.
SUPERSAMPLING = 2
# Smallest cosine between a disc's normal and the ray: its width over its length. Normals are not exact.
MIN_COSINE = 0.65
# Largest disc over those of its neighbours: closes a surface of random points, and keeps a stray point small.
MAX_RADIUS_RATIO = 1.4
# Power of the blending weight's fall: with more, single points show; with less, fine texture blurs.
BLENDING_POWER = 3


@dataclass(frozen=True)
class Camera:
    """A pinhole or orthographic camera; axes as OpenCV: x right, y down, z forward.

    Attributes:
        cam_from_world: (3, 3) rotation.
        centre: (3,) position in the cloud's frame.
        focal_px: focal length in pixels; for an orthographic camera pixels per unit of the cloud.
        width_px: columns of the image.
        height_px: rows of the image.
        orthographic: parallel projection along z.
    """

    cam_from_world: Array
    centre: Array
    focal_px: float
    width_px: int
    height_px: int
    orthographic: bool = False

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (N, 2), pixel centres at +0.5, and depths (N,) of points (N, 3); depth <= 0 lies behind the camera."""
        x_in_cam = (np.asarray(points, dtype=np.float64) - self.centre) @ self.cam_from_world.T
        depth = x_in_cam[:, 2]
        divisor = 1.0 if self.orthographic else np.where(depth > 0, depth, np.inf)[:, None]
        middle = np.array([self.width_px, self.height_px]) / 2.0
        return self.focal_px * x_in_cam[:, :2] / divisor + middle, depth


def orbit_camera(
    framed: Array,
    azimuth_deg: float,
    elevation_deg: float,
    size_px: tuple[int, int],
    orthographic: bool = False,
    margin: float = 0.06,
) -> Camera:
    """A camera that looks at the middle of some points from a direction around the z axis and just fits them.

    Args:
        framed: (N, 3) points that have to be inside the image, for instance the corners of a box.
        azimuth_deg: direction from the middle to the camera, counter-clockwise from x.
        elevation_deg: angle above the horizontal; negative looks from below.
        size_px: width and height of the image.
        orthographic: parallel instead of perspective projection.
        margin: free border as a share of the image.
    """
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    direction = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    up = np.array([0.0, 0.0, 1.0]) if abs(elevation_deg) < 89 else np.array([0.0, 1.0, 0.0])
    middle = (framed.min(0) + framed.max(0)) / 2.0
    rotation = look_at(middle + direction, middle, up)
    in_cam = (framed - middle) @ rotation.T
    # Centre the image on what is seen, not on the box.
    shift = np.array([*(in_cam[:, :2].min(0) + in_cam[:, :2].max(0)) / 2.0, 0.0])
    middle, in_cam = middle + shift @ rotation, in_cam - shift
    half = np.array(size_px) / 2.0 * (1.0 - 2.0 * margin)
    if orthographic:
        extent = np.maximum(np.abs(in_cam[:, :2]).max(0), 1e-9)
        distance = 2.0 * float(np.linalg.norm(np.ptp(framed, axis=0)))
        return Camera(rotation, middle + distance * direction, float((half / extent).min()), *size_px, True)
    # The shorter side sees 30 degrees.
    focal = min(size_px) / 2.0 / np.tan(np.radians(15.0))
    # The distance at which the outermost point touches the image's border.
    distance = float((np.abs(in_cam[:, :2] * focal / half).max(1) - in_cam[:, 2]).max())
    return Camera(rotation, middle + distance * direction, float(focal), *size_px)


def camera_at(place: Array, framed: Array, size_px: tuple[int, int], margin: float = 0.06) -> Camera:
    """A camera at a place (3,) that looks at the middle of some points (N, 3) and just fits those before it."""
    rotation = look_at(place, (framed.min(0) + framed.max(0)) / 2.0, np.array([0.0, 0.0, 1.0]))
    x, y, depth = np.abs((framed - place) @ rotation.T).T
    reach = np.max([x / size_px[0], y / size_px[1]], axis=0) / np.maximum(depth, 0.1 * depth.max())
    return Camera(rotation, place, float((0.5 - margin) / max(reach.max(), 1e-9)), *size_px)


def point_radii(
    points: Array,
    factor: float = 0.9,
    limit: float = 3.0,
    source: NDArray[np.uint8] | None = None,
) -> NDArray[np.float32]:
    """Disc radii (N,) in the cloud's unit: `factor` x the spacing around a point, at most `limit` x its median.

    The median is that of all points of the same source (N,), where this is given: dense points that come into a sparse
    cloud do not make its discs smaller.

    The spacing is the distance to the k-th neighbour, but not more than that of the neighbours themselves: a stray
    point off a dense surface is as small as the surface's points, and a sparse surface beside a dense one still closes.
    """
    neighbours = 4
    if len(points) <= neighbours:
        return np.full(len(points), max(float(np.ptp(points, axis=0).max()) * 0.01, 1e-9) if len(points) else 0.0, "f4")
    most = min(2 * neighbours, len(points) - 1)
    distance, nearest = cKDTree(points).query(points, k=most + 1, workers=threads())
    reach = distance[:, neighbours]
    around = np.median(reach[nearest[:, 1:]], axis=1)
    middle = np.empty(len(points))
    of = np.zeros(len(points), np.uint8) if source is None else source
    for one in np.unique(of):
        middle[of == one] = float(np.median(reach[of == one])) or 1e-9
    # Points that coincide still get a disc.
    spacing = np.clip(reach, around / 2, MAX_RADIUS_RATIO * around)
    return (factor * np.clip(spacing, middle / 20, middle * limit)).astype(np.float32)


def luminance(colors: ArrayLike) -> Array:
    """(N,) brightness 0 to 255 of colours (N, 3), by ITU-R BT.601."""
    return np.asarray(colors) @ np.array([0.299, 0.587, 0.114])


def brightened(*clouds: Cloud) -> list[Cloud]:
    """Clouds with lighter colours where all are dark, as at dusk or in shade.

    One factor makes their median a middle grey, but saturates no more than one point in a hundred.
    """
    known = np.concatenate([np.full((1, 3), 255), *(c.colors for c in clouds if c.colors is not None)])
    median, high = np.median(luminance(known)), np.percentile(known.max(1), 99)
    factor = max(1.0, min(128 / max(median, 1), 255 / max(high, 1)))
    colors = [None if c.colors is None else np.minimum(c.colors * factor, 255).astype(np.uint8) for c in clouds]
    return [replace(cloud, colors=lighter) for cloud, lighter in zip(clouds, colors)]


def render(
    cloud: Cloud,
    camera: Camera,
    radii: ArrayLike,
    colors: ArrayLike | None = None,
    eye_dome: float = 0.8,
) -> Image:
    """Draw a cloud as (H, W, 3) uint8 RGB.

    Args:
        cloud: N points; by their normals, where there are any, they are lit, and grey from behind.
        camera: where from.
        radii: (N,) disc radii in the cloud's unit, or one number for all (`point_radii`).
        colors: (N, 3) uint8, or one RGB, instead of the cloud's own colours; grey where there are none.
        eye_dome: strength of the dark rims at depth steps, 0 for none.
    """
    fine = replace(
        camera,
        focal_px=camera.focal_px * SUPERSAMPLING,
        width_px=camera.width_px * SUPERSAMPLING,
        height_px=camera.height_px * SUPERSAMPLING,
    )
    chosen = next((given for given in (colors, cloud.colors) if given is not None), (165, 165, 165))
    facing = _facing(cloud, camera)
    own = np.broadcast_to(np.asarray(chosen, np.float32), (len(cloud), 3))
    # Backs are grey: no photo saw them, and in their own colours a facade would show mirrored.
    rgb = np.where(facing[:, None] < 0, np.float32(190), own) * _head_light(cloud, camera, facing)[:, None]
    pixels, depth = fine.project(cloud.points)
    slopes = _slopes(cloud, fine, pixels)
    radius = np.broadcast_to(np.asarray(radii, dtype=np.float32), (len(cloud),))
    near = max(1e-9, 1e-3 * float(np.median(depth))) if len(cloud) else 0.0
    scale = np.full(len(cloud), fine.focal_px) if camera.orthographic else fine.focal_px / np.maximum(depth, near)
    # Discs of more than a sixth of the image are points next to the lens: they would only hide the rest.
    radius_px = np.clip(radius * scale, 0.75, min(fine.width_px, fine.height_px) / 6.0).astype(np.float32)
    shown = depth > near
    picture, total, surface, size = _splat(
        pixels[shown].astype(np.float32),
        depth[shown].astype(np.float32),
        slopes[shown],
        radius_px[shown],
        np.ascontiguousarray(radius[shown]),
        rgb[shown].astype(np.float32),
        fine.width_px,
        fine.height_px,
    )
    picture /= np.maximum(total, np.float32(1e-30))[..., None]
    covered = np.isfinite(surface)
    if eye_dome > 0 and covered.any():
        low, high = np.percentile(surface[covered], [2, 98])
        step = np.float32(max(high - low, 1e-6) * 0.02)
        picture *= _eye_dome(surface, 1.2 * size, step, np.float32(eye_dome))[..., None]
    picture[~covered] = 255
    shape = (camera.height_px, SUPERSAMPLING, camera.width_px, SUPERSAMPLING, 3)
    return np.clip(picture.reshape(shape).mean((1, 3)) + 0.5, 0, 255).astype(np.uint8)


def _facing(cloud: Cloud, camera: Camera) -> NDArray[np.float32]:
    """(N,) 1 where a surface is seen from its front, -1 from behind; 1 without normals."""
    if cloud.normals is None:
        return np.ones(len(cloud), np.float32)
    toward = -camera.cam_from_world[2] if camera.orthographic else camera.centre - cloud.points
    return np.where((toward * cloud.normals).sum(-1) < 0, np.float32(-1), np.float32(1))


def _head_light(cloud: Cloud, camera: Camera, facing: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) factor: a lamp left above the camera."""
    if cloud.normals is None:
        return np.ones(len(cloud), dtype=np.float32)
    light = 0.35  # by how much a surface seen edge-on is darker
    rotation = camera.cam_from_world.astype(np.float32)
    lamp = rotation.T @ (np.array([-0.35, -0.5, -0.8], dtype=np.float32) / np.float32(1.006))
    cosine = np.clip(facing * (cloud.normals @ lamp), 0.0, 1.0)
    return (1.0 - light + light * cosine).astype(np.float32)


def _slopes(cloud: Cloud, camera: Camera, pixels: Array) -> NDArray[np.float32]:
    """(N, 2) growth of depth along x and y in the tangent planes, lengths in units; zeros without normals."""
    if cloud.normals is None:
        return np.zeros((len(cloud), 2), dtype=np.float32)
    normals = cloud.normals @ camera.cam_from_world.T.astype(np.float32)
    along = normals[:, 2]
    if not camera.orthographic:
        rays = (pixels - np.array([camera.width_px, camera.height_px]) / 2) / camera.focal_px
        along = along + (normals[:, :2] * rays).sum(1)
    along = np.where(along < 0, -1, 1) * np.maximum(np.abs(along), MIN_COSINE)
    return np.asarray(-normals[:, :2] / along[:, None], dtype=np.float32)


@njit(cache=True, nogil=True)
def _splat(pixels, depth, slopes, radius_px, radius, rgb, width, height):  # type: ignore[no-untyped-def]
    """Sums of weighted colours (H, W, 3) and weights, nearest depths (inf: empty) and radii of the nearest discs."""
    surface = np.full((height, width), np.inf, dtype=np.float32)
    size = np.zeros((height, width), dtype=np.float32)
    picture = np.zeros((height, width, 3), dtype=np.float32)
    total = np.zeros((height, width), dtype=np.float32)
    for blending in (False, True):
        for i in range(len(depth)):
            x, y, r = pixels[i, 0], pixels[i, 1], radius_px[i]
            for v in range(max(0, int(np.floor(y - r))), min(height, int(np.floor(y + r)) + 1)):
                for u in range(max(0, int(np.floor(x - r))), min(width, int(np.floor(x + r)) + 1)):
                    a, b = u + 0.5 - x, v + 0.5 - y
                    t = a * slopes[i, 0] + b * slopes[i, 1]
                    q = (a * a + b * b + t * t) / (r * r)
                    # Bent away from the camera towards the rim, so that the nearest disc wins in its own middle.
                    z = depth[i] + radius[i] * np.float32(t / r + 0.5 * q)
                    if q > 1.0:
                        continue
                    if not blending and z < surface[v, u]:
                        surface[v, u] = z
                        size[v, u] = radius[i]
                    if blending and depth[i] + radius[i] * np.float32(t / r - 1.5) <= surface[v, u]:
                        w = np.float32(1.02 - q) ** BLENDING_POWER
                        total[v, u] += w
                        for k in range(3):
                            picture[v, u, k] += w * rgb[i, k]
    return picture, total, surface, size


@njit(cache=True, nogil=True)
def _eye_dome(surface, dead, step, strength):  # type: ignore[no-untyped-def]
    """(H, W) factor that darkens a pixel whose neighbours are nearer (eye-dome lighting).

    Differences up to `dead` (H, W) are the relief of the discs themselves; from `dead + step` on the shade is full.
    """
    height, width = surface.shape
    shade = np.ones((height, width), dtype=np.float32)
    for v in range(height):
        for u in range(width):
            z = surface[v, u]
            if not np.isfinite(z):
                continue
            total = 0.0
            for ring in (2, 4):
                for dv in (-ring, 0, ring):
                    for du in (-ring, 0, ring):
                        a, b = v + dv, u + du
                        if 0 <= a < height and 0 <= b < width and np.isfinite(surface[a, b]):
                            total += min(max((z - surface[a, b] - dead[v, u]) / step, 0.0), 1.0)
            shade[v, u] = np.exp(-strength * total / 16.0 * 1.5)
    return shade
