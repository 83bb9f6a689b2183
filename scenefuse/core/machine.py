"""What this machine has, the CPU threads that a stage's libraries use, and the memory that photos take."""

import contextlib
import os
import shutil
import sys
from pathlib import Path
from typing import Any

# Limits of a container, of control groups version 2 and 1.
MEMORY_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_mb() -> int:
    """Memory of the machine, or of the container that this runs in, in megabytes."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for file in MEMORY_LIMITS:
        text = file.read_text().strip() if file.is_file() else ""
        limits += [int(text)] if text.isdigit() else []
    return min(limits) // 10**6


def has_gpu() -> bool:
    """Whether an NVIDIA card is there: its driver's device files, or its tool (as under WSL)."""
    return any(Path("/dev").glob("nvidia[0-9]*")) or shutil.which("nvidia-smi") is not None


def has_screen() -> bool:
    """Whether a program that is started here can open a window."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def megapixels(folder: Path, width_px: int | None = None) -> float:
    """Millions of pixels of the pictures in a folder, each on a sheet that holds the widest and the highest.

    Args:
        folder: of them; only their headers are read. What is no picture takes nothing.
        width_px: the widest is scaled down to this.
    """
    # Every run of the workflow imports this module; few come here.
    from PIL import Image

    sizes = []
    for path in sorted(folder.glob("[!.]*")):
        with contextlib.suppress(OSError), Image.open(path) as picture:
            sizes.append(picture.size)
    widest, highest = (max(sides, default=0) for sides in (zip(*sizes) if sizes else ((), ())))
    scale = min(1.0, width_px / widest) if width_px and widest else 1.0
    return len(sizes) * widest * highest * scale**2 / 1e6


def use_threads(count: int) -> None:
    """Let PyTorch (where the stage has imported it), Numba (where it is installed) and OpenCV use `count` threads each.

    PyTorch takes seconds to import; imported before Numba starts its threads, both use the OpenMP that it brought.
    """
    import cv2

    torch: Any = sys.modules.get("torch")
    numba: Any = None
    with contextlib.suppress(ImportError):
        import numba

    cv2.setNumThreads(count)
    if numba is not None:
        # PyTorch's threads wait busily for a while: Numba uses the same ones, or the two would take each other's cores.
        numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]
        numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))
    if torch is not None:
        torch.set_num_threads(count)  # last, since Numba changes it when it starts
