"""Refine one object's depth networks with the depth its NeRF renders (stage 3)."""

from scenefuse.core.stage import run
from scenefuse.nerf.rendered_maps import refine_depth

if __name__ == "__main__":
    run(refine_depth)
