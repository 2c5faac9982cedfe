"""Names, links, examples and numbers of the documentation are right."""

import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

import numpy as np
import pytest
from docs import glossary_page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.glob("*.md")), DOCS / "api" / "index.md"]
TEXTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]


def blocks(language: str, page: Path) -> list[str]:
    """Return the fenced blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def found_in(pages, pattern):
    """Yield each match of a pattern in the texts of pages, with its page."""
    for page in pages:
        for match in re.findall(pattern, page.read_text()):
            yield page, match


def test_names_in_the_pages_exist():
    for _, name in found_in(PAGES, r"{py:\w+}`~?([\w.]+)`"):
        resolve_name(name)


def test_links_between_files_lead_somewhere():
    links = found_in([*PAGES, *TEXTS], r"\]\(([^)#]+)(?:#[^)]*)?\)")
    near = [(page, link) for page, link in links if "://" not in link]
    assert [link for link in near if not (link[0].parent / link[1]).exists()] == []


@cache
def anchors(page):
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in headings}


def test_links_into_files_lead_to_headings_of_the_sources():
    links = found_in([*PAGES, *TEXTS], r"\]\(([^)#:]*\.md|)#([^)]+)\)")
    lost = [
        (page.name, name, anchor)
        for page, (name, anchor) in links
        if anchor not in anchors(page.parent / name if name else page)
    ]
    assert lost == []


def test_every_room_has_its_page():
    package = ROOT / "src" / "pipistrelle"
    rooms = {path.parent.name for path in package.glob("*/__init__.py")} - {"verbs"}
    assert {page.stem for page in (DOCS / "api").glob("*.rst")} == {*rooms, "package"}
    alone = re.findall(r"automodule:: pipistrelle\.(\w+)", (DOCS / "api/package.rst").read_text())
    assert {*alone, "__init__", "__main__"} == {path.stem for path in package.glob("*.py")}


def test_the_settings_named_by_the_pages_exist():
    from pipistrelle.config import Config

    fields = {
        section: set(type(getattr(Config(), section)).model_fields)
        for section, field in Config.model_fields.items()
        if section not in ("seed", "settings", "own", "callers")
    }
    classes = {type(getattr(Config(), name)).__name__: names for name, names in fields.items()}
    for page in (DOCS / "conventions.md", ROOT / "papers" / "bradley_abaid" / "README.md"):
        named = re.findall(r"`([a-z]+)\.(?!py\b|csv\b)([a-z_]+)(?: =|`)", page.read_text())
        for section, name in named:
            assert name in fields[section], f"{page.name}: {section}.{name}"
    for row in re.findall(r"^\|.*\|$", (DOCS / "conventions.md").read_text(), re.MULTILINE):
        held = [classes[name] for name in re.findall(r"`(\w+Config)`", row)]
        words = re.findall(r"`(\w+)`", row.split("|")[2]) if held else []
        assert [word for word in words if not any(word in names for names in held)] == [], row


def test_a_change_touches_three_files_at_most_and_its_proof_exists():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    rows = re.findall(r"^\| (an? [^|]*|measurement[^|]*) \|[^|]*\|([^|]*)\|([^|]*)\|$", page, re.M)
    everywhere = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    assert len(rows) == 17
    for change, files, proofs in rows:
        named = re.findall(r"`([\w/]+\.py)`", files)
        assert 1 <= len(named) <= 3, change
        assert all((ROOT / "src" / "pipistrelle" / name).exists() for name in named), named
        tests = re.findall(r"`(test_\w+)`", proofs)
        assert tests, change
        assert [test for test in tests if f"def {test}(" not in everywhere] == []


@pytest.fixture(scope="module")
def guide():
    """Run the code of the page on extending, block by block, and return its names."""
    names = vars(ModuleType("guide"))
    for block in re.findall(
        r"^```python\n(.*?)^```", (DOCS / "extending.md").read_text(), re.M | re.S
    ):
        exec(compile(block, "extending.md", "exec"), names)
    return names


def test_the_guides_beam_changes_only_active_arrivals_outside_it(guide):
    from pipistrelle.acoustics.arrivals import arrivals_of_emission
    from pipistrelle.acoustics.paths import callers_of
    from pipistrelle.config import Config

    posts, beacon = np.array([[5.0, 0.5], [2.0, 5.0]]), np.array([0.0, 9.0])
    callers = callers_of(Config(), beacon)
    before = arrivals_of_emission(np.zeros(3), np.zeros(2), posts, callers, Config())
    after = guide["through_window"](before, 0.3)
    outside = (before.caller == 0) & (np.abs(before.bearing) > 0.3)
    assert 0 < outside.sum() < outside.size
    np.testing.assert_array_equal(after.level_db - before.level_db, np.where(outside, -40.0, 0.0))


def test_the_guides_array_finds_a_bearing(guide):
    from pipistrelle.arrays.beamforming import beamscan, steering_vector

    ears = {"position": guide["hexagon"].position, "frequency": 35e3, "speed_of_sound": 343.0}
    angles = np.radians(np.arange(-60, 61))
    power = beamscan(steering_vector(angles[75], **ears), angles, **ears)
    assert np.argmax(power) == 75
    assert guide["hexagon"].normal.size == 6


def test_the_guides_shape_call_and_medium_are_heard(guide):
    from pipistrelle.acoustics.arrivals import arrivals_of_emissions
    from pipistrelle.acoustics.emitter import SHAPES
    from pipistrelle.acoustics.paths import callers_of
    from pipistrelle.config import BeaconConfig, Config, ScenarioConfig
    from pipistrelle.experiments.hearing.listening import listen
    from pipistrelle.experiments.hearing.scenario import world_of

    pose, still = np.zeros((1, 3)), np.zeros((1, 2))
    posts, callers = np.array([[6.0, 1.0], [6.0, -1.0]]), callers_of(Config(), np.array([0.0, 9.0]))
    heard, _ = arrivals_of_emissions(
        pose, still, posts, callers, Config(), guide["pebbles"], guide["water"]
    )
    own = heard.level_db[heard.caller == 0]
    assert own[1] - own[0] > 20.0 * np.log10(0.05 / 0.02)
    del SHAPES["pebble"]
    config = Config(scenario=ScenarioConfig(steps=8), beacon=BeaconConfig(frequency=15e3))
    (frames,) = listen(world_of(config), config, (0.0025,), call=guide["Sweep"])
    assert sum(frame.rows.landmark.size for frame in frames) > 20


def test_the_guides_second_caller_is_mapped_unless_it_moves(guide):
    two, moving = guide["two_beacons"].track.landmarks, guide["with_a_boat"].track.landmarks
    assert {51, 52} <= set(two.landmark.tolist())
    assert {51, 52} & set(moving.landmark.tolist()) == {51}
    assert any(52 in frame.rows.landmark for frame in guide["heard"])


def test_the_guides_filter_drives_a_mission(guide):
    from pipistrelle.config import Config, ScenarioConfig
    from pipistrelle.estimation.catalogue import entry
    from pipistrelle.experiments.hearing.scenario import draw_scenario
    from pipistrelle.experiments.hearing.trajectories import true_motion
    from pipistrelle.experiments.runs.heard_world import drive_of
    from pipistrelle.experiments.runs.trial import run_filter

    config = Config(scenario=ScenarioConfig(steps=40, landmarks=3))
    world = draw_scenario(config, np.random.default_rng(7))
    lost = guide["DeadReckoning"](motion=true_motion(config.motion))
    track = run_filter(lost, drive_of(world, config), (), np.random.default_rng(7))
    ekf = entry("ekf").build(config, lost.motion)
    same = run_filter(ekf, drive_of(world, config), (), np.random.default_rng(7))
    np.testing.assert_allclose(track.pose.mean, same.pose.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(track.pose.covariance, same.pose.covariance, rtol=0, atol=1e-12)


def heard_and_drive(steps=120):
    """Return the labelled measurements of active sensing in a short drive, and the drive."""
    from pipistrelle.config import Config, ScenarioConfig
    from pipistrelle.experiments.hearing.listening import listen
    from pipistrelle.experiments.hearing.scenario import world_of
    from pipistrelle.experiments.runs.heard_world import drive_of

    config = Config(scenario=ScenarioConfig(steps=steps))
    world = world_of(config)
    (heard,) = listen(world, config, (0.0025,))
    return config, heard, drive_of(world, config)


def test_the_guides_association_reproduces_the_known_labels(guide):
    from pipistrelle.detection.noise import without_hidden
    from pipistrelle.detection.scans import NO_CALLERS, scan_of, without_labels
    from pipistrelle.estimation.beliefs import Assignment
    from pipistrelle.experiments.named_settings import Case
    from pipistrelle.experiments.runs.heard_world import scans_of
    from pipistrelle.experiments.runs.trial import run_trial

    class Anyone:
        """Takes all rows for one landmark."""

        def start(self):
            return None

        def associate(self, memory, belief, scan):
            return memory, Assignment(label=np.ones(scan.landmark.size, int))

    config, heard, drive = heard_and_drive()
    case = Case(strategy="active", filter="ekf")
    told = run_trial(case, drive, scans_of(heard, "active", config), config)
    known = told.track
    rows = (without_labels(frame.rows, NO_CALLERS) for frame in heard)
    hidden = [scan_of(without_hidden(scan, config.filter, timing=False), "active") for scan in rows]
    trial = run_trial(case, drive, hidden, config, association=guide["Nearest"]())
    found = trial.track
    np.testing.assert_array_equal(found.pose.mean, known.pose.mean)
    np.testing.assert_array_equal(found.landmarks.mean, known.landmarks.mean)
    assert found.landmarks.landmark.tolist() == list(range(1, 1 + len(known.landmarks.landmark)))
    assert trial.scores.map_rmse_m == told.scores.map_rmse_m, "by the positions"
    assert trial.scores.map_rmse_aligned_m == told.scores.map_rmse_aligned_m
    assert all((scan.landmark > 0).all() for scan in trial.scans), "as the filter had them"
    anyone = run_trial(case, drive, hidden, config, association=Anyone())
    assert not np.allclose(anyone.track.pose.mean, known.pose.mean, atol=0.1)


def test_the_guides_session_ends_where_a_filter_of_the_whole_drive_does(guide):
    from dataclasses import replace

    from pipistrelle.experiments.runs.trial import run_trial

    trial = run_trial(
        replace(guide["case"], filter="iekf"), guide["drive"], guide["scans"], guide["config"],
        association=guide["Nearest"](),
    )  # fmt: skip
    np.testing.assert_array_equal(trial.track.pose.mean[-1], guide["where"])


def test_the_guides_noise_reaches_the_filter_row_by_row(guide):
    from pipistrelle.detection.noise import without_hidden
    from pipistrelle.detection.scans import scan_of
    from pipistrelle.experiments.named_settings import Case
    from pipistrelle.experiments.runs.heard_world import scans_of
    from pipistrelle.experiments.runs.trial import run_trial

    config, heard, drive = heard_and_drive(40)
    scans = [
        guide["by_level"](
            scan_of(without_hidden(frame.rows, config.filter, timing=False), "active")
        )
        for frame in heard
    ]
    said = np.concatenate([scan.bearing_std for scan in scans])
    assert said.min() == 0.1 < said.max() <= 0.3
    case = Case(strategy="active", filter="ekf")
    constant = run_trial(case, drive, scans_of(heard, "active", config), config).track
    by_level = run_trial(case, drive, scans, config).track
    assert not np.array_equal(by_level.pose.covariance, constant.pose.covariance)


@pytest.fixture
def boats_log(tmp_path):
    """A boat that sails along x past three buoys, as the guide's format has it."""
    time = np.arange(0.0, 20.0, 0.25)
    buoys = {4: (8.0, 3.0), 5: (12.0, -4.0), 9: (20.0, 6.0)}
    rows = [
        f"{t} {label} {-np.degrees(np.arctan2(y, x - t))} {np.hypot(x - t, y)}"
        for t in time[:60:4]
        for label, (x, y) in buoys.items()
    ]
    (tmp_path / "sonar.txt").write_text("\n".join(rows))
    (tmp_path / "rudder.txt").write_text("\n".join(f"{t} 1.0 0.0" for t in time))
    chart = (f"{label} {x} {y}" for label, (x, y) in buoys.items())
    (tmp_path / "chart.txt").write_text("\n".join(chart))
    return tmp_path


