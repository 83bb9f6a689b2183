"""Undistort the photos of a sparse model."""

from scenefuse.core.stage import run
from scenefuse.mvs.undistort import undistort_photos

if __name__ == "__main__":
    run(undistort_photos)
