"""Fuse a scene's depth maps into its dense cloud."""

from scenefuse.core.stage import run
from scenefuse.mvs.dense_cloud import fuse_depth_maps

if __name__ == "__main__":
    run(fuse_depth_maps)
