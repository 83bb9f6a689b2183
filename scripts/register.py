"""Register two clouds of any known format on their own, without the workflow."""

from scenefuse.registration.register import register
from scenefuse.stage import run

if __name__ == "__main__":
    run(register)
