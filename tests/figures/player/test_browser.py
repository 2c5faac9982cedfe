"""The page in a real browser: it plays, it answers to keys and fingers, and it is quiet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import placed
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.figures.player import Rows, playback
from pipistrelle.figures.player import page as written_page
from reference.pages import contrasts, shown


@pytest.fixture(scope="module")
def written(played, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(written_page(played), encoding="utf-8")
    return path


@pytest.fixture(
    scope="module",
    params=[("phone", "dark"), ("desk", "light")],
    ids=lambda screen: "-".join(screen),
)
def opened(browser, written, request):
    page, noise = shown(browser, written, *request.param)
    yield page, noise
    page.context.close()


@pytest.fixture
def desk(browser, written):
    """A page of one's own."""
    page, _ = shown(browser, written)
    yield page
    page.context.close()


@pytest.fixture
def page_of(browser, tmp_path):
    """Open the page of a playback; at the end it must have been quiet."""
    path, pages = tmp_path / "view.html", []

    def opened_page(played):
        path.write_text(written_page(played), encoding="utf-8")
        pages.append(shown(browser, path))
        return pages[-1][0]

    yield opened_page
    for page, noise in pages:
        assert noise == [path.as_uri()]
        page.context.close()


def pose_shown(page, place=0):
    """Where a panel says that the vehicle is."""
    data = page.locator(".panel").nth(place).evaluate("panel => ({ ...panel.dataset })")
    return np.array([float(data["x"]), float(data["y"])])


def middle(page, layer, place=0):
    """The middle of a shape on a map, in the world's coordinates."""
    box = page.locator(f".panel >> nth={place} >> svg.map >> nth=0 >> path.{layer}").evaluate(
        "path => { const b = path.getBBox(); return [b.x + b.width / 2, -b.y - b.height / 2]; }"
    )
    return np.array(box)


def shapes(page, layer, place=0):
    """How many shapes a layer of a map holds."""
    path = page.locator(f".panel >> nth={place} >> svg.map >> nth=0 >> path.{layer}")
    return (path.get_attribute("d") or "").count("M")


def frame_shown(page):
    return int(page.locator("#slider").input_value()) + 1


def go(page, frame):
    page.locator("#slider").fill(str(frame - 1))


def until(page, expression):
    """Wait for what a page does by itself; its policy lets no string be a script."""
    for _ in range(200):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(50)
    raise AssertionError(expression)


def estimate_of(played, strategy, estimator="ekf"):
    (found,) = [e for e in played.estimates if (e.strategy, e.filter) == (strategy, estimator)]
    return found


def test_the_page_loads_without_messages_or_other_requests(opened, written):
    page, noise = opened
    page.wait_for_load_state("networkidle")
    go(page, 40)
    go(page, 1)
    assert [word for word in noise if not word.startswith("data:")] == [written.as_uri()]


def test_nothing_is_wider_than_the_screen(opened):
    page, _ = opened
    inner = page.evaluate("document.documentElement.clientWidth")
    assert page.evaluate("document.documentElement.scrollWidth") <= inner
    for name in (".panel", "svg.map", ".plot", ".bar", "#slider", "#clock", "#speed"):
        boxes = [each.bounding_box() for each in page.locator(name).all()]
        assert boxes, name
        for box in boxes:
            assert box["x"] >= 0, name
            assert box["x"] + box["width"] <= inner + 0.5, name


def test_a_frame_shows_the_vehicle_where_it_is_believed_and_where_it_is(opened, played):
    page, _ = opened
    assert page.locator(".panel").first.get_attribute("data-estimate") == "fused · EKF"
    drawn = []
    for frame in (1, 20, 40):
        go(page, frame)
        pose = estimate_of(played, "fused").pose[frame - 1]
        assert pose_shown(page) == pytest.approx(pose[:2], abs=1e-4)
        dart = page.evaluate("DART_PIXELS * panels[0].map.pixel")
        drawn.append(middle(page, "vehicle"))
        assert np.hypot(*(drawn[-1] - pose[:2])) < 0.3 * dart
        true = played.true_pose[frame - 1]
        assert np.hypot(*(middle(page, "true-vehicle") - true[:2])) < 0.3 * dart
        assert page.locator("#clock").inner_text() == f"{0.5 * frame:.1f} s · {frame} of 40"
    assert np.hypot(*(drawn[-1] - drawn[0])) > 5.0


