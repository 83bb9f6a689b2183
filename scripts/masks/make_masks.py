"""Make a mask of the object for every photo."""

from scenefuse.core.stage import run
from scenefuse.masks.make_masks import make_masks

if __name__ == "__main__":
    run(make_masks)
