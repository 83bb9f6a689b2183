"""The report page in a real browser, opened from a file: 3D views, colours, measuring, touch, a phone's width."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.browser import chromium, click, touch

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import write_json
from scenefuse.core.transforms import UP
from scenefuse.report.page import view_section
from scenefuse.report.view import VIEW_POINTS, View, encode, merge, write_view
from scenefuse.report.write_report import write_report
from scenefuse.surface.gltf import BRIDGED_TINT, write_glb
from scenefuse.surface.make_surface import surface_report, write_surface
from scenefuse.surface.mesh import Surface

SECTION = "[aria-label='3D view of house']"
STAGE = f"{SECTION} .view-stage"
RED, BLUE = (230, 0, 0), (0, 0, 230)
ACCENT = (199, 86, 11)
TAB, ESCAPE, ARROW_RIGHT = "\ue004", "\ue00c", "\ue014"  # as WebDriver names keys
SETTLE = "for (let k = 0; k < 3; k++) await new Promise((next) => requestAnimationFrame(next));"


def grid(count=21, step=0.1, height=0.0, color=(140, 150, 140)):
    """A flat grid of points about the origin, facing up."""
    x, y = np.meshgrid(*[(np.arange(count) - count // 2) * step] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return Cloud(points, np.tile(np.float32([0, 0, 1]), (x.size, 1)), np.tile(np.uint8(color), (x.size, 1)))


def completed(before, added, **fields):
    source = np.repeat([0, 1], [len(before), len(added)]).astype(np.uint16)
    return Cloud(
        np.concatenate([before.points, added.points]),
        np.concatenate([before.normals, added.normals]),
        np.concatenate([before.colors, added.colors]),
        {"source": source, **fields},
    )


def view_of(before, after, reach=1.0):
    cloud, corner = merge(before, after), reach * np.array([1.0, 1.0, 0.5])
    return View(cloud, {0: "scene", 1: "added"}, "m", -corner, corner, -90.0, 60.0, len(before), len(after))


def report(folder, views, status="registered"):
    """The page of a run of these objects; `views` by object, None for one without."""
    (folder / "summary").mkdir()
    (folder / "summary/summary.txt").write_text("all well\n")
    rows = "".join(f"{name}\t{status}\tbecause\t0.03\t0.04\n" for name in views)
    columns = "object\tstatus\treason\tscale_sd_log\tscene_scale_sd_log"
    (folder / "summary/objects.tsv").write_text(f"{columns}\n{rows}")
    for name, view in views.items():
        (folder / name / "figures").mkdir(parents=True)
        if view is not None:
            write_view(folder / name / "figures", view)
    page = folder / "summary/report.html"
    objects = [folder / name for name in views]
    write_report(summary=folder / "summary", scenes=[], objects=objects, title="test", report=page)
    return page


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A house with all fields, a red and a blue point in it 1.2 m apart; a shed without fields; a large scene."""
    before, added = grid(), grid(9, 0.05, 0.4, (200, 190, 60))
    for cloud, place, color in ((before, [-0.6, -0.6, 0], RED), (added, [0.2, 0.2, 0.4], BLUE)):
        cloud.colors[np.isclose(cloud.points, place).all(1)] = color
    count = len(before) + len(added)
    evidence = np.repeat([0, 1, 2, 3], [200, 141, 100, 81]).astype(np.uint8)
    deviation = np.linspace(0.001, 0.05, count).astype(np.float32)
    house = view_of(before, completed(before, added, evidence=evidence, deviation=deviation))
    plain, large = grid(), grid(step=100.0)
    views = {"house": house, "shed": view_of(plain, completed(plain, added)), "land": view_of(large, large, 1000.0)}
    return report(tmp_path_factory.mktemp("run"), views)


@pytest.fixture(scope="module")
def browser():
    with chromium() as window:
        yield window


@pytest.fixture
def opened(browser, page):
    browser.open(page)
    ready(browser)
    return browser


