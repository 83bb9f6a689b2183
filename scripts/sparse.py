"""Recover cameras and sparse points."""

from scenefuse.scenes.mapping import map_incremental
from scenefuse.stage import run

if __name__ == "__main__":
    run(map_incremental)
