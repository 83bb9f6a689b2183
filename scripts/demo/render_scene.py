"""Render the demo's mapping flight."""

from scenefuse.core.stage import run
from scenefuse.demo.capture import render_scene

if __name__ == "__main__":
    run(render_scene)
