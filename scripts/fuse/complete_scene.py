"""Fuse all registered objects of a scene into one cloud."""

from scenefuse.core.stage import run
from scenefuse.fuse.write import complete_scene

if __name__ == "__main__":
    run(complete_scene)
