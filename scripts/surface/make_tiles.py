"""Make 3D Tiles of a completed scene: its points, and the surfaces of its objects."""

from scenefuse.core.stage import run
from scenefuse.surface.tiles import make_tiles

if __name__ == "__main__":
    run(make_tiles)
