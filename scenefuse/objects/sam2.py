"""Masks by SAM 2 (Ravi et al. 2024), hiera-tiny, run by ONNX Runtime from weight files whose hashes are checked."""

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from scenefuse.objects.hull import Mask
from scenefuse.stage import StageError, sha256

SIDE_PX = 1024
"""Side of the square image the network takes."""


class Sam2:
    """The two networks, loaded: an encoder of photos and a decoder of prompts."""

    def __init__(self, encoder: Path, decoder: Path, threads: int) -> None:
        """Load both networks onto the CPU (or CUDA, where ONNX Runtime has it)."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        providers = [
            p for p in ("CUDAExecutionProvider", "CPUExecutionProvider") if p in onnxruntime.get_available_providers()
        ]
        self._encoder = onnxruntime.InferenceSession(str(encoder), options, providers=providers)
        self._decoder = onnxruntime.InferenceSession(str(decoder), options, providers=providers)

    def mask(
        self,
        image: NDArray[np.uint8],
        box_px: NDArray[np.float64],
        points_px: NDArray[np.float64],
        labels: NDArray[np.int_],
    ) -> tuple[Mask, float]:
        """Mask (H, W) of what a box and points ask for, and the IoU that the network predicts for it.

        Args:
            image: (H, W, 3) uint8 BGR.
            box_px: (4,) left, top, right, bottom.
            points_px: (P, 2) pixels.
            labels: (P,) 1 on the object, 0 beside it.
        """
        height, width = image.shape[:2]
        rgb = cv2.cvtColor(cv2.resize(image, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
        normalised = (rgb / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        blob = np.ascontiguousarray(normalised.transpose(2, 0, 1)[None], dtype=np.float32)
        names = [o.name for o in self._encoder.get_outputs()]
        features = dict(zip(names, self._encoder.run(None, {self._encoder.get_inputs()[0].name: blob})))
        scale = np.array([SIDE_PX / width, SIDE_PX / height])
        prompts = np.concatenate([box_px.reshape(2, 2), points_px.reshape(-1, 2)]) * scale
        kinds = np.concatenate([[2, 3], labels])
        inputs = features | {
            "point_coords": prompts[None].astype(np.float32),
            "point_labels": kinds[None].astype(np.float32),
            "mask_input": np.zeros((1, 1, SIDE_PX // 4, SIDE_PX // 4), dtype=np.float32),
            "has_mask_input": np.zeros(1, dtype=np.float32),
        }
        wanted = {i.name for i in self._decoder.get_inputs()}
        outputs = self._decoder.run(None, {k: v for k, v in inputs.items() if k in wanted})
        by_name = {o.name: v for o, v in zip(self._decoder.get_outputs(), outputs)}
        logits = next(v for v in by_name.values() if v.ndim == 4)[0]
        quality = next(v for v in by_name.values() if v.ndim == 2)[0]
        best = int(np.argmax(quality))
        mask = cv2.resize(logits[best].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0
        return mask, float(quality[best])


def check_weights(path: Path | None, expected_sha256: str, what: str) -> Path:
    """The path of a weight file that is there and is the right one.

    Raises:
        StageError: no path, no such file, or another hash.
    """
    if path is None:
        raise StageError(
            f"masks by SAM 2 need its {what} weights; set their path in the config "
            "(see config/README.md), or use grabcut"
        )
    if not path.is_file():
        raise StageError(f"the SAM 2 {what} weights {path} do not exist; download them, or use grabcut")
    found = sha256(path)
    if found != expected_sha256:
        raise StageError(
            f"the SAM 2 {what} weights {path} have SHA-256 {found[:16]}..., expected {expected_sha256[:16]}...; "
            "download them again"
        )
    return path
