"""Measure a registration and a completion."""

from scenefuse.core.stage import run
from scenefuse.metrics.compute_metrics import compute_metrics

if __name__ == "__main__":
    run(compute_metrics)
