"""Find the object's pose in the scene, and register or reject it."""

from scenefuse.core.stage import run
from scenefuse.register.register_object import register_object

if __name__ == "__main__":
    run(register_object)
