"""Estimate the object's scale in the scene, and find hypotheses of its pose there."""

from scenefuse.core.stage import run
from scenefuse.register.coarse import register_coarsely

if __name__ == "__main__":
    run(register_coarsely)
