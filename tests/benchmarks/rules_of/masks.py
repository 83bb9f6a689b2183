"""The rules of masks from clicks, on captures with cameras: IoU with true masks, and masks kept.

A trial is a capture, a row of results/bench/mask_captures.tsv: `name`, `folder` of the object's results, `prompts`,
`truth` (a folder of masks, may be empty), `every` (1 for all photos, 2 for every second, ...) and `method`. SAM 2's
features (17 MB a photo) and answers are kept in results/bench/sam2: what was queried before takes no time.
"""

import hashlib
import zlib
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from rules import Rule

from scenefuse.core.stage import StageError, read_json, value
from scenefuse.geometry.visual_hull import Mask, mask_iou
from scenefuse.marks.clicks import Clicks, read_points
from scenefuse.masks.make_masks import supplied_masks
from scenefuse.masks.prompts import NO_PIXELS
from scenefuse.masks.sam2 import Sam2
from scenefuse.masks.sam2_weights import DECODER, ENCODER
from scenefuse.masks.segmentation import MaskSettings, masks_from_prompts, score_masks
from scenefuse.photos.frames import original_sizes
from scenefuse.photos.workspace import Workspace, read_workspace

CAPTURES, CACHE = Path("results/bench/mask_captures.tsv"), Path("results/bench/sam2")
TRIALS = len(CAPTURES.read_text().splitlines()) - 1 if CAPTURES.is_file() else 0
# Photos are this large at most: the network sees 1024 pixels, its masks have 256.
SIDE_PX = 700


class Cached:
    """SAM 2 with its features and answers on disk."""

    def __init__(self) -> None:
        """Nothing is loaded before it is needed."""
        self._last: tuple[str, Any] = ("", None)

    @cached_property
    def _network(self) -> Sam2:
        return Sam2(Path(ENCODER), Path(DECODER), 1)

    def encode(self, image: Any) -> tuple[str, Any]:
        """The photo and its key; it is encoded when a prompt has no answer yet."""
        return hashlib.sha1(np.ascontiguousarray(image).tobytes()).hexdigest()[:16], image

    def masks(
        self, features: tuple[str, Any], size: tuple[int, int], points: Any, box: Any, outside: Any = NO_PIXELS
    ) -> tuple[list[Mask], Any]:
        """See Sam2."""
        given = (points, NO_PIXELS if box is None else box, outside)
        prompts = [np.round(np.asarray(a, dtype=float), 3) for a in given]
        key = hashlib.sha1(repr((features[0], size, [a.tolist() for a in prompts])).encode()).hexdigest()[:20]
        file = CACHE / "answers" / key[:2] / key
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            masks, quality = self._network.masks(self._features(features), size, points, box, outside)
            bits = np.packbits(np.array(masks)).tobytes()
            file.write_bytes(quality.astype(np.float64).tobytes() + zlib.compress(bits, 1))
        content = file.read_bytes()
        flat = np.unpackbits(np.frombuffer(zlib.decompress(content[24:]), dtype=np.uint8), count=3 * size[0] * size[1])
        return list(flat.reshape(3, *size).astype(bool)), np.frombuffer(content[:24])

    def _features(self, photo: tuple[str, Any]) -> Any:
        if self._last[0] != photo[0]:
            file = CACHE / f"{photo[0]}.npz"
            if not file.is_file():
                features: dict[str, Any] = self._network.encode(photo[1])
                np.savez(file, **features)
            with np.load(file) as content:
                self._last = photo[0], {name: content[name] for name in content.files}
        return self._last[1]


@dataclass(frozen=True)
class Capture:
    """Photos with cameras, clicks, and the true masks where there are some."""

    name: str
    photos: Workspace
    folder: Path
    marked: Any
    up: Any
    sizes: dict[str, tuple[int, int]]
    truth: dict[str, Mask]
    method: Any


