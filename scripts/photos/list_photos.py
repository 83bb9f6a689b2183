"""List and check the photos of a folder."""

from scenefuse.core.stage import run
from scenefuse.photos.photos import list_photos

if __name__ == "__main__":
    run(list_photos)