def test_the_guides_reader_maps_a_log_of_another_format_and_its_truth_scores_it(guide, boats_log):
    trials = {trial.strategy: trial for trial in guide["solve"](boats_log)}
    assert len(trials["fused"].scans) == 15
    assert [trials[strategy].scores.landmarks_total for strategy in ("active", "fused")] == [3, 3]
    assert trials["fused"].scores.map_rmse_m < 0.1
    assert trials["fused"].scores.position_rmse_m is None
    wide = sum(len(scan.landmark) for scan in trials["fused"].scans)
    assert sum(len(scan.landmark) for scan in trials["active"].scans) < wide == 45


def test_the_guides_reader_refuses_by_the_line(guide, boats_log):
    from pipistrelle.config import InputError

    (boats_log / "sonar.txt").write_text("0.0 4 0.0 1.0\n0.0 4 0.0 x\n")
    with pytest.raises(InputError, match=r"sonar\.txt, line 2: found range 'x'"):
        guide["solve"](boats_log)


def test_the_guides_filter_goes_by_its_name(tmp_path, monkeypatch):
    from pipistrelle.config import Config
    from pipistrelle.estimation.beliefs import Gaussian
    from pipistrelle.estimation.catalogue import entry
    from pipistrelle.experiments.hearing.scenario import true_motion

    texts = [text for text in blocks("python", DOCS / "extending.md") if "Reckoning" in text]
    (tmp_path / "guided.py").write_text("".join(texts))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    config, sure = Config(), Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
    spread = []
    for name in ("DeadReckoning", "WarierReckoning"):
        slam = entry(f"guided:{name}").build(config, true_motion(config.motion))
        spread.append(slam.predict(slam.init(sure), np.ones((1, 2)), np.ones(1), None)[1])
    np.testing.assert_allclose(4.0 * spread[0].covariance, spread[1].covariance, rtol=1e-12)
    assert entry("guided:WarierReckoning").title == "Dead reckoning, warier"
    assert entry("guided:WarierReckoning").nees_limit == 50.0


