"""Cut the scene around an object's fiducials."""

from scenefuse.registration.crop.crop_scene import crop_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(crop_scene)
