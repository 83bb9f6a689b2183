"""Draw a scene with its cameras and objects."""

from scenefuse.stage import run
from scenefuse.viz.figures import scene_figure

if __name__ == "__main__":
    run(scene_figure)
