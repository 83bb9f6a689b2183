"""Render the demo's mapping flight."""

from scenefuse.demo.capture import render_scene
from scenefuse.stage import run

if __name__ == "__main__":
    run(render_scene)
