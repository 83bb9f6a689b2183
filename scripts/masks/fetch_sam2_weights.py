"""Fetch SAM 2's weights."""

from scenefuse.core.stage import run
from scenefuse.masks.sam2_weights import fetch_sam2_weights

if __name__ == "__main__":
    run(fetch_sam2_weights)
