"""Find SIFT features in every photo."""

from scenefuse.core.stage import run
from scenefuse.sfm.features import extract_features

if __name__ == "__main__":
    run(extract_features)
