"""Find SIFT features in every photo."""

from scenefuse.sfm.features import extract_features
from scenefuse.stage import run

if __name__ == "__main__":
    run(extract_features)
