"""Estimate depth and normal maps for one chunk of a scene's photos."""

from scenefuse.core.stage import run
from scenefuse.mvs.depth_maps import estimate_depth_maps

if __name__ == "__main__":
    run(estimate_depth_maps)
