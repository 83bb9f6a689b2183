"""Masks of the object in every photo: GrabCut or SAM 2 from prompts, or supplied; the visual hull makes them agree."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import Delaunay

from scenefuse.fiducials import locate
from scenefuse.objects.box import Ground, find_ground, in_hull, span, upright_box
from scenefuse.objects.frames import original_sizes
from scenefuse.objects.grabcut import (
    cleaned,
    fill_hull,
    first_trimap,
    grabcut,
    learn_colours,
    prefer_colour,
    second_trimap,
    stamp_seeds,
)
from scenefuse.objects.hull import Box, Frame, Hull, Mask, agreement, carve, silhouette
from scenefuse.objects.sam2 import Sam2, check_weights
from scenefuse.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    manifest,
    quantity,
    read_json,
    threads,
    value,
    write_json,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MaskSettings:
    """How masks are made."""

    box_margin: float
    """Growth of the prompts' box on each side, as a share of its diagonal."""
    ground_margin: float
    """A sparse point is on the object only when it is this much above the ground, as a share of the box's diagonal."""
    grabcut_width_px: int
    """The first cut runs on photos at most this wide."""
    grabcut_iterations: int
    """Rounds of learning colours and cutting in the first cut."""
    hull_voxels: int
    """Voxels of the visual hull along the longest side of the box."""
    hull_tolerance: float
    """Share of the photos that may contradict a voxel of the hull."""
    band_px: float
    """Half width of the band along the hull's outline where a photo's own evidence decides, at a photo width of 640."""
    min_agreement: float
    """Smallest IoU of a mask with the hull's outline; below it the photo is dropped."""
    min_photos: int
    """Fewest good masks to go on with."""
    max_click_residual_px: float
    """Largest reprojection error of a clicked prompt."""
    sam2_encoder_sha256: str
    """SHA-256 of the SAM 2 encoder's weights."""
    sam2_decoder_sha256: str
    """SHA-256 of the SAM 2 decoder's weights."""


@dataclass(frozen=True)
class _Object:
    """What the sparse model and the prompts say about the object.

    Attributes:
        box: where it is.
        ground: under which nothing belongs to it.
        ground_found: whether the ground was measured; otherwise it is the box's bottom.
        spanning: (N, 3) points on the object that span it: the prompts.
        parts: (K, 4) rows of them whose tetrahedron is taken for object.
        sparse: (P, 3) sparse points.
        kind: (P,) per sparse point, 1 on the object, -1 not on it, 0 unknown.
    """

    box: Box
    ground: Ground
    ground_found: bool
    spanning: Array
    parts: NDArray[np.intp]
    sparse: Array
    kind: NDArray[np.int8]


