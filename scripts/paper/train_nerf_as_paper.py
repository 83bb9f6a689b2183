"""Train a NeRF of one object by the paper (stages 2 and 4)."""

from scenefuse.core.stage import run
from scenefuse.paper.train_nerf_as_paper import train_nerf_as_paper

if __name__ == "__main__":
    run(train_nerf_as_paper)
