"""Click an object's landmarks in photos of the demo."""

from demo.clicks import click_points
from scenefuse.core.stage import run

if __name__ == "__main__":
    run(click_points)
