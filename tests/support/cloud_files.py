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


def write_pcd(path, cloud, data):
    """Write a PCD, `data` binary or ascii, with double positions and packed colours, as PCL does."""
    names = ["x", "y", "z", "rgb"] + (["normal_x", "normal_y", "normal_z"] if cloud.normals is not None else [])
    kinds = ["F F F U F F F", "8 8 8 4 4 4 4", "1 1 1 1 1 1 1"]
    kinds = [" ".join(kind.split()[: len(names)]) for kind in kinds]
    header = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {kinds[1]}\nTYPE {kinds[0]}\nCOUNT {kinds[2]}\n"
    header += f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA {data}\n"
    table = np.empty(len(cloud), [(n, "<f8" if n in "xyz" else "<u4" if n == "rgb" else "<f4") for n in names])
    table["x"], table["y"], table["z"] = cloud.points.T
    table["rgb"] = cloud.colors.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    for name, values in zip(names[4:], cloud.normals.T if cloud.normals is not None else ()):
        table[name] = values
    body = (
        table.tobytes() if data == "binary" else "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode()
    )
    path.write_bytes(header.encode() + body)
