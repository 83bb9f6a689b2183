"""Refine, audit and accept or refuse the object's pose."""

from scenefuse.core.stage import run
from scenefuse.register.fine import register_finely

if __name__ == "__main__":
    run(register_finely)
