"""Fuse the depth maps that the last NeRF stage rendered into the object cloud."""

from scenefuse.objects.cloud import object_cloud
from scenefuse.stage import run

if __name__ == "__main__":
    run(object_cloud)
