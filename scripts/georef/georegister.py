"""Bring a sparse model into metres, or at least upright."""

from scenefuse.core.stage import run
from scenefuse.georef.georeference import georegister

if __name__ == "__main__":
    run(georegister)
