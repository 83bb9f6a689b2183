"""Train a NeRF of one object on posed photos on its own, without the workflow."""

from scenefuse.core.stage import run
from scenefuse.nerf.train_nerf import train_nerf

if __name__ == "__main__":
    run(train_nerf)
