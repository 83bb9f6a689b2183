"""The page to click in, as a person uses it: a real server and a real browser, with mouse and keyboard."""

import json
import re
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.browser import chromium
from support.clicking_page import LOCAL, MASK, Page, served
from support.user_project import Project

from scenefuse.marks.triangulation import read_ends
from scenefuse.photos.workspace import View, write_model
from scenefuse.pick.photo_tiles import Picture

NAME, SIZE = "Füße und Kopf.jpg", (600, 400)
DISC = ((250, 120), (200, 220), (300, 220))


@pytest.fixture(scope="module")
def browser():
    with chromium(LOCAL, "--window-size=1366,768") as window:
        yield window


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """A project with a red disc in four photos, one of them sharper than the others."""
    folder = tmp_path_factory.mktemp("yard")
    project = Project(folder)
    project.photos("flight", 4)
    (folder / "close").mkdir()
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    disc = (np.hypot(u - 250, v - 180) < 90)[..., None]
    noise = np.random.default_rng(0).normal(0, 6, (SIZE[1], SIZE[0], 3))
    pixels = (np.where(disc, [60, 50, 190], [60, 130, 70]) + noise).clip(0, 255).astype(np.uint8)
    for k, name in enumerate((NAME, "1.jpg", "2.jpg", "3.jpg")):
        file = cv2.imencode(".jpg", cv2.GaussianBlur(pixels, (0, 0), 3 * k) if k else pixels)[1]
        (folder / "close" / name).write_bytes(file.tobytes())
    project.write()
    return project


@pytest.fixture(scope="module")
def running(yard):
    with served(yard.path) as running:
        yield running


@pytest.fixture
def address(running):
    return running[0]


@pytest.fixture
def server(running):
    return running[1]


@pytest.fixture
def page(browser, yard, address):
    """The page of a project that holds neither clicks nor results yet."""
    for name in ("prompts.tsv", "clicks.tsv", "yard_lengths.tsv"):
        (yard.path / name).unlink(missing_ok=True)
    for name in ("objects", "scenes"):
        shutil.rmtree(yard.path / "results" / name, ignore_errors=True)
    return Page(browser, yard.path / "prompts.tsv", address, SIZE)


def test_clicks_give_a_mask_and_are_saved_where_they_were_made(page):
    for place in DISC:
        page.click(*place)
    page.marks(3)
    page.until(f"return !!document.querySelector('{MASK}')?.naturalWidth;")
    page.key("o")
    page.click(550, 350)
    page.marks(4)
    marked = page.saved()
    assert marked.labels == ["inside"] * 3 + ["outside"] and set(marked.photos) == {NAME}
    assert np.abs(marked.pixels - [*DISC, (550, 350)]).max() < 1
    assert page.browser.complaints() == []
    asked = {re.split(r"(?<!/)/(?!/)", url)[0] for url in page.browser.requests() if not url.startswith("data:")}
    assert asked == {page.address.split("/#")[0]}


def test_no_secret_is_in_the_address_bar_a_cookie_or_the_list_of_processes(page, address, server):
    assert page.browser.value("return [location.href, document.cookie];") == [address.split("#")[0], ""]
    assert page.browser.window.get_cookies() == []
    page.browser.window.refresh()  # the tab may read the page again
    page.until("return !!document.querySelector('.leaflet-tile-loaded');")
    assert address.split("#")[1] not in Path(f"/proc/{server.pid}/cmdline").read_text()


def test_another_tab_gets_nothing_by_an_address_that_was_used(page, address, browser):
    first = browser.window.current_window_handle
    browser.window.switch_to.new_window("tab")
    try:
        browser.window.get(address)
        page.until_text("Open this page by what scenefuse pick printed last.")
    finally:
        browser.window.close()
        browser.window.switch_to.window(first)
        browser.complaints()


def test_the_button_done_ends_the_page_and_its_server(yard, browser):
    for name in ("prompts.tsv", "clicks.tsv", "yard_lengths.tsv"):
        (yard.path / name).unlink(missing_ok=True)
    others = set(yard.path.glob("results/pick/*.html"))
    with served(yard.path) as (address, server):
        page = Page(browser, yard.path / "prompts.tsv", address, SIZE)
        page.button("Done")
        page.until_text("The clicks are saved, and this page has ended.")
        server.join(30)
        assert server.exitcode == 0
    assert set(yard.path.glob("results/pick/*.html")) == others


def test_the_mask_covers_the_disc(page):
    for place in DISC:
        page.click(*place)
    # A mask of the first click alone may come before.
    page.until(
        f"const image = document.querySelector('{MASK}'), canvas = document.createElement('canvas');"
        "if (!image?.naturalWidth) return false;"
        "canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;"
        "const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0);"
        "return given.every(([x, y, on]) => pen.getImageData(x, y, 1, 1).data[3] > 0 === on);",
        *((250, 180, True), (180, 180, True), (320, 180, True), (500, 180, False), (250, 350, False)),
    )


