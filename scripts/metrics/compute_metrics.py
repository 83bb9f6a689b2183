"""Measure a registration and a completion."""

from scenefuse.metrics.compute_metrics import compute_metrics
from scenefuse.stage import run

if __name__ == "__main__":
    run(compute_metrics)
