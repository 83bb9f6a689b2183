"""Find or copy the camera poses that an object's training stages use."""

from scenefuse.poses.find_poses import find_poses
from scenefuse.stage import run

if __name__ == "__main__":
    run(find_poses)
