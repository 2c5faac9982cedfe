"""The report's page in a real browser: quiet, whole, and readable on a phone and on a desk."""

from pathlib import Path

import pytest

from pipistrelle.report import page as module
from pipistrelle.report.page import write_report
from pipistrelle.report.study import read_study
from reference.pages import WIDTHS, contrasts, shown
from report.invented import invent, narrowed, only
from report.planted import LEVELS, by_level, write_planted

FIGURES = (
    "gain", "anees_ekf", "anees_fastslam", "position_rmse",
    "position_rmse_aligned", "heading_rmse", "map_rmse", "map_rmse_aligned",
    "landmarks", "table_ii", "piston", "example_map",
)  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_write_figure", lambda *_: None)
        write_report(invent(8, planned=115), folder)
    return folder / "index.html"


WRITTEN = "h1,h2,h3,.answer,.lede li,.verdict,.note,.tile,td,th,td small"
"""Where something is written."""
SCREENS = [
    pytest.param((screen, scheme), id=f"{screen}-{scheme}", marks=marks)
    for screen, scheme, marks in (
        ("phone", "dark", ()),
        ("desk", "light", ()),
        ("phone", "light", pytest.mark.slow),
        ("desk", "dark", pytest.mark.slow),
    )
]


@pytest.fixture(scope="module", params=SCREENS)
def opened(browser, written, request):
    """The page, and everything that it complained about or asked for."""
    page, noise = shown(browser, written, *request.param)
    yield page, noise
    page.context.close()


def test_the_page_loads_without_messages_and_requests_only_itself(opened, written):
    page, noise = opened
    page.wait_for_load_state("networkidle")
    assert [word for word in noise if not word.startswith("data:")] == [written.as_uri()]


def test_nothing_is_wider_than_the_screen(opened):
    page, _ = opened
    inner = page.evaluate("document.documentElement.clientWidth")
    assert page.evaluate("document.documentElement.scrollWidth") <= inner
    for name in FIGURES:
        box = page.locator(f"figure#{name}").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= inner


def test_every_figure_and_every_panel_is_visible(opened):
    page, _ = opened
    assert page.locator("figure").count() == len(FIGURES)
    for name in FIGURES:
        panels = page.locator(f"figure#{name} svg.panel:visible")
        assert panels.count() >= 1
        for i in range(panels.count()):
            box = panels.nth(i).bounding_box()
            assert box["width"] >= 250
            assert box["height"] >= 150


