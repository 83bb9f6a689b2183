"""Train a NeRF of one object by the paper (stages 2 and 4)."""

from scenefuse.paper.train_nerf_as_paper import train_nerf_as_paper
from scenefuse.stage import run

if __name__ == "__main__":
    run(train_nerf_as_paper)
