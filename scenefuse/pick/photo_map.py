"""The photo that is clicked in, as a map to zoom and pan; over it its clicks, and the masks: that of the clicks and the
workflow's."""

import asyncio
import base64
import html
import json
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from nicegui import ui
from nicegui.elements.leaflet.leaflet_layer import Layer
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Click
from scenefuse.pick.document import Corners, Rows
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.session import Session

# Zoom steps beyond the photo's own pixels.
EXTRA_ZOOM = 4
COLOURS = {"inside": "#00c853", "outside": "#ff1744", "box": "#2979ff"}
POINT, ACTIVE, EXPECTED = "#2979ff", "#ffd600", "#ff9100"
# A pointer means a click this near to it, on the screen.
POINTER_PX = 14

Handler = Callable[[float, float], None]


class PhotoMap:
    """A photo with its clicks; reports where it is clicked."""

    def __init__(self, on_click: Handler, on_remove: Handler, on_box: Callable[[Corners], None]) -> None:
        """Build the map inside the current element, without a photo.

        Args:
            on_click, on_remove: get the pixel of a click, and of a right click.
            on_box: gets two opposite corners.
        """
        options = {
            "attributionControl": False,
            "doubleClickZoom": False,
            "keyboard": False,
            "boxZoom": False,
            "zoomSnap": 0.1,
            "zoomDelta": 1,
            "wheelPxPerZoomLevel": 100,
            "maxBoundsViscosity": 0.8,
        }
        rectangle = {"showArea": False, "shapeOptions": {"color": COLOURS["box"], "weight": 2, "fill": False}}
        none = dict.fromkeys(("polyline", "polygon", "circle", "marker", "circlemarker"), False)
        self.widget = ui.leaflet(
            (0, 0), 2, options=options, draw_control={"draw": none | {"rectangle": rectangle}}, hide_drawn_items=True
        ).classes("photo")
        self.widget.clear_layers()  # the widget's own background comes from the internet
        self._rectangle = rectangle
        self._picture: Picture | None = None
        self._over: list[Layer] = []
        self._masks: dict[str, Layer] = {}
        self._drawing = False

        def clicked(event: Any, handler: Handler) -> None:
            if self._picture is not None and not self._drawing:
                handler(*self._picture.pixel(event.args["latlng"]["lat"], event.args["latlng"]["lng"]))

        def drawn(event: Any) -> None:
            self._drawing = False
            if self._picture is not None:
                start, _, end, _ = event.args["layer"]["_latlngs"][0]
                on_box((self._picture.pixel(start["lat"], start["lng"]), self._picture.pixel(end["lat"], end["lng"])))

        self.widget.on("map-click", lambda event: clicked(event, on_click))
        self.widget.on("map-contextmenu", lambda event: clicked(event, on_remove))
        self.widget.on("draw:created", drawn)
        self.widget.on("draw:drawstop", lambda: setattr(self, "_drawing", False), args=[])

    def show(self, picture: Picture, tiles: str) -> None:
        """Show another photo, whole.

        Args:
            picture: the photo.
            tiles: address of its tiles with {z}, {x} and {y}.
        """
        self.drag_box(False)
        self._picture = picture
        self.widget.clear_layers()
        self._over, self._masks = [], {}
        bounds = self._bounds()
        self.widget.tile_layer(
            url_template=tiles,
            options={
                "maxNativeZoom": picture.depth,
                "maxZoom": picture.depth + EXTRA_ZOOM,
                "minZoom": 0,
                "noWrap": True,
                "bounds": bounds,
                "updateWhenZooming": False,
                "keepBuffer": 1,
            },
        )
        self.widget.run_map_method("setMaxBounds", None)
        self.widget.run_map_method("setMinZoom", 0)
        self.widget.run_map_method("setMaxZoom", picture.depth + EXTRA_ZOOM)
        self.fit()

    def fit(self) -> None:
        """Show the whole photo."""
        if self._picture is not None:
            self.widget.run_map_method("fitBounds", self._bounds(), {"animate": False, "padding": [4, 4]})

    def zoom(self, steps: int) -> None:
        """Zoom in by steps, or out where they are negative."""
        self.widget.run_map_method("zoomIn" if steps > 0 else "zoomOut", abs(steps))

    def reach_px(self) -> float:
        """How many pixels of the photo a pointer may miss a click by."""
        picture = self._picture
        return 0.0 if picture is None else POINTER_PX / picture.scale * 2 ** (picture.depth - float(self.widget.zoom))

    def lay(self, name: str, address: str | None) -> None:
        """Lay a mask over the photo in the place of the former one of this name; None takes it away."""
        former = self._masks.pop(name, None)
        if address is not None and self._picture is not None:
            self._masks[name] = self.widget.image_overlay(
                url=address, bounds=self._bounds(), options={"interactive": False}
            )
        if former is not None:
            self.widget.remove_layer(former)

    def drag_box(self, wanted: bool) -> None:
        """Let a box be dragged, or give it up."""
        if wanted and not self._drawing:
            ui.run_javascript(
                f"const map = getElement({self.widget.id}).map; window.boxTool?.disable();"
                f"window.boxTool = new L.Draw.Rectangle(map, {json.dumps(self._rectangle)}); window.boxTool.enable();"
            )
        elif self._drawing and not wanted:
            ui.run_javascript("window.boxTool?.disable();")
        self._drawing = wanted

    def clear(self) -> None:
        """Take away clicks and lines."""
        for layer in self._over:
            self.widget.remove_layer(layer)
        self._over = []

    def draw_labels(self, clicks: Rows) -> None:
        """Draw clicks inside and outside, and a box."""
        for click in clicks:
            if click.label != "box":
                self._dot(click, COLOURS[click.label], "")
        corners = [click for click in clicks if click.label == "box"]
        if len(corners) == 2:
            ends = [self._place(c.x_px, c.y_px) for c in corners]
            self._add("rectangle", [ends, {"color": COLOURS["box"], "weight": 2, "fill": False, "interactive": False}])

    def draw_point(self, click: Click, active: bool) -> None:
        """Draw a named point."""
        self._dot(click, ACTIVE if active else POINT, click.name)

    def draw_expected(self, pixels: Array) -> None:
        """Draw where a point is to be expected: a cross-hair for one pixel, a line for more."""
        style = {"color": EXPECTED, "weight": 2, "opacity": 0.9, "interactive": False, "dashArray": "6 5"}
        if len(pixels) == 1:
            x, y = pixels[0]
            picture = self._picture
            assert picture is not None
            arm = 0.02 * max(picture.width, picture.height)
            for dx, dy in ((arm, 0.0), (0.0, arm)):
                line = [self._place(x - dx, y - dy), self._place(x + dx, y + dy)]
                self._add("polyline", [line, style | {"dashArray": ""}])
        elif len(pixels):
            self._add("polyline", [[self._place(*pixel) for pixel in np.asarray(pixels).tolist()], style])

    def _dot(self, click: Click, colour: str, text: str) -> None:
        options = {"radius": 6, "color": "#ffffff", "weight": 2, "fillColor": colour, "fillOpacity": 1}
        self._add("circleMarker", [self._place(click.x_px, click.y_px), options | {"interactive": False}])
        if text:
            layer = self._over[-1]
            layer.run_method(
                "bindTooltip", html.escape(text), {"permanent": True, "direction": "right", "offset": [8, 0]}
            )

    def _add(self, name: str, args: list[Any]) -> None:
        self._over.append(self.widget.generic_layer(name=name, args=args))

    def _place(self, x: float, y: float) -> tuple[float, float]:
        assert self._picture is not None
        return self._picture.place(x, y)

    def _bounds(self) -> list[list[float]]:
        picture = self._picture
        assert picture is not None
        return [list(picture.place(0, picture.height)), list(picture.place(picture.width, 0))]


