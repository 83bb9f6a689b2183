"""Train a NeRF of one object on posed photos on its own, without the workflow."""

from scenefuse.nerf.train_nerf import train_nerf
from scenefuse.stage import run

if __name__ == "__main__":
    run(train_nerf)
