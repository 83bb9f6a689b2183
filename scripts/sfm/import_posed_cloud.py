"""Take a cloud that lies in the coordinates of given cameras."""

from scenefuse.sfm.given.cloud import import_posed_cloud
from scenefuse.stage import run

if __name__ == "__main__":
    run(import_posed_cloud)
