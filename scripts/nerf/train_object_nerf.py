"""Train the depth-guided NeRF of one object: stages 2 and 4."""

from scenefuse.core.stage import run
from scenefuse.nerf.train_object_nerf import train_object_nerf

if __name__ == "__main__":
    run(train_object_nerf)
