"""Train a NeRF of one object on posed photos on its own, without the workflow."""

from scenefuse.objects.nerf_alone import nerf_files
from scenefuse.stage import run

if __name__ == "__main__":
    run(nerf_files)
