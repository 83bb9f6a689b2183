"""Render the demo's photos around one object."""

from scenefuse.demo.capture import render_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(render_object)
