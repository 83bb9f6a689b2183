"""Judge an object of the demo against its truth."""

from scenefuse.metrics.evaluation import evaluate_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(evaluate_object)
