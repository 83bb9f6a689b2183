"""Masks by GrabCut (Rother et al. 2004): one cut, a photo from prompts, and all photos of an object: seeded by prompts
and sparse points, then cut again along the visual hull."""

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Hull, Mask, silhouette
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.prompts import (
    BOX_GROWTH_SHARE,
    OUTLINE_BAND_SHARE,
    POINT_RADIUS_SHARE,
    Prompts,
    distance_to,
    prompted_parts,
)
from scenefuse.masks.target import Target
from scenefuse.photos.workspace import Rows, View, Workspace

Trimap = NDArray[np.uint8]

# Bins of a histogram of colours along each axis of CIELAB.
COLOUR_BINS = 32
# Specks and holes smaller than this share of a mask change side; holes smaller than the second whatever is in them, as
# a network's are as coarse.
SPECK_SHARE, PINHOLE_SHARE = 0.02, 0.0005
# A hole is one if its colours are twice as frequent around the mask as on it: log 2, in nats.
GAP_EVIDENCE_NATS = 0.7
# Paths between pixels: the picture is smoothed by this, and a step costs as much as this change of Lab.
PATH_BLUR_PX, STEP_COST = 0.7, 0.15
# What is this much nearer to the certain object than to certain background, as a share of both paths, is certain too:
# on the balloon's photos 0.6 to 0.8 were alike.
MIN_GROWN_SHARE = 0.7
# Rounds of learning colours and cutting in the first cut; later ones start from a good mask and take one.
FIRST_ROUNDS = 4
# Seeds grow, and the colours of a mask are learnt, in photos at most this wide.
COARSE_WIDTH_PX = 320


def first_trimap(size: tuple[int, int], outline_px: NDArray[np.float64], spanning_px: NDArray[np.float64]) -> Trimap:
    """GrabCut labels of a photo before any mask is known, (H, W).

    Args:
        size: (height, width).
        outline_px: (N, 2) pixels; nothing outside their convex hull is object.
        spanning_px: (M, 2) projected points of the object, seen or hidden, before the camera; their convex hull is
            likely object.
    """
    trimap = np.full(size, cv2.GC_BGD, dtype=np.uint8)
    fill_hull(trimap, outline_px, cv2.GC_PR_BGD)
    likely = np.zeros(size, dtype=np.uint8)
    if len(spanning_px):
        fill_hull(likely, spanning_px, 1)
    trimap[(trimap == cv2.GC_PR_BGD) & (likely > 0)] = cv2.GC_PR_FGD
    return trimap


def evidence_of(image: NDArray[np.uint8], log_ratio: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) the log of object over background density for the colours of a (H, W, 3) RGB photo, by that of each cell
    of Lab (B, B, B)."""
    cells = _cells(image)
    return log_ratio[cells[..., 0], cells[..., 1], cells[..., 2]]


def learn_colours(images: list[NDArray[np.uint8]], own: list[Mask], others: list[Mask]) -> NDArray[np.float32]:
    """(B, B, B) log of the density of colours of the pixels that are surely object over that of those that are surely
    not, per cell of Lab, over all photos: one alone shows too little of either."""
    counts = np.zeros((2, COLOUR_BINS, COLOUR_BINS, COLOUR_BINS), dtype=np.float32)
    for image, *sides in zip(images, own, others):
        cells = _cells(image)
        for k, side in enumerate(sides):
            flat = np.ravel_multi_index(tuple(cells[side].T), counts.shape[1:])
            counts[k] += np.bincount(flat, minlength=COLOUR_BINS**3).reshape(counts.shape[1:])
    smooth = np.stack([ndimage.gaussian_filter(c / max(c.sum(), 1), 0.7) for c in counts])
    return np.log((smooth[0] + 2e-5) / (smooth[1] + 2e-5)).astype(np.float32)


def _cells(image: NDArray[np.uint8]) -> NDArray[np.intp]:
    """(H, W, 3) cell of each pixel of an RGB photo in Lab; a and b are stretched: photographs use little of them."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32)
    lab[..., 1:] = (lab[..., 1:] - 128) * 2 + 128
    return np.clip(lab * (COLOUR_BINS / 256), 0, COLOUR_BINS - 1).astype(np.intp)


