"""Undistort the photos of a sparse model."""

from scenefuse.sfm.undistort import undistort_photos
from scenefuse.stage import run

if __name__ == "__main__":
    run(undistort_photos)