def ready(browser, name="house"):
    """Wait until a view has drawn."""
    browser.value(
        """
        const section = document.querySelector(`[aria-label="3D view of ${given[0]}"]`);
        section.scrollIntoView({ block: "center", behavior: "instant" });
        while (section.dataset.state !== "ready") {
          if (section.dataset.state === "failed") throw section.querySelector(".view-note").textContent;
          await new Promise((next) => setTimeout(next, 20));
        }
        """
        + SETTLE,
        name,
    )


def camera_of(browser, name="house"):
    """Eye, target and up of a view."""
    script = "for (const [s, v] of views) if (s.getAttribute('aria-label') === `3D view of ${given[0]}`) "
    return browser.value(script + "return Array.from(v.plot.getWorld().controls.getCameraArray());", name)


def choose(browser, text, name="house"):
    """Press one of a view's buttons and let it draw."""
    section = f"//section[@aria-label='3D view of {name}']"
    browser.window.find_element("xpath", f"{section}//*[self::span or self::button][.='{text}']").click()
    browser.value("await new Promise((next) => setTimeout(next, 100));" + SETTLE)


def changed(first, second):
    """Share of pixels that differ clearly."""
    return float((np.abs(first.astype(int) - second).max(2) > 30).mean())


def middle_of(picture, color):
    """Where on a picture a colour is, x and y."""
    rows, columns = np.nonzero(np.abs(picture.astype(int) - color).max(2) < 40)
    assert len(rows) > 20, "the point is not seen"
    return float(columns.mean()), float(rows.mean())


def test_the_page_draws_before_and_after_and_asks_for_nothing(opened):
    after = opened.picture(STAGE)
    assert after.reshape(-1, 3).std(0).max() > 20
    choose(opened, "Before")
    before = opened.picture(STAGE)
    assert before.reshape(-1, 3).std(0).max() > 20
    assert changed(before, after) > 0.01
    choose(opened, "After")
    assert changed(opened.picture(STAGE), after) < 0.001
    assert opened.complaints() == []
    assert {url.split(":")[0] for url in opened.requests()} <= {"file", "data", "blob"}


def test_photo_colours_are_those_of_the_points(opened):
    picture = opened.picture(STAGE)
    for color in (RED, BLUE, (140, 150, 140), (200, 190, 60)):
        assert (np.abs(picture.astype(int) - color).max(2) <= 3).sum() > 20, color


def test_a_scene_of_kilometres_fills_its_view(browser, page):
    browser.open(page)
    ready(browser, "land")
    picture = browser.picture("[aria-label='3D view of land'] .view-stage")
    covered = (np.abs(picture.astype(int) - (140, 150, 140)).max(2) <= 3).mean()
    # Discs of half the size would leave gaps: 0.21.
    assert covered > 0.32


def test_every_way_of_colouring_changes_the_picture_and_has_its_legend(opened):
    pictures = {}
    for mode, words in {
        "Natural": "Natural colours, brightened if all are dark",
        "Source": "added",
        "Class": "not measured: from the NeRF or a given cloud",
        "Std. deviation": "along its line of sight, without that of the object's place",
    }.items():
        choose(opened, mode)
        pictures[mode] = opened.picture(STAGE)
        assert words in opened.find(f"{SECTION} .view-legend").text, mode
    assert "49.0 mm" in opened.find(f"{SECTION} .view-legend").text
    names = list(pictures)
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            assert changed(pictures[first], pictures[second]) > 0.02, (first, second)
    choose(opened, "Before")
    assert "added" not in opened.find(f"{SECTION} .view-legend").text


