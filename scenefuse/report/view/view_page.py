"""The 3D views of the report page: their markup, colours and data, and the library that draws them, all in the page."""

import base64
import json
import zlib
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from scenefuse.report.view.view_file import LEVELS, View, encode
from scenefuse.report.view.view_points import AFTER, BEFORE, BOTH, REMOVED, UNKNOWN

Mode = dict[str, Any]

SOURCE_COLORS = ("#c4c9ce", "#f07819", "#2f7fbf", "#3d9a5f", "#a45fb0", "#c9a227", "#4bb3b8", "#d1647f")
"""Of the scene, then of its objects in turn."""
REMOVED_COLOR, UNKNOWN_COLOR = "#b3261e", "#dfe2e5"
# Told apart by every kind of colour vision (after Okabe and Ito 2008).
CLASSES = {
    0: ("#a9b1b9", "not checked"),
    1: ("#0f8a66", "measured: three photos confirm it, and its surroundings"),
    2: ("#d55e00", "not measured: of the NeRF, or a given cloud"),
    3: ("#b869a0", "not measured: of the scene's stereo"),
}


def view_section(key: str, name: str, view: View) -> str:
    """One view: stage, buttons, legend, and its points.

    Args:
        key: tells the views of a page apart.
        name: of what it shows, for labels.
        view: the points; few enough for a page.
    """
    about, planes = encode(view)
    about["modes"] = modes = _modes(view, about.get("deviation"))
    # Of an object by itself there is nothing to compare.
    changes = (view.cloud.fields["shown"] != BOTH).any()
    whens = [("before", "Before"), ("after", "After")]
    tools = (
        _choice(key, "when", "Show", whens, "after", hidden=not changes)
        + _choice(key, "colour", "Colours", [(m["name"], m["button"]) for m in modes], modes[0]["name"])
        + '<button type="button" class="measure" aria-pressed="false">Measure</button>'
        '<button type="button" class="home">Reset view</button>'
        '<button type="button" class="full">Full screen</button>'
        '<output aria-live="polite"></output>'
    )
    label = f"3D view of {name}. Arrow keys turn it, plus and minus zoom; while measuring, Enter marks the middle."
    # A closing tag inside JSON would end the script element.
    described = json.dumps(about).replace("</", "<\\/")
    return (
        f'<section class="view" aria-label="3D view of {escape(name)}"><div class="view-tools">{tools}</div>'
        f'<div class="view-stage" tabindex="0" role="application" aria-label="{escape(label)}">'
        '<svg class="marks" aria-hidden="true"></svg></div>'
        '<p class="view-note">Drag to turn; wheel (after a click) or pinch to zoom; right button or two fingers to '
        "move; double click to turn about a point."
        '<noscript> This view needs JavaScript.</noscript></p><div class="view-legend"></div>'
        f'<script type="application/json" class="about">{described}</script>'
        f'<script type="text/plain" class="points">{base64.b64encode(planes).decode()}</script></section>'
    )


def view_library() -> str:
    """K3D-jupyter's front end with its licences, packed, for a page that has views."""
    import k3d

    package = Path(k3d.__file__).parent
    source = (package / "static/standalone.js").read_bytes()
    packed = base64.b64encode(zlib.compress(source, 9)).decode()
    licence = metadata.distribution("k3d").read_text("licenses/LICENSE.txt") or "MIT licence"
    notices = (package / "static/standalone.js.LICENSE.txt").read_text(encoding="utf-8")
    credit = f"K3D-jupyter {k3d.__version__}\n{licence.strip()}\nIn it:\n{notices.strip()}"
    return f'<!-- {credit.replace("--", "- -")} -->\n<script type="text/plain" id="k3d">{packed}</script>'


def _choice(key: str, kind: str, legend: str, options: list[tuple[str, str]], chosen: str, hidden: bool = False) -> str:
    """Radio buttons that look like one row of buttons."""
    buttons = (
        f'<label><input type="radio" name="{escape(kind)}-{escape(key)}" value="{escape(option)}"'
        f"{' checked' if option == chosen else ''}><span>{escape(text)}</span></label>"
        for option, text in options
    )
    unseen = " hidden" if hidden else ""
    return f'<fieldset class="{kind}"{unseen}><legend>{legend}</legend>{"".join(buttons)}</fieldset>'


def _modes(view: View, deviations: list[float] | None) -> list[Mode]:
    """The ways to colour the points that the view's fields allow; the first one is chosen."""
    fields = view.cloud.fields
    modes: list[Mode] = []
    other = {"color": UNKNOWN_COLOR, "label": "unknown"}
    if view.cloud.colors is not None:
        brighter = "" if view.brighter == 1 else f", {view.brighter:.1f} x as bright"
        modes.append({"name": "photo", "button": "Colours", "label": f"The points' own colours{brighter}"})
    codes = sorted(set(view.sources) - {REMOVED})
    sources = {code: (SOURCE_COLORS[k % len(SOURCE_COLORS)], view.sources[code]) for k, code in enumerate(codes)}
    sources[REMOVED] = (REMOVED_COLOR, "scene, removed by fusion")
    modes.append({"name": "source", "button": "Source", "other": other, "entries": _entries(view, "source", sources)})
    if "evidence" in fields and np.isin(fields["evidence"], [code for code in CLASSES if code > 0]).any():
        classes = CLASSES | {UNKNOWN: (UNKNOWN_COLOR, "not in the completed scene")}
        found = _entries(view, "evidence", classes)
        modes.append({"name": "evidence", "button": "Class", "other": other, "entries": found})
    if deviations is not None:
        ramp = [to_hex(color) for color in colormaps["viridis"](np.linspace(0, 1, LEVELS))]
        low, high = (f"{end:.2g} {view.unit}" for end in deviations)
        entries = [{"code": k + 1, "color": color} for k, color in enumerate(ramp)]
        ends: Mode = {"ramp": ramp[::3], "low": low, "high": high}
        modes.append({"name": "deviation", "button": "Std. deviation", "other": other, "entries": entries} | ends)
    return modes


def _entries(view: View, field: str, meanings: dict[int, tuple[str, str]]) -> list[Mode]:
    """The values of a field that occur, with colour, label, and the pictures in which they are seen."""
    found = []
    for code, (color, label) in meanings.items():
        shown = set(view.cloud.fields["shown"][view.cloud.fields[field] == code].tolist())
        when = [name for name, absent in (("before", AFTER), ("after", BEFORE)) if shown - {absent}]
        if when:
            found.append({"code": code, "color": color, "label": label, "when": when})
    return found
