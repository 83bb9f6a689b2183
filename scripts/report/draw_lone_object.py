"""Draw the figures of an object that lies in no scene."""

from scenefuse.core.stage import run
from scenefuse.report.figures import draw_lone_object

if __name__ == "__main__":
    run(draw_lone_object)
