"""What an object costs a person in the page to click in: actions and waiting, in a real Chromium, with SAM 2.

PYTHONPATH=tests python tests/benchmarks/clicking.py --photos data/bronze_statue/near --photo DSC_0354.JPG \\
    --clicks 690 180 700 370 720 520 360 590 780 650 --weights results/weights/sam2
"""

import os
import shutil
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path

from support.browser import chromium
from support.clicking_page import LOCAL, MASK, Page, served

from scenefuse.core.stage import run
from scenefuse.photos.photo_files import photo_files, upright_size

PATIENCE_S = 900
ACTION_S = 2.0
"""Of a person, for one action."""
OTHER_ACTIONS = (
    *("scenefuse init", "photos into a folder", "a row of scenes.tsv", "a row of objects.tsv"),
    *("scenefuse pick", "choose the photo", "snakemake"),
)
CHOOSE = "[...document.querySelectorAll('.thumb .name')].find((e) => e.innerText === given[0]).click();"
SHOWN = "return document.querySelector('.thumb.here .name')?.innerText === given[0];"
CHANGED = f"const m = document.querySelector('{MASK}'); return !!m?.naturalWidth && m.src !== given[0];"


def clicking(*, photos: Path, photo: str, clicks: tuple[float, ...], weights: Path, count: int | None = None) -> None:
    """Print how long the page makes one wait, its server's memory, and the time of one object at 2 s an action.

    Args:
        photos: folder of an object's photos.
        photo: the one that is clicked in.
        clicks: x y x y ... in its pixels.
        weights: folder of SAM 2's `encoder.ort` and `decoder.onnx`.
        count: fill up the folder to so many photos, by copies under other names.
    """
    with tempfile.TemporaryDirectory() as temporary, chromium(LOCAL, "--window-size=1366,768") as browser:
        folder = Path(temporary)
        _project(folder, photos, weights, count)
        start = time.monotonic()
        with served(folder, "thing") as (address, server):
            page = Page(browser, folder / "prompts.tsv", address, upright_size(photos / photo))
            opened, page.patience_s = time.monotonic() - start, PATIENCE_S
            page.until(
                "return [...document.querySelectorAll('.thumb .name')].some((e) => e.innerText === given[0]);", photo
            )
            browser.value(CHOOSE, photo)
            page.until(SHOWN, photo)
            waits = [_click(page, *at) for at in zip(clicks[::2], clicks[1::2])]
            memory = _memory_mb(server.pid)
            page.until("return !document.body.innerText.includes('Looking for the sharpest');")
            sorted_after = time.monotonic() - start
        print(f"{len(list((folder / 'close').iterdir()))} photos of {' x '.join(map(str, page.size))}")
        print(f"page and first photo after {opened:.1f} s, all thumbnails after {sorted_after:.1f} s")
        print(f"from each click to its mask: {', '.join(f'{wait:.2f}' for wait in waits)} s; server {memory:.0f} MB")
        actions, waiting = len(OTHER_ACTIONS) + len(waits), opened + sum(waits)
        print(
            f"{actions} actions at {ACTION_S:g} s and {waiting:.1f} s of waiting: {ACTION_S * actions + waiting:.0f} s"
        )


def _project(folder: Path, photos: Path, weights: Path, count: int | None) -> None:
    """A project of one object without a scene."""
    (folder / "close").mkdir()
    files = photo_files(photos)
    for k, path in enumerate(islice(cycle(files), count or len(files))):
        shutil.copyfile(path, folder / "close" / (path.name if k < len(files) else f"{k:03d}_{path.name}"))
    (folder / "results/weights").mkdir(parents=True)
    shutil.copytree(weights, folder / "results/weights/sam2", copy_function=os.symlink)
    (folder / "objects.tsv").write_text("object\tphotos\tprompts\nthing\tclose\tprompts.tsv\n")
    (folder / "scenes.tsv").write_text("scene\tphotos\n")
    frames = f"object: {{ frames: {{ max_frames: {count or len(files)} }} }}\n"
    (folder / "mine.yaml").write_text(f"scenes: scenes.tsv\nobjects: objects.tsv\n{frames}")


def _click(page: Page, x: float, y: float) -> float:
    """Click, and wait for another mask than before; seconds."""
    before = page.browser.value(f"return document.querySelector('{MASK}')?.src ?? '';")
    page.click(x, y)
    start = time.monotonic()
    page.until(CHANGED, before)
    return time.monotonic() - start


def _memory_mb(process: int) -> float:
    """The greatest resident memory of a process so far, MB."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    run(clicking)
