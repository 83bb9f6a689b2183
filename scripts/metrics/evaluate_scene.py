"""Judge a scene of the demo against its truth."""

from scenefuse.core.stage import run
from scenefuse.metrics.evaluate import evaluate_scene

if __name__ == "__main__":
    run(evaluate_scene)
