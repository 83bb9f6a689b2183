"""Fuse all registered objects of a scene into one cloud."""

from scenefuse.fusion.complete_scene import complete_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(complete_scene)