def test_the_surface_is_shown_with_photos_class_and_deviation_beside_the_points(browser, tmp_path):
    """A plane that a picture paints, red on its far half and blue on its near one, with a bridged strip beside it."""
    corners = np.array([[-1, -0.8], [0.6, -0.8], [0.6, 0.8], [-1, 0.8], [0.6, -0.8], [1, -0.8], [1, 0.8], [0.6, 0.8]])
    points = np.column_stack([corners, np.full(8, 0.4)])
    fields = {"deviation": np.float32([0.001] * 4 + [np.nan] * 4), "class": np.uint8([1] * 4 + [2] * 4)}
    vertices = Cloud(points, np.tile(np.float32(UP), (8, 1)), np.zeros((8, 3), np.uint8), fields)
    faces = np.array([[0, 1, 2], [2, 3, 0], [4, 5, 6], [6, 7, 4]])
    surface = Surface(vertices, faces, np.uint8([1, 1, 2, 2]), 0.0)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]] * 2, np.float64)[faces]
    picture = np.repeat(np.uint8([RED, BLUE]), 32, axis=0)[:, None].repeat(64, axis=1)
    before, added = grid(), grid(9, 0.05, 0.4)
    deviation = np.linspace(0.001, 0.05, len(before) + len(added)).astype(np.float32)
    house = tmp_path / "house"
    house.mkdir()
    (house / "fused.ply").touch()
    write_surface(house / "surface.ply", surface)
    write_glb(house / "surface.glb", surface, {}, 1.0, uv, picture)
    write_json(house / "surface.json", surface_report(surface, "m"))
    browser.open(report(tmp_path, {"house": view_of(before, completed(before, added, deviation=deviation))}))
    ready(browser)
    assert "photos on the mesh" in browser.find(f"{SECTION} .view-legend").text  # it is shown first
    choose(browser, "After")
    choose(browser, "Source")
    choose(browser, "Mesh")
    browser.value("await new Promise((next) => setTimeout(next, 400));")
    # What a mesh does not have is not offered, and another colour is chosen.
    assert "Source" not in browser.find(f"{SECTION} .colour").text
    photos, legend = browser.picture(STAGE), f"{SECTION} .view-legend"
    assert middle_of(photos, RED)[1] < middle_of(photos, BLUE)[1]
    assert middle_of(photos, BRIDGED_TINT)[0] > middle_of(photos, RED)[0]
    assert re.search("photos on the mesh.*bridged: interpolated.*4 triangles", browser.find(legend).text, re.DOTALL)
    choose(browser, "Class")
    classes = browser.picture(STAGE)
    assert changed(photos, classes) > 0.1 and "measured: beside points" in browser.find(legend).text
    assert classes[..., 1].mean() > photos[..., 1].mean()
    choose(browser, "Std. deviation")
    assert changed(browser.picture(STAGE), classes) > 0.1
    # Three clicks give the command that draws a facade, with points of the cloud in the scene's frame.
    choose(browser, "Draw a facade")
    stage = browser.find(STAGE)
    width, height = stage.size["width"], stage.size["height"]
    for right, down in ((0.4, 0.45), (0.55, 0.45), (0.5, 0.6)):
        click(browser, stage, right * width, down * height)
    assert browser.find(f"{SECTION} output").text == "Below is the command that draws it, in the project's folder."
    words = browser.find(f"{SECTION} .command").text.split()
    assert words[:6] == ["scenefuse", "export", "--what", "drawings", "--object", "house"]
    clicked = np.array(words[7:], np.float64).reshape(3, 3)
    cloud = np.concatenate([before.points, added.points])
    assert np.linalg.norm(cloud[:, None] - clicked, axis=2).min(0).max() < 1e-3 and len(np.unique(clicked, axis=0)) == 3
    # A word of a command line that begins with a minus and is no plain number is an option.
    assert all(re.fullmatch(r"-?\d+(\.\d+)?", word) for word in words[7:]), words
    choose(browser, "Draw a facade")
    assert not browser.find(f"{SECTION} .command").is_displayed()
    choose(browser, "Before")
    assert "441 points" in browser.find(legend).text and browser.complaints() == []


