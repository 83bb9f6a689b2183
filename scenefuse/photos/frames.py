"""A scene's photos, upright, and an object's frames: of a folder of photos, or the sharpest frames of a video."""

import os
import re
import shutil
import struct
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, threads
from scenefuse.photos.photo_files import (
    VIDEO_SUFFIXES,
    distinct_photos,
    frame_name,
    geo_file,
    subtitles,
    thin_out,
    upright_size,
)
from scenefuse.photos.photos import (
    Photo,
    below_folder,
    bits_to_stretch,
    each_photo,
    inspect_photo,
    photo_notes,
    save_upright,
    stays,
    write_photos,
)
from scenefuse.photos.pictures import write_picture
from scenefuse.photos.positions import check_beside_exif, positions_of, read_geo
from scenefuse.photos.subtitles import positions_in_subtitles

Origin = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class VideoSettings:
    """Which frames of a scene's video are taken."""

    max_frames: int = setting(300, least=3)
    """Most frames of a video, spread evenly."""


@dataclass(frozen=True)
class FrameSettings:
    """Which frames are taken, and at what size."""

    frame_step: int = setting(1, least=1)
    """Take every n-th photo, or one of n frames of a video."""
    max_frames: int = setting(200, least=0)
    """Most frames, thinned out evenly; 0: no limit."""
    max_width_px: int = setting(1600, unit="px", least=1)
    """Widest frame; wider ones are scaled down."""


def list_photos(*, source: Path, upright: Path, photos: Path, settings: VideoSettings) -> None:
    """List a scene's photos: those of a folder and its subfolders, or frames of a video; all decoded once, and upright.

    Photos that EXIF says are rotated are turned and written again, and so are those of a format that COLMAP does not
    read, whatever their ending; all others are linked, unless all are dark or use few of their bits: then they are
    written brighter. From here on pixels count as people see them. A geo.txt in the folder takes the place of the
    positions in EXIF. Frames keep the video's size: later stages scale photos down as they need.

    Args:
        source: folder of photos (JPEG, PNG, TIFF or BMP), or video.
        upright: output, folder of the same names with upright copies of the rotated photos and links to all others; or
            of frames.
        photos: output, JSON with name, size in pixels, SHA-256, position and focal length of each photo in `upright`.
        settings: how many frames of a video.

    Raises:
        StageError: the folder is missing or holds no photo, a photo cannot be decoded, geo.txt is not well formed, or
            the video has no three frames that can be decoded.
    """
    kind = "video" if source.is_file() else "photos"
    with atomic_directory(upright) as temporary:
        if kind == "video":
            listed, origin, notes = _from_video(source, temporary, 1, settings.max_frames)
            more = {"origin": quantity(origin, "")}
        else:
            listed, turned, notes = _linked(source, temporary)
            more = {"turned": quantity(turned, "")}
    with_gps, stated = sum(p.has_gps for p in listed), sum(p.has_gps and bool(p.horizontal_sd_m) for p in listed)
    print(f"{len(listed)} photos in {source}, {with_gps} with a GPS position, {stated} with its accuracy", flush=True)
    write_photos(photos, listed, upright, kind, notes, **more)


