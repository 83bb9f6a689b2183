"""Render the demo's photos around one object."""

from demo.capture import render_object
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(render_object)
