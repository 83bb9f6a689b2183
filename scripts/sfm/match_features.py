"""Match features between chosen pairs of photos."""

from scenefuse.core.stage import run
from scenefuse.sfm.matches import match_features

if __name__ == "__main__":
    run(match_features)