def extract_frames(*, source: Path, frames: Path, photos: Path, settings: FrameSettings) -> None:
    """Take an object's frames from a folder of photos or from a video.

    Photos keep their file names; one that is neither too wide nor rotated is copied byte by byte.

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
    with atomic_directory(frames) as temporary:
        kind = "video" if source.is_file() else "photos"
        if source.is_file():
            chosen = settings.frame_step, settings.max_frames
            listed, origin, notes = _from_video(source, temporary, *chosen, settings.max_width_px)
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


def _linked(folder: Path, output: Path) -> tuple[list[Photo], dict[str, int], list[str]]:
    """A folder's photos, of which those that have to are written into `output` and the others linked; the orientations
    of those that were turned, and notes."""
    names, copies = distinct_photos(folder)
    geo = geo_file(folder)
    positions = read_geo(geo) if geo else {}
    stored = each_photo(lambda name: inspect_photo(folder, name), names)
    bits = bits_to_stretch(stored)
    listed = each_photo(lambda photo: _stood_upright(folder, photo, output, bits), stored)
    turned = {p.name: p.orientation for p in stored if p.orientation != 1}
    if geo:
        places = positions_of(names, positions, geo)
        check_beside_exif(places, [asdict(photo) for photo in listed], geo)
        listed = [replace(p, position_note="", **place) for p, place in zip(listed, places)]
    notes = copies + below_folder(names) + photo_notes(listed, bits)
    if geo:
        known = [photo for photo in listed if photo.has_gps]
        where = f"{known[0].name} at latitude {known[0].latitude_deg:.5f}, longitude {known[0].longitude_deg:.5f}"
        notes.append(f"{geo.name} gives {len(known)} of {len(listed)} positions ({where}); EXIF's are not used")
    if turned:
        first = next(iter(turned))
        notes.append(f"{len(turned)} photos ({first}, ...) carry an EXIF rotation; upright copies of them are used")
    return listed, turned, notes


def _stood_upright(folder: Path, photo: Photo, output: Path, bits: int) -> Photo:
    """Link or write one photo into `output`; what is listed is the result."""
    target = output / photo.name
    target.parent.mkdir(parents=True, exist_ok=True)
    if stays(folder, photo, bits):
        # As the table names the folder: links outlast a move of the project alone, or of both.
        original = os.path.realpath(folder / photo.name)
        absolute = folder.is_absolute()
        target.symlink_to(original if absolute else os.path.relpath(original, os.path.realpath(target.parent)))
        return photo
    return save_upright(folder, photo, target, bits)


def _from_folder(source: Path, output: Path, settings: FrameSettings) -> tuple[list[Photo], Origin, list[str]]:
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


def _from_video(
    source: Path, output: Path, step: int, limit: int, max_width_px: int | None = None
) -> tuple[list[Photo], Origin, list[str]]:
    """The sharpest frame (largest variance of the Laplacian, Pech-Pacheco et al. 2000) of each of some windows of equal
    length, written into `output`, with its position by the subtitles beside the video; what each was made of, and
    notes."""
    if source.suffix.lower() not in VIDEO_SUFFIXES:
        raise StageError(
            f"{source} is neither a folder of photos nor a video; use one of {' '.join(sorted(VIDEO_SUFFIXES))}"
        )
    if _is_panorama(source):
        raise StageError(f"the video {source} is a panorama, to which no lens is fitted: cut it into views")
    cv2.setNumThreads(threads())
    seconds = [at for at, _ in _decode(source, pictures=False)]
    if not seconds:
        raise StageError(f"the video {source} cannot be decoded; convert it to H.264 in an .mp4 file")
    if len(seconds) < 3:
        raise StageError(f"the video {source} has {len(seconds)} frames, at least 3 are needed; give a longer one")
    starts = thin_out(len(seconds), step, limit)
    window_of = np.searchsorted(starts, np.arange(len(seconds)), side="right") - 1
    decoded = zip(range(len(seconds)), _decode(source, pictures=True))
    scored = ((sharpness(frame), index, frame) for index, (_, frame) in decoded if frame is not None)
    origin: Origin = {}
    for _, window in groupby(scored, lambda one: window_of[one[1]]):
        origin |= _write_frame(output, *max(window, key=lambda one: one[0]), max_width_px)
    listed = [inspect_photo(output, name) for name in sorted(origin)]
    notes, beside, count = photo_notes(listed, 0), subtitles(source), video_size(source)[0]
    if count > len(seconds):
        notes.append(f"the video says that it has {count} frames, {len(seconds)} can be decoded: it may be cut short")
    if beside is not None:
        at = [seconds[origin[photo.name]["frame"]] for photo in listed]
        positions, note = positions_in_subtitles(beside, at)
        listed = [replace(photo, **asdict(position)) for photo, position in zip(listed, positions)]
        notes.append(note)
    return listed, origin, notes


def _is_panorama(source: Path) -> bool:
    """Whether an MP4 or MOV says so, by Google's Spherical Video RFC, version 1 or 2."""
    with open(source, "rb") as file:
        while len(head := file.read(8)) == 8:
            size, kind = struct.unpack(">I4s", head)
            size = int.from_bytes(file.read(8), "big") - 8 if size == 1 else size
            if kind == b"moov":
                return re.search(rb"GSpherical:Spherical>\s*true|sv3d.{4}svhd", file.read(size), re.DOTALL) is not None
            if size < 8:  # 0 is for a box up to the end
                break
            file.seek(size - 8, os.SEEK_CUR)
    return False


def video_size(source: Path) -> tuple[int, int, int]:
    """How many frames a video says it has, their width and height as people see them; zeros where it is none."""
    video = cv2.VideoCapture(str(source))
    kinds = (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    count, width, height = (int(video.get(kind)) for kind in kinds)
    return count, width, height


def _decode(source: Path, pictures: bool) -> Iterator[tuple[float, NDArray[Any] | None]]:
    """When each frame of a video is shown (s), in order, and the frame, its pixels made square, None where it is lost;
    without `pictures` they are only counted, which is much faster."""
    video = cv2.VideoCapture(str(source))
    wide, high = (video.get(kind) or 1.0 for kind in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    try:
        while video.grab():
            frame = video.retrieve()[1] if pictures else None
            if frame is not None and wide != high:
                frame = cv2.resize(frame, None, None, min(wide / high, 1.0), min(high / wide, 1.0), cv2.INTER_AREA)
            yield video.get(cv2.CAP_PROP_POS_MSEC) / 1000, frame
    finally:
        video.release()


def _write_frame(output: Path, score: float, index: int, frame: NDArray[Any], max_width_px: int | None) -> Origin:
    height, width = frame.shape[:2]
    if max_width_px is not None and width > max_width_px:
        size = (max_width_px, round(height * (max_width_px / width)))
        frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    name = f"frame_{index:06d}.jpg"
    write_picture(output / name, np.ascontiguousarray(frame[..., ::-1], dtype=np.uint8))
    return {name: {"frame": index, "width": width, "height": height, "sharpness": round(score, 3)}}
