"""Train depth and pose networks by the paper and chain its poses (stage 1)."""

from scenefuse.paper.estimate_as_paper import estimate_as_paper
from scenefuse.stage import run

if __name__ == "__main__":
    run(estimate_as_paper)