def test_colours_whose_fields_are_absent_are_not_offered(opened):
    labels = opened.find("[aria-label='3D view of shed'] .colour").text
    assert "Natural" in labels and "Source" in labels
    assert "Class" not in labels and "deviation" not in labels


def test_two_clicked_points_are_measured_in_the_scenes_unit(opened):
    choose(opened, "Measure")
    picture, stage = opened.picture(STAGE), opened.find(STAGE)
    for color in (RED, BLUE):
        click(opened, stage, *middle_of(picture, color))
    # With one standard deviation, of both points, 0.050 m, and of a scale known to 5 %.
    assert opened.find(f"{SECTION} output").text == "1.200 ± 0.078 m"
    assert "1.200 ± " in opened.find(f"{SECTION} .marks").get_attribute("textContent")
    assert (np.abs(opened.picture(STAGE).astype(int) - ACCENT).max(2) < 20).sum() > 50
    # The marks stay on the points while the view turns.
    stage.send_keys(ARROW_RIGHT * 3)
    opened.value(SETTLE)
    marks = opened.value(
        "return [...document.querySelectorAll(given[0])].map((c) => [+c.getAttribute('cx'), +c.getAttribute('cy')]);",
        f"{SECTION} .marks circle",
    )
    stage.send_keys(ESCAPE)
    turned = opened.picture(STAGE)
    assert changed(turned, picture) > 0.05
    for mark, color in zip(marks, (RED, BLUE)):
        # A ball's visible part is not quite around its middle.
        np.testing.assert_allclose(mark, middle_of(turned, color), atol=8)
        assert np.abs(np.subtract(mark, middle_of(picture, color))).max() > 15
    assert opened.find(f"{SECTION} output").text == ""


def test_a_length_between_points_whose_deviations_are_unknown_is_known_to_the_scale_at_best(opened):
    ready(opened, "shed")
    choose(opened, "Measure", "shed")
    stage = opened.find("[aria-label='3D view of shed'] .view-stage")
    for x in (-60, 60):
        click(opened, stage, stage.size["width"] / 2 + x, stage.size["height"] / 2)
    said = opened.find("[aria-label='3D view of shed'] output").text
    found = re.fullmatch(r"([\d.]+) ± ([\d.]+) m or more", said)
    assert found and float(found[2]) == pytest.approx(0.05 * float(found[1]), rel=0.05), said


def test_a_length_in_a_view_of_kilometres_is_no_more_exact_than_the_page_holds_its_ends(opened):
    script = """
    const land = [...views.values()].find((v) => v.section.ariaLabel.endsWith("land"));
    land.picked = [[0, 0, 0], [1.0123, 0, 0]].map((place) => Object.assign(place, { deviation: given[0] }));
    land.about = { ...land.about, scale_sd: 0 };
    return land.distance();
    """
    # Of 2 km in 65,536 steps: each axis is known to 9 mm.
    assert [opened.value(script, sd) for sd in (0, 0.001)] == ["1.01 m", "1.012 ± 0.018 m"]


def test_dragging_turns_and_the_wheel_zooms_once_the_view_is_in_use(opened):
    stage, first = opened.find(STAGE), opened.picture(STAGE)
    camera = camera_of(opened)
    opened.wheel(stage, -240)
    opened.value("await new Promise((next) => setTimeout(next, 300));")
    np.testing.assert_allclose(camera_of(opened), camera, atol=1e-9)
    ready(opened)
    opened.drag(stage, 150, 0)
    opened.value(SETTLE)
    assert changed(opened.picture(STAGE), first) > 0.05
    turned = camera_of(opened)
    np.testing.assert_allclose(np.linalg.norm(turned[:3]), np.linalg.norm(camera[:3]), rtol=1e-3)
    opened.wheel(stage, -240)
    opened.value("await new Promise((next) => setTimeout(next, 300));")
    assert np.linalg.norm(camera_of(opened)[:3]) < 0.99 * np.linalg.norm(turned[:3])
    choose(opened, "Reset view")
    assert changed(opened.picture(STAGE), first) < 0.001


