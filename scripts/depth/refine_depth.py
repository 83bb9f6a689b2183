"""Refine one object's depth networks with the depth its NeRF renders (stage 3)."""

from scenefuse.depth.refine_depth import refine_depth
from scenefuse.stage import run

if __name__ == "__main__":
    run(refine_depth)
