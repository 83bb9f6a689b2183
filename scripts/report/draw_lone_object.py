"""Draw the figures of an object that lies in no scene."""

from scenefuse.report.figures import draw_lone_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(draw_lone_object)
