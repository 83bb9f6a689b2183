"""At which distances clouds are scored against truth, and what the scores are called; see `scores_at`."""

# Shares of the object's diagonal, by the ending of their keys.
THRESHOLDS = {"025pct": 0.0025, "05pct": 0.005, "1pct": 0.01, "2pct": 0.02}
SCORES = ("f_score", "precision", "recall")
