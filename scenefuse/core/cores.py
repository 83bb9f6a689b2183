"""CPU threads of a stage, for all libraries that have their own."""

import contextlib
from typing import Any

import cv2

nb: Any = None
with contextlib.suppress(ImportError):
    import numba as nb

    # PyTorch's threads wait busily for a while: Numba uses the same ones, or the two would take each other's cores.
    nb.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]


def use_threads(count: int) -> None:
    """Let PyTorch (where it is installed), Numba and OpenCV use `count` threads each."""
    torch: Any = None
    with contextlib.suppress(ModuleNotFoundError):
        import torch  # before Numba starts its threads: it then uses the OpenMP that PyTorch brought along

    cv2.setNumThreads(count)
    if nb is not None:
        nb.set_num_threads(max(1, min(count, nb.config.NUMBA_NUM_THREADS)))
    if torch is not None:
        torch.set_num_threads(count)  # last, since Numba changes it when it starts
