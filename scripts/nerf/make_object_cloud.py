"""Fuse the depth maps that the last NeRF stage rendered into the object cloud."""

from scenefuse.nerf.object_cloud import make_object_cloud
from scenefuse.stage import run

if __name__ == "__main__":
    run(make_object_cloud)