def make_masks(
    *,
    cameras: Path,
    cameras_json: Path,
    sfm: Path,
    photos: Path,
    method: Literal["grabcut", "sam2", "supplied"],
    prompts: Path | None,
    supplied: Path | None,
    sam2_encoder: Path | None,
    sam2_decoder: Path | None,
    settings: MaskSettings,
    seed: int,
    masks: Path,
    contact_sheet: Path,
    report: Path,
) -> None:
    """Write a mask of the object for every undistorted photo (method K1, K3).

    Prompts give an upright box; the sparse points in it and above the ground seed GrabCut or SAM 2 in each
    photo. The masks carve a visual
    hull, whose outline repairs them outside a narrow band, and a photo that disagrees with it is dropped.
    Supplied masks are
    undistorted and measured against their hull, never changed.

    Args:
        cameras: undistorted COLMAP workspace of the object (PINHOLE cameras).
        cameras_json: its report, with `up_in_camera_frame`.
        sfm: the COLMAP model before undistortion.
        photos: JSON list of the frames, with the sizes of the photos they were made from: clicks are in their pixels.
        method: where masks come from.
        prompts: for grabcut and sam2: TSV of pixels clicked in two or more photos, or of points in the
            object's frame, on the object and
            spanning it.
        supplied: for supplied: folder of masks named like the photos, with or without `_mask`; non-zero on the object.
        sam2_encoder: for sam2: weights of the encoder (.ort or .onnx).
        sam2_decoder: for sam2: weights of the decoder (.onnx).
        settings: see MaskSettings.
        seed: seed of the ground's RANSAC.
        masks: output folder, {photo without suffix}.png, uint8 0 or 255, the size of the undistorted photo.
        contact_sheet: output PNG, all masks over their photos.
        report: output JSON: method, area and agreement per photo, photos dropped and why.

    Raises:
        StageError: prompts, weights or masks are missing or wrong; too few good masks.
    """
    cv2.setNumThreads(threads())
    frames, sparse = _read_frames(cameras)
    up = np.array(value(read_json(cameras_json), "up_in_camera_frame"), dtype=np.float64)
    without: dict[str, str] = {}
    if method == "supplied":
        found = _supplied_masks(supplied, sfm, frames)
        without = {f.name: "no mask was supplied" for f in frames if f.name not in found}
        frames = [f for f in frames if f.name in found]
        first = [found[f.name] for f in frames]
        target = _object_from_masks(frames, first, sparse, up, settings, seed)
        hull = _carve(target, frames, first, settings, settings.hull_tolerance)
        final = first
    else:
        points = _prompt_points(prompts, sfm, photos, settings)
        target = _object_from_points(points, frames, sparse, up, settings, seed)
        print(f"{np.sum(target.kind > 0)} sparse points on the object, {np.sum(target.kind < 0)} not", flush=True)
        if method == "sam2":
            encoder = check_weights(sam2_encoder, settings.sam2_encoder_sha256, "encoder")
            decoder = check_weights(sam2_decoder, settings.sam2_decoder_sha256, "decoder")
            network = Sam2(encoder, decoder, threads())
            first = [_sam2_mask(network, target, f, settings) for f in frames]
        else:
            first = _grabcut_masks(target, frames, settings)
        # The first masks are made photo by photo: their hull lets twice as many of them disagree.
        hull = _carve(target, frames, first, settings, 2 * settings.hull_tolerance)
        final = first
        for _ in range(2 if method == "grabcut" else 1):
            if method == "grabcut":
                final = _recut(target, final, frames, hull, settings)
            else:
                final = [_clamped(m, f, hull, settings) for m, f in zip(final, frames)]
            hull = _carve(target, frames, final, settings, settings.hull_tolerance)
    outlines = [silhouette(hull, f) for f in frames]
    before = [agreement(m, o) for m, o in zip(first, outlines)]
    after = [agreement(m, o) for m, o in zip(final, outlines)]
    dropped = without | _dropped(frames, final, after, settings)
    kept = [k for k, f in enumerate(frames) if f.name not in dropped]
    for name, reason in sorted(dropped.items()):
        print(f"{name} dropped: {reason}", flush=True)
    if len(kept) < settings.min_photos:
        raise StageError(
            f"only {len(kept)} of {len(frames)} photos in {cameras} have a good mask, {settings.min_photos} needed: "
            "check that the prompts span the object, or supply masks"
        )
    with atomic_directory(masks) as folder:
        for k in kept:
            path = folder / f"{Path(frames[k].name).stem}.png"
            cv2.imwrite(str(path), final[k].astype(np.uint8) * 255)
        files = manifest(folder)
    with atomic_file(contact_sheet) as path:
        cv2.imwrite(str(path), _contact_sheet(frames, final, after, dropped))
    per_photo = {
        f.name: {"area": round(float(m.mean()), 5), "agreement": round(a, 4), "first_agreement": round(b, 4)}
        for f, m, a, b in zip(frames, final, after, before)
    }
    print(f"{len(kept)} of {len(frames)} masks, median agreement {np.median([after[k] for k in kept]):.3f}", flush=True)
    write_json(
        report,
        {
            "method": quantity(method, ""),
            "masks": quantity(len(kept), "1"),
            "photos": quantity(len(frames) + len(without), "1"),
            "median_agreement": quantity(float(np.median([after[k] for k in kept])), "1"),
            "ground": quantity("measured" if target.ground_found else "not found; bottom of the box", ""),
            "hull_voxel": quantity(hull.voxel, "object units"),
            "dropped": dropped,
            "per_photo": per_photo,
            "files": files,
        },
    )


def _read_frames(cameras: Path) -> tuple[list[Frame], Array]:
    """The photos of an undistorted workspace in name order, and the (P, 3) sparse points."""
    try:
        model = pycolmap.Reconstruction(cameras / "sparse")
    except Exception as error:
        raise StageError(
            f"{cameras}/sparse is not a readable COLMAP model ({error}); rerun the cameras stage"
        ) from None
    rows = {point: row for row, point in enumerate(sorted(model.points3D))}
    sparse = np.array([model.points3D[p].xyz for p in rows], dtype=np.float64).reshape(-1, 3)
    frames = []
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name):
        picture = cv2.imread(str(cameras / "images" / image.name), cv2.IMREAD_COLOR)
        if picture is None:
            raise StageError(f"{cameras}/images/{image.name} cannot be read; rerun the cameras stage")
        seen = image.get_observation_points2D()
        frames.append(
            Frame(
                image.name,
                np.asarray(picture, dtype=np.uint8),
                model.cameras[image.camera_id].calibration_matrix(),
                image.cam_from_world().matrix(),
                np.array([p.xy for p in seen], dtype=np.float64).reshape(-1, 2),
                np.array([rows[p.point3D_id] for p in seen], dtype=np.int64),
            )
        )
    if not frames:
        raise StageError(f"{cameras} holds no photo with a camera; look at the report of the object's SfM")
    return frames, sparse


