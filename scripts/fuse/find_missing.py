"""Find what an object still lacks after fusion, and where to stand next."""

from scenefuse.core.stage import run
from scenefuse.fuse.find_missing import find_missing

if __name__ == "__main__":
    run(find_missing)
