"""Write the cameras of a scene and its objects in one frame."""

from scenefuse.core.stage import run
from scenefuse.surface.cameras import export_cameras

if __name__ == "__main__":
    run(export_cameras)
