"""Surfaces of the demo's objects against the truth: python tests/benchmarks/surface.py --results results

For each object: F-scores of the completed cloud and of its surface, the share of the true surface that it closes, the
error of bridged faces, shares of the area, how far its elevations are off, PSNR of held-out photos' right halves
beside the NeRF's (gain fitted on the left; holes count), and processor time. Both are rendered on black. Masks by SAM
2 hold pieces of the background, which the NeRF learns and no surface has, and pixels at an outline are part
background: so PSNR is also of pixels that lie wholly in the true mask and show the front of a face that is not
bridged. The back of a wall shows what is painted on its front: the inside of the balloon's basket, dark and seen by
few photos, has no surface of its own.
"""

import csv
import resource
from pathlib import Path

import cv2
import numpy as np

from demo import textures
from demo.capture import light_of
from demo.evaluate import read_object_truth, scene_scores, surface_to_find
from demo.truth import SAMPLES, Mesh, distances, read_cameras, sample_surface
from demo.world import World, build_world, openness
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Array, Sim3
from scenefuse.fuse.compare import MARGIN
from scenefuse.mvs.undistort import undistort_picture
from scenefuse.photos.pictures import read_gray, read_rgb
from scenefuse.photos.workspace import read_cameras as cameras_of
from scenefuse.surface.drawings import SIDES, draw, pixel_of
from scenefuse.surface.gltf import read_painted
from scenefuse.surface.make_surface import SurfaceInputs, mesh_of, placed_views, read_surface, surface_report
from scenefuse.surface.mesh import FaceClass, cast, caster
from scenefuse.surface.texture import textured

FOLD = 8
# Samples along a pixel's side in true elevations; side of the squares that are compared.
SAMPLES_OF_A_PIXEL, SQUARE_PX = 3, 32


def seconds() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


def spread(surface, count: int) -> np.ndarray:
    points = surface.vertices.points
    middle = points.mean(0)
    return middle + sample_surface(Mesh((points - middle).astype(np.float32), surface.faces.astype(np.int32)), count, 0)