def _prompt_points(prompts: Path | None, sfm: Path, photos: Path, settings: MaskSettings) -> Array:
    """(N, 3) prompts in the object's frame."""
    if prompts is None:
        raise StageError("masks from prompts need a prompts file; set its path in config/objects.tsv, or supply masks")
    names, points, _ = locate(prompts, sfm, settings.max_click_residual_px, original_sizes(read_json(photos)))
    if len(points) < 3:
        raise StageError(
            f"{prompts} holds {len(names)} points on the object, three or more are needed; mark some at its ends"
        )
    return points


def _object_from_points(
    points: Array, frames: list[Frame], sparse: Array, up: Array, settings: MaskSettings, seed: int
) -> _Object:
    """Box, ground and the kind of each sparse point, from (N, 3) points that span the object.

    A sparse point is on the object when it lies above the ground in the convex hull of the points, grown
    by a quarter of the margin; not on it when outside the hull grown by the whole margin, or below the ground; in
    between nobody knows. Nobody knows either of a point of two photos: two rays that are mismatched along their
    epipolar lines meet somewhere all the same.
    """
    box = upright_box(points, up, settings.box_margin)
    x_in_box = box.to_box(sparse)
    ground, found = find_ground(x_in_box, box, box.to_box(points), seed)
    height = ground.height_of(x_in_box)
    margin = settings.ground_margin * box.diagonal
    grow = settings.box_margin * float(np.linalg.norm(np.ptp(points, axis=0)))
    kind = np.zeros(len(sparse), dtype=np.int8)
    kind[~in_hull(sparse, span(points, grow))] = -1
    if found:
        kind[height < 0.5 * margin] = -1
    kind[in_hull(sparse, span(points, 0.25 * grow)) & (height > margin)] = 1
    kind[np.bincount(np.concatenate([f.point_rows for f in frames]), minlength=len(sparse)) < 3] = 0
    return _Object(box, ground, found, points, _parts(points, 0.12 * box.diagonal), sparse, kind)


def _parts(points: Array, max_edge: float) -> NDArray[np.intp]:
    """(K, 4) rows of (N, 3) prompts, tetrahedra with short edges: close clicks mark the corners of a small part."""
    if len(points) < 5:
        return np.empty((0, 4), dtype=np.intp)
    corners = Delaunay(points, qhull_options="Qbb Qc QJ").simplices.astype(np.intp)
    edges = np.linalg.norm(points[corners][:, :, None] - points[corners][:, None], axis=-1)
    return corners[edges.max((1, 2)) < max_edge]


def _object_from_masks(
    frames: list[Frame], masks: list[Mask], sparse: Array, up: Array, settings: MaskSettings, seed: int
) -> _Object:
    """Box and ground from supplied masks: the sparse points that lie in the mask wherever they are seen."""
    seen, hit = np.zeros(len(sparse)), np.zeros(len(sparse))
    for frame, mask in zip(frames, masks):
        u, v = np.clip(frame.observed.astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        np.add.at(seen, frame.point_rows, 1)
        np.add.at(hit, frame.point_rows, mask[v, u])
    own = sparse[(seen >= 2) & (hit > 0.8 * seen)]
    if len(own) < 10:
        raise StageError(
            f"only {len(own)} sparse points lie in the supplied masks; "
            "are they white on the object, and of these photos?"
        )
    axes = upright_box(own, up, 0.0)
    x = axes.to_box(own)
    low, high = np.percentile(x, [0.5, 99.5], axis=0)
    return _object_from_points(own[((x >= low) & (x <= high)).all(1)], frames, sparse, up, settings, seed)


def _grabcut_masks(target: _Object, frames: list[Frame], settings: MaskSettings) -> list[Mask]:
    """First masks by GrabCut, seeded by the prompts, the sparse points, and the colours of both over all photos."""
    trimaps = []
    for frame in frames:
        size = frame.image.shape[:2]
        trimaps.append(first_trimap(size, _outline(target, frame, settings), frame.project(target.spanning)[0]))
        _stamp(trimaps[-1], target, frame)
    colours = learn_colours(
        [f.image for f in frames], [t == cv2.GC_FGD for t in trimaps], [t == cv2.GC_BGD for t in trimaps]
    )
    masks = []
    for frame, trimap in zip(frames, trimaps):
        prefer_colour(trimap, colours.evidence(frame.image))
        masks.append(cleaned(grabcut(frame.image, trimap, settings.grabcut_width_px, settings.grabcut_iterations)))
    return masks


def _outline(target: _Object, frame: Frame, settings: MaskSettings) -> Array:
    """Pixels (N, 2) in whose convex hull the object is: its span with the margin, or all where that ends behind us."""
    grow = settings.box_margin * float(np.linalg.norm(np.ptp(target.spanning, axis=0)))
    pixels, depth = frame.project(span(target.spanning, grow))
    height, width = frame.image.shape[:2]
    return pixels if (depth > 0).all() else np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)