def test_everything_is_named_and_reached_by_the_keyboard(opened):
    opened.value("document.querySelector(given[0]).focus();", f"{SECTION} .when input:checked")
    kinds = []
    for _ in range(6):
        opened.window.switch_to.active_element.send_keys(TAB)
        active = opened.window.switch_to.active_element
        kinds.append(active.get_attribute("name") or active.get_attribute("role") or active.text)
        assert active.accessible_name, kinds
    assert kinds[:1] == ["colour-object-house"] and {"Measure", "Reset view", "application"} <= set(kinds)
    first = opened.picture(STAGE)
    opened.find(STAGE).send_keys("+++")
    opened.value(SETTLE)
    assert changed(opened.picture(STAGE), first) > 0.05


@pytest.mark.process
def test_a_phone_shows_turns_and_measures_without_scrolling_sideways(page, tmp_path):
    with chromium(phone=True) as phone:
        phone.open(report(tmp_path, {"the_north_wing_of_the_old_mill_seen_from_the_other_bank_of_it": None}))
        assert phone.value("return [innerWidth, document.documentElement.scrollWidth];") == [390, 390]
        phone.open(page)
        ready(phone)
        phone.value("const n = document.querySelector('nav'); n.innerHTML += Array(6).fill(n.innerHTML).join('');")
        assert phone.value("return [innerWidth, document.documentElement.scrollWidth];") == [390, 390]
        boxes = phone.value(
            "return [...document.querySelectorAll(given[0])].map((b) => b.getBoundingClientRect().toJSON());",
            f"{SECTION} .view-tools span, {SECTION} button:not([hidden])",
        )
        assert all(box["left"] >= 0 and box["right"] <= 390 and box["height"] >= 34 for box in boxes)
        stage, first = phone.find(STAGE), phone.picture(STAGE)
        assert 300 <= stage.size["height"] <= 0.7 * 844 and first.reshape(-1, 3).std(0).max() > 20
        # Under a finger the page scrolls, until the view is tapped.
        camera, top = camera_of(phone), phone.value("return scrollY;")
        touch(phone, stage, [(180, 260), (180, 200), (180, 120)])
        phone.value(SETTLE)
        np.testing.assert_allclose(camera_of(phone), camera)
        assert phone.find(f"{SECTION} .wake").is_displayed()
        touch(phone, stage, [(180, 200)])
        assert not phone.find(f"{SECTION} .wake").is_displayed()
        choose(phone, "Measure")
        first = phone.picture(STAGE)
        for color in (RED, BLUE):
            touch(phone, stage, [middle_of(first, color)])
        assert phone.find(f"{SECTION} output").text.startswith("1.200 ± ")
        choose(phone, "Measure")
        camera, top = camera_of(phone), phone.value("return scrollY;")
        touch(phone, stage, [(100, 100), (160, 140), (220, 160)])
        phone.value(SETTLE)
        assert np.abs(np.subtract(camera_of(phone), camera)).max() > 0.1
        assert phone.value("return scrollY;") == top
        assert phone.complaints() == []


# A client's questions, and what answers each.
QUESTIONS = {
    "how large is it?": r"11\.4 m × 10\.1 m, 7\.85 m high",
    "how exact?": r"12\.9 mm in the scene, the standard deviation of a point",
    "what is missing?": r"2\.0 % is missing: 0\.9 % seen by no photo",
    "which CRS?": r"UTM zone 32N \(EPSG:25832\)",
    "which heights?": r"which does not say whether above the ellipsoid or the sea",
    "when?": "2024-06-01",
    "when were the close-ups taken?": "taken 2024-06-02",
    "how many photos?": "40 of 40 used",
    "may I trust the scale?": r"trust it to 0\.2 %, 22\.4 mm on a 10 m wall",
    "where is the file?": r"objects/\s*house/\s*fused\.ply",
    "what next?": "photograph it from 4 places",
    "who made it?": r"Made with scenefuse \d.* on 20\d\d-\S+ by Hof Müller",
    "which frame?": r"with its surroundings \(local frame, metres; for CloudCompare\)",
    "what is that beside the GPS?": r"on Earth as exact as the scene \(see Position\)",
}
SHOWN = """
const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const range = document.createRange();
  range.selectNodeContents(walker.currentNode);
  const { left, right, bottom } = range.getBoundingClientRect();
  if (walker.currentNode.parentElement.checkVisibility() && left >= 0 && right <= innerWidth)
    found.push([(bottom + scrollY) / innerHeight, walker.currentNode.data]);
}
return found;
"""


