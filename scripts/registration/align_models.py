"""Align the object's sparse model with the scene's by features that their photos share."""

from scenefuse.registration.shared_features.align_models import align_models
from scenefuse.stage import run

if __name__ == "__main__":
    run(align_models)
