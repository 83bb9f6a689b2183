"""Judge an object of the demo against its truth."""

from scenefuse.metrics.evaluate_object import evaluate_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(evaluate_object)