@pytest.mark.process
@pytest.mark.parametrize(("phone", "screens"), [(False, 2), (True, 3)])
def test_a_clients_questions_are_answered_by_the_first_screens(tmp_path, phone, screens):
    page = report(tmp_path, {"house": None})
    rows = {
        "scenes": "scene=yard length_unit=m points=900 completed_points=1000 completed_by=house crs=EPSG:25832"
        " latitude_deg=47.5 longitude_deg=9.1 altitude_m=470"
        " photographed=2024-06-01 photos=60 registered=60 gps_scale_sd_log=0.002 made_by=Hof_Müller",
        "objects": "object=house scene=yard status=registered unit=m length=11.4 width=10.1 height=7.85"
        " surface_missing=0.02 surface_never_seen=0.009 deviation=0.00692 world_deviation=0.0129"
        " scale_sd_log=0.001 scene_scale_sd_log=0.002 crs=EPSG:25832 photographed=2024-06-02"
        " surface_untextured=0.011 registered=40 frames=40 added_points=75 stations=4 stations_show=0.7",
    }
    for name, row in rows.items():
        columns, cells = zip(*(pair.split("=") for pair in row.split()))
        (tmp_path / f"summary/{name}.tsv").write_text(
            "\t".join(columns) + "\n" + "\t".join(cells).replace("f_M", "f M") + "\n"
        )
    (tmp_path / "yard").mkdir()
    known = {"scenes": [tmp_path / "yard"], "objects": [tmp_path / "house"], "title": "test", "report": page}
    write_report(summary=tmp_path / "summary", **known)
    with chromium("--window-size=1400,900", phone=phone) as window:
        window.open(page)
        shown = [text for at, text in window.value(SHOWN) if at <= screens]
        assert window.complaints() == []
    said = "\n".join(shown).replace("\u00a0", " ")
    assert [question for question, answer in QUESTIONS.items() if not re.search(answer, said, re.IGNORECASE)] == []


@pytest.mark.process
def test_a_browser_without_webgl_says_so(page):
    with chromium("--disable-gpu", "--disable-3d-apis") as old:
        old.open(page)
        note = f"{SECTION} .view-note"
        old.value("while (!document.querySelector('[data-state=failed]')) await new Promise((n) => setTimeout(n, 20));")
        assert "The 3D view cannot be shown" in old.find(note).text and "WebGL" in old.find(note).text


def test_a_page_of_many_views_keeps_few_of_them_alive(browser, tmp_path):
    view = view_of(grid(), completed(grid(), grid(9, 0.05, 0.4, (200, 190, 60))))
    names = [f"house{k}" for k in range(6)]
    browser.open(report(tmp_path, dict.fromkeys(names, view)))
    for name in names:
        ready(browser, name)
        assert browser.value("return live.length;") <= 4
    ready(browser, names[0])
    assert browser.picture(f"[aria-label='3D view of {names[0]}'] .view-stage").reshape(-1, 3).std(0).max() > 20
    # K3D gives a context back twice, and WebGL says so.
    assert [line for line in browser.complaints() if "context" not in line.lower()] == []


