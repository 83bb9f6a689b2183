"""Bring a sparse model into metres, or at least upright."""

from scenefuse.sfm.georeference import georegister
from scenefuse.stage import run

if __name__ == "__main__":
    run(georegister)
