"""Add the registered object to the scene."""

from scenefuse.fusion import fuse
from scenefuse.stage import run

if __name__ == "__main__":
    run(fuse)
