"""Every kind of study through the whole door: `pipistrelle report` answers what it asks."""

import csv
import html
import json
import re

import pytest

from pipistrelle.__main__ import main
from pipistrelle.evaluation.comparison import INTERVALS
from pipistrelle.experiments.studies.plan import read_plan
from pipistrelle.experiments.studies.study import run_study
from pipistrelle.report.page import write_report
from pipistrelle.report.sentences import SENTENCES
from pipistrelle.report.variables import three_digits
from reference.studies import TINY
from report.drawing import draw_only
from report.invented import invent, narrowed, only, write_store
from report.planted import FUSED_EKF, LEVELS, by_level, write_planted

BOTH = 'filters = ["ekf"]\nstrategies = ["fused", "passive"]\n'
TWO_FILTERS = 'filters = ["ekf", "iekf"]\nstrategies = ["fused"]\n'
SECTION, EVERY = ('<section class="effect"', "</section>"), "Every value and combination"
ONE_FILTER = 'filters = ["ekf"]\n'


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    draw_only(monkeypatch)


class Page:
    """A report as a reader and as a program meet it."""

    def __init__(self, folder):
        self.folder = folder
        self.text = (folder / "index.html").read_text(encoding="utf-8")
        self.summary = json.loads((folder / "summary.json").read_text())

    def said(self, start, end):
        """Return the words between two marks of the page."""
        cut = self.text[self.text.index(start) : self.text.index(end)]
        return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", cut)).split())

    @property
    def header(self):
        return self.said("<header>", "</header>")

    @property
    def ids(self):
        return re.findall(r'id="([^"]+)"', self.text)

    def effects(self, **asked):
        rows = self.summary["effects"]
        return [row for row in rows if all(row[key] == value for key, value in asked.items())]


@pytest.fixture
def reported(tmp_path):
    """Write a study with planted effects, report it by the command, and open the page."""

    def reported(*args, **given):
        write_planted(tmp_path / "s", *args, **given)
        assert main(["report", str(tmp_path / "s"), "--quiet"]) == 0
        return Page(tmp_path / "s" / "report")

    return reported


def test_a_planted_effect_is_in_the_answer_in_the_table_and_in_the_summary(reported):
    page = reported(effect=by_level(0.34), ways=BOTH)
    assert "What does the beacon level change?" in page.header
    sentence = (
        r"no effect on the aligned position RMSE was shown; .*"
        r"The beacon level from 36\.8 to 48\.8 raises the position RMSE by 0\.3\d* m "
        r"\[0\.\d+, 0\.\d+\], averaged over 2 cases\."
    )
    assert re.search(sentence, page.header)
    assert '<section class="effect" data-variable="beacon.level_db">' in page.text
    assert re.search(r"fused EKF \+0\.3\d* m \[0\.\d+, 0\.\d+\]", page.header)
    (found,) = page.effects(measure="position_rmse_m", to="48.8", strategy="fused", filter="ekf")
    everything = found["by_exclusion"]["none"]
    assert everything["shown"] is True
    assert everything["alone"][0] < 0.34 < everything["alone"][1]
    assert page.summary["answered_by"] == "none"
    assert 'id="rule-none" checked' in page.text
    assert page.summary["question"] == "What does the beacon level change?"


def test_a_table_of_false_assumptions_has_a_row_for_either_side_of_the_truth(reported):
    page = reported('"assumed.wheelbase" = [0.16, 0.18, 0.2, 0.22, 0.24]', ways=BOTH, worlds=3)
    table, every = page.said(*SECTION).split(EVERY)
    assert table.startswith("The assumed wheelbase, against 0.2 ")
    ends, inner = ("0.16", "0.24"), ("0.18", "0.22")
    for part, values in ((table, ends), (every, (*ends, *inner))):
        for strategy in ("fused", "passive"):
            for value in values:
                assert f"{strategy} EKF: {value} instead of 0.2 " in part
        assert part.count(" instead of ") == 2 * len(values)


def test_where_the_truth_is_the_greatest_value_a_table_goes_down_from_it(reported):
    page = reported('"assumed.wheelbase" = [0.16, 0.18, 0.2]', worlds=3)
    table, every = page.said(*SECTION).split(EVERY)
    assert table.startswith("The assumed wheelbase, from 0.2 to 0.16 ")
    assert "fused EKF, to 0.18 " in every


