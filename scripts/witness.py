"""The second witness: features that the object's photos share with the scene's."""

from scenefuse.registration.witness import find_witness
from scenefuse.stage import run

if __name__ == "__main__":
    run(find_witness)
