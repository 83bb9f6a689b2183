"""Train one object's depth and pose networks and write its depth maps (stage 1)."""

from scenefuse.depth.train_depth import train_depth
from scenefuse.stage import run

if __name__ == "__main__":
    run(train_depth)
