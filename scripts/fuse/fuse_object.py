"""Add the registered object to the scene."""

from scenefuse.core.stage import run
from scenefuse.fuse.fuse_object import fuse_object

if __name__ == "__main__":
    run(fuse_object)
