"""Real scenes laid on each other by their clouds alone, measured against the photos that they share.

snakemake --configfile config/examples/two_walks/config.yaml --cores 2
python tests/benchmarks/two_walks.py --results results --pictures results/two_walks
"""

from pathlib import Path

import numpy as np

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import run, value
from scenefuse.core.transforms import Sim3, rotation_angle_deg
from scenefuse.georef.align_models import AlignmentSettings, align_landmarks
from scenefuse.georef.landmarks import read_landmarks
from scenefuse.register.register_object import draw_alignment
from scenefuse.two_clouds.find import RegistrationSettings, find_in_scene

PAIRS = {"south_building": ("walk2", "walk1"), "rock": ("boulder_section", "boulder")}
UP = np.array([0.0, 0.0, 1.0])


def two_walks(*, results: Path, pictures: Path) -> None:
    """Print the decision of the clouds, the alignment of the photos, and how far they are apart.

    Args:
        results: the results folder of the workflow.
        pictures: folder for the clouds on each other, by clouds and by photos.
    """
    pictures.mkdir(parents=True, exist_ok=True)
    for name, pair in PAIRS.items():
        folders = [results / "scenes" / part for part in pair]
        obj, scene = (read_cloud(folder / "dense.ply") for folder in folders)
        found = find_in_scene(obj, scene, RegistrationSettings(), 0, ups=(UP, UP), marked=True)[0]
        ours, theirs = (read_landmarks(folder / "georeferenced", folder / "features.db") for folder in folders)
        alignment = align_landmarks(ours, theirs, AlignmentSettings(), 0)
        print(f"{name}, {len(obj)} points in {len(scene)}")
        print(f"  clouds  {'registered' if found.registered else 'unregistered'}: {found.reason}")
        print(f"  photos  {'found' if value(alignment, 'found') else 'not found'}: {value(alignment, 'reason')}")
        if found.scene_from_object is not None:
            draw_alignment(pictures / f"{name}_clouds.png", obj, scene, found.scene_from_object, 0)
        if not value(alignment, "found"):
            continue
        pose = Sim3.from_matrix(np.array(value(alignment, "scene_from_object")))
        draw_alignment(pictures / f"{name}_photos.png", obj, scene, pose, 0)
        if found.scene_from_object is not None:
            centre, diagonal = obj.points.mean(0), obj.diagonal * pose.scale
            shift = np.linalg.norm(found.scene_from_object.apply(centre) - pose.apply(centre)) / diagonal
            turn = rotation_angle_deg(found.scene_from_object.rotation @ pose.rotation.T)
            scale = found.scene_from_object.scale / pose.scale - 1
            print(f"  apart   scale {scale:+.2%}, rotation {turn:.2f} degrees, shift {shift:.2%} of the diagonal")


if __name__ == "__main__":
    run(two_walks)
