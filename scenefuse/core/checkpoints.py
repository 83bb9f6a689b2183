"""Long trainings: states saved and resumed, the learning rate over the steps, signals held back until a step is whole,
and lines that report progress.

Nothing here knows what is trained: a state is a dictionary of tensors, numbers, lists and dictionaries.
"""

import contextlib
import hashlib
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.stage import StageError, atomic_file, stopped_by

# A kill costs half a minute of training at most, and saving takes well under a hundredth of the time.
SAVE_EVERY_SECONDS = 30.0

SECONDS_BETWEEN_LINES = 5.0

State = dict[str, Any]
Terms = dict[str, float]


def learning_rate_factor(step: int, steps: int, warmup: float) -> float:
    """Share of the highest learning rate at a step: a linear rise, then half a cosine.

    The cosine is equation (5) of Loshchilov and Hutter, SGDR (2017), without restarts.

    Args:
        step: 0 for the first one.
        steps: of the whole training.
        warmup: steps until the highest rate, fractions allowed; less than one counts as one.
    """
    warmup = max(1.0, warmup)
    rise = min(1.0, (step + 1) / warmup)
    done = max(0.0, (step - warmup) / max(1.0, steps - warmup))
    return rise * 0.5 * (1 + math.cos(math.pi * done))


def step_generator(seed: int, step: int) -> torch.Generator:
    """Random numbers of a step, the same ones in a resumed training."""
    return torch.Generator().manual_seed(seed * 1_000_003 + step)


