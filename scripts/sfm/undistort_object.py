"""Undistort an object's frames and find its up direction."""

from scenefuse.sfm.undistort_object import undistort_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(undistort_object)
