"""Stage 3 of an object: photos correct the depth that the NeRF rendered, for the NeRF to be trained again on it."""

import time
from pathlib import Path

from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, threads, value, write_json
from scenefuse.nerf.prior.confirmed import confirm, read_stage_maps, write_prior
from scenefuse.photos.views import load_views


def refine_depth(
    *, workspace: Path, masks: Path, rendered: Path, stage: Path, report: Path, width_px: int, hold_out_every: int
) -> None:
    """Move rendered depth to where the training photos match, and mark what other views confirm (method N12).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        rendered: stage 2's folder, with depth_maps/.
        stage: output folder: depth_maps/{photo}.bin and confidence_maps/{photo}.bin (0..1).
        report: output JSON: shares of the depths that photos moved, contradicted, confirmed.
        width_px: width of the rendered maps.
        hold_out_every: as in stage 1.

    Raises:
        StageError: no photo of the object has a rendered depth.
    """
    start = time.monotonic()
    use_threads(threads())
    views = load_views(workspace, masks, width_px, hold_out_every)
    depths = read_stage_maps(rendered / "depth_maps", views)
    if not depths.any():
        raise StageError(f"{rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    prior, content = confirm(views, depths)
    with atomic_directory(stage) as folder:
        write_prior(folder, views, prior)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"photos moved {value(content, 'refined_share'):.0%} of the rendered depths", flush=True)