@pytest.fixture(scope="module")
def grid(tmp_path_factory) -> Path:
    """The page of a study of two variables, one filter and two strategies."""
    folder = tmp_path_factory.mktemp("grid")
    plan = '"rays.weights" = ["instantaneous", "aggregated"]\n' + LEVELS
    ways = 'filters = ["ekf"]\nstrategies = ["fused", "passive"]\n'
    write_planted(folder / "s", plan, ways=ways, effect=by_level(0.3), worlds=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_write_figure", lambda *_: None)
        write_report(read_study(folder / "s"), folder / "r")
    return folder / "r" / "index.html"


def test_figures_of_a_single_filter_fill_the_page_side_by_side(browser, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_write_figure", lambda *_: None)
    ways = [("ekf", way) for way in ("active", "fused", "passive")]
    write_report(narrowed(only(invent(3), ways), [0, 11]), tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((tmp_path / "index.html").as_uri())
    whole = page.locator("main").bounding_box()["width"]
    left, right = (
        page.locator(f"figure#{name}").bounding_box() for name in ("position_rmse", "heading_rmse")
    )
    assert left["y"] == right["y"]
    assert left["width"] + right["width"] > 0.95 * whole
    alone = page.locator("figure#position_rmse svg.panel:visible")
    assert alone.count() == 1
    assert alone.bounding_box()["width"] > 0.9 * left["width"]
    page.close()


def test_the_last_of_an_odd_number_of_single_panels_has_its_caption_at_its_side(
    browser, tmp_path, monkeypatch
):
    monkeypatch.setattr(module, "_write_figure", lambda *_: None)
    write_report(only(invent(3), [("ekf", "active"), ("ekf", "fused")]), tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((tmp_path / "index.html").as_uri())
    lone = page.locator("figure.lone")
    assert [one.get_attribute("id") for one in lone.all()] == ["map_rmse_aligned"]
    whole = page.locator("main").bounding_box()["width"]
    panel = lone.locator("svg.panel:visible").bounding_box()
    words = lone.locator("figcaption:visible").bounding_box()
    assert lone.bounding_box()["width"] > 0.95 * whole
    assert words["x"] > panel["x"] + panel["width"]
    assert panel["y"] - 20 < words["y"] < panel["y"] + panel["height"]
    page.close()


@pytest.mark.parametrize("look", SCREENS)
def test_a_grids_answer_and_effects_are_on_the_first_screen_and_nothing_is_cut(browser, grid, look):
    screen, scheme = look
    context = browser.new_context(
        viewport={"width": WIDTHS[screen], "height": 900}, color_scheme=scheme
    )
    page, noise = context.new_page(), []
    page.on("console", lambda message: noise.append(message.text))
    page.on("pageerror", lambda error: noise.append(str(error)))
    page.goto(grid.as_uri())
    assert noise == []
    inner = page.evaluate("document.documentElement.clientWidth")
    assert page.evaluate("document.documentElement.scrollWidth") <= inner
    answer = page.locator(".answer").bounding_box()
    assert answer["y"] + answer["height"] < 450
    assert page.locator(".lede li").first.bounding_box()["y"] < 900
    if screen == "desk":
        table = page.locator('section[data-variable="beacon.level_db"] table').first
        assert table.bounding_box()["y"] < 900
        shown = page.locator("#effects td.shown")
        assert shown.count() >= 2
        assert shown.first.evaluate("e => getComputedStyle(e).fontWeight") == "650"
    assert contrasts(page, WRITTEN)[0][0] >= 4.5
    context.close()


def test_names_of_values_are_read_out_on_a_grids_panels(browser, grid):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(grid.as_uri())
    page.locator("figure#position_rmse_by_beacon_level_db .none svg.panel").first.focus()
    page.keyboard.press("ArrowRight")
    readout = page.locator("#readout")
    readout.wait_for(state="visible")
    assert readout.inner_text().splitlines()[0] == "beacon.level_db = 36.8"
    assert "fused: " in readout.inner_text()
    page.locator("figure#position_rmse_by_rays_weights .none svg.panel").first.focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("#readout").inner_text().splitlines()[0] == "instantaneous"
    page.close()


def test_the_eight_verdicts_are_visible(opened):
    page, _ = opened
    assert page.locator("#scoreboard").is_visible()
    assert page.locator("[data-sentence]").count() == 26
    sections = page.locator("section[data-claim]")
    assert sections.count() == 8
    for i in range(8):
        verdict = sections.nth(i).get_attribute("data-verdict")
        assert verdict in ("reproduced", "not-reproduced", "open")
        shown = sections.nth(i).locator(".verdict")
        assert shown.is_visible()
        assert shown.inner_text().lower().startswith(verdict.replace("-", " "))


def test_the_answer_comes_first_and_a_partial_study_is_marked(opened):
    page, _ = opened
    answer, partial = (page.locator(name).bounding_box() for name in (".answer", "#partial"))
    first = page.locator("section[data-claim]").first.bounding_box()
    assert answer["y"] < partial["y"] < first["y"]
    assert "8 of 115 worlds are done" in page.locator("#partial").inner_text()


def test_a_finger_or_a_mouse_reads_the_numbers_out(opened):
    page, _ = opened
    panel = page.locator("figure#position_rmse .world svg.panel").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    at = box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"]
    if page.evaluate("navigator.maxTouchPoints > 0"):
        page.touchscreen.tap(*at)
    else:
        page.mouse.move(*at)
    readout = page.locator("#readout")
    assert readout.is_visible()
    text = readout.inner_text()
    assert all(name in text for name in ("active: ", "fused: ", "passive: ", " ± ", "°"))
    shown, width = readout.bounding_box(), page.evaluate("innerWidth")
    assert shown["x"] >= 0
    assert shown["x"] + shown["width"] <= width


def test_arrow_keys_walk_through_the_numbers_and_escape_ends_it(opened):
    page, _ = opened
    page.mouse.move(0, 0)
    page.locator("figure#landmarks .world svg.panel").first.focus()
    readout = page.locator("#readout")
    said = []
    for _ in range(3):
        page.keyboard.press("ArrowRight")
        readout.wait_for(state="visible")
        said.append(readout.inner_text().splitlines()[0])
    page.keyboard.press("ArrowLeft")
    assert said == ["11°", "14°", "18°"]
    assert readout.inner_text().splitlines()[0] == "14°"
    page.keyboard.press("Escape")
    assert readout.is_hidden()


def test_the_map_shows_the_numbers_of_its_landmarks(opened):
    page, _ = opened
    page.locator("figure#example_map svg.panel").focus()
    page.keyboard.press("ArrowLeft")
    page.locator("#readout").wait_for(state="visible")
    assert page.locator("#readout").inner_text().startswith("beacon\nx: ")
    page.keyboard.press("Escape")


def test_the_switch_shows_the_figures_under_another_rule(opened):
    page, _ = opened
    for rule in ("case", "none", "world"):
        page.locator(f"label[for=rule-{rule}]").click()
        for other in ("world", "case", "none"):
            shown = page.locator(f"figure#gain .by-rule.{other}").is_visible()
            assert shown == (other == rule)


def test_text_contrasts_with_its_background(opened):
    """At least 4.5 to 1, as the accessibility guidelines ask for."""
    page, _ = opened
    ratios = contrasts(page, WRITTEN)
    assert len(ratios) > 50
    assert [(ratio, what) for ratio, what in ratios if ratio < 4.5] == []


def test_on_paper_nothing_is_left_that_needs_a_screen(opened):
    page, _ = opened
    page.emulate_media(media="print")
    assert page.locator(".switch > input").first.is_hidden()
    assert page.locator("figure#gain .world").is_visible()
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(media="screen")
    assert ground == "rgb(255, 255, 255)"
