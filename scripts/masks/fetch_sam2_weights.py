"""Fetch SAM 2's weights."""

from scenefuse.masks.sam2_weights import fetch_sam2_weights
from scenefuse.stage import run

if __name__ == "__main__":
    run(fetch_sam2_weights)
