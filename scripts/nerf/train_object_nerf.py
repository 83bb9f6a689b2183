"""Train the depth-guided NeRF of one object: stages 2 and 4."""

from scenefuse.nerf.train_object_nerf import train_object_nerf
from scenefuse.stage import run

if __name__ == "__main__":
    run(train_object_nerf)
