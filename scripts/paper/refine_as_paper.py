"""Refine depth and pose networks by the paper on what the NeRF renders (stage 3)."""

from scenefuse.core.stage import run
from scenefuse.paper.estimate_as_paper import refine_as_paper

if __name__ == "__main__":
    run(refine_as_paper)
