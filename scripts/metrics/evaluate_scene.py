"""Judge a scene of the demo against its truth."""

from scenefuse.metrics.evaluate_scene import evaluate_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(evaluate_scene)
