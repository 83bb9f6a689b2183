"""Judge an object of the demo against its truth."""

from scenefuse.core.stage import run
from scenefuse.metrics.evaluate import evaluate_object

if __name__ == "__main__":
    run(evaluate_object)
