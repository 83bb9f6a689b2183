"""Positions of a drone in the subtitles beside its video, as DJI's and Autel's write them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scenefuse.core.transforms import Array
from scenefuse.photos.positions import Position, degrees_of

NUMBER = r"[-+]?\d+(?:\.\d+)?"
# From when to when a block is shown: hours, minutes, seconds, of which some drones count 60.
SHOWN = re.compile(r"(\d+):(\d+):(\d+[.,]\d+)\s*-->\s*(\d+):(\d+):(\d+[.,]\d+)")
# A block for each frame: [latitude: 50.11] [longtitude : 8.61] [rel_alt: 10.2 abs_alt: 120.3], misspelled by some.
NAMED = re.compile(r"\b(latitude|longt?itude|altitude|abs_alt|rel_alt)\s*:\s*([-+]?\d+(?:[.,]\d+)?)", re.I)
# One for each second: GPS(8.61,50.11,14), a number of satellites; GPS(50.11,8.61,0.0M); GPS(E: 8.61, N: 50.11, 120.3m).
SIDE = rf"([NSEW]?)[:\s]*({NUMBER})\s*"
PLACE = re.compile(rf"\b(?:GPS|RTK)\s*\(\s*{SIDE},\s*{SIDE}(?:,\s*({NUMBER})\s*(m?)\s*)?\)", re.I)
# The height above take-off in these: BAROMETER:12.3, Hb:12.3, H 12.30m.
HEIGHT = re.compile(rf"\b(?:BAROMETER[:(]|Hb:|H )\s*({NUMBER})")


def positions_in_subtitles(path: Path, seconds: Sequence[float]) -> tuple[list[Position], str]:
    """Where a drone was at some seconds of its video, `Position()` where its subtitles do not say; and a note on them.

    Between the moments at which they change, position and height are interpolated: receivers give fewer of them than a
    video has frames, some one a second, in which a drone flies 10 m.
    """
    text = path.read_bytes().decode(errors="replace")
    shown = list(SHOWN.finditer(text))
    ends = [*(block.start() for block in shown[1:]), len(text)]
    blocks = sorted((*_times(block), *_stated(text[block.end() : end])) for block, end in zip(shown, ends))
    # Columns: first and last second; latitude, longitude; altitude, height above take-off.
    table: Array = np.array(blocks, dtype=np.float64).reshape(-1, 6)
    known, at = np.isfinite(table[:, 2]), np.asarray(seconds)
    if not known.any():
        return [Position()] * len(at), f"{path.name} beside the video gives no positions that can be read"
    relative = bool(np.isnan(table[:, 4]).all() and np.isfinite(table[:, 5]).any())
    block_of = np.searchsorted(table[:, 0], at, side="right") - 1
    inside = (block_of >= 0) & known[block_of] & (at <= table[-1, 1])
    places = np.stack([*_between(at, table, 2, 3), *_between(at, table, 5 if relative else 4)], 1).tolist()
    found = [
        Position(north, east, None if np.isnan(up) else up) if there else Position()
        for (north, east, up), there in zip(places, inside)
    ]
    first = table[known][0]
    note = (
        f"{path.name} gives {inside.sum()} of {len(at)} positions (the first: latitude {first[2]:.5f}, longitude"
        f" {first[3]:.5f}) and ends after {table[-1, 1]:.0f} s; the last frame is of {at[-1]:.0f} s"
    )
    return found, note + ("; its heights are above take-off, not the sea" if relative else "")


def _times(block: re.Match[str]) -> tuple[float, float]:
    hours, minutes, seconds = ([float(block[k + part].replace(",", ".")) for part in (0, 3)] for k in (1, 2, 3))
    first, last = (3600 * h + 60 * m + s for h, m, s in zip(hours, minutes, seconds))
    return first, last


def _stated(text: str) -> tuple[float, float, float, float]:
    """Latitude and longitude (degrees), altitude, and height above take-off (m) in a block; NaN where there is none."""
    named = {name.lower(): number.replace(",", ".") for name, number in NAMED.findall(text)}
    sides: list[tuple[str | None, str | None]]
    sides = [(named.get("latitude"), None), (named.get("longitude", named.get("longtitude")), None)]
    altitude, height = named.get("abs_alt", named.get("altitude")), named.get("rel_alt")
    if found := PLACE.search(text):
        sides = [(found[4], found[3].upper() or None), (found[2], found[1].upper() or None)]
        # Of the drones that write a unit, Autel's write the longitude first, and letters.
        if sides[1][1] in ("N", "S") or (not sides[1][1] and (found[6] or abs(float(found[4])) > 90)):
            sides.reverse()
        altitude = found[5] if found[6] else None
    if found := HEIGHT.search(text):
        height = found[1]
    place, _ = degrees_of(*sides[0], *sides[1])
    if place is None:
        return np.nan, np.nan, np.nan, np.nan
    # Some firmware writes radians; read as degrees they would all lie in the sea, in the Gulf of Guinea.
    if abs(place[0]) < np.pi / 2 and abs(place[1]) < np.pi:
        place = float(np.degrees(place[0])), float(np.degrees(place[1]))
    # Matrices write an altitude of 0 throughout.
    return *place, float(altitude or 0) or np.nan, float(height or np.nan)


def _between(at: Array, table: Array, *columns: int) -> list[Array]:
    """Columns at some seconds, linear between the blocks in which they change; NaN where they are nowhere known."""
    rows = table[np.isfinite(table[:, columns]).all(1)]
    if not len(rows):
        return [np.full(len(at), np.nan) for _ in columns]
    rows = rows[np.r_[True, (np.diff(rows[:, columns], axis=0) != 0).any(1)]]
    return [np.interp(at, rows[:, 0], rows[:, column]) for column in columns]
