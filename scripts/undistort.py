"""Undistort the photos of a sparse model."""

from scenefuse.scenes.undistort import undistort
from scenefuse.stage import run

if __name__ == "__main__":
    run(undistort)
