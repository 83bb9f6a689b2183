"""A page in one file: style, script and pictures in it, no network, readable on paper."""

import base64
import io
from html import escape
from pathlib import Path

from PIL import Image as Picture

from scenefuse.core.stage import StageError
from scenefuse.report.view.view_page import view_library
from scenefuse.report.view.view_script import VIEW_SCRIPT, VIEW_STYLE

STYLE = """
:root { --ink: #1d2329; --soft: #5b6670; --line: #dfe3e7; --accent: #c7560b; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 28px 20px 60px; background: #fff; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 20px; margin: 40px 0 8px; border-top: 1px solid var(--line);
  padding-top: 22px; } h3 { font-size: 16px; margin: 24px 0 6px; }
p, figcaption { color: var(--soft); margin: 4px 0 10px; max-width: 88ch; } a { color: var(--accent); }
nav a { display: inline-block; margin-right: 14px; } figure { margin: 14px 0 22px; break-inside: avoid; }
img { max-width: 100%; height: auto; display: block; }
.badge { display: inline-block; font-size: 13px; padding: 1px 9px; border-radius: 9px; margin-left: 8px;
  border: 1px solid; vertical-align: 2px; font-weight: 500; } .ok { color: #1c6b35; } .no { color: #9c2b1f; }
.wide { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; font-size: 12.5px; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 7px; text-align: right; border-bottom: 1px solid var(--line); vertical-align: top; }
td.text { max-width: 46ch; } tr:last-child td { border-bottom: 0; }
th { font-weight: 600; color: var(--soft); vertical-align: bottom; line-height: 1.25; } .text { text-align: left; }
.slider { position: relative; max-width: 840px; border: 1px solid var(--line); --cut: 50%; }
.slider figure { margin: 0; } .slider .after { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--cut)); }
.slider::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--cut); width: 2px;
  background: var(--accent); }
.slider figcaption { position: absolute; top: 8px; margin: 0; padding: 1px 8px; background: #fffc; color: var(--ink); }
.slider .before figcaption { left: 8px; } .slider .after figcaption { right: 8px; }
.range { width: 100%; max-width: 840px; display: block; margin: 6px 0 0; accent-color: var(--accent); }
pre { font-size: 12.5px; line-height: 1.4; background: #f7f8f9; border: 1px solid var(--line); border-radius: 6px;
  padding: 12px 14px; overflow-x: auto; }
@media print { body { max-width: none; padding: 0; font-size: 11px; } nav, .range { display: none; }
  .slider { display: flex; gap: 6px; border: 0; } .slider::after { display: none; } table { font-size: 8.5px; }
  .slider .after { position: relative; clip-path: none; } .slider figure { position: relative; flex: 1; }
  .wide { overflow: visible; border: 0; } th, td { padding: 2px 4px; } h2 { break-after: avoid; }
  pre { font-size: 8px; white-space: pre-wrap; } }
"""
SCRIPT = """
for (const range of document.querySelectorAll(".range")) {
  const slider = range.previousElementSibling;
  const move = (percent) => {
    range.value = percent;
    slider.style.setProperty("--cut", percent + "%");
  };
  range.addEventListener("input", () => move(range.value));
  slider.addEventListener("pointermove", (event) => {
    if (event.pointerType === "touch" && !event.isPrimary) return;
    const box = slider.getBoundingClientRect();
    move(Math.min(100, Math.max(0, ((event.clientX - box.left) / box.width) * 100)));
  });
}
"""


def document(title: str, body: list[str], has_views: bool) -> str:
    """An HTML page of these parts; with the library that draws 3D views, if it has some."""
    style, script = (STYLE + VIEW_STYLE, SCRIPT + VIEW_SCRIPT) if has_views else (STYLE, SCRIPT)
    content = "\n".join([*body, *([view_library()] if has_views else [])])
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{style}</style>\n</head>\n'
        f"<body>\n{content}\n<script>{script}</script>\n</body>\n</html>\n"
    )


def embedded(path: Path, alt: str) -> str:
    """An <img> that holds the picture, as WebP: a third of the PNG's size; StageError where it is none."""
    buffer = io.BytesIO()
    try:
        with Picture.open(path) as opened:
            size = opened.size
            opened.convert("RGB").save(buffer, format="WEBP", quality=85, method=4)
    except OSError as error:
        raise StageError(f"{path} is not a readable picture ({error}); draw the figures again") from None
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img src="data:image/webp;base64,{data}" width="{size[0]}" height="{size[1]}" alt="{escape(alt)}">'
