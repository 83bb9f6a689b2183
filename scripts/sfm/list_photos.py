"""List and check the photos of a folder."""

from scenefuse.sfm.photos import list_photos
from scenefuse.stage import run

if __name__ == "__main__":
    run(list_photos)