class Progress:
    """Collects the loss terms of every step; prints a line now and then.

    Args:
        steps: of the whole training.
        first: step that this process begins with; later than 0 where it was resumed.
        report: called with each line.
    """

    def __init__(self, steps: int, first: int, report: Callable[[str], None]) -> None:
        self.steps, self.first, self.report = steps, first, report
        self.start = self.printed = time.monotonic()
        self.history: list[Terms] = []
        self.rays = self.samples = 0

    def add(self, step: int, terms: Terms, rays: int, samples: int) -> None:
        """Count a step with its loss terms, rays and samples."""
        self.history.append(terms)
        self.rays, self.samples = self.rays + rays, self.samples + samples
        now = time.monotonic()
        if now - self.printed > SECONDS_BETWEEN_LINES or step + 1 == self.steps:
            self.printed = now
            self.report(self._line(step + 1, now - self.start))

    def summary(self) -> Terms:
        """Mean terms of the last tenth of the steps, `steps`, `seconds`, `rays_per_second`, `samples_per_second`."""
        elapsed = max(time.monotonic() - self.start, 1e-9)
        # There the learning rate hardly changes anything any more.
        return self._means(max(1, self.steps // 10)) | {
            "steps": float(self.steps),
            "seconds": elapsed,
            "rays_per_second": self.rays / elapsed,
            "samples_per_second": self.samples / elapsed,
        }

    def _line(self, done: int, elapsed: float) -> str:
        left = elapsed / (done - self.first) * (self.steps - done)
        # The mean of 20 steps: one step's losses jump.
        means = " ".join(f"{name} {mean:.4g}" for name, mean in self._means(20).items())
        speed = f"{self.rays / elapsed:.0f} rays/s {self.samples / elapsed:.0f} samples/s"
        return f"step {done}/{self.steps} {means} | {speed}, {left:.0f} s left"

    def _means(self, last: int) -> Terms:
        recent = self.history[-last:]
        names = dict.fromkeys(name for terms in recent for name in terms)
        return {name: float(np.mean([terms[name] for terms in recent if name in terms])) for name in names}


@contextlib.contextmanager
def checkpointed(path: Path | None, state: Callable[[], State]) -> Iterator[Callable[[int], None]]:
    """Yield a function to call with the number of steps done, each time a step is whole.

    It saves `state()` every half minute. SIGTERM and SIGINT are held back until it is called; then it saves and ends
    the process. A training that runs to its end leaves its last checkpoint to the caller, who removes it.

    Args:
        path: of the checkpoint; None saves nothing.
        state: called for all that a resumed training needs.

    Raises:
        StageError: weights are no longer finite, when a state is saved or at the end.
    """
    saved = time.monotonic()

    def step_done(count: int) -> None:
        nonlocal saved
        if path is not None and (signals or time.monotonic() - saved > SAVE_EVERY_SECONDS):
            save_checkpoint(path, state())
            saved = time.monotonic()
        if signals:
            print(f"error: {stopped_by(signals[0])} after step {count}", flush=True)
            sys.exit(128 + signals[0])

    with _held_back() as signals:
        yield step_done
    require_finite(state())


def save_checkpoint(path: Path, state: State) -> None:
    """Write a state under a temporary name, sync and rename it. A full disk is a printed note: training goes on.

    Raises:
        StageError: the state holds a number that is not finite; the file stays as it was.
    """
    require_finite(state)
    try:
        with atomic_file(path) as temporary, open(temporary, "wb") as file:
            torch.save(state, file)
    except (OSError, RuntimeError) as error:  # PyTorch turns a failed write into a RuntimeError
        why = " ".join(str(error).split())
        print(f"note: {path} could not be saved ({why}); training goes on, but a kill now would cost it", flush=True)


def load_checkpoint(path: Path | None, like: State) -> State | None:
    """The state that a killed run saved, on the CPU; None where there is none to go on from.

    A file that is damaged, or that holds other tensors than `like`, is a printed note: the training starts afresh.

    Args:
        path: of the checkpoint, or None.
        like: the state of the untrained networks.
    """
    if path is None or not path.is_file():
        return None
    try:
        return read_state(path, like, "training starts afresh")
    except StageError as error:
        print(f"note: {error}", flush=True)
        return None


def read_state(path: Path, like: State, advice: str) -> State:
    """A saved state, on the CPU.

    Args:
        path: of the file.
        like: what it has to hold, with tensors of these shapes and types.
        advice: what to do where it cannot be read, the end of a sentence.

    Raises:
        StageError: the file is damaged, or holds something else.
    """
    try:
        state: State = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a truncated file raises any of half a dozen
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise StageError(f"{path} cannot be read ({why}); {advice}") from None
    if not _fits(state, like):
        raise StageError(f"{path} was saved by another version; {advice}")
    return state


def key_of(*parts: Any) -> str:
    """Sixteen hex digits that change when any part or PyTorch's version does.

    Arrays and tensors count by content, dataclasses, lists and dictionaries by what they hold, others by their repr.
    A checkpoint in a folder of this name is found by no training that has other settings or inputs.
    """
    digest = hashlib.sha256(torch.__version__.encode())

    def add(part: Any) -> None:
        if is_dataclass(part) and not isinstance(part, type):
            add({field.name: getattr(part, field.name) for field in fields(part)})
        elif isinstance(part, dict):
            add([item for pair in part.items() for item in pair])
        elif isinstance(part, list | tuple):
            digest.update(f"{len(part)} parts".encode())
            for item in part:
                add(item)
        elif isinstance(part, Tensor | np.ndarray):
            array = np.ascontiguousarray(part.detach().cpu().numpy() if isinstance(part, Tensor) else part)
            digest.update(f"{array.shape} {array.dtype}".encode() + array.tobytes())
        else:
            digest.update(repr(part).encode())

    add(parts)
    return digest.hexdigest()[:16]


def require_finite(state: State) -> None:
    """Raise StageError if any tensor or number of a state is not finite."""
    if not _finite(state):
        raise StageError(
            "the training diverged: its weights are no longer finite numbers; check the photos, masks, cameras and"
            " depths it was given, and report it if they are right"
        )


def _finite(part: Any) -> bool:
    if isinstance(part, Tensor):
        return not part.is_floating_point() or bool(torch.isfinite(part).all())
    if isinstance(part, dict | list | tuple):
        return all(map(_finite, part.values() if isinstance(part, dict) else part))
    return not isinstance(part, float) or math.isfinite(part)


def _fits(state: Any, like: Any) -> bool:
    """Whether a state has every key and every tensor's shape and type of another; it may hold more."""
    if isinstance(like, dict):
        return isinstance(state, dict) and all(key in state and _fits(state[key], like[key]) for key in like)
    if isinstance(like, Tensor):
        return isinstance(state, Tensor) and (state.shape, state.dtype) == (like.shape, like.dtype)
    return isinstance(state, type(like))


@contextlib.contextmanager
def _held_back() -> Iterator[list[int]]:
    """Yield a list that SIGTERM and SIGINT are put into while it lasts; other threads than the main one get none."""
    signals: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda received, _: signals.append(received)) for number in numbers]
    try:
        yield signals
    finally:
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)
