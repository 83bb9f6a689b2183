"""Click an object's landmarks in photos of the demo."""

from scenefuse.demo.prompts import click_object
from scenefuse.stage import run

if __name__ == "__main__":
    run(click_object)
