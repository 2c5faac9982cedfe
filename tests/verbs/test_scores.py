"""A score that has a line in the one table is in results, comparisons and reports."""

from dataclasses import replace
from pathlib import Path

from pipistrelle.config import Config
from pipistrelle.evaluation.scores import EVERYWHERE, SCORES
from pipistrelle.experiments.studies.plan import Plan
from reference.command_line import SHORT
from reference.results import study_folder
from report.drawing import draw_only

TITLE = "echoes of a new kind"


def test_a_score_added_to_the_table_is_in_result_compare_and_report(
    obey, in_a_folder_of_its_own, monkeypatch
):
    name = "measurements_per_frame"
    monkeypatch.setitem(SCORES, name, replace(SCORES[name], title=TITLE, shown=EVERYWHERE))
    draw_only(monkeypatch)
    for folder, seed in (("one", 7), ("two", 8)):
        plan = Plan(
            name=folder, iterations=4, strategies=("active", "fused"), filters=("ekf",),
            config=Config(seed=seed), grid={},
        )  # fmt: skip
        study_folder(Path(folder), plan, lambda case, world: 2.0 + world + case.number)
    for words in (("run", *SHORT, "--strategy", "fused"), ("compare", "one", "two")):
        _, printed, _ = obey(*words)
        assert TITLE in printed
    assert obey("report", "one", "--quiet")[0] == 0
    page = Path("one/report/index.html").read_text(encoding="utf-8")
    assert page.count(f">{TITLE}<") > 1, "among the effects and among the cases"
    assert TITLE.capitalize() in page, "over what is varied"