def test_a_click_is_exact_to_a_pixel_when_zoomed_in(page):
    page.browser.wheel(page.browser.find(".photo"), -300)
    time.sleep(1)
    page.key("+")
    time.sleep(1)
    page.click(300.5, 200.5)
    page.marks(1)
    assert np.abs(page.saved().pixels - (300.5, 200.5)).max() < 0.5


def test_undo_and_redo_by_keyboard(page):
    page.click(*DISC[0])
    page.click(*DISC[1])
    page.marks(2)
    page.key("z")
    page.marks(1)
    page.key("z")
    page.marks(0)
    page.until(f"return !document.querySelector('{MASK}');")
    page.key("y")
    page.marks(1)


def test_a_right_click_removes_the_click_under_the_pointer(page):
    page.click(*DISC[0])
    page.click(*DISC[1])
    page.marks(2)
    page.click(500, 350, button=2)
    page.click(*DISC[0], button=2)
    page.marks(1)
    assert np.abs(page.saved().pixels - DISC[1]).max() < 1


def test_a_box_is_dragged(page):
    page.key("b")
    page.until("return !!window.boxTool?._enabled;")
    page.drag((140, 70), (360, 290))
    page.marks(1)
    marked = page.saved()
    assert marked.labels == ["box", "box"] and np.abs(marked.pixels - [(140, 70), (360, 290)]).max() < 1.5
    page.until(f"return !!document.querySelector('{MASK}')?.naturalWidth;")
    page.click(*DISC[0])  # and the tool is the one for clicks again
    page.marks(2)


def test_the_keyboard_steps_through_the_photos_sharpest_first(page):
    names = "return [...document.querySelectorAll('.thumb .name')].map((e) => e.innerText);"
    page.until("return !document.body.innerText.includes('Looking for the sharpest');")
    page.until(f"const names = (() => {{ {names} }})(); return names[0] === given[0] && names[3] === '3.jpg';", NAME)
    for key, name in (("n", "1.jpg"), ("n", "2.jpg"), ("p", "1.jpg"), ("p", NAME), ("p", "3.jpg")):
        page.key(key)
        page.until("return document.querySelector('.thumb.here .name').innerText === given[0];", name)


def test_what_cannot_be_clicked_is_said(page):
    page.click(-5, 100)
    page.until_text("lies outside")
    page.click(*DISC[0])
    page.marks(1)
    page.click(*DISC[0])
    page.until_text("already marked inside")
    page.marks(1)


def test_only_outside_clicks_are_said_to_be_too_few(page):
    page.key("o")
    page.click(550, 350)
    page.until_text("There are only clicks outside")


def test_clicks_survive_a_reload_and_a_restart(page, browser, yard):
    page.click(*DISC[0])
    page.marks(1)
    page.open()
    page.marks(1)
    with served(yard.path) as (address, _):
        again = Page(browser, yard.path / "prompts.tsv", address, SIZE)
        again.marks(1)


def test_two_pages_of_one_server_show_the_same(page, browser, yard):
    # Each address opens one page; the file has the next one.
    port = page.address.split(":")[2].split("/")[0]
    page.address = re.search(r'url=(\S+?)"', (yard.path / f"results/pick/open-{port}.html").read_text())[1]
    first = browser.window.current_window_handle
    browser.window.switch_to.new_window("tab")
    try:
        page.open()
        page.click(*DISC[0])
        page.marks(1)
        browser.window.switch_to.window(first)
        page.marks(1)
    finally:
        browser.window.switch_to.window(first)
        for other in browser.window.window_handles:
            if other != first:
                browser.window.switch_to.window(other)
                browser.window.close()
        browser.window.switch_to.window(first)


def test_what_an_editor_wrote_is_read_again(page):
    page.click(*DISC[0])
    page.marks(1)
    page.click(*DISC[1])
    page.marks(2)
    page.path.write_text(f"label\tphoto\tx_px\ty_px\noutside\t{NAME}\t550\t350\n")
    page.marks(1)


def test_named_points_are_marked_in_the_scene_s_photos(page, yard):
    page.key("t")
    page.until_text("Named points")
    page.button("Named points")
    page.until("return !!document.querySelector('.side input');")
    page.write("chimney")
    page.until_text("chimney · 0 photos")
    for _ in range(2):
        action = page.mouse()
        action.pointer_action.move_to_location(*page.point(30, 20, 64, 48)).click()
        action.perform()
        page.marks(1)
        page.key("n")
    page.until_text("chimney · 2 photos")
    page.path = yard.path / "clicks.tsv"
    marked = page.saved()
    assert marked.labels == ["chimney"] * 2 and len(set(marked.photos)) == 2
    assert np.abs(marked.pixels - (30, 20)).max() < 0.5


def masked(folder, names):
    """Results of an object whose photos have the disc as their mask, but for one that was left out and some without a
    camera."""
    lens = np.array([[500.0, 0, 300], [0, 500, 200], [0, 0, 1]])
    views = [View(name, lens, np.eye(4), *SIZE) for name in [*names, "3.jpg"]]
    for part in ("sparse", "undistorted/sparse", "masks"):
        (folder / part).mkdir(parents=True)
    for part in ("sparse", "undistorted/sparse"):
        write_model(folder / part, views)
    for name in names:
        mask = cv2.circle(np.zeros(SIZE[::-1], dtype=np.uint8), (250, 180), 90, 255, -1)
        cv2.imwrite(str(folder / "masks" / f"{name.split('.')[0]}.png"), mask)
    kept = {name: {"area": 0.1, "agreement": 0.9 + 0.01 * k} for k, name in enumerate(names)}
    (folder / "masks.json").write_text(json.dumps({"dropped": {"3.jpg": "disagrees"}, "per_photo": kept}))


