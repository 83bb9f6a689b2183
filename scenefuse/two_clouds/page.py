"""The pages of a registration of two clouds: its decision, numbers and 3D view; of a refusal, one to draw a box in."""

import json
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from PIL import Image

from scenefuse.cloud.clouds import Cloud, voxel_downsample
from scenefuse.core.stage import atomic_file, value
from scenefuse.core.transforms import UP, Array, Sim3, inside_box, rotation_between
from scenefuse.photos.sheets import TILE_PX
from scenefuse.report.page import document, figure, view_section, webp
from scenefuse.report.render import Camera, point_radii, render
from scenefuse.report.values import asset, flatten, number
from scenefuse.report.view import REACH, View, view_of
from scenefuse.two_clouds.complete import Completed

ROWS = {
    "scale": "scale",
    "scale_sd_log": "its standard deviation (log)",
    "rotation_sd_deg": "standard deviation of the rotation",
    "translation_sd": "standard deviation of the position",
    "f_score": "F-score",
    "margin": "margin to the best other pose",
    "agreement.fitness": "share of the scene part with an object point within tau",
    "agreement.fitness_source": "share of the object with a scene point within tau",
    "agreement.inlier_rmse": "distance of these (RMS)",
    "agreement.tau": "tau",
    "evidence": "what the decision rests on",
    "searched": "searched",
    "version": "scenefuse",
}
"""Quantities of transform.json that the page lists."""


def write_page(
    page: Path, content: dict[str, Any], unit: str, picture: Path, done: Completed | None, up: Array | None
) -> None:
    """Write one HTML file that needs no other and no network.

    Args:
        page: output.
        content: of transform.json.
        unit: of the scene's lengths.
        picture: of the alignment; left out where no pose was found.
        done: the scene completed; None where the pose was refused.
        up: (3,) unit up direction in the scene; z where it is not known.
    """
    inputs, status = value(content, "inputs"), value(content, "status")
    names = Path(inputs["object"]).name, Path(inputs["scene"]).name
    title = f"{names[0]} in {names[1]}"
    badge = f'<span class="badge {"ok" if status == "registered" else "no"}">{escape(status)}</span>'
    parts = [f"<h1>{escape(title)}{badge}</h1>", f"<p>{escape(value(content, 'reason'))}</p>"]
    if done is None:
        parts.append(f"<p>The pose was refused, so there is no completed scene. {escape(value(content, 'next'))}.</p>")
    else:
        scene_points = inputs["scene_points"] - len(done.removed)
        parts.append(_changes(done, scene_points, unit))
        parts.append(view_section("scene", title, view_of_scene(names[0], done, up, unit)))
    if picture.is_file():
        caption = "From above, from the front and from the side: scene grey, object orange; below in their own colours."
        parts.append(figure(picture, caption))
    parts += [f"<p>Note: {escape(note)}.</p>" for note in value(content, "notes")]
    parts.append(_table(content))
    if "scene_from_object" in content:
        rows = "\n".join(" ".join(f"{cell:.17g}" for cell in row) for row in value(content, "scene_from_object"))
        refused = "" if done is not None else ", of the refused pose: not to be used"
        parts.append(f"<h2>x_scene = M x_object{refused}</h2><pre>{rows}</pre>")
    with atomic_file(page) as temporary:
        temporary.write_text(document(title, parts, done is not None), encoding="utf-8")