def _stamp(trimap: NDArray[np.uint8], target: _Object, frame: Frame) -> None:
    """Mark what the sparse points that a photo sees make certain, the prompts, and what close prompts enclose.

    A prompt that the photo does not see is hidden by the object itself, so its pixel is the object's all the same.
    """
    height, width = trimap.shape
    rows = frame.point_rows
    radius, diagonal = 0.003 * width, target.box.diagonal
    stamp_seeds(trimap, frame.observed, target.sparse[rows], target.kind[rows], radius, 0.06 * diagonal)
    pixels, depth = frame.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)


def _sam2_mask(network: Sam2, target: _Object, frame: Frame, settings: MaskSettings) -> Mask:
    """First mask of one photo by SAM 2: the box of the object's points, three of them, and two points beside it."""
    height, width = frame.image.shape[:2]
    kind = target.kind[frame.point_rows]
    own = frame.observed[kind > 0]
    if len(own) < 3:
        return np.zeros((height, width), dtype=bool)
    outline = np.clip(_outline(target, frame, settings), 0, [width, height])
    box = np.concatenate([outline.min(0), outline.max(0)])
    others = frame.observed[kind < 0]
    others = others[((others > box[:2]) & (others < box[2:])).all(1)]
    inner = own[np.argsort(np.linalg.norm(own - np.median(own, axis=0), axis=1))[: max(1, int(0.7 * len(own)))]]
    points = np.concatenate([_spread(inner, 3), _spread(others, 2)])
    labels = np.array([1] * min(3, len(inner)) + [0] * min(2, len(others)))
    mask, quality = network.mask(frame.image, box, points, labels)
    print(f"{frame.name}: predicted IoU {quality:.2f}", flush=True)
    return cleaned(mask)


def _spread(points: Array, count: int) -> Array:
    """At most `count` of (N, 2) points, far from each other, the first one given first."""
    chosen = list(points[:1])
    while chosen and len(chosen) < min(count, len(points)):
        distance = np.min([np.linalg.norm(points - c, axis=1) for c in chosen], axis=0)
        chosen.append(points[int(np.argmax(distance))])
    return np.array(chosen).reshape(-1, 2)


def _carve(target: _Object, frames: list[Frame], masks: list[Mask], settings: MaskSettings, tolerance: float) -> Hull:
    """The visual hull; photos that contradict a tolerant hull have no say in the one that counts."""
    trusted = [k for k, m in enumerate(masks) if m.any()]
    for share in (max(tolerance, 0.34), tolerance):
        if len(trusted) < 2:
            break
        voters = [frames[k] for k in trusted], [masks[k] for k in trusted]
        hull = carve(target.box, target.ground.height_of, *voters, settings.hull_voxels, share)
        if share == tolerance:
            break
        trusted = [k for k in trusted if agreement(masks[k], silhouette(hull, frames[k])) >= settings.min_agreement]
    if len(trusted) < 2 or len(hull.shell) == 0:
        raise StageError(
            "the masks of the photos have no common object; check that the prompts lie on one object and span it, "
            "or supply masks"
        )
    return hull


