"""Render the demo's photos around one object."""

from scenefuse.core.stage import run
from scenefuse.demo.capture import render_object

if __name__ == "__main__":
    run(render_object)