def test_where_nothing_is_planted_nothing_is_shown_anywhere(reported):
    """The negative control: of 24 worlds, and none of the families is wrong in this draw."""
    page = reported(ways=BOTH, worlds=24)
    assert "from 36.8 to 48.8: no effect on the position RMSE was shown; the change" in page.header
    mine = page.effects(variable="beacon.level_db")
    assert len(mine) == 2 * 2 * 6
    assert not any(row["by_exclusion"]["none"]["shown"] for row in mine)
    assert 'class="shown"' not in page.text[: page.text.index("</header>")]


KINDS = {
    "a number": (LEVELS, FUSED_EKF, "What does the beacon level change?"),
    "an assumption": (
        '"assumed.wheelbase" = [0.18, 0.2, 0.22]', BOTH, "What does the assumed wheelbase change?",
    ),
    "a beamwidth": ("beamwidth = [180, 33, 11]", ONE_FILTER, "What does the beamwidth change?"),
    "words": (
        '"rays.weights" = ["instantaneous", "aggregated"]', BOTH, "What does the rays weights ",
    ),
    "lists": (
        '"rays.range_bounds" = [[0.5, 20.0], [0.5, 10.0], [2.0, 40.0]]', FUSED_EKF,
        "What does the rays range bounds change?",
    ),
    "two variables": (
        '"rays.exponent" = [1, 3]\n' + LEVELS, TWO_FILTERS,
        "What do the rays exponent and the beacon level change?",
    ),
    "three variables": (
        'beamwidth = [180, 11]\n"rays.exponent" = [1, 3]\n"air.spreading" = ["paper", "bistatic"]',
        ONE_FILTER, "What do the beamwidth, rays.exponent and air.spreading change?",
    ),
    "radius and tone": (
        '"emitter.radius" = [0.0025, 0.025]\n"emitter.frequency" = [35e3, 40e3]', ONE_FILTER,
        "What do emitter.radius and emitter.frequency change?",
    ),
    "other worlds": (
        '"scenario.landmarks" = [12, 20]', FUSED_EKF, "What does the scenario landmarks change?",
    ),
    "a value alone": ('"rays.exponent" = [3.0]', ONE_FILTER, "How do active, fused and passive"),
    "no grid": ("", ONE_FILTER, "How do active, fused and passive sensing compare?"),
    "two filters": ("", TWO_FILTERS, "How do EKF and invariant EKF compare?"),
    "a filter from outside": (
        LEVELS, 'filters = ["no_such:Slam"]\nstrategies = ["fused"]\n',
        "What does the beacon level change?",
    ),
    "one case": ("", FUSED_EKF, "How well does EKF locate the vehicle by fused sensing?"),
    "passive alone": (
        '"emitter.radius" = [0.0025, 0.025]', 'filters = ["ekf"]\nstrategies = ["passive"]\n',
        "What does the beamwidth change?",
    ),
}  # fmt: skip
AXES = ("two variables", "three variables", "words", "a beamwidth")
LONG = ("three variables", "radius and tone")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if kind in LONG else ()) for kind in KINDS]
)
def test_every_kind_of_study_has_a_question_an_answer_and_figures(reported, kind):
    grid, ways, question = KINDS[kind]
    page = reported(grid, ways=ways, worlds=4)
    assert question in page.header
    answer, *_ = page.summary["answer"]
    assert answer.endswith(".")
    assert answer in page.header
    assert page.summary["claims"] == page.summary["sentences"] == page.summary["table_ii"] == []
    assert page.summary["scoreboard"] is None
    for absent in ("The paper’s claims", "Table II", "Not the paper's study", "None", "nan"):
        assert absent not in page.said("<header>", '<h2 id="config">'), absent
    assert "claims" not in page.ids
    assert len(page.ids) == len(set(page.ids))
    varied = [v["name"] for v in page.summary["variables"]]
    shown = re.findall(r'data-variable="([^"]+)"', page.text)
    assert shown[: len(varied)] == [name for name in varied if name in shown]
    if kind in AXES:
        assert_every_variable_is_an_axis_of_every_combination(page, kind)


