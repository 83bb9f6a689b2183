"""Write the paper's tables beside this run's numbers."""

from scenefuse.report.compare_with_paper import compare_with_paper
from scenefuse.stage import run

if __name__ == "__main__":
    run(compare_with_paper)
