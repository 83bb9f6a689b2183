"""Masks by SAM 2 (Ravi et al. 2024): hiera-tiny, run by ONNX Runtime from weights whose hashes are checked."""

from collections import OrderedDict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, sha256
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask, mask_iou
from scenefuse.marks.photo_clicks import SUFFICIENT_CLICKS, PhotoClicks
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.prompts import BOX_GROWTH_SHARE, NO_PIXELS, Prompts, far_apart
from scenefuse.masks.sam2_weights import DECODER, DECODER_SHA256, ENCODER, ENCODER_SHA256, why_unavailable
from scenefuse.masks.target import Target
from scenefuse.photos.workspace import View

# Side of the square image that the network takes; the masks that it gives and takes have a quarter of it.
SIDE_PX = 1024
# Known points that prompt a photo at most: far apart, they say as much as hundreds.
MAX_POINTS_INSIDE, MAX_POINTS_OUTSIDE = 10, 6
# Points in the middle of the object that prompt it as well, with the box around all: by points on all its ends and off
# it, the network is sure of nothing.
MIDDLE_POINTS = 4
# Points off the object prompt only this near the box around those on it, as a share of its longer side.
MAX_OUTSIDE_DISTANCE_SHARE = 0.3


class Sam2:
    """The network, loaded onto the CPU (or CUDA, where ONNX Runtime has it): an encoder of photos and a decoder of
    prompts.

    Attributes:
        kept: photos whose features are kept, the last ones; 17 MB each.
    """

    def __init__(self, encoder: Path, decoder: Path, threads: int) -> None:
        """Load both networks, and keep one photo's features."""
        self.kept = 1
        self._features = OrderedDict[int, tuple[NDArray[np.uint8], dict[str, NDArray[np.float32]]]]()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        providers = [
            p for p in ("CUDAExecutionProvider", "CPUExecutionProvider") if p in onnxruntime.get_available_providers()
        ]
        self._encoder = onnxruntime.InferenceSession(str(encoder), options, providers=providers)
        self._decoder = onnxruntime.InferenceSession(str(decoder), options, providers=providers)

    def encode(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
        """Features of a (H, W, 3) uint8 RGB photo, for any number of prompts; kept ones where it is the same array."""
        if id(image) not in self._features:
            names = [o.name for o in self._encoder.get_outputs()]
            found = self._encoder.run(None, {self._encoder.get_inputs()[0].name: _blob(image)})
            # The array is kept, too: another one would get its identity.
            self._features[id(image)] = image, dict(zip(names, found))
            while len(self._features) > self.kept:
                self._features.popitem(last=False)
        return self._features[id(image)][1]

    def masks(
        self,
        features: dict[str, NDArray[np.float32]],
        size: tuple[int, int],
        points_px: Array,
        box: Array | None,
        outside_px: Array = NO_PIXELS,
    ) -> tuple[list[Mask], Array]:
        """Three masks (H, W), a part, a larger part and the whole, and how good the network thinks they are, (3,).

        Args:
            features: of the photo.
            size: its (height, width).
            points_px: (P, 2) pixels on the object.
            box: (2, 2) corners of a box around it, upper left first.
            outside_px: (Q, 2) pixels not on it.
        """
        points, labels = _prompts(size, points_px, box, outside_px)
        inputs = features | {
            "point_coords": points[None],
            "point_labels": labels[None],
            "mask_input": np.zeros((1, 1, SIDE_PX // 4, SIDE_PX // 4), dtype=np.float32),
            "has_mask_input": np.zeros(1, dtype=np.float32),
        }
        wanted = {i.name for i in self._decoder.get_inputs()}
        outputs = self._decoder.run(None, {k: v for k, v in inputs.items() if k in wanted})
        logits, quality = next(o for o in outputs if o.ndim == 4)[0], next(o for o in outputs if o.ndim == 2)[0]
        return _enlarged(logits, size), quality.astype(np.float64)


def _blob(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """An RGB photo as the (1, 3, 1024, 1024) input of the encoder."""
    small = cv2.resize(image, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    normalised = (small / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    return np.ascontiguousarray(normalised.transpose(2, 0, 1)[None], dtype=np.float32)


def _prompts(
    size: tuple[int, int], points_px: Array, box: Array | None, outside_px: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels in the network's own, and their labels: 1 on the object, 0 off it, the box's corners 2 and 3.

    Where there is no box, a point labelled -1 stands for it, as the network was trained.
    """
    height, width = size
    corners, names = (np.zeros((1, 2)), [-1.0]) if box is None else (box, [2.0, 3.0])
    points = np.concatenate([points_px, outside_px, corners]) * [SIDE_PX / width, SIDE_PX / height]
    labels = [1.0] * len(points_px) + [0.0] * len(outside_px) + names
    return points.astype(np.float32), np.array(labels, dtype=np.float32)


def _enlarged(logits: NDArray[np.float32], size: tuple[int, int]) -> list[Mask]:
    """The network's (3, 256, 256) answers at the photo's size."""
    height, width = size
    return [cv2.resize(m.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0 for m in logits]


def segment(network: Sam2, target: Target, view: View) -> Mask:
    """The object in one photo, prompted by all exact points, as this photo sees them, and the box around all.

    A point that the photo does not see is hidden by the object itself, so its pixel is the object's all the same. Where
    the photo shows no exact point, all prompt.

    Args:
        network: SAM 2.
        target: points that span the object.
        view: the photo, with RGB pixels.

    Returns:
        (H, W), of the network's masks the one with most points in it and the best quality; empty where no point is in
        the photo.
    """
    size = (view.height, view.width)
    pixels, depth = view.project(target.spanning)
    front = depth > 0
    inside = front & (pixels >= 0).all(1) & (pixels < size[::-1]).all(1)
    if not inside.any():
        return np.zeros(size, dtype=bool)
    exact = inside.copy()
    exact[target.inexact] = False
    on = pixels[exact if exact.any() else inside]
    found, quality = network.masks(network.encode(view.pixels), size, on, _box(pixels[front], size))
    u, v = on.astype(int).T
    return cleaned(found[int(np.argmax([m[v, u].mean() * q for m, q in zip(found, quality)]))], view.pixels)


def segment_like(network: Sam2, target: Target, view: View, outline: Mask, clicks: PhotoClicks) -> Mask:
    """The object in one photo once more, prompted by what other photos say: the box of their outline of it, and a few
    of its points in the middle of that. The network does not see the outline: it would only give it back.

    Args:
        network: SAM 2.
        target: the object's points.
        view: the photo, with RGB pixels.
        outline: (H, W) the visual hull of the other photos' masks, not empty.
        clicks: made in this photo; they prompt it too.

    Returns:
        (H, W), of the network's masks the one most like the outline.
    """
    size, pixels = (view.height, view.width), view.visible(target.sparse[target.kind > 0])[1]
    own = pixels[outline[pixels[:, 1], pixels[:, 0]]].astype(np.float64) + 0.5
    on = np.concatenate([clicks.on, _middle(own)]) if len(own) else clicks.on
    box = _box(np.argwhere(outline)[:, ::-1] + 0.5, size) if clicks.box is None else clicks.box
    found, _ = network.masks(network.encode(view.pixels), size, on, box, clicks.off)
    return cleaned(max(found, key=lambda mask: mask_iou(mask, outline)), view.pixels)


def _box(pixels: NDArray[Any], size: tuple[int, int]) -> Array:
    """(2, 2) corners of a box around (N, 2) pixels of a photo of (height, width), upper left first: points seldom mark
    the ends."""
    low, high = pixels.min(0), pixels.max(0)
    grow = BOX_GROWTH_SHARE * (high - low).max()
    return np.clip(np.stack([low - grow, high + grow]), 0, size[::-1])


def query_sam2(network: Sam2, view: View, prompts: Prompts, box: Array | None) -> tuple[list[Mask], Array]:
    """SAM 2's masks (H, W) of a photo and its own estimate of their IoU: three from pixels all over the object, and
    where there are many of these, three from a few in its middle and the box around all.

    Args:
        network: SAM 2.
        view: the photo, with RGB pixels.
        prompts: all clicks prompt it, and a few of the known points, far apart; of those off the object the near ones.
        box: (2, 2) corners of a box around it, upper left first, or None. Beside enough clicks it is not used: it says
            nothing that they do not, and where it is wrong the mask is.
    """
    features, size = network.encode(view.pixels), (view.height, view.width)
    box = None if len(prompts.clicked) >= SUFFICIENT_CLICKS else box
    inside = prompts.inside
    around = inside if box is None else box
    low, high = around.min(0), around.max(0)
    side = float((high - low).max())
    reach = MAX_OUTSIDE_DISTANCE_SHARE * side
    known_off = prompts.known_off
    near = known_off[((known_off > low - reach) & (known_off < high + reach)).all(1)]
    off = far_apart(prompts.clicked_off, near if len(near) else known_off, MAX_POINTS_OUTSIDE)
    on = far_apart(prompts.clicked, prompts.known, MAX_POINTS_INSIDE)
    masks, quality = network.masks(features, size, on, box, off)
    if len(inside) > MAX_POINTS_INSIDE:
        grow = BOX_GROWTH_SHARE * side
        grown = np.clip(np.stack([low - grow, high + grow]), 0, size[::-1]) if box is None else box
        more, their_quality = network.masks(features, size, _middle(inside), grown)
        masks, quality = [*masks, *more], np.concatenate([quality, their_quality])
    return masks, quality


def _middle(pixels: Array) -> Array:
    """A few of (N, 2) pixels: the middle one, and of the half nearest to it those far apart."""
    order = np.argsort(np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1), kind="stable")
    return far_apart(pixels[order[:1]], pixels[order[: (len(order) + 1) // 2]], MIDDLE_POINTS)


def load_network(threads: int) -> Sam2:
    """SAM 2 from the weights that a rule fetches.

    Raises:
        StageError: they are missing, or others.
    """
    check_weights(Path(ENCODER), ENCODER_SHA256)
    check_weights(Path(DECODER), DECODER_SHA256)
    return Sam2(Path(ENCODER), Path(DECODER), threads)


def check_weights(path: Path, expected_sha256: str) -> None:
    """StageError where a file of weights is missing or another one."""
    if not path.is_file():
        why = why_unavailable()
        advice = f"delete {path.parent} and run again" if why else "have rule fetch_sam2_weights fetch them"
        raise StageError(
            f"the SAM 2 weights {path} do not exist{why and f' ({why})'}; {advice}, or set object.masks.method: grabcut"
        )
    found = sha256(path)
    if found != expected_sha256:
        raise StageError(
            f"the SAM 2 weights {path} have SHA-256 {found[:16]}..., expected {expected_sha256[:16]}...; "
            f"delete {path.parent} and run again to fetch them"
        )
