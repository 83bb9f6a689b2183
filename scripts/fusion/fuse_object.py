"""Add the registered object to the scene."""

from scenefuse.fusion.fuse_object import fuse_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(fuse_object)