@pytest.mark.parametrize("frame", [1, 12, 40])
def test_the_map_shows_the_current_frame(opened, watched, frame):
    page, _ = opened
    _, snapshots = watched
    go(page, frame)
    for place, strategy in enumerate(("fused", "active")):
        seen = snapshots[strategy, "ekf"][frame - 1]
        full = placed(seen.landmarks)
        members = sum(shapes(page, f"member-{level}", place) for level in range(1, 7))
        assert members == (~full).sum()
        assert shapes(page, "dots", place) == shapes(page, "placed", place) == full.sum()
        ranged = np.isfinite(seen.scan.range)
        assert shapes(page, "ranges", place) == ranged.sum()
        assert shapes(page, "bearings", place) == (~ranged).sum()
    assert members == 0, "active sensing has no rays"


def test_rays_are_weighed_and_pruned_before_ones_eyes(desk, played):
    estimate = estimate_of(played, "fused")
    gone = np.diff(estimate.pruned.first)
    frame = int(np.argmax(gone)) + 1
    assert gone.max() > 0
    go(desk, frame)
    assert shapes(desk, "pruned-1") == gone[frame - 1]
    go(desk, frame + 1)
    assert shapes(desk, "pruned-2") == gone[frame - 1]
    rows = slice(*estimate.mapped.first[frame - 1 : frame + 1])
    labels, weight = estimate.mapped.landmark[rows], estimate.mapped.numbers[rows, 5]
    alone = np.array([np.sum(labels == label) == 1 for label in labels])
    go(desk, frame)
    heavy = np.sum(weight[~alone] >= 5 / 6)
    assert shapes(desk, "member-6") == heavy
    opacity = [
        float(desk.locator(f"svg.map path.member-{level}").first.evaluate(
            "path => getComputedStyle(path).fillOpacity"
        ))
        for level in range(1, 7)
    ]  # fmt: skip
    assert np.all(np.diff(opacity) > 0), "the likelier, the darker"


def test_the_beam_is_shown_where_the_strategy_calls(desk):
    go(desk, 10)
    selects = desk.locator(".head select")
    selects.nth(1).select_option(label="passive · EKF")
    assert shapes(desk, "beam", 0) == 1
    assert shapes(desk, "beam", 1) == 0


def test_particles_are_shown_where_there_are_any(desk):
    go(desk, 30)
    assert shapes(desk, "cloud") == 0
    desk.locator(".head select").first.select_option(label="fused · FastSLAM 2.0")
    assert shapes(desk, "cloud") == 100
    assert frame_shown(desk) == 30, "another estimate is shown at the same time"


def test_keys_go_from_frame_to_frame(desk):
    told = {
        "ArrowRight": 2, "Shift+ArrowRight": 12, "ArrowLeft": 11, "Shift+ArrowLeft": 1, "End": 40,
        "Home": 1,
    }  # fmt: skip
    for key, frame in told.items():
        desk.keyboard.press(key)
        assert frame_shown(desk) == frame, key
    desk.keyboard.press("ArrowLeft")
    assert frame_shown(desk) == 1
    desk.locator("#slider").focus()
    desk.keyboard.press("ArrowRight")
    assert frame_shown(desk) == 2, "the slider does not go on its own beside"


def test_space_plays_until_it_is_pressed_again_and_to_the_end(desk):
    desk.locator("#speed").select_option("10")
    desk.locator("body").click(position={"x": 5, "y": 5})
    desk.keyboard.press("Space")
    until(desk, "control.slider.value > 3")
    assert desk.locator("#play").get_attribute("aria-label") == "Pause"
    desk.keyboard.press("Space")
    stopped = frame_shown(desk)
    assert desk.locator("#play").get_attribute("aria-label") == "Play"
    desk.wait_for_timeout(200)
    assert frame_shown(desk) == stopped
    desk.locator("#speed").select_option("100")
    desk.locator("#play").click()
    until(desk, "control.slider.value === '39' && !state.playing")
    desk.locator("#speed").select_option("10")  # at a hundred it is over before it is looked at
    desk.locator("#play").click()
    until(desk, "state.playing && control.slider.value < 39")


