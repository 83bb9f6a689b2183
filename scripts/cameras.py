"""Undistort an object's frames and find its up direction."""

from scenefuse.objects.cameras import object_cameras
from scenefuse.stage import run

if __name__ == "__main__":
    run(object_cameras)
