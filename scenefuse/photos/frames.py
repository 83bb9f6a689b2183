"""An object's frames: copies of photos from a folder, or the sharpest frames of a video."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, threads
from scenefuse.photos.photo_files import VIDEO_SUFFIXES, frame_name, thin_out, upright_size
from scenefuse.photos.photos import (
    Photo,
    below_folder,
    bits_to_stretch,
    distinct_photos,
    each_photo,
    inspect_photo,
    photo_notes,
    save_upright,
    stays,
    write_photos,
)
from scenefuse.photos.pictures import write_picture


@dataclass(frozen=True)
class FrameSettings:
    """Which frames are taken, and at what size."""

    frame_step: int = setting(1, least=1)
    """Take every n-th photo, or one frame out of each n of a video."""
    max_frames: int = setting(200, least=0)
    """Most frames; more are thinned out evenly. 0 sets no limit."""
    max_width_px: int = setting(1600, unit="px", least=1)
    """Widest frame; wider ones are scaled down."""


def extract_frames(*, source: Path, frames: Path, photos: Path, settings: FrameSettings) -> None:
    """Take an object's frames from a folder of photos or from a video.

    Photos keep their file names; one that is neither too wide nor rotated is copied byte by byte. A video is cut into
    windows of equal length and the sharpest frame of each is kept (largest variance of the Laplacian,
    Pech-Pacheco et al. 2000).

    Args:
        source: folder of photos, or video file.
        frames: output, folder of frames.
        photos: output, JSON list of them, with the size of each frame's original.
        settings: choice and size.

    Raises:
        StageError: the source is missing, holds no photos, cannot be decoded, or yields fewer than three frames.
    """
    if not source.exists():
        raise StageError(f"the object's photos {source} do not exist; check the path in the table of objects")
    if source.is_file() and source.suffix.lower() not in VIDEO_SUFFIXES:
        raise StageError(
            f"{source} is neither a folder of photos nor a video; use one of {' '.join(sorted(VIDEO_SUFFIXES))}"
        )
    with atomic_directory(frames) as temporary:
        kind = "video" if source.is_file() else "photos"
        if source.is_file():
            origin = _from_video(source, temporary, settings)
            listed = [inspect_photo(temporary, name) for name in sorted(origin)]
            notes = photo_notes(listed, 0)
        else:
            listed, origin, notes = _from_folder(source, temporary, settings)
    if len(listed) < 3:
        shutil.rmtree(frames)
        advice = "lower object.frames.frame_step" if kind == "video" else "take more photos around the object"
        raise StageError(f"{source} yields {len(listed)} frames, at least 3 are needed; {advice}")
    print(f"{len(listed)} frames from {source}", flush=True)
    turned = {name: entry["orientation"] for name, entry in origin.items() if entry.get("orientation", 1) != 1}
    more = {"origin": quantity(origin, ""), "turned": quantity(turned, "")}
    write_photos(photos, listed, frames, kind, notes, **more)


def original_sizes(content: dict[str, Any]) -> dict[str, tuple[int, int]]:
    """Frame name -> (width, height) of the photo it was made from, from the content of photos.json."""
    if "origin" not in content:
        return {p["name"]: (p["width"], p["height"]) for p in content["photos"]}
    return {name: (entry["width"], entry["height"]) for name, entry in content["origin"]["value"].items()}


def sharpness(frame: NDArray[Any]) -> float:
    """Variance of the Laplacian of a (H, W, 3) BGR frame at no more than 640 columns: larger is sharper."""
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, 640.0 / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


def _from_folder(
    source: Path, output: Path, settings: FrameSettings
) -> tuple[list[Photo], dict[str, dict[str, Any]], list[str]]:
    """The frames, what each was made of, and notes."""
    names, copies = distinct_photos(source)
    flat: dict[str, str] = {}
    for name in (names[i] for i in thin_out(len(names), settings.frame_step, settings.max_frames)):
        stem = Path(frame_name(name)).stem
        if stem in flat:
            raise StageError(f"{flat[stem]} and {name} in {source} would share the mask {stem}.png; rename one of them")
        flat[stem] = name
    photos = each_photo(lambda name: inspect_photo(source, name), flat.values())
    bits = bits_to_stretch(photos)

    def copy(photo: Photo) -> Photo:
        target = output / frame_name(photo.name)
        if photo.width <= settings.max_width_px and stays(source, photo, bits):
            shutil.copyfile(source / photo.name, target)
        else:
            photo = save_upright(source, photo, target, bits, settings.max_width_px)
        return replace(photo, name=target.name)

    frames = each_photo(copy, photos)
    origin = {}
    for photo, frame in zip(photos, frames):
        width, height = upright_size(source / photo.name)
        origin[frame.name] = {"source": photo.name, "width": width, "height": height, "orientation": photo.orientation}
    used = f"{len(frames)} of {len(names)} photos are used, spread evenly (object.frames.max_frames, frame_step)"
    notes = [*([used] if len(frames) < len(names) else []), *photo_notes(frames, bits), *copies, *below_folder(names)]
    return sorted(frames, key=lambda frame: frame.name), origin, notes


def _from_video(source: Path, output: Path, settings: FrameSettings) -> dict[str, dict[str, Any]]:
    cv2.setNumThreads(threads())
    count = sum(1 for _ in _decode(source, pictures=False))
    if count == 0:
        raise StageError(f"the video {source} cannot be decoded; convert it to H.264 in an .mp4 file")
    starts = thin_out(count, settings.frame_step, settings.max_frames)
    window_of = np.searchsorted(starts, np.arange(count), side="right") - 1
    scored = ((sharpness(frame), min(index, count - 1), frame) for index, frame in _decode(source, pictures=True))
    origin: dict[str, dict[str, Any]] = {}
    for _, window in groupby(scored, lambda one: window_of[one[1]]):
        origin |= _write_frame(output, *max(window, key=lambda one: one[0]), settings)
    return origin


def _decode(source: Path, pictures: bool) -> Iterator[tuple[int, NDArray[Any]]]:
    """Frames of a video in order; without `pictures` they are only counted, which is much faster."""
    video = cv2.VideoCapture(str(source))
    try:
        index = 0
        while video.grab():
            frame: NDArray[Any] | None = video.retrieve()[1] if pictures else np.zeros(0)
            if frame is not None:
                yield index, frame
            index += 1
    finally:
        video.release()


def _write_frame(
    output: Path, score: float, index: int, frame: NDArray[Any], settings: FrameSettings
) -> dict[str, dict[str, Any]]:
    height, width = frame.shape[:2]
    scale = min(1.0, settings.max_width_px / width)
    if scale < 1.0:
        size = (settings.max_width_px, round(height * scale))
        frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    name = f"frame_{index:06d}.jpg"
    write_picture(output / name, np.ascontiguousarray(frame[..., ::-1], dtype=np.uint8))
    return {name: {"frame": index, "width": width, "height": height, "sharpness": round(score, 3)}}
