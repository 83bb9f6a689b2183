"""Estimate the object's scale in the scene, and find hypotheses of its pose there."""

from scenefuse.registration.coarse import register_coarsely
from scenefuse.stage import run

if __name__ == "__main__":
    run(register_coarsely)
