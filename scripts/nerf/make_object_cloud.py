"""Fuse the depth maps that the last NeRF stage rendered into the object cloud."""

from scenefuse.core.stage import run
from scenefuse.nerf.object_cloud import make_object_cloud

if __name__ == "__main__":
    run(make_object_cloud)
