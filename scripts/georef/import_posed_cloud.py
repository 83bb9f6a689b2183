"""Take a cloud that lies in the coordinates of given cameras."""

from scenefuse.core.stage import run
from scenefuse.georef.given_cloud import import_posed_cloud

if __name__ == "__main__":
    run(import_posed_cloud)
