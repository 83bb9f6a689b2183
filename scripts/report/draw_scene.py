"""Draw a scene with its cameras and objects."""

from scenefuse.core.stage import run
from scenefuse.report.scene_figures import draw_scene

if __name__ == "__main__":
    run(draw_scene)
