"""What the paper published in its Tables 2 to 4, of its own captures, whose objects the demo's are named after."""

OBJECTS = ("house", "balloon", "sculpture")
# By measure and registration variant, in the order of OBJECTS. RMSE is in metres; no diagonal is given to divide it by.
PUBLISHED = {
    ("fitness", "full"): (0.9302, 0.9916, 0.9207),
    ("inlier_rmse", "full"): (0.0852, 0.0096, 0.0348),
    ("normal_consistency", "full"): (0.6023, 0.6210, 0.7948),
    ("surface_variation", "full"): (0.1597, 0.1897, 0.1219),
    ("nue", "full"): (1.17, 1.29, 1.21),
    ("primitive_fitting_score", "full"): (0.9984, 0.9954, 0.9975),
    ("fitness", "no_scale"): (0.3083, 0.0820, 0.3085),
    ("inlier_rmse", "no_scale"): (0.2614, 0.1810, 0.3724),
    ("normal_consistency", "no_scale"): (0.4448, 0.2196, 0.4834),
    ("fitness", "no_crop"): (0.4129, 0.5876, 0.3621),
    ("inlier_rmse", "no_crop"): (0.4424, 0.1804, 0.0655),
    ("normal_consistency", "no_crop"): (0.3056, 0.5695, 0.7373),
}


def published(name: str) -> dict[tuple[str, str], tuple[float, str]]:
    """Value and unit by measure and variant of an object of the paper's; nothing of any other."""
    if name not in OBJECTS:
        return {}
    place = OBJECTS.index(name)
    return {key: (values[place], "m" if key[0] == "inlier_rmse" else "1") for key, values in PUBLISHED.items()}
