"""Train depth and pose networks by the paper and chain its poses (stage 1)."""

from scenefuse.core.stage import run
from scenefuse.paper.estimate_as_paper import estimate_as_paper

if __name__ == "__main__":
    run(estimate_as_paper)
