"""Estimate how far a sparse model may be bent."""

from scenefuse.sfm.bundle.spread import estimate_spread
from scenefuse.stage import run

if __name__ == "__main__":
    run(estimate_spread)
