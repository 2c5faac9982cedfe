"""The report as files: the same bytes, whole, closed, and harmless whatever a study holds."""

import csv
import json
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipistrelle.__main__ import main
from pipistrelle.config import InputError
from pipistrelle.experiments.studies.plan import cases_of, read_plan
from pipistrelle.experiments.studies.world import TABLES, done_worlds, with_sums, world_file
from pipistrelle.files import LOG, REPORT, RESULTS, OwnFiles
from pipistrelle.report.page import write_report
from pipistrelle.report.sentences import SENTENCES, TABLE_II
from pipistrelle.report.study import RULES, read_study
from pipistrelle.report.variables import setting_variable
from report.drawing import draw_only
from report.invented import (
    PLAN,
    RADII,
    STRATEGIES,
    diverging,
    invent,
    narrowed,
    only,
    with_third,
    write_store,
)  # fmt: skip

FIGURES = [
    "anees_ekf", "anees_fastslam", "example_map", "gain", "heading_rmse", "landmarks", "map_rmse",
    "map_rmse_aligned", "piston", "position_rmse", "position_rmse_aligned", "table_ii",
]  # fmt: skip
BAD = "<script>alert('a')</script>\"'&"


class Reader(HTMLParser):
    """Collect elements and check that they close in order."""

    VOID = frozenset({"meta", "link", "input", "br", "img"})

    def __init__(self):
        super().__init__()
        self.open, self.found = [], []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def of(self, tag):
        return [attrs for found, attrs in self.found if found == tag]


def read(folder):
    reader = Reader()
    reader.feed((folder / "index.html").read_text(encoding="utf-8"))
    assert reader.open == []
    return reader


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "store"
    write_store(folder, invent(6), iterations=115, failed=((1, 4),))
    return folder


