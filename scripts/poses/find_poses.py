"""Find or copy the camera poses that an object's training stages use."""

from scenefuse.core.stage import run
from scenefuse.poses.find_poses import find_poses

if __name__ == "__main__":
    run(find_poses)
