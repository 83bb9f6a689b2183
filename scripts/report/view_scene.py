"""Write the 3D view of a scene."""

from scenefuse.report.view.view_scene import view_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(view_scene)
