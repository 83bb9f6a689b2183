"""Draw a scene with its cameras and objects."""

from scenefuse.report.figures import draw_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(draw_scene)
