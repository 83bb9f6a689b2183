"""Judge an object of the demo against its truth."""

from demo.evaluate import evaluate_object
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(evaluate_object)
