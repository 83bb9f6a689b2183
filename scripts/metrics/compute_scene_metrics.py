"""Measure a completed scene."""

from scenefuse.metrics.compute_scene_metrics import compute_scene_metrics
from scenefuse.stage import run

if __name__ == "__main__":
    run(compute_scene_metrics)
