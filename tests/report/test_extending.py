"""A figure and a sentence of one's own, as the documentation writes them."""

import csv
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipistrelle.report import page as module
from pipistrelle.report.charts import CHARTS
from pipistrelle.report.claims import judge_sentences
from pipistrelle.report.page import write_report
from pipistrelle.report.sentences import SENTENCES
from pipistrelle.report.study import HEADING, RULES, selections
from report.drawing import draw_only
from report.invented import BEAMWIDTH, changed, diverging, invent

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"


@pytest.fixture(scope="module")
def guide():
    """Names of the two sections' code."""
    names = vars(ModuleType("guide"))
    text = GUIDE.read_text()
    text = text[text.index("## A figure of the report") :]
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        exec(compile(block, GUIDE.name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def extended(guide, tmp_path_factory):
    folder = tmp_path_factory.mktemp("extended")
    study = invent(8)
    study.trials["ekf", "fused"] = diverging(study.trials["ekf", "fused"], 3)
    with pytest.MonkeyPatch.context() as patch:  # the package's own are drawn elsewhere
        draw_only(patch, "worlds")
        write_report(
            study,
            folder,
            sentences=(*SENTENCES, guide["headings"]),
            charts=(*CHARTS, guide["world_charts"]),
        )
    return study, folder


class Sections(HTMLParser):
    """Collect the figures and the sentences of a page."""

    def __init__(self, text):
        super().__init__()
        self.figures, self.sentences = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "figure":
            self.figures.append(given["id"])
        if "data-sentence" in given:
            self.sentences.append((given["data-sentence"], given["data-verdict"]))


def test_a_figure_given_to_the_report_is_on_the_page_and_in_three_files(extended):
    study, folder = extended
    assert "worlds" in Sections((folder / "index.html").read_text(encoding="utf-8")).figures
    assert all((folder / "figures" / f"worlds.{kind}").stat().st_size for kind in ("png", "pdf"))
    with (folder / "figures" / "worlds.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["panel"] == "EKF"]
    found = {rule: [float(r["fused_m"]) for r in rows if r["exclusion"] == rule] for rule in RULES}
    score = study.trials["ekf", "fused"].scores["position_rmse_m"][:, 0]
    assert found["none"] == pytest.approx(score, rel=1e-8)
    assert found["world"] == pytest.approx(np.delete(score, 3), rel=1e-8)


def test_a_sentence_given_to_the_report_is_judged_and_counted(extended):
    _, folder = extended
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert Sections(text).sentences[-1] == ("27", "reproduced")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["sentences"][-1]["words"] == "With either filter, fused has the better heading."
    assert summary["scoreboard"]["sentences"] == 27
    assert len(summary["claims"]) == 8


def test_an_added_sentence_can_be_refuted_without_changing_the_others(guide):
    worse = changed(invent(60), ("ekf", "fused"), HEADING, lambda error: error + 0.02)
    *others, mine = judge_sentences(selections(worse), (*SENTENCES, guide["headings"]))
    assert mine["verdict"] == "not-reproduced"
    assert mine["comparisons"] == 2 * len(BEAMWIDTH)
    assert others == judge_sentences(selections(worse))


def test_an_added_sentence_needs_no_other_change(guide, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_write_figure", lambda *_: None)
    write_report(invent(2), tmp_path, sentences=(guide["headings"],), charts=())
    page = Sections((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert [number for number, _ in page.sentences] == ["27"]
    assert page.figures == ["piston", "example_map"]