def rendered(view, painted) -> tuple[np.ndarray, np.ndarray]:
    """The (H, W, 3) picture of a painted surface, and where it shows the front of a face that is not bridged."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(view.intrinsics).T
    surface = painted.surface
    rays = rays @ view.cam_from_world[:3, :3]
    hit = cast(caster(surface.vertices.points, surface.faces), view.centre, rays)
    on = np.flatnonzero(np.isfinite(hit["t_hit"]))
    face, uv = hit["primitive_ids"][on].astype(int), hit["primitive_uvs"][on]
    weights = np.column_stack([1 - uv.sum(1), uv])[..., None]
    side = len(painted.picture)
    at = np.floor((painted.uv[face] * weights).sum(1) * side).astype(int).clip(0, side - 1)
    picture = np.zeros((view.height * view.width, 3))
    picture[on] = painted.picture[at[:, 1], at[:, 0]]
    shown = np.zeros(len(picture), dtype=bool)
    front = (hit["primitive_normals"][on] * rays[on]).sum(1) < 0
    shown[on[front & (surface.classes[face] != FaceClass.BRIDGED)]] = True
    return picture.reshape(view.height, view.width, 3), shown.reshape(view.height, view.width)


def psnr(folder: Path, truth: Path, found, views) -> Array:
    """(2, 3) of held-out photos, in the mask and on the object where it is shown: PSNR in dB of the texture and of the
    NeRF, and the share of the mask's or the object's pixels."""
    own = [k for k, (workspace, _) in enumerate(views) if workspace == folder / "undistorted"]
    held_out = own[FOLD // 2 :: FOLD]
    rest = [views[k] for k in range(len(views)) if k not in held_out]

    painted = textured(found, [view for _, view in rest], lambda k: read_rgb(rest[k][0] / "images" / rest[k][1].name))
    scores, taken = [], cameras_of(folder / "sparse")
    for workspace, view in (views[k] for k in held_out):
        name = f"{Path(view.name).stem}.png"
        true = undistort_picture(read_gray(truth / "masks" / name), taken[view.name], view)
        picture, shown = rendered(view, painted)
        # At the size that the NeRF renders.
        nerf = read_rgb(folder / "stage4/renders" / name).astype(np.float32)
        size = nerf.shape[1::-1]
        photo = _shrunk(read_rgb(workspace / "images" / view.name), size)
        on = _shrunk(shown, size) > 0.999
        own_mask, whole = _shrunk(read_gray(folder / "masks" / name) > 127, size), _shrunk(true > 127, size) > 0.999
        for fitted, mask, of in ((own_mask > 0.999, own_mask > 0.5, own_mask > 0.5), (whole, whole & on, whole)):
            left, right, of = fitted & on, mask.copy(), of.copy()
            left[:, size[0] // 2 :], right[:, : size[0] // 2], of[:, : size[0] // 2] = False, False, False
            for one in (_shrunk(picture, size), nerf):
                gain = np.exp(np.median(np.log(np.maximum(photo[left], 1) / np.maximum(one[left], 1)), axis=0))
                off = (np.clip(gain * one, 0, 255) - photo) ** 2
                scores.append(10 * np.log10(255**2 / off[right].mean()))
            scores.append(100 * right.sum() / of.sum())
    return np.reshape(scores, (-1, 2, 3)).mean(0)


def _shrunk(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def elevation_errors(folder: Path, world: World, open_sky: np.ndarray, place: Sim3) -> tuple[Array, Array]:
    """How far the four elevations of an object are off, in their pixels: the true edges of the object, from the nearest
    edge drawn; and what a square of the picture shows, of each that lies on the object wholly.

    An edge is where the depth changes by more than MARGIN of the diagonal between two pixels, or something ends.
    """
    whole, painted = read_surface(folder / "surface.ply"), read_painted(folder / "surface.glb")
    pixel, edges, shifts = pixel_of(whole, painted), [], []
    turn = np.radians(value(read_json(folder / "drawings/drawings.json"), "wall_turn"))
    turned = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    for right, up in (axes for side, axes in SIDES.items() if side != "above"):
        axes = np.array([right, up, np.cross(right, up)]) @ turned
        drawing = draw(whole, painted, axes, pixel)
        shape, pixel = drawing.classes.shape, drawing.pixel
        along = whole.vertices.points @ axes[2]
        # As many samples of a pixel as photos have, for the same smooth edges.
        fine = SAMPLES_OF_A_PIXEL * np.array(shape)
        rows, columns = (np.arange(n) + 0.5 for n in fine)
        x, y = np.meshgrid(columns, rows)
        x, y = drawing.left + x * pixel / SAMPLES_OF_A_PIXEL, drawing.top - y * pixel / SAMPLES_OF_A_PIXEL
        origins = place.apply(np.stack([x, y, np.full(x.shape, along.max())], axis=-1) @ axes)
        rays = np.concatenate([origins, np.broadcast_to(place.rotate(-axes[2]), origins.shape)], axis=-1)
        # Samples of a pixel next to each other.
        n = SAMPLES_OF_A_PIXEL
        rays = rays.reshape(shape[0], n, shape[1], n, 6).swapaxes(1, 2).reshape(-1, 6).astype(np.float32)
        depth_m = place.scale * np.ptp(along)
        light, owners, distance = light_of(world, rays, shape, open_sky, place.scale * pixel / depth_m, 0.0)
        distance = np.where(distance <= depth_m, distance, np.inf)
        margin, owner = MARGIN * whole.vertices.diagonal, world.owner(folder.name)
        middle = n * n // 2
        true = outline(distance[..., middle] / place.scale, margin) & (owners[..., middle] == owner)
        # From inside the ground, which rises before an object, one sees its foundations.
        true &= origins[n // 2 :: n, n // 2 :: n, 2] >= world.bounds(folder.name)[0, 2]
        ours = outline(np.where(np.isnan(drawing.heights), np.inf, along.max() - drawing.heights), margin)
        edges.append(cv2.distanceTransform((~ours).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[true])
        picture = np.zeros((*shape, 3), np.uint8)
        textures.encode(picture, light)
        on = ((owners == owner) & np.isfinite(distance)).all(-1) & (drawing.classes == FaceClass.MEASURED)
        shifts.append(displacements(drawing.colors[..., :3], picture, on))
    return np.concatenate(edges), np.concatenate(shifts)


def outline(depth: np.ndarray, margin: float) -> np.ndarray:
    """Pixels (H, W) nearer than a neighbour by more than a margin; a depth is infinite where nothing is."""
    padded = np.pad(depth, 1, constant_values=np.inf)
    around = [padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]]
    return np.isfinite(depth) & (np.max(around, axis=0) > depth + margin)


def displacements(picture: np.ndarray, true: np.ndarray, on: np.ndarray) -> np.ndarray:
    """Pixels by which what a picture shows lies beside the truth, of each square that is shown wholly."""
    a, b = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY).astype(np.float32) for one in (picture, true))
    window, found = cv2.createHanningWindow((SQUARE_PX, SQUARE_PX), cv2.CV_32F), []
    for row in range(0, len(a) - SQUARE_PX + 1, SQUARE_PX):
        for column in range(0, a.shape[1] - SQUARE_PX + 1, SQUARE_PX):
            square = slice(row, row + SQUARE_PX), slice(column, column + SQUARE_PX)
            if on[square].all():
                (dx, dy), _ = cv2.phaseCorrelate(a[square], b[square], window)
                found.append(np.hypot(dx, dy))
    return np.array(found)


def median_and_90(values: np.ndarray) -> str:
    return "; ".join(f"{number:.1f}" for number in np.percentile(values, [50, 90]))


def f_scores(scores: dict[str, dict[str, float]]) -> str:
    return "; ".join(f"{scores[at]['f_score']:.3f}" for at in ("025pct", "05pct", "1pct"))


def row(results: Path, name: str, world: World, open_sky: np.ndarray) -> dict[str, str]:
    folder, scene, truth = results / "objects" / name, results / "scenes/demo", results / "demo/demo/truth"
    fused, own = folder / "fused.ply", folder / "undistorted"
    cloud, start = read_cloud(fused), seconds()
    inputs = SurfaceInputs(fused, folder / "fusion.json", own, scene / "undistorted")
    views = placed_views(inputs)
    found = mesh_of(inputs, views)
    mesh_s, start = seconds() - start, seconds()
    in_mask, on_object = psnr(folder, truth / name, found, views)
    texture_s = seconds() - start
    known = read_object_truth(folder / "undistorted", truth / "scene", truth / name, SAMPLES, 0)
    place = Sim3.from_matrix(np.array(value(read_json(scene / "truth.json"), "truth_from_scene")))
    surface = surface_to_find(known, read_cameras(truth / "scene/cameras.json"))
    scores = [scene_scores(place.apply(p), known, surface) for p in (cloud.points, spread(found, 400_000))]
    bridged = place.apply(spread(found.part(found.classes == FaceClass.BRIDGED), 20_000))
    error = np.minimum(*(distances(mesh.caster(), bridged) for mesh in (known.mesh, known.rest))) / known.diagonal
    report = surface_report(found, "m")
    edges, shifts = elevation_errors(folder, world, open_sky, place)
    return {
        "measure": name,
        "completed cloud, F at 0.25 %; 0.5 %; 1 %": f_scores(scores[0]),
        "surface, the same": f_scores(scores[1]),
        "area measured; plain; unconfirmed; bridged; open (%)": "; ".join(
            f"{100 * value(report, share):.1f}" for share in ("measured", "plain", "unconfirmed", "bridged", "open")
        ),
        "seen surface closed to 0.5; 1 (%)": "; ".join(
            f"{100 * scores[1][at]['recall']:.1f}" for at in ("05pct", "1pct")
        ),
        "bridged area within 1 % (%)": f"{100 * (error <= 0.01).mean():.1f}",
        "elevations: edges off; picture off, median; 90 % (px)": f"{median_and_90(edges)}; " + median_and_90(shifts),
        "held-out PSNR in the mask, texture; NeRF (dB)": "; ".join(f"{dB:.1f}" for dB in in_mask[:2]),
        "the same on the object's front; its share (%)": "; ".join(f"{number:.1f}" for number in on_object),
        "processor time, mesh; texture (s)": f"{mesh_s:.0f}; {texture_s:.0f}",
    }


def surface(
    *,
    results: Path = Path("results"),
    table: Path = Path("docs/results/surface.tsv"),
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    seed: int = 0,
) -> None:
    """Write the table.

    Args:
        results: of a finished demo and `scenefuse export`.
        table: output, TSV with a column for each object.
        objects: their names.
        seed: of the demo.
    """
    world = build_world(seed)
    open_sky = openness(world, 24, seed)
    rows = [row(results, name, world, open_sky) for name in objects]
    with open(table, "w", newline="") as file:
        writer = csv.writer(file, delimiter="\t", lineterminator="\n")
        for measure in rows[0]:
            writer.writerow([measure, *(one[measure] for one in rows)])


if __name__ == "__main__":
    run(surface)