@pytest.fixture(scope="module")
def printed(store):
    """What `pipistrelle report` prints of a partial study with a failed trial."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as out:
        draw_only(patch, "gain")
        assert main(["report", str(store), "-o", str(store.parent / "out")]) == 0
    return out.getvalue().splitlines()


@pytest.fixture(scope="module")
def reported(store, printed):
    """What it writes, with one of the figures drawn."""
    return store.parent / "out"


def few(worlds):
    """Worlds at two of their beamwidths by one filter: a page that is soon written."""
    return narrowed(only(invent(worlds), [("ekf", way) for way in STRATEGIES]), [0, 11])


@pytest.fixture(scope="module")
def small():
    return few(2)


@pytest.fixture
def undrawn(monkeypatch):
    draw_only(monkeypatch)


def test_everything_is_there(reported):
    assert sorted(path.name for path in reported.iterdir()) == [
        "SHA256SUMS", "figures", "index.html", "summary.json",
    ]  # fmt: skip
    names = sorted(path.name for path in (reported / "figures").iterdir())
    assert names == sorted(f"{name}.{kind}" for name in FIGURES for kind in ("csv", "pdf", "png"))
    assert all((reported / "figures" / f"gain.{kind}").stat().st_size for kind in ("pdf", "png"))


@pytest.mark.parametrize("name", ["index.html", "summary.json", "figures/gain.csv"])
def test_a_users_file_in_the_place_of_the_reports_is_refused_by_name(
    small, tmp_path, undrawn, name
):
    site = tmp_path / "site"
    (site / name).parent.mkdir(parents=True)
    (site / name).write_text("mine")
    with pytest.raises(InputError, match="site: is not empty and holds no report of Pipistrelle"):
        write_report(small, site)
    assert [path for path in site.rglob("*") if path.is_file()] == [site / name]
    shutil.rmtree(site)
    OwnFiles(site, REPORT).replace({"figures/other.png": "an earlier report's"})
    (site / name).write_text("mine")
    with pytest.raises(InputError, match=f"{name}: is not Pipistrelle's, so it is not replaced"):
        write_report(small, site)
    assert (site / name).read_text() == "mine"
    assert (site / "figures" / "other.png").exists()


def assert_same_bytes(reported, again, kinds):
    """Files of some kinds are the same in both folders; there are some."""
    found = [path for path in sorted(reported.rglob("*")) if path.suffix in kinds]
    assert {path.suffix for path in found} == kinds
    for path in found:
        assert path.read_bytes() == (again / path.relative_to(reported)).read_bytes(), path.name


def test_the_same_folder_gives_the_same_page_in_place_of_an_earlier_page(
    store, reported, tmp_path, undrawn
):
    OwnFiles(tmp_path, REPORT).replace({"index.html": "earlier", "figures/other.png": "earlier"})
    (tmp_path / "notes.txt").write_text("mine")
    write_report(read_study(store), tmp_path)
    assert_same_bytes(reported, tmp_path, {".html", ".json", ".csv"})
    whole = {path.relative_to(reported) for path in reported.rglob("*")}
    assert {path.relative_to(tmp_path) for path in tmp_path.rglob("*")} == whole | {
        Path("notes.txt")
    }


@pytest.mark.slow
def test_the_same_folder_gives_the_same_figures(store, tmp_path):
    for name in "ab":
        write_report(read_study(store), tmp_path / name)
    assert_same_bytes(tmp_path / "a", tmp_path / "b", {".png", ".pdf"})
    sizes = [path.stat().st_size for path in (tmp_path / "a" / "figures").iterdir()]
    assert len(sizes) == 3 * len(FIGURES)
    assert min(sizes) > 0


def test_the_page_asks_for_nothing_outside(reported):
    reader = read(reported)
    for tag in ("script", "img", "link", "iframe", "use", "image"):
        for attrs in reader.of(tag):
            for name in ("src", "href", "xlink:href", "srcset"):
                assert attrs.get(name, "data:,").startswith("data:")
    text = (reported / "index.html").read_text(encoding="utf-8")
    assert re.findall(r"url\(|@import|https?://", text) == []


def test_links_lead_to_files_and_places_that_are_there_once(reported):
    reader = read(reported)
    places = [attrs["id"] for _, attrs in reader.found if "id" in attrs]
    assert len(places) == len(set(places))
    assert "departures" not in places, "the settings are the paper's"
    for attrs in reader.of("a"):
        target = attrs["href"]
        if target.startswith("#"):
            assert target[1:] in places
        else:
            assert (reported / target).is_file()


def test_the_eight_verdicts_are_on_the_page_and_in_the_summary(reported):
    summary = json.loads((reported / "summary.json").read_text())
    sections = [attrs for attrs in read(reported).of("section") if "data-claim" in attrs]
    assert [int(attrs["data-claim"]) for attrs in sections] == list(range(1, 9))
    assert [attrs["data-verdict"] for attrs in sections] == [
        claim["verdict"] for claim in summary["claims"]
    ]
    shown = [attrs for attrs in read(reported).of("div") if "data-sentence" in attrs]
    assert {int(attrs["data-sentence"]): attrs["data-verdict"] for attrs in shown} == {
        row["sentence"]: row["verdict"] for row in summary["sentences"]
    }
    assert len(shown) == len(SENTENCES) == summary["scoreboard"]["sentences"]
    for one in (*summary["claims"], *summary["sentences"]):
        assert one["verdict"] in ("reproduced", "not-reproduced", "open")


def test_a_page_counts_its_worlds_and_warns_if_they_are_few_or_not_all(reported, tmp_path, undrawn):
    texts = {6: (reported / "index.html").read_text(encoding="utf-8")}
    for worlds in (1, 2, 20):
        write_report(few(worlds), tmp_path)
        texts[worlds] = (tmp_path / "index.html").read_text(encoding="utf-8")
    for worlds, text in texts.items():
        assert ("6 of 115 worlds are done" in text) is (worlds == 6)
        assert ("so few worlds may show what others would not" in text) is (worlds < 20)
        assert not re.search(r"\b1 worlds", text)
    assert "1 world · 5 trials" in texts[1]
    assert "2 worlds · 10 trials" in texts[2]
    assert json.loads((reported / "summary.json").read_text())["partial"] is True


def test_all_rules_can_be_looked_at(reported):
    reader = read(reported)
    shown = [set(attrs.get("class", "").split()) for attrs in reader.of("div")]
    for rule in RULES:
        assert sum({"by-rule", rule} <= names for names in shown) >= 8


def test_failed_trials_are_listed_with_their_world(reported):
    text = (reported / "index.html").read_text(encoding="utf-8")
    assert "1 failed trials" not in text
    assert "1 failed trial" in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    (failed,) = json.loads((reported / "summary.json").read_text())["failed"]
    assert failed["iteration"] == 1


def strange(study):
    """The same study with texts that would be markup, as one of a variable of two words."""
    two = narrowed(study, [0, 1])
    variable = replace(setting_variable(BAD, [BAD, f"{BAD}2"]), label=BAD, column=BAD, meaning=BAD)
    failure = {"iteration": 0, "strategy": BAD, "filter": BAD, "beamwidth_deg": 33.0,
               "settings": {BAD: BAD}, "error": BAD}  # fmt: skip
    return replace(two, name=BAD, variables=(variable,), grid={BAD: (BAD,)}, errors=(failure,))


def test_no_text_of_a_study_becomes_markup(tmp_path, undrawn):
    write_report(strange(invent(3)), tmp_path)
    reader = read(tmp_path)
    assert len(reader.of("script")) == 1
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert text.count("<script>") == 1
    assert text.count("alert(&#39;a&#39;)") >= 20
    assert not [a for _, attrs in reader.found for a in attrs if a.startswith("on")]


def test_failed_trials_are_counted_over_all_combinations(tmp_path, capsys, undrawn):
    grid = '"air.relative_humidity" = [0.3, 0.7]\n'
    radii = [*RADII[::11]]
    (tmp_path / "plan.toml").write_text(PLAN.format(iterations=2, settings="", radii=radii) + grid)
    cases = cases_of(read_plan(tmp_path / "plan.toml"))
    moist = [case.number for case in cases if case.values["air.relative_humidity"] == 0.7]
    failed = [(0, moist[0]), (1, moist[5]), (1, moist[-1])]
    again = tmp_path / "again"
    write_store(again, invent(2), grid=grid, failed=failed, radii=radii)
    assert main(["report", str(again)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "failed: 3 trials; see the page"
    summary = json.loads((again / "report" / "summary.json").read_text())
    assert summary["trials_failed"] == 3
    assert [row["settings"] for row in summary["failed"]] == [{"air.relative_humidity": "0.7"}] * 3
    text = (again / "report" / "index.html").read_text(encoding="utf-8")
    assert "3 failed trials" in text
    assert len(re.findall(r"<h4>World \d, .*, air\.relative_humidity = 0\.7</h4>", text)) == 3


def test_the_summary_is_plain_json_even_of_a_study_that_diverged(tmp_path, undrawn):
    study = narrowed(invent(3), [0, 11])
    for trials in study.trials.values():
        trials.scores["position_rmse_m"][:] = np.inf
        trials.nees[0] = np.inf
        trials.diverged[:] = True
    write_report(study, tmp_path)
    text = (tmp_path / "summary.json").read_text()
    assert "Infinity" not in text
    assert "NaN" not in text
    read(tmp_path)


def test_a_rule_without_worlds_has_a_note_and_the_others_are_shown(tmp_path, undrawn):
    study = narrowed(invent(3), [0, 11])
    for way, trials in study.trials.items():
        if way[0] == "ekf":
            study.trials[way] = diverging(trials, slice(None))
    write_report(study, tmp_path)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert text.count("No world is left under this rule.") == 2
    assert (tmp_path / "figures" / "anees_ekf.csv").read_text().count("none,") > 0


def test_figures_and_table_ii_have_their_numbers_under_each_rule(reported):
    rows = {}
    for name in ("position_rmse", "anees_fastslam", "table_ii"):
        with (reported / "figures" / f"{name}.csv").open(newline="") as file:
            rows[name] = list(csv.DictReader(file))
        assert {row["exclusion"] for row in rows[name]} == set(RULES)
    table = rows["table_ii"]
    assert len(table) == len(RULES) * len(TABLE_II)
    assert [float(row["paper_full"]) for row in table[:8]] == [row.full[0] for row in TABLE_II]
    assert table[0]["exclusion"] == "world"
    assert float(table[0]["full_std"]) > 0.0


def test_the_command_prints_the_answer_the_verdicts_and_the_page_last(reported, printed):
    answer = json.loads((reported / "summary.json").read_text())["answer"]
    assert printed[:2] == ["partial: 6 of 115 worlds", "failed: 1 trial; see the page"]
    assert printed[-2 - len(answer) :] == ["", *answer, str(reported / "index.html")]
    claims = printed[2 : -2 - len(answer)]
    assert [line[0] for line in claims if line[0] != " "] == list("12345678")


def test_a_mistake_ends_in_a_line(small, tmp_path, capsys, undrawn):
    assert main(["report", str(tmp_path)]) == 2
    assert "plan.toml" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_report(small, tmp_path / "file" / "deep")


def panels_of(folder, figure):
    text = (folder / "index.html").read_text(encoding="utf-8")
    start = text.index(f'<figure id="{figure}">')
    drawn = text[start : text.index("</figure>", start)]
    return list(dict.fromkeys(re.findall(r'<h4 class="c-\w+">(.*?)</h4>', drawn)))


def test_a_third_filter_has_its_panels_rows_and_files(tmp_path, monkeypatch):
    draw_only(monkeypatch, "Smoother")
    write_report(with_third(invent(4), "toy_slam.filters:Smoother"), tmp_path)
    ids = [attrs.get("id") for _, attrs in read(tmp_path).found]
    assert ids.index("departures") < ids.index("claims"), "its settings are not the paper's"
    titles = ["EKF", "FastSLAM 2.0", "Smoother"]
    assert panels_of(tmp_path, "position_rmse") == titles
    assert panels_of(tmp_path, "landmarks") == titles
    assert panels_of(tmp_path, "gain") == [f"{w}, {t}" for w in ("position", "map") for t in titles]
    assert panels_of(tmp_path, "anees_toy_slam_filters_Smoother") == list(STRATEGIES)
    assert len(panels_of(tmp_path, "table_ii")) == 4, "the paper's table is of its two"
    for kind in ("png", "pdf", "csv"):
        assert (tmp_path / "figures" / f"anees_toy_slam_filters_Smoother.{kind}").is_file()
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<td></td><td>2 of 4</td><td></td>" in text, "no limit and no count of the paper's"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["exclusions"][2]["diverged"]["active"] > 0
    assert [row["filter"] for row in summary["exclusions"]][2] == "toy_slam.filters:Smoother"
    assert len(summary["claims"]) == 8, "the paper's question is asked still"
    assert "Smoother" in {row["filter"] for row in summary["findings"]}


def test_a_stored_study_of_a_filter_that_is_not_installed_can_be_read(tmp_path, undrawn):
    folder = tmp_path / "store"
    plan, *_ = write_store(folder, invent(2), radii=[*RADII[::11]])
    for world in done_worlds(folder):
        paths = {name: world_file(folder, name, world) for name in TABLES}
        tables = {name: pl.read_parquet(path) for name, path in paths.items()}
        name = pl.col("filter").replace("fastslam", "no_such_module:Slam")
        changed = tables | {"trials": tables["trials"].with_columns(name)}
        paths["trials"].write_bytes(with_sums(changed, plan, world)["trials"])
    write_report(read_study(folder), tmp_path / "report")
    assert panels_of(tmp_path / "report", "map_rmse") == ["EKF", "Slam"]


def test_a_report_never_takes_the_place_of_results_or_of_a_log(small, tmp_path, undrawn):
    for kind in (RESULTS, LOG):
        folder, name = tmp_path / kind.title, kind.names[0]
        OwnFiles(folder, kind).replace({name: "precious"})
        with pytest.raises(InputError, match=f"holds {kind.title} of Pipistrelle, which a"):
            write_report(small, folder)
        assert (folder / name).read_text() == "precious"
