"""Estimate how far a sparse model may be bent."""

from scenefuse.core.stage import run
from scenefuse.georef.spread import estimate_spread

if __name__ == "__main__":
    run(estimate_spread)
