"""F-score, precision and recall of a cloud against a true surface (Knapitsch et al. 2017, section 4)."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array

# Distances at which clouds are scored, as shares of the object's diagonal, by the ending of their keys.
THRESHOLDS = {"025pct": 0.0025, "05pct": 0.005, "1pct": 0.01, "2pct": 0.02}
SCORES = ("f_score", "precision", "recall")


def f_score(
    cloud_to_truth: NDArray[np.floating], truth_to_cloud: NDArray[np.floating], tau: float
) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean at a distance `tau`."""
    precision = float((cloud_to_truth <= tau).mean()) if len(cloud_to_truth) else 0.0
    recall = float((truth_to_cloud <= tau).mean()) if len(truth_to_cloud) else 0.0
    total = precision + recall
    return precision, recall, 2 * precision * recall / total if total > 0 else 0.0


def scores_at(
    cloud_to_truth: NDArray[np.floating], truth_to_cloud: NDArray[np.floating], diagonal: float
) -> dict[str, dict[str, float]]:
    """F-score, precision and recall at each of THRESHOLDS (method G8): {"1pct": {"f_score": ..., ...}, ...}.

    Args:
        cloud_to_truth: (N,) distances of the cloud's points to the true surface.
        truth_to_cloud: (M,) distances of points on the true surface to the cloud.
        diagonal: of the object's true bounding box, in the unit of the distances.
    """
    found = {}
    for ending, share in THRESHOLDS.items():
        precision, recall, score = f_score(cloud_to_truth, truth_to_cloud, share * diagonal)
        found[ending] = dict(zip(SCORES, (score, precision, recall)))
    return found


def nearest(points: Array, cloud: Array) -> Array:
    """(N,) distance of each of (N, 3) points to the nearest point of a cloud; infinite when it is empty."""
    if len(cloud) == 0:
        return np.full(len(points), np.inf)
    return cKDTree(cloud).query(points, workers=threads())[0]
