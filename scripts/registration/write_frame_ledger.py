"""Collect the transforms between an object's frames."""

from scenefuse.registration.frame_ledger import write_frame_ledger
from scenefuse.stage import run

if __name__ == "__main__":
    run(write_frame_ledger)