def test_a_button_with_the_focus_is_not_pressed_twice_by_space(desk):
    desk.locator("#play").focus()
    desk.keyboard.press("Space")
    assert desk.evaluate("state.playing")


def test_estimates_are_shown_singly_or_side_by_side(desk):
    selects = desk.locator(".head select")
    assert [each.input_value() for each in selects.all()] == ["2", "0"]
    selects.nth(0).select_option(label="nothing")
    assert desk.locator(".panel").count() == 1
    assert desk.locator(".panel").get_attribute("data-estimate") == "active · EKF"
    desk.locator("#beside").click()
    assert desk.locator(".panel").count() == 2
    assert desk.locator("#beside").is_hidden()
    left, right = (desk.locator(".panel").nth(i).bounding_box() for i in (0, 1))
    assert left["y"] == right["y"]
    assert left["x"] + left["width"] <= right["x"]


def test_charts_show_the_errors_and_move_to_a_clicked_frame(desk, played):
    go(desk, 25)
    estimate = estimate_of(played, "fused")
    off = np.hypot(*(estimate.pose[24] - played.true_pose[24])[:2])
    bound = 3.0 * np.sqrt(estimate.spread[24, 0] + estimate.spread[24, 2])
    said = desk.locator(".position output").first.inner_text()
    assert said == f"{off:.2f} m, 3σ {bound:.2f} m"
    plot = desk.locator(".position .plot").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    desk.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 10)
    assert frame_shown(desk) == pytest.approx(20, abs=1)


def test_both_panels_have_one_scale(desk):
    boxes = [desk.locator(".position svg").nth(i).get_attribute("viewBox") for i in (0, 1)]
    assert boxes[0] == boxes[1]
    maps = [desk.locator("svg.map:not(.near)").nth(i).get_attribute("viewBox") for i in (0, 1)]
    assert maps[0] == maps[1]


def test_a_selected_landmark_shows_its_details(desk, played):
    go(desk, 40)
    estimate = estimate_of(played, "fused")
    rows = slice(*estimate.mapped.first[39:41])
    labels, numbers = estimate.mapped.landmark[rows], estimate.mapped.numbers[rows]
    alone = [label for label in labels if np.sum(labels == label) == 1 and label != 21]
    many = [label for label in labels if np.sum(labels == label) > 1]
    assert alone
    assert many
    for label, words in ((alone[0], "placed since "), (many[0], "a ray of ")):
        desk.keyboard.press("Escape")
        x, y = numbers[labels == label][0, :2].tolist()
        at = desk.evaluate(
            "([x, y]) => { const p = new DOMPoint(x, -y)"
            ".matrixTransform(panels[0].map.svg.getScreenCTM()); return [p.x, p.y]; }",
            [x, y],
        )
        desk.mouse.click(*at)
        story = desk.locator(".told").first.inner_text()
        chosen = desk.evaluate("state.chosen")
        assert f"Landmark {chosen}: " in story
        if chosen == label:
            assert words in story
        assert shapes(desk, "chosen") == np.sum(labels == chosen)
    desk.keyboard.press("Escape")
    assert "Select a landmark" in desk.locator(".told").first.inner_text()


def test_a_landmarks_life_is_a_line_that_grows_thick_when_it_is_placed(desk, played):
    go(desk, 40)
    estimate = estimate_of(played, "fused")
    rows = slice(*estimate.mapped.first[39:41])
    heard = len(set(estimate.mapped.landmark.tolist()))
    counts = np.unique(estimate.mapped.landmark[rows], return_counts=True)[1]
    said = desk.locator(".lives output").first.inner_text()
    assert said.startswith(f"{np.sum(counts == 1)} placed, {np.sum(counts > 1)} ray")
    view = desk.locator(".lives svg").first.get_attribute("viewBox")
    assert float(view.split()[-1]) == heard
    widths = [
        float(desk.locator(f".lives path.{name}").first.evaluate(
            "path => parseFloat(getComputedStyle(path).strokeWidth)"
        ))
        for name in ("life-1", "placed-life")
    ]  # fmt: skip
    assert widths[0] < widths[1]