def test_the_workflow_s_masks_are_stepped_through(page, yard):
    masked(yard.path / "results/objects/shed", ["1.jpg", "2.jpg"])
    scores = "return [...document.querySelectorAll('.thumb .score')].map((e) => e.offsetParent ? e.innerText : '');"
    shown = f"return (() => {{ {scores} }})().filter((text) => text).sort().join() === given[0];"
    page.until(shown, "0.90,0.91,left out,no camera")  # taken up while the page is open
    assert page.browser.value(f"return !document.querySelector('{MASK}');")  # its own photo has none
    page.key("n")
    page.until("return document.querySelector('.thumb.here .name').innerText === '1.jpg';")
    page.until(f"return !!document.querySelector('{MASK}')?.naturalWidth;")
    page.key("m")
    page.until(f"return !document.querySelector('{MASK}');")
    page.key("m")
    page.until(f"return !!document.querySelector('{MASK}')?.naturalWidth;")


def test_a_point_is_expected_where_the_other_photos_see_it(page, yard):
    """Three cameras side by side; the point is 4 in front of them."""
    lens = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    poses = [np.array([[1.0, 0, 0, -k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) for k in range(3)]
    folder = yard.path / "results/scenes/yard/sparse"
    folder.mkdir(parents=True)
    write_model(folder, [View(f"{k}.jpg", lens, pose, 64, 48) for k, pose in enumerate(poses)])
    head = "point\tphoto\tx_px\ty_px\n"
    (yard.path / "clicks.tsv").write_text(head + "top\t0.jpg\t42\t20\n")
    drawn = "return [...document.querySelectorAll('.leaflet-overlay-pane path')].map((e) => e.getBBox());"
    count = f"return (() => {{ {drawn} }})().length === given[0];"

    def show(name):
        thumb = "[...document.querySelectorAll('.thumb')].find((e) => e.innerText.includes(given[0]))"
        page.until(f"return !!{thumb};", name)
        page.browser.value(f"{thumb}.click();", name)
        page.until("return document.querySelector('.thumb.here .name').innerText === given[0];", name)

    page.until("return document.body.innerText.includes('In the scene');")
    page.key("t")
    page.until_text("64 × 48")  # both tables have a photo 1.jpg
    show("1.jpg")
    page.button("top · 1 photo")
    page.until(count, 1)  # a dashed line along the ray, which runs level
    (line,) = page.browser.value(drawn)
    assert line["width"] > 5 * line["height"]
    page.path = yard.path / "clicks.tsv"
    page.path.write_text(head + "top\t0.jpg\t42\t20\ntop\t2.jpg\t17\t20\n")
    page.until(count, 2)  # the two arms of a cross-hair
    boxes = page.browser.value(drawn)
    middle = np.mean([[b["x"] + b["width"] / 2, b["y"] + b["height"] / 2] for b in boxes], axis=0)
    corner = page.browser.value(
        "const e = document.querySelector('.photo');"
        "const p = getElement(+e.id.slice(1)).map.latLngToLayerPoint(given); return [p.x, p.y];",
        *Picture("", Path(), 64, 48).place(29.5, 20),
    )
    assert np.abs(middle - corner).max() < 4  # of the screen's pixels, a photo's being ten of them
    show("2.jpg")
    page.until_text("2.jpg: 0.0 px off")


def test_a_known_length_is_clicked_in_two_photos_end_after_end(page, yard):
    page.button("Known lengths")
    page.until_text("New length")
    page.write("bar 1.5")
    page.until_text("bar, 1.5 m: b · 0 photos")
    for _ in range(2):
        for count, x in ((1, 20), (2, 40)):
            action = page.mouse()
            action.pointer_action.move_to_location(*page.point(x, 20, 64, 48)).click()
            action.perform()
            page.marks(count)
        page.key("n")
    page.until_text("bar, 1.5 m: b · 2 photos")
    page.until_text("into the column lengths of the table of scenes")
    page.until_text("results/scenes/yard/residuals.tsv")
    clicks = read_ends(yard.path / "yard_lengths.tsv")
    assert clicks.labels == ["bar\t1.5\ta", "bar\t1.5\tb"] * 2
    assert np.abs(clicks.pixels - [(20, 20), (40, 20)] * 2).max() < 0.5 and len(set(clicks.photos)) == 2


def test_the_page_fits_a_laptop_s_screen_and_says_what_comes_next(page):
    wide, high = page.browser.value("return [innerWidth, innerHeight];")
    right, low = page.browser.value(
        "const b = document.querySelector('.side').getBoundingClientRect(); return [b.right, b.bottom];"
    )
    assert right <= wide and low <= high
    assert "results/objects/shed/masks.png" in page.text()
