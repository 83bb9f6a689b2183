"""A page in one file: style, script, pictures and 3D views in it, no network, readable on paper.

Markup, style and script are files in assets/; K3D-jupyter's front end draws the views.
"""

import base64
import io
import json
import zlib
from html import escape
from importlib import metadata
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import yaml
from matplotlib import colormaps
from matplotlib.colors import to_hex
from PIL import Image

from scenefuse.core.stage import StageError
from scenefuse.report.values import asset, length
from scenefuse.report.view import LEVELS, REMOVED, Shown, View, encode
from scenefuse.report.view_mesh import ViewMesh, encode_mesh
from scenefuse.surface.mesh import FaceClass

# Colours of the scene, then of its objects in turn.
SOURCE_COLORS = ("#c4c9ce", "#f07819", "#2f7fbf", "#3d9a5f", "#a45fb0", "#c9a227", "#4bb3b8", "#d1647f")
REMOVED_COLOR, UNKNOWN_COLOR = "#b3261e", "#dfe2e5"
# Colour and label of each number of the field `evidence`.
EVIDENCE: dict[int, tuple[str, str]]
# The same of the classes of faces.
CLASSES: dict[int, tuple[str, str]]
EVIDENCE, CLASSES = (yaml.safe_load(asset("report.yaml"))[name] for name in ("evidence", "classes"))
Mode = dict[str, Any]


def document(title: str, body: list[str], has_views: bool) -> str:
    """An HTML page of these parts; with what draws 3D views, if it has some."""
    names = ("page", "view") if has_views else ("page",)
    style, script = ("".join(asset(f"{name}.{kind}") for name in names) for kind in ("css", "js"))
    content = "\n".join([*body, *([_view_library()] if has_views else [])])
    return Template(asset("page.html")).substitute(title=escape(title), style=style, body=content, script=script)


def embedded(path: Path, alt: str) -> str:
    """An <img> that holds the picture, as WebP: a third of the PNG's size; StageError where it is none."""
    try:
        with Image.open(path) as opened:
            size, data = opened.size, webp(opened)
    except OSError as error:
        raise StageError(f"{path} is not a readable picture ({error}); draw the figures again") from None
    return f'<img src="data:image/webp;base64,{data}" width="{size[0]}" height="{size[1]}" alt="{escape(alt)}">'


def webp(image: Image.Image) -> str:
    """A picture as WebP in base64."""
    buffer = io.BytesIO()
    image.convert("RGB").save(buffer, format="WEBP", quality=85, method=4)
    return base64.b64encode(buffer.getvalue()).decode()


def figure(path: Path, caption: str) -> str:
    """A picture with its caption."""
    return f'<figure class="sheet">{embedded(path, caption)}<figcaption>{escape(caption)}</figcaption></figure>'


def view_section(key: str, name: str, view: View, mesh: ViewMesh | None = None, scale_sd: float = 0.0) -> str:
    """One 3D view: stage, buttons, legend, its points and its mesh.

    Args:
        key: tells the views of a page apart.
        name: of what it shows, for labels.
        view: the points; few enough for a page.
        mesh: of the completed object in the view's frame.
        scale_sd: relative standard deviation of lengths by the scale, as far as it is known.
    """
    about, planes = encode(view)
    about["scale_sd"] = scale_sd
    deviations = about.get("deviation")
    about["modes"] = modes = _modes(view, deviations)
    buttons = {mode["name"]: mode["button"] for mode in modes}
    whens, triangles, picture = {"before": "Before", "after": "After"}, b"", ""
    if mesh is not None:
        whens["surface"] = "Mesh"
        middle = (view.cloud.points.min(0) + view.cloud.points.max(0)) / 2
        about["surface"], triangles = encode_mesh(mesh, middle, deviations)
        own = _mesh_modes(mesh, [mode for mode in modes if mode["name"] == "deviation"])
        about["surface"] |= {"modes": own, "name": name}
        buttons |= {mode["name"]: mode["button"] for mode in own}
        picture = "" if mesh.picture is None else webp(mesh.picture)
    return Template(asset("view.html")).substitute(
        name=escape(name),
        # An object by itself has no before and after.
        no_surface=" hidden" if mesh is None else "",
        one_cloud="" if (view.cloud.fields["shown"] != Shown.BOTH).any() else " hidden",
        whens=_choice(f"when-{key}", whens, "after" if mesh is None else "surface"),
        colours=_choice(f"colour-{key}", buttons, modes[0]["name"]),
        # A closing tag inside JSON would end the script element.
        about=json.dumps(about).replace("</", "<\\/"),
        points=base64.b64encode(planes).decode(),
        triangles=base64.b64encode(triangles).decode(),
        picture=picture,
    )