def test_a_double_click_moves_the_centre_of_turning(opened):
    point = middle_of(opened.picture(STAGE), RED)
    opened.double_click(opened.find(STAGE), *point)
    np.testing.assert_allclose(camera_of(opened)[3:6], [-0.6, -0.6, -0.2], atol=1e-3)
    opened.value(SETTLE)
    moved = middle_of(opened.picture(STAGE), RED)
    box = opened.find(STAGE).size
    np.testing.assert_allclose(moved, [box["width"] / 2, box["height"] / 2], atol=12)


def test_objects_that_are_not_in_the_scene_have_no_view(tmp_path):
    text = report(tmp_path, {"house": None}, status="unregistered").read_text()
    assert "There is no 3D view, for it was not added to the scene." in text
    assert 'class="view"' not in text and 'id="k3d"' not in text


def test_no_object_of_many_has_the_colour_of_its_scene():
    whole = grid()
    whole.fields["source"] = np.arange(len(whole)).astype(np.uint16) % 12
    view = replace(view_of(grid(), whole), sources={k: f"object {k}" for k in range(12)})
    about = json.loads(re.search(r'class="about">(.*?)</script>', view_section("key", "yard", view))[1])
    colors = {entry["label"]: entry["color"] for entry in about["modes"][1]["entries"]}
    assert len(colors) == 12 and list(colors.values()).count(colors["object 0"]) == 1


def test_more_views_than_a_page_holds_get_fewer_points_each(tmp_path, monkeypatch):
    monkeypatch.setattr("scenefuse.report.write_report.PAGE_POINTS", 2000)
    view = view_of(grid(40), completed(grid(40), grid(9, 0.05, 0.4)))
    text = report(tmp_path, {"house": view, "shed": view}).read_text()
    counts = [sum(json.loads(about)["points"].values()) for about in re.findall(r'class="about">(.*?)</script>', text)]
    assert len(counts) == 2 and all(700 < count <= 1000 for count in counts)


def test_a_length_is_as_exact_in_the_scene_s_view_as_its_scale(tmp_path):
    page, yard, view = report(tmp_path, {}), tmp_path / "yard", view_of(grid(), completed(grid(), grid(9, 0.05, 0.4)))
    yard.mkdir()
    Image.new("RGB", (40, 30)).save(yard / "scene.png")
    write_view(yard, view)
    (tmp_path / "summary/scenes.tsv").write_text("scene\tgps_scale_sd_log\nyard\t0.03\n")
    write_report(summary=tmp_path / "summary", scenes=(yard,), title="test", report=page)
    assert json.loads(re.search(r'class="about">(.*?)</script>', page.read_text())[1])["scale_sd"] == 0.03
    assert "Objects boxed." in page.read_text() and "Cameras red" not in page.read_text()  # a given cloud has none


@pytest.mark.slow
def test_a_page_of_three_objects_and_a_scene_stays_below_15_mb(tmp_path, monkeypatch):
    rng, count = np.random.default_rng(0), VIEW_POINTS
    points = rng.normal(size=(count, 3))
    points *= (5 + rng.normal(0, 0.01, (count, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    colors = np.clip(rng.normal(128, 40, (count, 1)) + rng.normal(0, 10, (count, 3)), 0, 255)
    fields = {"deviation": rng.gamma(2, 0.01, count).astype(np.float32)}
    fields |= {name: rng.integers(0, most, count).astype(np.uint8) for name, most in (("evidence", 4), ("source", 2))}
    whole = Cloud(points, (points / 5).astype(np.float32), colors.astype(np.uint8), fields)
    view = view_of(whole[whole.fields["source"] == 0], whole)
    packed = encode(view)
    monkeypatch.setattr("scenefuse.report.page.encode", lambda _: packed)  # all four are the same
    page = report(tmp_path, dict.fromkeys(("house", "shed", "barn", "all"), view))
    assert 3_000_000 < page.stat().st_size < 11_000_000  # the pictures of three objects take 3 MB
