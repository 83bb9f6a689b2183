"""Judge a scene of the demo against its truth."""

from demo.evaluate import evaluate_scene
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(evaluate_scene)
