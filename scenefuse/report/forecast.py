"""What a run will take: time, memory and disk space, forecast before its first job."""

import contextlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from PIL.ExifTags import IFD

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.photos.frames import video_size
from scenefuse.photos.photo_files import open_picture, photo_files, subtitles, thin_out, upright_size
from scenefuse.report.values import bytes_in, size_text

# Bytes that a feature takes in both databases of a model, with its matches; a pixel of a photo in its copies as JPEG; a
# pixel of a scene's depth, normal and confidence maps, with its share of the clouds; a pixel of an object's maps of
# stages 1 to 4, with its share of the registration and the pictures. Fitted to what the demo took (docs/results.md).
BYTES = {"feature": 450, "photo": 2, "scene": 24, "object": 60}
# Seconds of one core, fitted to the demo's benchmarks. A job's start with its small work.
JOB_S = 4.0
# A megapixel that is searched for features, enlarged ones too; two photos, times the features of both; a photo in the
# mapping, times its features.
FEATURES_S, PAIR_S, MAPPING_S = 0.3, 6e-9, 7e-4
# A megapixel of a scene's depth maps, and one of any maps in each job that reads them.
STEREO_S, MAPS_S = 3.5, 1.5
MAP_READERS = {
    "scene": ("fuse_depth_maps", "estimate_scene_spread"),
    "object": ("estimate_depth_prior", "refine_depth", "make_object_cloud", "fuse_object", "find_missing"),
}
MASK_S = {"sam2": 13.0, "grabcut": 0.9}
# A ray of a NeRF.
RAY_S = 5.5e-5
# The clock's time, over processor seconds shared by all cores: jobs that wait for each other leave some idle.
IDLE_FACTOR = 1.15
# A forecast is right within this factor: what is short by more cannot do.
ERROR_FACTOR = 1.5
# Its file in the folder of logs, and columns.
FORECAST, COLUMNS = "forecast.tsv", ["benchmark", "seconds"]


