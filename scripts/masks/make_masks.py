"""Make a mask of the object for every photo."""

from scenefuse.masks.make_masks import make_masks
from scenefuse.stage import run

if __name__ == "__main__":
    run(make_masks)
