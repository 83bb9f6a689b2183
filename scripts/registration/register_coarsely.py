"""Find hypotheses of the object's pose in the scene."""

from scenefuse.registration.coarse import register_coarsely
from scenefuse.stage import run

if __name__ == "__main__":
    run(register_coarsely)
