"""Refine, audit and accept or refuse the object's pose."""

from scenefuse.registration.fine import register_finely
from scenefuse.stage import run

if __name__ == "__main__":
    run(register_finely)