def _recut(target: _Object, masks: list[Mask], frames: list[Frame], hull: Hull, settings: MaskSettings) -> list[Mask]:
    """GrabCut once more, on all that a photo's mask and the hull do not agree on."""
    outlines = [silhouette(hull, f) for f in frames]
    colours = learn_colours(
        [f.image for f in frames], [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    )
    cut = []
    for frame, mask, outline in zip(frames, masks, outlines):
        width = frame.image.shape[1]
        trimap = second_trimap(outline, mask, colours.evidence(frame.image), settings.band_px * width / 640)
        _stamp(trimap, target, frame)
        cut.append(cleaned(grabcut(frame.image, trimap, width, 1)) if outline.any() else outline)
    return cut


def _clamped(mask: Mask, frame: Frame, hull: Hull, settings: MaskSettings) -> Mask:
    """The photo's mask within a band along the hull's outline, the hull elsewhere."""
    outline = silhouette(hull, frame)
    band = settings.band_px * frame.image.shape[1] / 640
    within = ndimage.distance_transform_edt(outline) > band
    beyond = ndimage.distance_transform_edt(~outline) > band
    return cleaned((mask | within) & ~beyond & outline.any())


def _supplied_masks(folder: Path | None, sfm: Path, frames: list[Frame]) -> dict[str, Mask]:
    """Masks from a folder by the name of the photo they belong to, undistorted like it."""
    if folder is None or not folder.is_dir():
        raise StageError(f"the folder of supplied masks {folder} does not exist; set its path in config/objects.tsv")
    files = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"):
            stem = path.stem.removesuffix(".jpg").removesuffix(".JPG").removesuffix(".png")
            files[stem.removesuffix("_mask")] = path
    model = pycolmap.Reconstruction(sfm)
    originals = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    masks = {}
    for frame in frames:
        file = files.get(Path(frame.name).stem)
        if file is None or frame.name not in originals:
            continue
        matte = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if matte is None:
            raise StageError(f"the supplied mask {file} cannot be read; export it again as PNG")
        masks[frame.name] = _undistorted(_matte(matte), originals[frame.name], frame)
    if not masks:
        example = next(iter(files), "none")
        raise StageError(
            f"masks that match no photo: {len(files)} masks in {folder} (first: {example}), photos are named like "
            f"{frames[0].name}; name a mask like its photo, with or without _mask"
        )
    print(f"{len(masks)} of {len(frames)} photos have a supplied mask", flush=True)
    return masks


def _matte(picture: NDArray[Any]) -> Mask:
    """A mask picture as (H, W) bool: alpha where it varies, else brightness, above half of the largest value."""
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() < picture[..., 3].max():
        channel = picture[..., 3]
    else:
        channel = picture[..., :3].max(2) if picture.ndim == 3 else picture
    return channel > max(1, channel.max()) / 2


def _undistorted(mask: Mask, camera: pycolmap.Camera, frame: Frame) -> Mask:
    """A mask in the pixels of the original photo, moved into those of the undistorted one."""
    height, width = frame.image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(frame.intrinsics).T
    pixels = np.asarray(camera.img_from_cam(rays)).reshape(height, width, 2)
    scale = np.array([mask.shape[1] / camera.width, mask.shape[0] / camera.height])
    x, y = np.moveaxis((pixels * scale - 0.5).astype(np.float32), -1, 0)
    soft = cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return soft > 0.5


def _dropped(frames: list[Frame], masks: list[Mask], scores: list[float], settings: MaskSettings) -> dict[str, str]:
    """Photos without a usable mask, and why."""
    reasons = {}
    for frame, mask, score in zip(frames, masks, scores):
        if not mask.any():
            reasons[frame.name] = "empty mask"
        elif score < settings.min_agreement:
            reasons[frame.name] = (
                f"IoU with the visual hull is {score:.2f}, below {settings.min_agreement} (min_agreement)"
            )
    return reasons


def _contact_sheet(
    frames: list[Frame], masks: list[Mask], scores: list[float], dropped: dict[str, str], width_px: int = 240
) -> NDArray[np.uint8]:
    """All photos with the background dimmed and the mask's outline drawn: green, or red where dropped."""
    tiles = []
    for frame, mask, score in zip(frames, masks, scores):
        height = round(width_px * frame.image.shape[0] / frame.image.shape[1])
        picture = np.where(mask[..., None], frame.image, frame.image // 3).astype(np.uint8)
        edge = mask & ~ndimage.binary_erosion(mask, iterations=max(1, frame.image.shape[1] // 320))
        picture[edge] = (0, 0, 255) if frame.name in dropped else (0, 255, 0)
        tile = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
        cv2.putText(
            tile, f"{Path(frame.name).stem} {score:.2f}", (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1
        )
        tiles.append(tile)
    columns = min(8, len(tiles))
    tallest = max(t.shape[0] for t in tiles)
    sheet = np.zeros((-(-len(tiles) // columns) * tallest, columns * width_px, 3), dtype=np.uint8)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet[row * tallest : row * tallest + tile.shape[0], column * width_px : (column + 1) * width_px] = tile
    return sheet
