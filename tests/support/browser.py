"""A real Chromium without a screen, for pages that are opened from a file."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

BROWSERS = ("chromium", "google-chrome")
# WebGL without a GPU, no sandbox (the tests may run as root), and no way to any server.
OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-device-scale-factor=1"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
    *("--disable-domain-reliability", "--disable-default-apps", "--host-resolver-rules=MAP * ~NOTFOUND"),
)
PHONE = {"width": 390, "height": 844, "pixelRatio": 1.0, "touch": True}


@contextmanager
def chromium(*extra: str, phone: bool = False) -> Iterator["Browser"]:
    """A browser window of 1200 x 900 pixels, or a phone's; skips the test where there is none."""
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="needs selenium: pip install -r tests/requirements.txt"
    )
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for option in (*OPTIONS, "--window-size=1200,900", *extra):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    if phone:
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": PHONE})
    window = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield Browser(window)
    finally:
        window.quit()


class Browser:
    """What the tests do with a page."""

    def __init__(self, window):
        self.window = window

    def open(self, page: Path) -> None:
        self.window.get(page.resolve().as_uri())

    def value(self, script: str, *given):
        """What some JavaScript returns, which may await and is given values as `given`."""
        kept, value = self.window.execute_async_script(
            "const done = arguments[arguments.length - 1], values = [...arguments].slice(0, -1);"
            f"(async (given) => {{ {script} }})(values).then((v) => done([true, v]), (e) => done([false, `${{e}}`]));",
            *given,
        )
        assert kept, value
        return value

    def find(self, selector: str):
        return self.window.find_element("css selector", selector)

    def picture(self, selector: str) -> np.ndarray:
        """(H, W, 3) pixels of an element, as they are on the screen once they no longer change."""
        data = b""
        for _ in range(20):
            last, data = data, self.find(selector).screenshot_as_png
            if data == last:
                break
        shown = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        return cv2.cvtColor(shown, cv2.COLOR_BGR2RGB)

    def drag(self, element, right: float, down: float) -> None:
        self._actions().drag_and_drop_by_offset(element, right, down).perform()

    def double_click(self, element, x: float, y: float) -> None:
        """At pixels from an element's upper left corner."""
        right, down = round(x - element.size["width"] / 2), round(y - element.size["height"] / 2)
        self._actions().move_to_element_with_offset(element, right, down).double_click().perform()

    def wheel(self, element, down: float) -> None:
        from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

        self._actions().scroll_from_origin(ScrollOrigin.from_element(element), 0, down).perform()

    def _actions(self):
        from selenium.webdriver import ActionChains

        return ActionChains(self.window)

    def complaints(self) -> list[str]:
        """What the console holds of warnings and errors."""
        return [line["message"] for line in self.window.get_log("browser") if line["level"] in ("WARNING", "SEVERE")]

    def requests(self) -> list[str]:
        """The addresses that the page asked for."""
        events = (json.loads(line["message"])["message"] for line in self.window.get_log("performance"))
        return [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]


def click(browser: Browser, element, x: float, y: float) -> None:
    """Click with the mouse at pixels from an element's upper left corner."""
    _point(browser, element, [(x, y)], "mouse")


def touch(browser: Browser, element, path: list[tuple[float, float]], kind: str = "touch") -> None:
    """Put a finger (or the mouse) down, move it along a path of pixels from an element's upper left corner, and lift
    it."""
    _point(browser, element, path, kind)


def _point(browser: Browser, element, path, kind: str) -> None:
    from selenium.webdriver.common.action_chains import ActionBuilder
    from selenium.webdriver.common.actions.pointer_input import PointerInput

    box = browser.value("return given[0].getBoundingClientRect().toJSON();", element)
    action = ActionBuilder(browser.window, mouse=PointerInput(kind, "pointer"), duration=30)
    for k, (x, y) in enumerate(path):
        action.pointer_action.move_to_location(round(box["x"] + x), round(box["y"] + y))
        if k == 0:
            action.pointer_action.pointer_down()
    action.pointer_action.pointer_up()
    action.perform()