def test_a_page_without_truth_shows_no_position_error(page_of, watched):
    done, snapshots = watched
    drive = replace(done.drive, truth=NO_TRUTH)
    blind = replace(done, drive=drive, callers=(), beamwidth=None)
    page = page_of(playback(blind, {("fused", "ekf"): snapshots["fused", "ekf"]}))
    go(page, 40)
    assert page.locator(".panel").count() == 1
    assert page.locator(".head select").is_disabled()
    assert page.locator("#beside").is_hidden()
    assert page.locator(".position figcaption").inner_text().startswith("3σ of position [m]")
    for layer in ("true-path", "true-vehicle", "places", "ties", "callers", "beam"):
        assert shapes(page, layer) == 0, layer
    assert shapes(page, "vehicle") == 1


def test_an_estimate_that_is_nowhere_is_shown_without_a_complaint(page_of, played):
    estimate = estimate_of(played, "fused")
    wild = np.full(estimate.mapped.numbers.shape, 1e300)
    lost = replace(
        estimate,
        outcome="failed: <b>it fell</b>",
        pose=np.full_like(estimate.pose, np.nan),
        spread=np.full_like(estimate.spread, np.nan),
        mapped=replace(estimate.mapped, numbers=wild),
    )
    page = page_of(replace(played, estimates=(lost,)))
    for frame in (1, 20, 40):
        go(page, frame)
    assert page.locator(".head p").inner_text() == "failed: <b>it fell</b>"
    assert shapes(page, "vehicle") == 0


def test_a_mission_of_one_frame_is_shown(page_of, watched):
    page = page_of(playback(*watched, most=1))
    page.keyboard.press("End")
    page.keyboard.press("Space")
    page.wait_for_timeout(100)
    assert page.locator("#clock").inner_text().endswith("1 of 1")


def test_a_revised_path_is_shown_with_the_online_path(page_of, played):
    estimate = estimate_of(played, "fused")
    points = np.vstack([estimate.start, estimate.pose])[:, :2] + 3.0
    nobody = np.zeros(len(points), int)
    rows = Rows(first=np.array([0, len(points)]), landmark=nobody, numbers=points)
    smooth = replace(estimate, revised_at=np.array([39]), revised=rows)
    page = page_of(replace(played, estimates=(smooth,)))
    go(page, 39)
    assert shapes(page, "revised") == 0
    go(page, 40)
    apart = middle(page, "path") - middle(page, "revised")
    assert apart == pytest.approx([3.0, 3.0], abs=1e-3)
    off = np.hypot(*(points[-1] - played.true_pose[39, :2]))
    said = page.locator(".position output").inner_text()
    assert f"{off:.2f} m as revised at the end" in said


def test_text_has_enough_contrast(opened):
    """At least 4.5 to 1, as the accessibility guidelines ask for."""
    page, _ = opened
    ratios = contrasts(page, "h1,h2,p,b,small,output,figcaption,label,button,.tick,.axis span")
    assert len(ratios) > 20
    assert [(ratio, what) for ratio, what in ratios if ratio < 4.5] == []


@pytest.fixture(
    scope="module",
    params=[("phone", "light"), ("phone", "dark"), ("desk", "light"), ("desk", "dark")],
    ids=lambda screen: "-".join(screen),
)
def timing(browser, timed, request, tmp_path_factory):
    """A page of a mission with excess paths, the one in front that has them, and its numbers."""
    shown_now = playback(*timed)
    path = tmp_path_factory.mktemp("timed") / "view.html"
    path.write_text(written_page(shown_now), encoding="utf-8")
    page, noise = shown(browser, path, *request.param)
    page.keyboard.press("Escape")
    assert page.locator(".panel").first.get_attribute("data-estimate") == "fused · EKF"
    yield page, noise, estimate_of(shown_now, "fused")
    assert noise == [path.as_uri()]
    page.context.close()


def excess_paths_of(estimate, frame, label):
    rows = slice(*estimate.excess_paths.first[frame - 1 : frame + 1])
    return estimate.excess_paths.numbers[rows][estimate.excess_paths.landmark[rows] == label]


def test_a_frame_shows_the_ellipses_of_its_resolved_landmark(timing):
    page, _, estimate = timing
    counts = set()
    for frame in range(1, 41, 3):
        go(page, frame)
        told = excess_paths_of(estimate, frame, estimate.resolved[frame - 1])
        counts.add(len(told))
        assert shapes(page, "excess-paths") == shapes(page, "excess-ways") == len(told)
        assert shapes(page, "excess-spot") == min(len(told), 1)
        assert shapes(page, "excess-paths", 1) == 0, "active sensing takes no excess paths"
        *standing, boat = np.isfinite(estimate.callers[frame - 1, :, 0])
        stars, ellipse = np.sum([*standing, boat]), boat
        assert shapes(page, "believed-callers") == stars + ellipse
    assert {1, 2} <= counts


