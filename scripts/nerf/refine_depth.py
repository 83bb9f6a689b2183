"""Correct the depth that one object's NeRF renders by the photos (stage 3)."""

from scenefuse.core.stage import run
from scenefuse.nerf.rendered_maps import refine_depth

if __name__ == "__main__":
    run(refine_depth)