def assert_every_variable_is_an_axis_of_every_combination(page, kind):
    variables = page.summary["variables"]
    for variable in variables:
        slug = variable["name"].replace(".", "_")
        name = "position_rmse" if len(variables) == 1 else f"position_rmse_by_{slug}"
        assert f'<figure id="{name}"' in page.text
        assert any(one.startswith(f"effect_{slug}_") for one in page.ids)
        with (page.folder / "figures" / f"{name}.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["exclusion"] == "none"]
        means = [r for r in rows if "worlds" not in r["series"] and "bound" not in r["series"]]
        drawn = {round(float(row["position_rmse_m"]), 6) for row in means}
        assert drawn == {round(c["position_rmse_m"][0], 6) for c in page.summary["cases"]}
    column = "beamwidth_deg" if kind == "a beamwidth" else None
    if column:
        assert {row[column] for row in rows} >= {"11", "33", "180"}


def test_the_answer_comes_first_then_its_figures_then_the_rest(reported):
    page = reported(ways=ONE_FILTER)
    order = ["effects", "figures", "effect_beacon_level_db_ekf", "position_rmse", "gain",
             "further", "map_rmse_aligned", "anees_ekf", "consistency", "ways", "cases",
             "models", "exclusions", "method", "config"]  # fmt: skip
    assert [one for one in page.ids if one in order] == order
    assert page.text.index('data-variable="beacon.level_db"') < page.text.index("</header>")
    assert page.text.index('data-variable="strategy"') > page.text.index('id="ways"')


def assert_the_papers_question_is_asked_and_its_claims_come_after_its_figures(page):
    assert "Does listening to someone else’s calls" in page.header
    assert len(page.summary["claims"]) == 8
    order = ["figures", "gain", "landmarks", "claims", "table-ii", "further", "anees_ekf"]
    assert [one for one in page.ids if one in order] == order
    assert "effects" not in page.ids
    assert page.summary["answered_by"] == "world"
    assert 'id="rule-world" checked' in page.text
    assert len(page.effects(variable="beamwidth")) == 2 * 2 * 11 * (6 + 4), "errors, and gains"


@pytest.mark.parametrize("variable", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_without_the_papers_cases_its_claims_are_not_judged(tmp_path, variable):
    if variable:
        write_store(tmp_path / "s", invent(3), grid='"rays.exponent" = [1.0, 3.0]\n')
        assert main(["report", str(tmp_path / "s"), "-o", str(tmp_path / "r"), "--quiet"]) == 0
    else:
        ekf = only(invent(3), [("ekf", way) for way in ("active", "fused", "passive")])
        write_report(ekf, tmp_path / "r")
    page = Page(tmp_path / "r")
    assert page.summary["claims"] == page.summary["sentences"] == []
    assert "data-claim" not in page.text
    assert "data-sentence" not in page.text
    assert "the beamwidth" in page.header


def test_sentences_given_to_the_report_are_judged_whatever_a_study_holds(tmp_path):
    write_report(narrowed(invent(30), [0, 11]), tmp_path, sentences=SENTENCES[10:13])
    page = Page(tmp_path)
    verdicts = [row["verdict"] for row in page.summary["sentences"]]
    assert verdicts == ["reproduced", "open", "open"]
    assert re.findall(r'data-claim="(\d)"', page.text) == ["4", "5", "6"]
    assert page.summary["scoreboard"]["sentences"] == 3
    assert "The paper’s claims" not in page.text
    assert page.summary["question"] == "What does the beamwidth change?"


def test_every_case_is_listed_with_its_numbers(reported):
    page = reported('"rays.exponent" = [1, 3]\n' + LEVELS, ways=BOTH, worlds=5)
    cases = page.summary["cases"]
    assert len(cases) == 2 * 3 * 2
    assert {case["at"] for case in cases} == {
        f"rays.exponent = {power}, beacon.level_db = {level}"
        for power in (1, 3) for level in (36.8, 42.8, 48.8)
    }  # fmt: skip
    assert all(case["n"] == 5 and case["diverged"] == 0.0 for case in cases)
    assert "12 cases" in page.said('<h2 id="cases">', '<h2 id="models">')


def test_a_plan_of_ones_own_that_ran_in_fewer_worlds_is_partial_on_the_page_and_in_the_terminal(
    tmp_path, capsys, monkeypatch
):
    draw_only(monkeypatch)
    plan, folder = tmp_path / "tiny.toml", tmp_path / "s"
    plan.write_text(TINY.replace("iterations = 1", "iterations = 4"))
    for worlds, told in ((2, ["partial: 2 of 4 worlds"]), (4, [])):
        run_study(read_plan(plan, iterations=worlds), folder)
        capsys.readouterr()
        assert main(["report", str(folder)]) == 0
        printed = capsys.readouterr().out.splitlines()
        assert [line for line in printed if line.startswith("partial")] == told
        page = Page(folder / "report")
        assert page.summary["partial"] is bool(told)
        for words in ("2 of 4 worlds are done", "effects may still change"):
            assert (words in page.header) is bool(told)


def test_a_study_that_ran_is_answered_in_the_degrees_that_it_was_asked_in(tmp_path):
    """From the plan's beamwidths to the page, with a filter's own settings, nothing invented."""
    plan = tmp_path / "wide.toml"
    plan.write_text(
        'format = 1\niterations = 2\nfilters = ["ekf", "iekf"]\nstrategies = ["active"]\n'
        "[config.scenario]\nsteps = 40\nlandmarks = 12\n"
        '[own.iekf]\nfilter.noise = "measured"\n[grid]\nbeamwidth = [180, 33.2, 11.5]\n'
    )
    run_study(read_plan(plan), tmp_path / "s")
    assert main(["report", str(tmp_path / "s"), "--quiet"]) == 0
    page = Page(tmp_path / "s" / "report")
    assert page.summary["variables"][0]["values"] == ["11.5°", "33.2°", "180°"]
    assert len(page.summary["answer"]) == 2
    assert "The beamwidth from 11.5° to 180°" in page.header
    assert "active invariant EKF" in page.header
    with (page.folder / "figures" / "position_rmse.csv").open(newline="") as file:
        widths = {float(row["beamwidth_deg"]) for row in csv.DictReader(file)}
    assert {round(width, 6) for width in widths} >= {11.5, 33.2, 180.0}


def test_every_interval_is_the_summarys_and_half_of_it_would_have_been_shown(tmp_path, capsys):
    """One effect of the family is shown and one is not, and both go by one rule."""

    def effect(case):
        return by_level(0.3 if case.strategy == "fused" else 0.0)(case)

    folder = tmp_path / "a [b] c"
    write_planted(folder, ways=BOTH, effect=effect)
    assert main(["report", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert INTERVALS in printed
    *_, raw, last = printed.splitlines()
    assert raw.startswith("The beacon level from 36.8 to 48.8 raises the position RMSE by 0")
    assert last == str(folder / "report" / "index.html")
    (row,) = (line for line in printed.splitlines() if line.startswith("fused EKF"))
    assert re.match(r"fused EKF +\+0\.3\d* m\* +\[0\.\d+, 0\.\d+\]$", row)
    page = Page(folder / "report")
    assert INTERVALS.replace("'", "’") in page.header.replace("'", "’")
    for strategy, shown in (("fused", True), ("passive", False)):
        (found,) = page.effects(measure="position_rmse_m", to="48.8", strategy=strategy)
        found = found["by_exclusion"]["none"]
        low, high = found["interval"]
        assert found["shown"] is shown
        assert f"[{three_digits(low)}, {three_digits(high)}]" in page.header
        if not shown:
            assert found["would_have_shown"] == pytest.approx((high - low) / 2.0)


def test_a_gain_has_its_row_and_its_line(reported):
    def effect(case):
        return by_level({"active": -0.5, "fused": -0.1}[case.strategy])(case)

    ways = 'strategies = ["active", "fused"]\nfilters = ["ekf"]\n'
    page = reported(f'{LEVELS}\n"rays.exponent" = [1.0, 3.0]', ways=ways, effect=effect)
    (found,) = page.effects(
        measure="gain_position_rmse_m", variable="beacon.level_db", to="48.8", strategy="fused"
    )
    size = found["by_exclusion"]["none"]
    assert size["mean"] == pytest.approx(-0.4, abs=0.05)
    assert re.search(r"gain of fused EKF over active −0\.[34]\d* m \[", page.header)
    rows = list(csv.DictReader((page.folder / "figures/gain_by_beacon_level_db.csv").open()))
    means = [row for row in rows if row["series"].startswith("mean, active minus fused")]
    assert means
    assert all(float(r["gain_m_low"]) < float(r["gain_m"]) < float(r["gain_m_high"]) for r in means)


def test_a_short_run_of_the_papers_plan_is_partial_and_asked_the_papers_question(tmp_path, capsys):
    plan, *_ = write_store(tmp_path / "s", invent(2, planned=115), name="paper")
    assert (plan.name, plan.iterations) == ("paper", 2)
    assert main(["report", str(tmp_path / "s")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "partial: 2 of 115 worlds"
    open_ones = [i for i, line in enumerate(printed) if re.match(r"\d  open ", line)]
    assert open_ones
    for i in open_ones:
        assert re.search(r"^ {19}Sentences that hold: \d of .*; open: \d.*\.$", printed[i + 1])
    page = Page(tmp_path / "s" / "report")
    assert page.summary["partial"] is True
    assert "2 of 115 worlds are done" in page.header
    assert_the_papers_question_is_asked_and_its_claims_come_after_its_figures(page)