def test_the_plans_of_the_page_on_robustness_have_the_truth_among_their_values(tmp_path):
    from pipistrelle.experiments.studies.plan import read_plan
    from pipistrelle.report.study import read_study
    from report.planted import write_planted

    page = DOCS / "robustness.md"
    (text,) = blocks("toml", page)
    head = text[: text.index("[grid]")]
    rows = re.findall(r"^\| `(\w+)` \| (`\".*`) \|$", page.read_text(), re.MULTILINE)
    grids = {"sound": text[text.index("[grid]") :].splitlines()[1:]}
    grids |= {name: re.findall(r"`([^`]+)`", cell) for name, cell in rows}
    truth = {}
    for name, lines in grids.items():
        path = tmp_path / f"{name}.toml"
        named = head.replace('name = "sound"', f'name = "{name}"')
        path.write_text("\n".join((named, "[grid]", *lines)))
        plan = read_plan(path)
        assert (plan.name, plan.filters) == (name, ("ekf", "iekf"))
        write_planted(tmp_path / name, "\n".join(lines), worlds=1)
        study = read_study(tmp_path / name)
        truth |= {one.name: one.words[one.base] for one in study.variables}
    assert truth == {
        "assumed.speed_of_sound": "343", "motion.speed_bias": "0", "assumed.wheelbase": "0.2",
        "motion.turn_bias": "0", "assumed.speed_std": "0.1", "assumed.steering_std": "0.03",
        "filter.first_pose": "exact",
    }  # fmt: skip


