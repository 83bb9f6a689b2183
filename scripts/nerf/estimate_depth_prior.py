"""Estimate the depth of each of one object's photos (stage 1)."""

from scenefuse.core.stage import run
from scenefuse.nerf.depth_prior import estimate_depth_prior

if __name__ == "__main__":
    run(estimate_depth_prior)
