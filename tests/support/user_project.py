"""A working directory of a user's own, and what Snakemake plans in it."""

import re
from pathlib import Path

import cv2
import numpy as np
import yaml

from scenefuse.cloud.clouds import Cloud, write_cloud

CLICKS = "label\tphoto\tx_px\ty_px\n" + "".join(f"inside\t0.jpg\t{x}\t20\n" for x in (20, 30, 40))
"""Clicks on an object, in a photo of `Project.photos`."""
HEADER = "object\tscene\tphotos\tfiducials\tprompts\tmasks\n"


def planned(output: str) -> set[str]:
    """Rules that a dry run lists."""
    return set(re.findall(r"^([a-z0-9_]+) +\d+$", output, re.MULTILINE)) - {"total"}


def write_clouds(path: Path) -> None:
    """A project of clouds alone: the yard, in it a house, and a shed of a single point, which fails."""
    rng = np.random.default_rng(0)
    for name, count in (("yard", 2000), ("house", 500), ("shed", 1)):
        write_cloud(path / f"{name}.ply", Cloud(rng.uniform(0, 9, (count, 3))))
    (path / "scenes.tsv").write_text("scene\tcloud\nyard\tyard.ply\n")
    (path / "objects.tsv").write_text("object\tscene\tcloud\nhouse\tyard\thouse.ply\nshed\tyard\tshed.ply\n")
    (path / "mine.yaml").write_text(yaml.safe_dump({"scenes": "scenes.tsv", "objects": "objects.tsv"}))


def film(path: Path, frames: int = 12, size: tuple[int, int] = (128, 96)) -> Path:
    """A video of noise, four frames a second, and DJI's subtitles of a flight east beside it; returns its path."""
    rng, video = np.random.default_rng(0), cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 4.0, size)
    for _ in range(frames):
        blocks = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
        video.write(cv2.resize(blocks, size, interpolation=cv2.INTER_NEAREST))
    video.release()
    times = [f"00:00:{index / 4:06.3f}".replace(".", ",") for index in range(frames + 1)]
    stated = (f"[latitude: 47.5] [longitude: {8 + k / 1e4:.6f}] [rel_alt: 9 abs_alt: {400 + k}]" for k in range(frames))
    shown = zip(range(1, frames + 1), times, times[1:], stated)
    path.with_suffix(".SRT").write_text("\n".join(f"{k}\n{a} --> {b}\n{text}\n" for k, a, b, text in shown))
    return path


class Project:
    """A working directory of a user's own: the scene yard, and in it the shed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config: dict = {"scenes": "scenes.tsv", "objects": "objects.tsv"}
        # Fetches nothing.
        self.config["object"] = {"masks": {"method": "grabcut"}}
        self.scenes = "scene\tphotos\nyard\tflight\n"
        self.objects = HEADER + "shed\tyard\tclose\tclicks.tsv\tprompts.tsv\t\n"

    def photos(self, folder: str, count: int = 5) -> None:
        """Make a folder with this many photos of noise."""
        (self.path / folder).mkdir()
        rng = np.random.default_rng(0)
        for index in range(count):
            picture = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            cv2.imwrite(str(self.path / folder / f"{index}.jpg"), picture)

    def clicked(self, objects: int) -> None:
        """Photos on both sides, and so many objects that are clicked in both."""
        self.photos("flight")
        self.photos("close")
        for name in ("clicks.tsv", "prompts.tsv"):
            (self.path / name).write_text(CLICKS)
        self.objects = HEADER + "".join(f"shed{k}\tyard\tclose\tclicks.tsv\tprompts.tsv\t\n" for k in range(objects))

    def write(self) -> Path:
        """Write tables and settings; returns the settings file."""
        (self.path / "scenes.tsv").write_text(self.scenes)
        (self.path / "objects.tsv").write_text(self.objects)
        (self.path / "mine.yaml").write_text(yaml.safe_dump(self.config))
        return self.path / "mine.yaml"