def test_the_scale_on_the_page_on_robustness_ignores_pose():
    import polars as pl

    names = vars(ModuleType("guide"))
    for block in blocks("python", DOCS / "robustness.md"):
        exec(compile(block, "robustness.md", "exec"), names)
    angle = np.linspace(0.0, 6.0, 50)
    true = np.column_stack((3.0 * np.cos(angle), np.sin(angle)))
    turned = 1.25 * true @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + (4.0, -7.0)
    columns = ("x_m", "y_m", "true_x_m", "true_y_m")
    track = pl.DataFrame(dict(zip(columns, np.hstack((turned, true)).T, strict=True)))
    assert names["scale"](track) == pytest.approx(1.25)


@pytest.mark.slow
def test_the_readme_shows_the_output_of_the_command(tmp_path, capsys):
    from pipistrelle.__main__ import main

    (shown,) = blocks("text", ROOT / "README.md")
    assert main(["run", "--seed", "7", "-o", str(tmp_path / "seen")]) == 0
    printed = capsys.readouterr().out.splitlines()
    rows = [line for line in printed if line[:32] in [row[:32] for row in shown.splitlines()]]
    for line, other in zip(shown.splitlines(), rows, strict=True):
        numbers = [re.findall(r"\d+(?:\.\d+)?", text) for text in (line, other)]
        assert re.sub(r"[\d.]+", "#", line).split() == re.sub(r"[\d.]+", "#", other).split()
        # Another machine's mathematics may move a detection or two across the threshold.
        np.testing.assert_allclose(*np.array(numbers, dtype=float), rtol=0.1)


