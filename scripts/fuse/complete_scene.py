"""Fuse all registered objects of a scene into one cloud."""

from scenefuse.core.stage import run
from scenefuse.fuse.complete_scene import complete_scene

if __name__ == "__main__":
    run(complete_scene)
