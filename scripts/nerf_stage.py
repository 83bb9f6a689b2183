"""Train the depth-guided NeRF of one object: stages 2 and 4."""

from scenefuse.objects.train_nerf import train_nerf
from scenefuse.stage import run

if __name__ == "__main__":
    run(train_nerf)