@pytest.mark.slow
def test_the_built_pages_are_read_without_a_network_and_without_a_word(browser, tmp_path):
    """The examples are left out: they are run by tests of their own."""
    build = [sys.executable, "-m", "sphinx", "-q", "-D", "plot_gallery=0", DOCS, tmp_path]
    subprocess.run(build, cwd=ROOT, check=True)
    pages, asked, noise, fonts = sorted(tmp_path.rglob("*.html")), set(), [], set()
    page = browser.new_page()
    page.on("request", lambda request: asked.add(request.url))
    page.on("console", lambda message: noise.append(message.text))
    page.on("pageerror", lambda error: noise.append(str(error)))
    for path in pages:
        page.goto(path.as_uri())
        faces = "document.fonts.ready.then(f => [...f].map(x => x.family + ' ' + x.status))"
        if page.locator("math").count():
            fonts.add(tuple(page.evaluate(faces)))
    other, entries = browser.new_page(), found_in(PAGES, r"(?:{index}|,) ! (\w+)")
    first = {word: f"{page.stem}.html#index-0" for page, word in entries}  # before symbols of code
    first |= {word: f"glossary.html#term-{word}" for word in ("ray", "caller", "bound")}
    first["sweep"] = "calls.html"
    assert {word: _first_found(other, tmp_path, word) for word in first} == first
    assert {"index", "equations", "estimation", "search"} <= {path.stem for path in pages}
    assert [url for url in asked if not url.startswith((tmp_path.as_uri(), "data:"))] == []
    assert noise == []
    assert fonts == {("STIX Two Math loaded",)}


def _first_found(page, pages, word):
    """Search the built pages for a word, and return where the first link leads."""
    page.goto(f"{(pages / 'search.html').as_uri()}?q={word}")
    return re.sub(r"\?[^#]*", "", page.locator("ul.search li > a").first.get_attribute("href"))


def test_the_glossary_is_sorted_and_defines_each_name_once():
    entries = glossary_page.terms()
    names = [entry["term"] for entry in entries]
    assert names == sorted(names, key=str.casefold)
    every = [name.casefold() for entry in entries for name in (entry["term"], *also(entry))]
    assert len(every) == len({*every})
    assert (DOCS / "glossary.md").read_text(encoding="utf-8").count(glossary_page.PLACE) == 1
    assert glossary_page.markdown().count("\n  ") == len(entries)


def test_a_term_of_the_glossary_has_a_short_meaning_and_a_page():
    for entry in glossary_page.terms():
        assert entry.keys() <= {"term", "also", "meaning", "page", "not", "never"}
        sentences = re.split(r"(?<=\.) (?=[A-Z])", entry["meaning"])
        assert len(sentences) <= 2, entry
        assert all(sentence.endswith(".") for sentence in sentences), entry
        assert max(len(sentence.split()) for sentence in sentences) <= 25, entry
        assert glossary_page.title_of(entry["page"])


def test_a_word_that_the_glossary_replaces_is_no_term_and_replaced_once():
    entries = glossary_page.terms()
    names = {name for entry in entries for name in (entry["term"], *also(entry))}
    words = [word for entry in entries for word in entry.get("never", ())]
    assert names.isdisjoint(words)
    assert len(words) == len({*words})
    for entry in entries:
        own = [*entry.get("not", ()), *entry.get("never", ())]
        assert {entry["term"], *also(entry)}.isdisjoint(own), entry["term"]
        text = " ".join([entry["term"], *also(entry), entry["meaning"]])
        used = [word for word in words if re.search(rf"\b{word}\b", text, re.IGNORECASE)]
        assert used == [], entry["term"]


def also(entry):
    return entry.get("also", ())
