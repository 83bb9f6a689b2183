"""Draw a completed object from above and from four sides."""

from scenefuse.core.stage import run
from scenefuse.surface.drawings import draw_surface

if __name__ == "__main__":
    run(draw_surface)
