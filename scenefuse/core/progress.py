"""How a training is doing: running means of its losses, rates, and lines to print."""

import time
from collections.abc import Callable

import numpy as np

SECONDS_BETWEEN_LINES = 5.0
# A line shows the mean of so many steps: one step's losses jump.
STEPS_IN_A_LINE = 20
# The summary is taken over the last tenth of the steps, where the learning rate hardly changes anything any more.
SUMMARY_SHARE = 10

Terms = dict[str, float]


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
        return self._means(max(1, self.steps // SUMMARY_SHARE)) | {
            "steps": float(self.steps),
            "seconds": elapsed,
            "rays_per_second": self.rays / elapsed,
            "samples_per_second": self.samples / elapsed,
        }

    def _line(self, done: int, elapsed: float) -> str:
        left = elapsed / (done - self.first) * (self.steps - done)
        means = " ".join(f"{name} {mean:.4g}" for name, mean in self._means(STEPS_IN_A_LINE).items())
        speed = f"{self.rays / elapsed:.0f} rays/s {self.samples / elapsed:.0f} samples/s"
        return f"step {done}/{self.steps} {means} | {speed}, {left:.0f} s left"

    def _means(self, last: int) -> Terms:
        recent = self.history[-last:]
        names = dict.fromkeys(name for terms in recent for name in terms)
        return {name: float(np.mean([terms[name] for terms in recent if name in terms])) for name in names}
