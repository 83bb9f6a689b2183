"""Draw the figures of one object."""

from scenefuse.stage import run
from scenefuse.viz.figures import object_figures

if __name__ == "__main__":
    run(object_figures)
