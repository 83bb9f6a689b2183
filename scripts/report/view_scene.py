"""Write the 3D view of a scene."""

from scenefuse.core.stage import run
from scenefuse.report.scene_figures import view_scene

if __name__ == "__main__":
    run(view_scene)
