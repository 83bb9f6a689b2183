"""Cut the scene around an object's fiducials."""

from scenefuse.core.stage import run
from scenefuse.crop.crop_scene import crop_scene

if __name__ == "__main__":
    run(crop_scene)