def test_an_ellipse_is_about_vehicle_and_caller_and_as_long_as_the_way(timing):
    page, _, estimate = timing
    told = [excess_paths_of(estimate, i, estimate.resolved[i - 1]) for i in range(1, 41)]
    frame = next(i for i, rows in enumerate(told, start=1) if len(rows) == 1)
    go(page, frame)
    ((caller, excess_path),) = told[frame - 1]
    place, vehicle = estimate.callers[frame - 1, int(caller), :2], estimate.pose[frame - 1, :2]
    points = page.locator(".panel >> nth=0 >> svg.map >> nth=0 >> path.excess-paths").evaluate(
        "path => Array.from({ length: 12 }, (_, i) =>"
        " path.getPointAtLength(i * path.getTotalLength() / 12)).map(({ x, y }) => [x, -y])"
    )
    for point in np.array(points):
        way = np.hypot(*(point - place)) + np.hypot(*(point - vehicle))
        assert way == pytest.approx(np.hypot(*(place - vehicle)) + excess_path, rel=5e-3)


def test_a_selected_landmark_shows_its_excess_paths(timing):
    page, _, estimate = timing
    labels = estimate.excess_paths.landmark[slice(*estimate.excess_paths.first[29:31])]
    other = next(label for label in labels if label != estimate.resolved[29])
    go(page, 30)
    page.evaluate(f"() => choose({other})")
    assert shapes(page, "excess-paths") == len(excess_paths_of(estimate, 30, other))
    ends = page.evaluate(f"() => panels[0].estimate.maps[29].get({other})[0].x")
    assert middle(page, "excess-spot")[0] == pytest.approx(ends, abs=1e-2)
    page.keyboard.press("Escape")


def test_ellipses_are_hidden_and_shown_by_key_and_button(timing):
    page, _, _ = timing
    go(page, 40)
    there, button = shapes(page, "excess-paths"), page.locator("#ellipses")
    assert there > 0

    def press():
        page.keyboard.press("e")

    for hide, show in ((press, button.click), (button.click, press)):
        hide()
        assert [shapes(page, name) for name in ("excess-paths", "excess-ways", "excess-spot")] == [
            0
        ] * 3
        assert button.get_attribute("aria-pressed") == "false"
        show()
        assert shapes(page, "excess-paths") == there
        assert button.get_attribute("aria-pressed") == "true"


def test_with_ellipses_nothing_is_wider_than_the_screen_and_all_callers_have_names(timing):
    page, _, _ = timing
    inner = page.evaluate("document.documentElement.clientWidth")
    assert page.evaluate("document.documentElement.scrollWidth") <= inner
    names = page.locator("svg.map >> nth=0 >> text.name").all_text_contents()
    assert names == ["beacon", "mate", "boat"]
    assert page.locator(".reading li b").nth(3).inner_text() == "An ellipse of an excess path"
    ratios = contrasts(page, ".reading b, .reading small, footer p, header button")
    assert [(ratio, what) for ratio, what in ratios if ratio < 4.5] == []


def test_callers_without_truth_are_labelled_at_their_estimates(page_of, timed):
    known = playback(*timed)
    nowhere = tuple((label, name, np.full(2, np.nan)) for label, name, _ in known.callers[:2])
    estimate = estimate_of(known, "fused")
    some = replace(estimate, callers=estimate.callers[:, :2])
    page = page_of(replace(known, callers=nowhere, estimates=(some,)))
    go(page, 40)
    assert shapes(page, "callers") == 0
    assert shapes(page, "believed-callers") == 2
    spots = page.locator("svg.map >> nth=0 >> text.name").evaluate_all(
        "all => all.map((text) => ['x', 'y'].map((name) => Number(text.getAttribute(name))))"
    )
    away = np.hypot(*(np.array(spots) * [1.0, -1.0] - estimate.callers[39, :2, :2]).T)
    assert (away < 2.0).all()
