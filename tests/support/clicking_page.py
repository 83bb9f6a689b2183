"""The page to click in, served as for a person, and what a person does with it in a real browser."""

import multiprocessing
import os
import re
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from scenefuse.marks.clicks import read_points
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.pick import pick

# The page comes from this machine, and from nowhere else.
LOCAL = "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"
PATIENCE_S = 60
MASK = "img.leaflet-image-layer"


@contextmanager
def served(folder, name="shed", config="mine.yaml"):
    """The address of a page of an object of the project in a folder, and the server's process.

    The process is a copy of one that has imported the page's code.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["scenefuse.pick.pick"])
    printed, child = context.Pipe(duplex=False)
    server = context.Process(target=_serve, args=(folder, name, config, child))
    server.start()
    child.close()
    try:
        text = ""
        while not (found := re.search(r"http://127\.0\.0\.1:\d+/#\S+", text)):
            part = os.read(printed.fileno(), 4096).decode()
            assert part, text
            text += part
        yield found[0], server
    finally:
        server.terminate()
        server.join(PATIENCE_S)


def _serve(folder, name, config, output):
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    # NiceGUI serves in a main process alone, and takes one that knows of pytest for one of its own tests.
    multiprocessing.current_process().name = "MainProcess"
    for variable in [variable for variable in os.environ if variable.startswith("PYTEST")]:
        del os.environ[variable]
    os.chdir(folder)
    pick(object=name, configfile=(Path(config),), no_browser=1)


class Page:
    """What a person does with the page, and sees."""

    def __init__(self, browser, path, address, size):
        """Open the page whose table is at `path`; photos are of one size, (width, height)."""
        self.browser, self.path, self.address, self.size = browser, path, address, size
        self.patience_s = PATIENCE_S
        self.open()

    def open(self):
        self.browser.complaints()
        self.browser.window.get("about:blank")
        self.browser.window.get(self.address)
        self.until("return !!document.querySelector('.leaflet-tile-loaded');")

    def until(self, script, *given):
        end = time.monotonic() + self.patience_s
        while not self.browser.value(script, *given):
            assert time.monotonic() < end, f"never: {script}; the page says: {self.text()}"
            time.sleep(0.05)

    def text(self):
        return self.browser.value("return document.body.innerText;")

    def until_text(self, text):
        self.until("return document.body.innerText.includes(given[0]);", text)

    def point(self, x, y, width=None, height=None):
        """Where a pixel of the photo is in the window."""
        width, height = width or self.size[0], height or self.size[1]
        return self.browser.value(
            "const e = document.querySelector('.photo'), box = e.getBoundingClientRect();"
            "const p = getElement(+e.id.slice(1)).map.latLngToContainerPoint(given);"
            "return [Math.round(box.x + p.x), Math.round(box.y + p.y)];",
            *Picture("", Path(), width, height).place(x, y),
        )

    def mouse(self, button=0):
        from selenium.webdriver.common.action_chains import ActionBuilder
        from selenium.webdriver.common.actions.pointer_input import PointerInput

        return ActionBuilder(self.browser.window, mouse=PointerInput("mouse", "pointer"), duration=40)

    def click(self, x, y, button=0):
        action = self.mouse()
        action.pointer_action.move_to_location(*self.point(x, y)).pointer_down(button=button).pointer_up(button=button)
        action.perform()

    def drag(self, start, end):
        action, middle = self.mouse(), ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        action.pointer_action.move_to_location(*self.point(*start)).pointer_down()
        action.pointer_action.move_to_location(*self.point(*middle)).move_to_location(*self.point(*end)).pointer_up()
        action.perform()

    def key(self, keys):
        from selenium.webdriver import ActionChains

        ActionChains(self.browser.window).send_keys(keys).perform()

    def button(self, text):
        """Press the button of this text, once it can be pressed: a dialogue takes a moment to appear."""
        self._once_it_can_be_used("button", lambda e: text in e.text and (e.click(), True), f"no button {text}")

    def write(self, text):
        """Write into the side panel's field, once it can be written into, and press Enter."""
        self._once_it_can_be_used(".side input", lambda e: (e.send_keys(f"{text}\n"), True), "no field")

    def _once_it_can_be_used(self, selector, use, complaint):
        from selenium.common.exceptions import (
            ElementClickInterceptedException,
            ElementNotInteractableException,
            StaleElementReferenceException,
        )

        not_yet = ElementClickInterceptedException, ElementNotInteractableException, StaleElementReferenceException
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for element in self.browser.window.find_elements("css selector", selector):
                with suppress(*not_yet):
                    if use(element):
                        return
            time.sleep(0.05)
        raise AssertionError(f"{complaint}: {self.text()}")

    def marks(self, count):
        """Wait until the badge of the shown photo counts so many clicks."""
        shown = "document.querySelector('.thumb.here .clicks')"
        self.until(f"const b = {shown}; return (b.offsetParent ? +b.innerText : 0) === given[0];", count)

    def saved(self):
        """What the table holds; each click is in it at once."""
        return read_points(self.path)
