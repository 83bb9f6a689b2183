"""Align the object's sparse model with the scene's by features that their photos share."""

from scenefuse.core.stage import run
from scenefuse.georef.align_models import align_models

if __name__ == "__main__":
    run(align_models)
