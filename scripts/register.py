"""Register two clouds of any known format on their own, without the workflow, and fuse them."""

from scenefuse.core.stage import run
from scenefuse.two_clouds.register import register

if __name__ == "__main__":
    run(register)
