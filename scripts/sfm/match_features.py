"""Match features between chosen pairs of photos."""

from scenefuse.sfm.matches import match_features
from scenefuse.stage import run

if __name__ == "__main__":
    run(match_features)