def write_box_page(page: Path, scene: Cloud, up: Array | None, boxes: list[Array], command: str) -> None:
    """Write a page that shows a scene along an axis and gives the command with the --crop-box that is drawn in it.

    Args:
        page: output, one HTML file.
        scene: to draw in, in its file's coordinates.
        up: (3,) unit up direction there. The scene is seen along the axis that is nearest to it, else along the one in
            which it reaches least.
        boxes: (2, 3) corners of places to propose.
        command: to which the box is added.
    """
    low, high = scene.points.min(0), scene.points.max(0)
    along = int(np.argmin(high - low) if up is None else np.abs(up).argmax())
    axes = [axis for axis in range(3) if axis != along]
    toward = np.zeros(3)
    toward[along] = 1.0 if up is None or up[along] > 0 else -1.0
    upward = np.eye(3)[axes[1]]
    right = np.cross(upward, toward)
    # Free space around it, so that a rectangle can go around what lies at its border.
    size_px = 3 * TILE_PX[0]
    pixel = 1.1 * float(max((high - low)[axes].max(), 1e-9)) / size_px
    width, height = (int(side) for side in np.ceil((high - low)[axes] / pixel + 0.1 * size_px))
    middle = (low + high) / 2
    away = middle + ((high - low)[along] + pixel) * toward
    camera = Camera(np.array([right, -upward, -toward]), away, 1 / pixel, width, height, orthographic=True)
    thinned = voxel_downsample(scene, pixel, mean_colors=True)
    heights = thinned.points[:, along] * toward[along]
    # Without colours, by height.
    ends = np.percentile(heights, [2, 98])
    by_height = colormaps["viridis"](Normalize(ends[0], ends[1], clip=True)(heights), bytes=True)[:, :3]
    colors = by_height if thinned.colors is None else thinned.colors
    picture = render(thinned, camera, point_radii(thinned.points), colors)
    steps = np.array([right[axes[0]] * pixel, -pixel])
    decimals = max(0, int(np.ceil(-np.log10(pixel))))
    about = {
        "axes": axes,
        "corner": (middle[axes] - steps * [width / 2, height / 2]).tolist(),
        "step": steps.tolist(),
        "heights": [float(low[along]) - pixel, float(high[along]) + pixel],
        "decimals": decimals,
        "places": [box.tolist() for box in boxes],
        "command": command,
    }
    buttons = [f'<button type="button">Place {k + 1}</button>' for k in range(len(boxes))]
    body = Template(asset("box.html")).substitute(
        title="Where is the object?",
        axis="xyz"[along],
        places=f"Places that look like it: {''.join(buttons)}" if boxes else "",
        picture=webp(Image.fromarray(picture)),
        width=width,
        height=height,
        about=json.dumps(about).replace("</", "<\\/"),
    )
    with atomic_file(page) as temporary:
        temporary.write_text(document("Where is the object?", [body], False), encoding="utf-8")


def view_of_scene(name: str, done: Completed, up: Array | None, unit: str) -> View:
    """The 3D view of the completed scene around what was added, before and after."""
    level = Sim3(1.0, rotation_between(UP if up is None else up, UP), np.zeros(3))
    added = done.added if len(done.added) else done.before
    corners = np.percentile(added.points, [0.5, 99.5], axis=0)
    middle = np.floor(corners.mean(0))
    level = level @ Sim3(1.0, np.eye(3), -middle)
    reach = (0.5 + REACH) * float(np.linalg.norm(corners[1] - corners[0]))
    before, after = (
        cloud[inside_box(cloud.points, middle - reach, middle + reach)].transformed(level)
        for cloud in (done.before, done.after)
    )
    low, high = np.percentile(added.transformed(level).points, [0.5, 99.5], axis=0)
    numbers = np.unique(after.fields.get("source", np.zeros(1, np.int64))).tolist()
    names = {0: "scene", done.source: f"added from {name}"}
    sources = {code: names.get(code, f"{code} in the scene") for code in numbers}
    return view_of(before, after, low, high, sources, unit, -60.0)


def _changes(done: Completed, scene_points: int, unit: str) -> str:
    """What became of the scene, in a paragraph."""
    removed = len(done.removed)
    text = [
        f"{len(done.added):,} points of the object were added to {scene_points:,} of the scene"
        + (f", {removed:,} of which were taken away" if removed else "; none was taken away")
        + f"; what lies within {number(done.fill_distance)}{_unit(unit)} of the scene's points counts as one place",
        *done.notes,
    ]
    return f"<p>{escape('; '.join(text))}. <code>source</code> of completed.ply: 0 scene, {done.source} object.</p>"


def _table(content: dict[str, Any]) -> str:
    """The quantities of ROWS that there are."""
    fields = flatten(content)
    cells = [
        f'<tr><td class="text">{escape(label)}</td><td class="text">{escape(number(fields[name]["value"]))}'
        f"{escape(_unit(fields[name]['unit']))}</td></tr>"
        for name, label in ROWS.items()
        if name in fields
    ]
    return f'<h2>Numbers</h2><div class="wide"><table><tbody>{"".join(cells)}</tbody></table></div>'


def _unit(unit: str) -> str:
    """A unit behind its number; nothing for a pure number."""
    return "" if unit in ("", "1") else f" {unit}"
