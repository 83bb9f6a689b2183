"""Take a cloud or mesh for a scene."""

from scenefuse.cloud.import_cloud import import_scene_cloud
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(import_scene_cloud)
