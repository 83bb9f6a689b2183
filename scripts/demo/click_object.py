"""Click an object's landmarks in photos of the demo."""

from scenefuse.core.stage import run
from scenefuse.demo.clicks import click_object

if __name__ == "__main__":
    run(click_object)
