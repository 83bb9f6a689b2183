"""Draw the figures of one object."""

from scenefuse.report.figures import draw_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(draw_object)
