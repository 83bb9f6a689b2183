"""List and check a scene's photos, or take frames from its video."""

from scenefuse.core.stage import run
from scenefuse.photos.frames import list_photos

if __name__ == "__main__":
    run(list_photos)
