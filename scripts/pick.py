"""Click what an object is in its photos, in a page of this machine's browser, without editing tables."""

from scenefuse.pick.pick import pick
from scenefuse.stage import run

if __name__ == "__main__":
    run(pick)
