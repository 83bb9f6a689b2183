"""Measure a completed scene."""

from scenefuse.core.stage import run
from scenefuse.metrics.compute_metrics import compute_scene_metrics

if __name__ == "__main__":
    run(compute_scene_metrics)
