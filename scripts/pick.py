"""Click what an object is in its photos, in a page of this machine's browser, without editing tables."""

from scenefuse.core.stage import run
from scenefuse.pick.pick import pick

if __name__ == "__main__":
    run(pick)
