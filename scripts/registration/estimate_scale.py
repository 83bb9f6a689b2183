"""Estimate the object's scale in the scene."""

from scenefuse.registration.scale import estimate_scale
from scenefuse.stage import run

if __name__ == "__main__":
    run(estimate_scale)