def second_trimap(outline: Mask, mask: Mask, evidence: NDArray[np.float32], band_px: float) -> Trimap:
    """GrabCut labels from the hull's outline and the mask so far, (H, W).

    Certain is only what both and the colours agree on, away from the outline; beyond two bands outside it
    nothing is object, whatever the mask has there. Elsewhere the majority of the three decides.

    Args:
        outline: the hull as the photo sees it.
        mask: the photo's own mask.
        evidence: (H, W) log ratio of the colour's densities; where it is strong it overrules both.
        band_px: half width of the band along the outline that is never certain.
    """
    inner, outer = distance_to(~outline), distance_to(outline)
    # One pixel's colour is noise: its neighbours within half a band count too.
    colour = cv2.GaussianBlur(np.clip(evidence, -3, 3), (0, 0), band_px / 4)
    votes = colour + np.where(outline, 1, -1) + np.where(mask, 1, -1)
    trimap = np.where(votes > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[(inner > band_px) & mask & (colour > 0)] = cv2.GC_FGD
    trimap[(outer > band_px) & ~mask & (colour < 0) | (outer > 2 * band_px)] = cv2.GC_BGD
    return trimap


def grow_seeds(image: NDArray[np.uint8], trimap: Trimap, width_px: int) -> None:
    """Make certain, in place, what is joined with the certain object by even colours, and far from what is not object.

    The length of a path is what the colour changes along it, in Lab, and a little for every pixel (geodesic
    segmentation, Bai and Sapiro 2007). A part of the object that has the background's colours, and so no edge that
    GrabCut's colours see, has an edge around it all the same. Only the object grows: the background lies on all sides
    and is never the nearer one by chance.

    Args:
        image: (H, W, 3) uint8 RGB.
        trimap: (H, W) OpenCV's labels.
        width_px: paths run on an image at most this wide.
    """
    sides = [trimap == cv2.GC_FGD, trimap == cv2.GC_BGD]
    if not all(side.any() for side in sides):
        return
    height, width = trimap.shape
    scale = min(1.0, width_px / width)
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    lab = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB).astype(np.float32)
    graph = _steps(np.asarray(cv2.GaussianBlur(lab, (0, 0), PATH_BLUR_PX), dtype=np.float32))
    away = []
    for side in sides:
        # Areas: a disc of one pixel must not get lost.
        small = cv2.resize(side.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        paths = dijkstra(graph, directed=False, indices=np.flatnonzero(small), min_only=True) if small.any() else np.inf
        away.append(np.broadcast_to(paths, size[0] * size[1]).reshape(size[1], size[0]))
    with np.errstate(invalid="ignore"):
        share = cv2.resize((away[1] / (away[0] + away[1])).astype(np.float32), (width, height))
    trimap[(share > MIN_GROWN_SHARE) & (trimap != cv2.GC_BGD)] = cv2.GC_FGD


def _steps(lab: NDArray[np.float32]) -> coo_matrix:
    """Lengths of the steps between neighbouring pixels of a (H, W, 3) picture, straight and diagonal, (HW, HW)."""
    height, width = lab.shape[:2]
    rows = np.arange(height * width).reshape(height, width)
    steps = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        there = slice(down, height), slice(max(0, right), width + min(0, right))
        length = np.linalg.norm(lab[here] - lab[there], axis=-1) + STEP_COST * np.hypot(down, right)
        steps.append((length.ravel(), rows[here].ravel(), rows[there].ravel()))
    lengths, first, second = (np.concatenate(part) for part in zip(*steps))
    return coo_matrix((lengths, (first, second)), shape=(height * width,) * 2).tocsr()


def grabcut(image: NDArray[np.uint8], trimap: Trimap, width_px: int, iterations: int) -> Mask:
    """The object's pixels, (H, W).

    Args:
        image: (H, W, 3) uint8 RGB.
        trimap: (H, W) OpenCV's labels.
        width_px: the cut runs on an image at most this wide, cropped to the object's surroundings.
        iterations: rounds of learning colours and cutting.
    """
    height, width = trimap.shape
    unknown = trimap != cv2.GC_BGD
    if not unknown.any():
        return np.zeros((height, width), dtype=bool)
    rows, columns = np.flatnonzero(unknown.any(1)), np.flatnonzero(unknown.any(0))
    pad = max(8, (rows[-1] - rows[0] + columns[-1] - columns[0]) // 8)
    top, bottom = max(0, rows[0] - pad), min(height, rows[-1] + pad + 1)
    left, right = max(0, columns[0] - pad), min(width, columns[-1] + pad + 1)
    scale = min(1.0, width_px / width)
    size = (max(8, round((right - left) * scale)), max(8, round((bottom - top) * scale)))
    picture = cv2.resize(image[top:bottom, left:right], size, interpolation=cv2.INTER_AREA)
    picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    labels = np.asarray(cv2.resize(trimap[top:bottom, left:right], size, interpolation=cv2.INTER_NEAREST), np.uint8)
    own = np.count_nonzero(labels & cv2.GC_FGD)  # GC_PR_FGD has that bit too
    # GrabCut learns five colours of each side and needs pixels to learn from.
    if min(own, labels.size - own) >= 10:
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.setRNGSeed(0)
        cv2.grabCut(picture, labels, (0, 0, 1, 1), models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)
    mask, small = np.zeros((height, width), dtype=bool), (labels & cv2.GC_FGD).astype(np.float32)
    mask[top:bottom, left:right] = cv2.resize(small, (right - left, bottom - top)) > 0.5
    return mask


def along_edges(image: NDArray[np.uint8], mask: Mask, band_px: float, width_px: int) -> Mask:
    """A coarse mask (H, W) moved to the edges of its photo (H, W, 3): cut again in a photo at most this wide, but only
    this near its outline."""
    inner, outer = distance_to(~mask), distance_to(mask)
    trimap = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[inner > band_px], trimap[outer > band_px] = cv2.GC_FGD, cv2.GC_BGD
    return grabcut(image, trimap, width_px, 1) if mask.any() else mask


def cleaned(mask: Mask, image: NDArray[np.uint8] | None = None) -> Mask:
    """The mask (H, W) without specks and holes: parts smaller than a share of the mask's area change side.

    With the photo (H, W, 3), holes through which one sees what is around the mask stay: pinholes aside, those whose
    colours are rather those around it than its own.
    """
    area = np.count_nonzero(mask)
    for side in (True, False):
        count, labels, parts, _ = cv2.connectedComponentsWithStats((mask == side).astype(np.uint8), connectivity=4)
        if count > 2:
            small = parts[:, cv2.CC_STAT_AREA] < SPECK_SHARE * area
            small[0] = False
            gaps = small & (parts[:, cv2.CC_STAT_AREA] >= PINHOLE_SHARE * area)
            if image is not None and not side and gaps.any():
                colours = _colours_of(image, mask, small[labels])
                for gap in np.flatnonzero(gaps):
                    x, y, width, height = parts[gap, : cv2.CC_STAT_AREA]
                    window = np.s_[y : y + height, x : x + width]
                    here = evidence_of(image[window], colours)[labels[window] == gap]
                    small[gap] = here.mean() >= -GAP_EVIDENCE_NATS
            mask = np.where(small[labels], not side, mask)
    return mask


def _colours_of(image: NDArray[np.uint8], mask: Mask, unsure: Mask) -> NDArray[np.float32]:
    """The colours of a mask (H, W), beside those around it; some thousands of pixels of each are enough."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    longest = max(width, height)
    grow, step = int(BOX_GROWTH_SHARE * longest), max(1, longest // COARSE_WIDTH_PX)
    near = np.s_[max(0, y - grow) : y + height + grow : step, max(0, x - grow) : x + width + grow : step]
    return learn_colours([image[near]], [mask[near]], [~mask[near] & ~unsure[near]])


def fill_hull(canvas: NDArray[np.uint8], points: NDArray[np.float64], value: int) -> None:
    """Fill the convex hull of (N, 2) pixels."""
    # cv2 draws with 16-bit coordinates internally: far-away corners are clipped to a frame around the photo.
    clipped = np.clip(points, -4 * max(canvas.shape), 5 * max(canvas.shape)).astype(np.int32)
    cv2.fillConvexPoly(canvas, cv2.convexHull(clipped.reshape(-1, 1, 2)), value)


def first_cuts(target: Target, photos: Workspace, width_px: int, clicked: Mapping[int, PhotoClicks]) -> list[Mask]:
    """First masks (H, W), seeded by the prompts and the sparse points.

    Args:
        target: box, prompts and sparse points of the object.
        photos: views with RGB pixels.
        width_px: photos are cut at most this wide.
        clicked: clicks by row of the photo.
    """
    masks = []
    for k, (view, seen, seen_at) in enumerate(zip(photos.views, photos.seen, photos.seen_at)):
        spanning, depth = view.project(target.spanning)
        trimap = first_trimap((view.height, view.width), target.outline(view), spanning[depth > 0])
        stamp(trimap, target, view, seen, seen_at, clicked.get(k))
        if clicked:
            grow_seeds(view.pixels, trimap, COARSE_WIDTH_PX)
        masks.append(cleaned(grabcut(view.pixels, trimap, width_px, FIRST_ROUNDS)))
    return masks


def query_grabcut(width_px: int, view: View, prompts: Prompts, box: Array | None) -> tuple[list[Mask], Array]:
    """One mask (H, W) of a photo by GrabCut, and its quality: 1, or 0 where it is empty or all of the photo.

    Args:
        width_px: photos are cut at most this wide.
        view: the photo, with RGB pixels.
        prompts: what those inside span is likely object.
        box: (2, 2) corners of a box, upper left first, outside of which nothing is object; or None.
    """
    on, off = prompts.inside, prompts.outside
    trimap = np.full((view.height, view.width), cv2.GC_PR_BGD, dtype=np.uint8)
    if box is not None:
        trimap[_off_box(trimap, box, BOX_GROWTH_SHARE)] = cv2.GC_BGD
        trimap[~_off_box(trimap, box, 0)] = cv2.GC_PR_FGD
    elif len(on) >= 3:
        fill_hull(trimap, on, cv2.GC_PR_FGD)
    _discs(trimap, off, on, POINT_RADIUS_SHARE * max(view.width, view.height))
    grow_seeds(view.pixels, trimap, COARSE_WIDTH_PX)
    mask = cleaned(grabcut(view.pixels, trimap, width_px, FIRST_ROUNDS))
    return [mask], np.array([float(mask.any() and not mask.all())])


def _off_box(trimap: Trimap, box: Array, slack: float) -> Mask:
    """(H, W) what lies outside a box (2, 2) in pixels, grown on all sides by a share of its longer side."""
    grow = slack * float((box[1] - box[0]).max())
    (left, top), (right, bottom) = np.maximum(box + [[-grow], [grow]], 0).astype(int)
    off = np.ones(trimap.shape, dtype=bool)
    off[top : bottom + 1, left : right + 1] = False
    return off


def _discs(trimap: Trimap, off: Array, on: Array, radius_px: float) -> None:
    """Make the discs around pixels (M, 2) off the object and (N, 2) on it certain, in place."""
    for pixels, label in ((off, cv2.GC_BGD), (on, cv2.GC_FGD)):
        for x, y in pixels.astype(int):
            cv2.circle(trimap, (int(x), int(y)), max(1, round(radius_px)), label, -1)


def second_cuts(
    target: Target,
    masks: list[Mask],
    photos: Workspace,
    hull: Hull,
    clicked: Mapping[int, PhotoClicks],
) -> list[Mask]:
    """GrabCut once more, where a photo's mask and the hull do not agree.

    Args:
        target: box, prompts and sparse points of the object.
        masks: (H, W) per photo.
        photos: views with RGB pixels.
        hull: of these masks.
        clicked: clicks by row of the photo.
    """
    outlines = [silhouette(hull, view) for view in photos.views]
    own, others = [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    colours = learn_colours([view.pixels for view in photos.views], own, others)
    cut = []
    for k, (view, mask, outline) in enumerate(zip(photos.views, masks, outlines)):
        # With the whole band the masks of the demo's house lost 0.002 of IoU, and its held-out photos 0.9 dB.
        band_px = OUTLINE_BAND_SHARE / 2 * view.width
        trimap = second_trimap(outline, mask, evidence_of(view.pixels, colours), band_px)
        stamp(trimap, target, view, photos.seen[k], photos.seen_at[k], clicked.get(k))
        if not outline.any():
            cut.append(outline)
            continue
        found, told = grabcut(view.pixels, trimap, view.width, 1), clicked.get(k)
        cut.append(cleaned(found))
        if told is not None and len(told.on):
            # A small part that was clicked is no speck.
            cut[-1] = cut[-1] | prompted_parts(found, told.on, told.off)
    return cut


def stamp(
    trimap: Trimap, target: Target, view: View, seen: Rows, seen_at: Array, clicks: PhotoClicks | None = None
) -> None:
    """Mark in place what the sparse points that a photo sees make certain, the prompts, what close prompts enclose, and
    the photo's own clicks and box.

    A prompt that the photo does not see is hidden by the object itself, so its pixel is the object's all the same.

    Args:
        trimap: (H, W) labels.
        target: box, prompts and sparse points of the object.
        view: the photo.
        seen: (K,) rows of the sparse points that it observes.
        seen_at: (K, 2) pixels where it does.
        clicks: made in this photo, if any.
    """
    radius, kind = POINT_RADIUS_SHARE * max(view.width, view.height), target.kind[seen]
    _discs(trimap, seen_at[kind < 0], seen_at[kind > 0], radius)
    pixels, depth = view.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)
    if clicks is None:
        return
    if clicks.box is not None:
        trimap[_off_box(trimap, clicks.box, BOX_GROWTH_SHARE)] = cv2.GC_BGD
    _discs(trimap, clicks.off, clicks.on, radius)
