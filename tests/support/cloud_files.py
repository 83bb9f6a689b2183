"""Clouds at real coordinates, and files of them that other programs write."""

import numpy as np
import pye57

# A place in Germany, zone 32 (EPSG:32632), metres.
UTM = np.array([500_000.0, 5_572_094.0, 300.0])


def write_e57(path, scans, **options):
    """Write an E57 file of scans: points (N, 3), colours (N, 3), quaternion w x y z and position of the scanner."""
    file = pye57.E57(str(path), mode="w")
    for points, colors, rotation, translation in scans:
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T.astype(np.float64)))
        columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colors.T)) | options
        file.write_scan_raw(columns, rotation=rotation, translation=translation)
    file.close()
