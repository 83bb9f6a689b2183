"""Recover cameras and sparse points."""

from scenefuse.sfm.mapping import map_photos
from scenefuse.stage import run

if __name__ == "__main__":
    run(map_photos)