class MaskLayers:
    """Lays masks over a map's photo as its clicks and the workflow's results change.

    Attributes:
        note: what is wrong with the mask of the clicks; "" where nothing is.
    """

    def __init__(self, session: Session, photo_map: PhotoMap, on_note: Callable[[], None]) -> None:
        self._session, self._map, self._on_note = session, photo_map, on_note
        self._clicked: tuple[str, Rows] | None = None
        self._results: tuple[str, tuple[float, ...]] | None = None
        self._segmenting = asyncio.Lock()
        self.note = ""

    def forget(self) -> None:
        """Another photo is shown: no mask lies over it yet."""
        self._clicked = self._results = None

    def update(self, picture: Picture, clicks: Rows, visible: bool) -> None:
        """Lay what is not there yet, in the background, and take away what is no longer so."""
        results = (picture.name, self._session.results_state) if visible and self._session.masks.agreement else None
        if results != self._results:
            self._results = results
            self._map.lay("workflow", None)
            if results is not None:
                asyncio.get_running_loop().create_task(self._lay_workflow(picture, results))
        clicked = (picture.name, clicks) if visible and any(row.label != "outside" for row in clicks) else None
        if clicked != self._clicked:
            self._clicked, self.note = clicked, "Making it ..." if clicked else ""
            if clicked is None:
                self._map.lay("clicked", None)
            else:
                asyncio.get_running_loop().create_task(self._lay_clicked(picture, clicked))

    async def _lay_workflow(self, picture: Picture, results: tuple[str, tuple[float, ...]]) -> None:
        try:
            mask = await asyncio.to_thread(self._session.masks.mask, picture)
        except StageError as error:
            print(error, flush=True)
            return
        if mask is not None and results == self._results:
            self._map.lay("workflow", overlay(mask, EXPECTED))

    async def _lay_clicked(self, picture: Picture, clicked: tuple[str, Rows]) -> None:
        address = None
        try:
            async with self._segmenting:
                if clicked != self._clicked:
                    return
                shared = self._session.shared_pixels(picture.name)
                mask, notes = await asyncio.to_thread(self._session.segmenter.mask, picture, clicked[1], shared)
            note = " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in notes)
            address = overlay(mask, COLOURS["inside"])
        except StageError as error:
            note = str(error)
        if clicked == self._clicked:
            self._map.lay("clicked", address)
            self.note = note
            self._on_note()


def overlay(mask: NDArray[np.bool_], colour: str) -> str:
    """A mask (H, W) as the address of a transparent picture (data:) of a colour #rrggbb: its inside tinted, its outline
    opaque."""
    blue_green_red = tuple(bytes.fromhex(colour[1:]))[::-1]
    pixels = np.zeros((*mask.shape, 4), dtype=np.uint8)
    pixels[..., :3] = blue_green_red
    pixels[mask, 3] = 70
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(pixels, lines, -1, (*blue_green_red, 255), 2)
    return "data:image/png;base64," + base64.b64encode(cv2.imencode(".png", pixels)[1].tobytes()).decode()
