"""Register an object by the paper's recipe."""

from scenefuse.registration.paper import register_as_paper
from scenefuse.stage import run

if __name__ == "__main__":
    run(register_as_paper)
