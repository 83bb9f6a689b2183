"""Click an object's landmarks in photos of the demo."""

from scenefuse.core.stage import run
from scenefuse.demo.prompts import click_object

if __name__ == "__main__":
    run(click_object)
