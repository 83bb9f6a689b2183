"""Register an object by the paper's recipe."""

from scenefuse.core.stage import run
from scenefuse.paper.register_as_paper import register_as_paper

if __name__ == "__main__":
    run(register_as_paper)
