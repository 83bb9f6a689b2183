"""Render the demo's mapping flight."""

from demo.capture import render_scene
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(render_scene)
