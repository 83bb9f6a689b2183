"""Take a cloud or mesh for an object."""

from scenefuse.cloud.import_cloud import import_object_cloud
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(import_object_cloud)