@cache
def capture_of(number: int) -> Capture:
    """A capture with every n-th of its photos, those with clicks among them."""
    row = pd.read_csv(CAPTURES, sep="\t", keep_default_na=False).iloc[number]
    folder, marked = Path(row.folder), read_points(Path(row.prompts))
    if not isinstance(marked, Clicks):
        raise StageError(f"{row.prompts} has points in the object's frame, and no clicks in photos")
    whole = read_workspace(folder / "undistorted")
    stems = {Path(photo).stem for photo in marked.photos}
    clicked = [k for k, view in enumerate(whole.views) if Path(view.name).stem in stems]
    some = whole.subset(sorted({*range(clicked[0] % row.every, len(whole.views), row.every), *clicked}))
    views = [some.rgb(view).at_most(SIDE_PX) for view in some.views]
    scales = [[small.width / view.width, small.height / view.height] for small, view in zip(views, some.views)]
    photos = replace(some, views=views, seen_at=[at * scale for at, scale in zip(some.seen_at, scales)])
    truth = supplied_masks(Path(row.truth), folder / "sparse", views)[0] if row.truth else {}
    up = np.array(value(read_json(folder / "undistorted.json"), "up_in_camera_frame"))
    sizes = original_sizes(read_json(folder / "photos.json"))
    return Capture(row["name"], photos, folder, marked, up, sizes, truth, row.method)


def evaluate(number: int, rule: Rule | None) -> dict[str, Any]:
    """Masks of one capture."""
    cv2.setNumThreads(1)
    capture = capture_of(number)
    settings = MaskSettings(method=capture.method)
    network: Any = Cached() if capture.method == "sam2" else None
    row: dict[str, Any] = {"kind": capture.name, "photos": len(capture.photos.views), "kept": 0}
    row |= {"iou": np.nan, "least iou": np.nan, "reason": ""}
    try:
        found = masks_from_prompts(
            capture.marked, capture.folder / "sparse", capture.sizes, capture.photos, capture.up, network, settings, 0
        )
        scored = score_masks(found.masks, found.target, capture.photos.views, settings, found.clicked)
    except StageError as error:
        return row | {"reason": str(error)}
    kept = {name: mask for name, mask in scored.masks.items() if name not in scored.dropped}
    row["kept"] = len(kept)
    against = [mask_iou(mask, capture.truth[name]) for name, mask in kept.items() if name in capture.truth]
    return row | ({"iou": float(np.mean(against)), "least iou": min(against)} if against else {})


def _never(_: Any) -> float:
    return 1e9


def _mask_as_it_is(position: int) -> Any:
    return lambda _: lambda *given, **__: given[position]


M = "scenefuse.masks"
RULES = [
    Rule("no votes next to the outline", f"{M}.votes.POINT_RADIUS_SHARE", lambda _: 0.0),
    Rule("enclosed points are unknown", f"{M}.votes.MIN_OWN_POINTS", _never),
    Rule("a click outside counts in all photos", f"{M}.votes._denied", lambda _: lambda *__: []),
    Rule("points by stereo", f"{M}.segmentation.with_stereo_points", lambda _: lambda photos: photos),
    Rule("four prompts in the middle", f"{M}.sam2.MIDDLE_POINTS", lambda _: 1),
    Rule("prompts outside near only", f"{M}.sam2.MAX_OUTSIDE_DISTANCE_SHARE", _never),
    Rule("the largest of several clicks' masks", f"{M}.propagation.SCORE_MARGIN", lambda _: 1e-9),
    Rule("clicked parts prompt alone", f"{M}.propagation._with_clicked_parts", _mask_as_it_is(2)),
    Rule("parts of a mask that nothing prompts", f"{M}.propagation.prompted_parts", _mask_as_it_is(0)),
    Rule("contradicted masks once more", f"{M}.propagation.agrees_with_others", lambda _: lambda *__: True),
    Rule("SAM 2 again by the hull", f"{M}.segmentation.MIN_SHARE_OF_MEDIAN", lambda _: 0.0),
    Rule("outlines move to edges", f"{M}.segmentation.along_edges", _mask_as_it_is(1)),
    Rule("gaps by their colours", f"{M}.grabcut.PINHOLE_SHARE", _never),
    Rule("masks compared by a tolerant hull, too", f"{M}.segmentation.MAX_LACKING_SHARE", lambda _: 0.1),
    Rule("seeds grow along even colours", f"{M}.grabcut.grow_seeds", lambda _: lambda *__: None),
    Rule("close prompts enclose a part", f"{M}.target._parts", lambda _: lambda *__: np.empty((0, 4), np.intp)),
    Rule("clicked specks stay", f"{M}.grabcut.prompted_parts", lambda _: lambda mask, *__: mask & False),
    Rule("clicks on a point may miss by 5 %", f"{M}.segmentation.BOX_GROWTH_SHARE", lambda _: 0.0),
]
