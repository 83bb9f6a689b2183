"""Write the paper's tables beside this run's numbers."""

from scenefuse.core.stage import run
from scenefuse.paper.compare_with_paper import compare_with_paper

if __name__ == "__main__":
    run(compare_with_paper)