def _view_library() -> str:
    """K3D-jupyter's front end with its licences, packed, for a page that has views."""
    import k3d

    package = Path(k3d.__file__).parent
    source = (package / "static/standalone.js").read_bytes()
    packed = base64.b64encode(zlib.compress(source, 9)).decode()
    licence = metadata.distribution("k3d").read_text("licenses/LICENSE.txt") or "MIT licence"
    notices = (package / "static/standalone.js.LICENSE.txt").read_text(encoding="utf-8")
    credit = f"K3D-jupyter {k3d.__version__}\n{licence.strip()}\nIn it:\n{notices.strip()}"
    return f'<!-- {credit.replace("--", "- -")} -->\n<script type="text/plain" id="k3d">{packed}</script>'


def _choice(group: str, options: dict[str, str], chosen: str) -> str:
    """Radio buttons that look like one row of buttons."""
    return "".join(
        f'<label><input type="radio" name="{escape(group)}" value="{escape(option)}"'
        f"{' checked' if option == chosen else ''}><span>{escape(text)}</span></label>"
        for option, text in options.items()
    )


def _modes(view: View, deviations: list[float] | None) -> list[Mode]:
    """The ways to colour the points that the view's fields allow; the first one is chosen."""
    modes: list[Mode] = []
    other = {"color": UNKNOWN_COLOR, "label": "unknown"}
    if view.cloud.colors is not None:
        modes.append({"name": "photo", "button": "Natural", "label": "Natural colours, brightened if all are dark"})
    tints = zip(sorted(set(view.sources) - {REMOVED}), SOURCE_COLORS + SOURCE_COLORS[1:] * len(view.sources))
    sources = {code: (tint, view.sources[code]) for code, tint in tints}
    sources[REMOVED] = (REMOVED_COLOR, "scene, removed by fusion")
    modes.append({"name": "source", "button": "Source", "other": other, "entries": _entries(view, "source", sources)})
    evidence = view.cloud.fields.get("evidence", np.zeros(0))
    if ((evidence > 0) & (evidence != REMOVED)).any():
        found = _entries(view, "evidence", EVIDENCE)
        modes.append({"name": "evidence", "button": "Class", "other": other, "entries": found})
    if deviations is not None:
        ramp = [to_hex(color) for color in colormaps["viridis"](np.linspace(0, 1, LEVELS))]
        low, high = (length(end, view.unit) for end in deviations)
        entries = [{"code": k + 1, "color": color} for k, color in enumerate(ramp)]
        label = "Of a point along its line of sight, without that of the object's place"
        ends: Mode = {"ramp": ramp[::3], "low": low, "high": high, "label": label}
        modes.append({"name": "deviation", "button": "Std. deviation", "other": other, "entries": entries} | ends)
    return modes


def _mesh_modes(mesh: ViewMesh, deviation: list[Mode]) -> list[Mode]:
    """The ways to colour a mesh: photos, or the points' colours; class; standard deviation as of the points."""
    found = [
        {"code": code, "color": color, "label": label, "when": ["surface"]}
        for code, (color, label) in CLASSES.items()
        if (mesh.vertices.fields["class"] == code).any()
    ]
    other, modes = {"color": UNKNOWN_COLOR}, list[Mode]()
    if mesh.uv is not None or mesh.vertices.colors is not None:
        bridged = [entry for entry in found if entry["code"] == FaceClass.BRIDGED]
        label = "The photos on the mesh" if mesh.uv is not None else "The points' colours on the mesh"
        modes.append({"name": "photo", "button": "Natural", "label": label, "entries": bridged, "other": other})
    modes.append({"name": "evidence", "button": "Class", "entries": found, "other": other})
    return modes + deviation


def _entries(view: View, field: str, meanings: dict[int, tuple[str, str]]) -> list[Mode]:
    """The values of a field that occur, with colour, label, and the pictures in which they are seen."""
    found = []
    for code, (color, label) in meanings.items():
        shown = set(view.cloud.fields["shown"][view.cloud.fields[field] == code].tolist())
        when = [name for name, absent in (("before", Shown.AFTER), ("after", Shown.BEFORE)) if shown - {absent}]
        if when:
            found.append({"code": code, "color": color, "label": label, "when": when})
    return found
