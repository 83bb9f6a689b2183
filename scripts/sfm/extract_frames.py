"""Take an object's frames from a folder of photos or a video."""

from scenefuse.sfm.frames import extract_frames
from scenefuse.stage import run

if __name__ == "__main__":
    run(extract_frames)
