"""Train one object's depth and pose networks and write its depth maps (stage 1)."""

from scenefuse.core.stage import run
from scenefuse.nerf.train_depth import train_depth

if __name__ == "__main__":
    run(train_depth)
