"""Make the surface of one completed object."""

from scenefuse.core.stage import run
from scenefuse.surface.make_surface import make_surface

if __name__ == "__main__":
    run(make_surface)
