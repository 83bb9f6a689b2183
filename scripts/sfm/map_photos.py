"""Recover cameras and sparse points."""

from scenefuse.core.stage import run
from scenefuse.sfm.mapping import map_photos

if __name__ == "__main__":
    run(map_photos)
