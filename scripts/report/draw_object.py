"""Draw the figures of one object."""

from scenefuse.core.stage import run
from scenefuse.report.figures import draw_object

if __name__ == "__main__":
    run(draw_object)
