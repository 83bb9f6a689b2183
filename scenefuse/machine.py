"""What this machine has, for the limits of jobs that run on it side by side. Standard library only."""

import os
import shutil
from pathlib import Path

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
