"""The demo's camera bodies, and what each makes of the light that reaches it: blur, vignetting, exposure, noise, tone.

Lens distortion and principal point are geometry: the renderer casts its rays through them
(`demo.truth`).
All that is done here happens in linear light, before the tone curve and the rounding to 8 bits.
"""

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from demo import textures
from demo.truth import Cameras
from scenefuse.core.stage import quantity
from scenefuse.core.transforms import Array

Kind = Literal["real", "ideal"]


@dataclass(frozen=True)
class Body:
    """A camera model, as its maker sells it; the default is ideal.

    Attributes:
        shift: how far the principal point lies off the middle, as shares of width and height.
        distortion: k1, k2, p1, p2 of Brown (1971), as in OpenCV and in COLMAP's OPENCV camera.
        corner: share of the light that the lens passes to the photo's farthest corner.
        gains: mean gains of red, green and blue: exposure and white balance.
        exposure_sd: spread of a photo's exposure, of its logarithm.
        balance_sd: the same of red and of blue against green.
        shot: variance of the noise, over the light.
        read: standard deviation of the noise without light.
        blurred: share of photos that are a little out of focus and shaken.
        defocus_px: range of their defocus, the standard deviation of a Gaussian.
        max_motion_px: longest path of the picture during their exposure.
        haze: how white the sky is above its photos; 0 is blue.
        quality: of its JPEG files.
        subsampling: of their colours, Pillow's number: 0 is 4:4:4, 2 is 4:2:0.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    corner: float = 1.0
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure_sd: float = 0.0
    balance_sd: float = 0.0
    shot: float = 0.0
    read: float = 0.0
    blurred: float = 0.0
    defocus_px: tuple[float, float] = (0.3, 0.8)
    max_motion_px: float = 2.5
    haze: float = 0.0
    quality: int = 95
    subsampling: int = 0


IDEAL = Body()
# Barrel distortion of a wide drone lens: 17 px inwards in the corners of a photo of 800 x 600.
DRONE = Body(
    shift=(0.010, -0.008),
    distortion=(-0.08, 0.03, 0.0008, -0.0006),
    corner=0.75,
    gains=(0.91, 0.94, 0.98),
    exposure_sd=0.08,
    balance_sd=0.03,
    shot=2e-4,
    read=1.2e-3,
    haze=0.85,
)
# A phone's lens bends outwards halfway to the corner and back again: 3 px in a photo of 640 x 480.
PHONE = Body(
    shift=(-0.011, 0.009),
    distortion=(0.07, -0.09, -0.001, 0.0014),
    corner=0.8,
    gains=(1.1, 1.06, 1.0),
    exposure_sd=0.08,
    balance_sd=0.03,
    shot=2e-4,
    read=1.2e-3,
    blurred=0.25,
    haze=0.85,
    quality=88,
    subsampling=2,
)
FLIGHT: dict[Kind, Body] = {"real": DRONE, "ideal": IDEAL}
ORBIT: dict[Kind, Body] = {"real": PHONE, "ideal": IDEAL}


@dataclass(frozen=True)
class Exposure:
    """What differs from photo to photo of one body.

    Attributes:
        gains: (3,) of red, green and blue.
        defocus_px: standard deviation of a Gaussian blur, pixels; 0 is sharp.
        motion_px: (2,) path of the picture during the exposure, x and y in pixels.
    """

    gains: Array
    defocus_px: float
    motion_px: Array

    def as_json(self) -> dict[str, Any]:
        """For the truth file of a capture."""
        return {
            "gains": quantity(self.gains, "1"),
            "defocus": quantity(self.defocus_px, "px"),
            "motion": quantity(self.motion_px, "px"),
        }


def draw_exposure(body: Body, rng: np.random.Generator) -> Exposure:
    """One photo's exposure, white balance and blur."""
    spread = body.exposure_sd * rng.normal() + body.balance_sd * rng.normal(size=3) * [1, 0, 1]
    blurred, angle = rng.random() < body.blurred, rng.uniform(0, np.pi)
    defocus, path = (
        rng.uniform(*body.defocus_px),
        rng.uniform(0, body.max_motion_px) * np.array([np.cos(angle), np.sin(angle)]),
    )
    return Exposure(np.array(body.gains) * np.exp(spread), defocus * blurred, path * blurred)


def expose(
    light: Array, body: Body, exposure: Exposure, cameras: Cameras, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The photo that a body makes of the light that reaches its lens.

    Args:
        light: (H, W, 3) linear red, green and blue.
        body: the camera model.
        exposure: of this photo.
        cameras: whose principal point is the middle of the vignetting.
        rng: of the noise: Gaussian, its variance `shot` times the light and `read` squared.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    if exposure.defocus_px > 0:
        light = np.asarray(
            cv2.filter2D(light, -1, blur_kernel(exposure), borderType=cv2.BORDER_REPLICATE), dtype=np.float64
        )
    light = light * vignetting(cameras, body.corner)[..., None] * exposure.gains
    light += np.sqrt(body.shot * light + body.read**2) * rng.standard_normal(light.shape, dtype=np.float32)
    picture = np.empty(light.shape, dtype=np.uint8)
    textures.encode(picture, np.maximum(light, 0.0))
    return picture


def vignetting(cameras: Cameras, corner: float) -> Array:
    """(H, W) share of the light that arrives: falls with the squared distance from the principal point to `corner`."""
    middle = cameras.intrinsics[:2, 2]
    x, y = np.arange(cameras.width) + 0.5 - middle[0], np.arange(cameras.height) + 0.5 - middle[1]
    farthest = np.square(np.maximum(middle, [cameras.width, cameras.height] - middle)).sum()
    return 1.0 - (1.0 - corner) * (y[:, None] ** 2 + x**2) / farthest


def blur_kernel(exposure: Exposure) -> Array:
    """(K, K) weights that sum to 1: a Gaussian moved along the path of the picture, K odd."""
    radius = int(np.ceil(np.abs(exposure.motion_px).max() / 2 + 3 * exposure.defocus_px))
    at = np.arange(-radius, radius + 1)
    path = ((np.arange(16) + 0.5) / 16 - 0.5)[:, None] * exposure.motion_px
    weights = np.exp(-0.5 * ((at - path[:, :, None]) / exposure.defocus_px) ** 2)
    x, y = np.moveaxis(weights / weights.sum(-1, keepdims=True), 1, 0)
    return (y[:, :, None] * x[:, None, :]).mean(0)
