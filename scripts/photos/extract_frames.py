"""Take an object's frames from a folder of photos or a video."""

from scenefuse.core.stage import run
from scenefuse.photos.frames import extract_frames

if __name__ == "__main__":
    run(extract_frames)
