"""Find what an object still lacks after fusion, and where to stand next."""

from scenefuse.fusion.find_missing import find_missing
from scenefuse.stage import run

if __name__ == "__main__":
    run(find_missing)