@dataclass(frozen=True)
class Photos:
    """Photos of a scene or an object, as far as the forecast needs to know them.

    Attributes:
        count: of the photos that are used.
        width, height: pixels of the first, as it is turned.
        with_gps: whether the first has a position.
    """

    count: int
    width: int
    height: int
    with_gps: bool

    def megapixels(self, longest_px: float) -> float:
        """Megapixels of all photos, scaled down until their longer side has so many pixels."""
        return self.count * self.width * self.height * min(1.0, longest_px / max(self.width, self.height)) ** 2 / 1e6

    @staticmethod
    def of(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> "Photos | None":
        """Those of a table's row, also those that the demo is yet to render; None for a cloud, and for what cannot be
        read."""
        if not row.get("photos"):
            return None
        if Path(row["photos"]).is_relative_to("results/demo") and not Path(row["photos"]).exists():
            flight, orbit = settings["demo"]["flight"], settings["demo"]["orbit"]
            count = flight["columns"] * flight["rows"] + flight["obliques"] if kind == "scene" else orbit["views"]
            width = (flight if kind == "scene" else orbit)["width_px"]
            return Photos(count, width, round(0.75 * width), kind == "scene")
        source, frames = Path(row["photos"]), settings[kind]["frames"]
        try:
            if source.is_file():
                count, width, height = video_size(source)
                with_gps = subtitles(source) is not None
            else:
                files = photo_files(source)
                count, (width, height) = len(files), upright_size(files[0])
                with open_picture(files[0]) as first:
                    with_gps = bool(first.getexif().get_ifd(IFD.GPSInfo))
        except StageError:
            return None
        if kind == "object" or source.is_file():
            count = len(thin_out(count, frames.get("frame_step", 1), frames["max_frames"]))
        return Photos(count, width, height, with_gps) if count else None


def disk_bytes(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> int | None:
    """Bytes that a scene or an object from photos will take, or None where they are not known (`Photos.of`).

    With a cloud beside the photos there are no maps.

    Args:
        kind: `scene` or `object`.
        row: its row of the table.
        settings: its settings.
    """
    photos, own = Photos.of(kind, row, settings), settings[kind]
    if photos is None:
        return None
    if kind == "scene":
        kept, mapped = own["undistort"]["max_size_px"], own["depth_maps"]["max_image_size_px"]
        mapped = min(kept, mapped)
    else:
        longer = max(photos.width, photos.height) / photos.width
        kept, mapped = own["frames"]["max_width_px"] * longer, own["nerf"]["width_px"] * longer
    maps = 0.0 if row.get("cloud") else BYTES[kind] * photos.megapixels(mapped)
    features = photos.count * BYTES["feature"] * own["features"]["max_features"]
    return round(1e6 * (BYTES["photo"] * photos.megapixels(kept) + maps) + features)


def job_seconds(kind: str, row: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, float]:
    """Seconds of one core that the larger jobs of a scene or an object will take, by rule; the others take `JOB_S`.

    Empty where they are not known (`Photos.of`).
    """
    photos, own = Photos.of(kind, row, settings), settings[kind]
    if photos is None:
        return {}
    searched = photos.megapixels(own["features"]["max_image_size_px"]) * 4.0 ** -own["features"]["first_octave"]
    features, pairs = own["features"]["max_features"], _pairs(photos, own["matches"])
    model = {
        f"extract_{kind}_features": FEATURES_S * searched,
        f"match_{kind}_features": PAIR_S * pairs * features**2,
        f"map_{kind}_photos": MAPPING_S * photos.count * features,
    }
    if kind == "scene":
        maps = photos.megapixels(own["depth_maps"]["max_image_size_px"])
        work = {"estimate_depth_maps": STEREO_S * maps / own["chunks"]}
    else:
        maps = photos.megapixels(own["nerf"]["width_px"] * max(photos.width, photos.height) / photos.width)
        rays = own["nerf"]["rays_per_epoch"]
        work = {
            "make_masks": MASK_S["grabcut" if own["masks"]["method"] == "grabcut" else "sam2"] * photos.count,
            "train_object_nerf": RAY_S * own["stage2"]["epochs"] * rays,
            "retrain_object_nerf": RAY_S * own["stage4"]["epochs"] * rays,
        }
    work |= dict.fromkeys(MAP_READERS[kind], MAPS_S * maps)
    return {rule: JOB_S + seconds for rule, seconds in (model if row.get("cloud") else model | work).items()}


def _pairs(photos: Photos, matches: Mapping[str, Any]) -> float:
    """How many pairs of photos are compared; of neighbours, more than half are mutual."""
    from scenefuse.sfm.matches import MatchSettings  # loads COLMAP and Numba

    choice, every = MatchSettings(**matches), photos.count * (photos.count - 1) / 2
    by_gps = photos.with_gps and choice.pairs in ("auto", "spatial") and photos.count >= choice.spatial_from
    if not by_gps and (choice.pairs == "exhaustive" or photos.count <= choice.exhaustive_up_to):
        return every
    return min(every, 0.6 * photos.count * choice.neighbours)


def forecast_lines(
    seconds: Mapping[str, float],
    cores: int,
    memory_mb: Mapping[str, int],
    available_mb: int,
    needed: Mapping[Path, int | None],
    keep_maps: bool,
) -> list[str]:
    """What a run will take and whether that is there, in sentences.

    Args:
        seconds: of one core, by rule, of all jobs that will run.
        cores: that jobs share.
        memory_mb: largest request of a job, by rule.
        available_mb: memory of the machine.
        needed: bytes by folder of results, which need not exist; None where they are unknown.
        keep_maps: whether maps stay; otherwise less disk is needed at a time.

    Raises:
        StageError: the disk is too small even if the forecast is too large by its usual error.
    """
    total = sum(seconds.values())
    largest = sorted(seconds, key=lambda rule: -seconds[rule])[:3]
    most = max(memory_mb, key=lambda rule: memory_mb[rule])
    lines = [
        f"time: about {duration(IDLE_FACTOR * total / cores)} on {cores} {'core' if cores == 1 else 'cores'} like the"
        f" demo's; most of it for {', '.join(largest)}",
        f"memory: up to {size_text(1e6 * memory_mb[most])} in one job ({most})",
    ]
    unknown = [folder.name for folder, size in needed.items() if size is None]
    if unknown:
        lines[0] += f"; without those that have no photos: {', '.join(unknown)}"
    if memory_mb[most] > available_mb:
        lines[1] += f", and this machine has {size_text(1e6 * available_mb)}: set fewer pixels or features for it"
    return lines + _disk(needed, keep_maps)


def _disk(needed: Mapping[Path, int | None], keep_maps: bool) -> list[str]:
    known = {folder: size for folder, size in needed.items() if size is not None}
    if not known:
        return []
    there = next(path for path in next(iter(known)).absolute().parents if path.exists())
    taken = {folder: bytes_in(folder) for folder in known}
    free, more = shutil.disk_usage(there).free, sum(max(0, size - taken[folder]) for folder, size in known.items())
    amount = "about" if keep_maps else "less than, as maps go (keep_maps: false),"
    line = (
        f"disk: scenes and objects will take {amount} {size_text(sum(known.values()))}"
        f" ({size_text(sum(taken.values()))} now), {size_text(free)} are free"
    )
    advice = "free some space, or set `keep_maps: false`" if keep_maps else "free some space, or run fewer at a time"
    if more > free * ERROR_FACTOR and keep_maps:
        raise StageError(f"{line}; that cannot do: {advice}")
    return [line + (f"; that is too little: {advice}" if more > free else "")]


def duration(seconds: float) -> str:
    """Hours and minutes, as people write them."""
    hours, minutes = divmod(max(1, round(seconds / 60)), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def write_forecast(path: Path, seconds: Mapping[str, float]) -> None:
    """Write the seconds that the jobs of a run will take, by their benchmark's file."""
    with atomic_file(path) as temporary:
        pd.DataFrame(sorted(seconds.items()), columns=COLUMNS).to_csv(
            temporary, sep="\t", index=False, float_format="%.1f"
        )


def read_forecast(path: Path) -> dict[str, float]:
    """What `write_forecast` wrote; empty where nothing is, or nothing that can be read."""
    try:
        table = pd.read_csv(path, sep="\t")
        return dict(zip(table[COLUMNS[0]].astype(str), table[COLUMNS[1]].astype(float)))
    except (OSError, ValueError, KeyError):
        return {}


def seconds_left(forecast: Mapping[str, float], folder: Path, started: float, cores: int) -> float:
    """Seconds of the clock that a run will still take, by its forecast and the processor seconds of its jobs so far.

    Args:
        forecast: seconds of one core, by the benchmark's file of each job of the run.
        folder: that the run works in.
        started: when it started, as files' dates have it.
        cores: that jobs share.
    """
    taken, done = 0.0, 0.0
    for name, seconds in forecast.items():
        file = folder / name
        # While Snakemake writes it, a file is empty.
        with contextlib.suppress(OSError, ValueError, KeyError):
            if file.stat().st_mtime >= started:
                # Snakemake measures nothing of a job of less than a moment.
                taken += float(pd.to_numeric(pd.read_csv(file, sep="\t")["cpu_time"], errors="coerce").fillna(0).sum())
                done += seconds
    total = sum(forecast.values())
    # What is left takes longer than forecast, as what is done did; the more is done, the more is known of that.
    slower = (taken + total - done) / total if total else 1.0
    return IDLE_FACTOR * slower * (total - done) / cores
