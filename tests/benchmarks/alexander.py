"""The masks of config/examples/alexander beside the supplied ones, after that workflow has run; GrabCut beside SAM 2.

python tests/benchmarks/alexander.py --results results --given data/alexander/masks
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.settings import ROOT, build, read_settings
from scenefuse.core.stage import read_json, run, value
from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.masks.make_masks import MaskInputs, make_masks, supplied_masks
from scenefuse.masks.segmentation import MaskSettings
from scenefuse.photos.workspace import read_workspace
from scenefuse.report.figures import inner, upright
from scenefuse.report.render import orbit_camera, point_radii, render

EXAMPLE = ROOT / "config/examples/alexander"
WRONG = {"DSC05138.JPG"}
"""The supplied mask of this photo is another photo's."""


def alexander(*, results: Path, given: Path) -> None:
    """Print the IoU of the masks with the supplied ones (bench/alexander.tsv) and the NeRF's quality; draw the cloud.

    The supplied masks are undistorted like the photos. A photo that a method leaves out counts for neither its mean
    nor its median, and is counted beside them. GrabCut runs here, with the same prompts and cameras.

    Args:
        results: the results folder of the workflow.
        given: folder of supplied masks.
    """
    folder, shipped = results / "objects/alexander", read_settings(EXAMPLE / "config.yaml")
    views = read_workspace(folder / "undistorted").views
    supplied, _ = supplied_masks(given, folder / "sparse", views)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        make_masks(
            inputs=MaskInputs(
                workspace=folder / "undistorted", workspace_json=folder / "undistorted.json",
                sparse=folder / "sparse", photos_json=folder / "photos.json", prompts=EXAMPLE / "prompts.tsv",
            ),
            settings=build(MaskSettings, shipped["object"]["masks"] | {"method": "grabcut"}),
            seed=shipped["seed"], masks=work / "masks", contact_sheet=results / "bench/alexander_grabcut.png",
            report=work / "masks.json",
        )  # fmt: skip
        rows = []
        for method, masks in (("sam2", folder / "masks"), ("grabcut", work / "masks")):
            for name in sorted(set(supplied) - WRONG):
                mask = cv2.imread(str(masks / f"{Path(name).stem}.png"), cv2.IMREAD_GRAYSCALE)
                iou = np.nan if mask is None else mask_iou(mask > 127, supplied[name])
                rows.append({"method": method, "photo": name, "iou": iou})
    table = pd.DataFrame(rows)
    table.to_csv(results / "bench/alexander.tsv", sep="\t", index=False, float_format="%.4f")
    for method, part in table.groupby("method", sort=False):
        known = part.dropna()
        worst = known.sort_values("iou").head(5)
        listed = ", ".join(f"{photo} {iou:.3f}" for photo, iou in zip(worst.photo, worst.iou))
        print(
            f"{method}: {len(known)} of {len(part)} photos, IoU mean {known.iou.mean():.3f}, "
            f"median {known.iou.median():.3f}, above 0.95 in {(known.iou > 0.95).sum()}; least: {listed}"
        )
    for stage in ("stage2", "stage4"):
        report = read_json(folder / f"{stage}.json")
        print(
            f"{stage}: held-out PSNR inside the mask {value(report, 'psnr_held_out'):.2f} dB, SSIM "
            f"{value(report, 'ssim'):.3f}, silhouettes' IoU {value(report, 'silhouette_iou'):.3f}, "
            f"{value(report, 'photos_measured')} photos"
        )
    report = read_json(folder / "object.json")
    print(f"cloud: {value(report, 'points')} points; {value(report, 'inconsistent_share'):.1%} of depths inconsistent")
    cloud = upright(read_cloud(folder / "object.ply"), folder / "undistorted")
    framed, radii = inner(cloud.points), point_radii(cloud.points)
    sides = [render(cloud, orbit_camera(framed, a, 10, (420, 420)), radii) for a in (220, 310, 130, 40)]
    cv2.imwrite(str(results / "bench/alexander.png"), np.hstack(sides)[..., ::-1])


if __name__ == "__main__":
    run(alexander)
