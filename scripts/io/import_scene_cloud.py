"""Take a cloud or mesh for a scene."""

from scenefuse.io.import_cloud import import_scene_cloud
from scenefuse.stage import run

if __name__ == "__main__":
    run(import_scene_cloud)
