"""Reports: a page with the answer, figures and tables, and the same numbers for programs.

The page is one file without outside requests: style, script and drawings are inside. The template
escapes every text. The same folder gives the same bytes. A study that holds the paper's cases is
asked the paper's question and its sentences are judged; other studies are asked for the effects of
their variables.
"""

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from math import inf
from pathlib import Path
from typing import Any

from pipistrelle import __version__
from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.evaluation.comparison import INTERVALS
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.figures.chart import Chart, column_count, csv_rows, csv_text, draw_chart
from pipistrelle.figures.style import page_of, save_figure
from pipistrelle.files import REPORT, claim, drawn_files
from pipistrelle.report import effects as changes
from pipistrelle.report import tables
from pipistrelle.report.charts import Figure, answers, study_charts
from pipistrelle.report.claims import (
    WITHOUT,
    YARDSTICKS,
    findings,
    judge_claims,
    judge_sentences,
    papers_answer,
    scoreboard,
)
from pipistrelle.report.effects import HEADLINE, OTHERWISE, Effect, effects_of, measures_of
from pipistrelle.report.models import model_charts
from pipistrelle.report.sentences import FILTERS, SENTENCES, Sentence, papers_cases
from pipistrelle.report.study import (
    ONLINE_POSITION,
    RULES,
    Rule,
    Selection,
    Study,
    filter_titles,
    has_numbers,
    selections,
)
from pipistrelle.report.svg import legend, panel_svg, readings
from pipistrelle.report.variables import UNITS, amount, number_word, three_digits
from pipistrelle.settings import to_toml

LIBRARIES = ("numpy", "scipy", "numba", "polars", "pydantic", "matplotlib", "jinja2")
PAPERS_QUESTION = "Does listening to someone else’s calls as well as one’s own build a better map?"
SPOKEN = {"reproduced": "Reproduced", "not-reproduced": "Not reproduced", "open": "Open"}
MIN_WORLDS = 20
"""Number of worlds below which a report warns that effects may be due to chance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """A study together with its question, answer, effects and judged claims."""

    study: Study
    papers: bool
    """Whether it holds the paper's cases and answers the paper's question."""
    question: str
    rule: Rule
    """Exclusion rule of the answer."""
    selections: Mapping[Rule, Selection]
    effects: Mapping[Rule, tuple[Effect, ...]]
    """Effects and selections under each rule."""
    sentences: list[dict[str, Any]]
    """Judged, as `judge_sentences` returns them."""
    answer: list[str]
    """A headline, then further sentences."""
    findings: list[dict[str, str]]
    """Table of the answer to the paper's question; empty for other questions."""


def answered(study: Study, sentences: Sequence[Sentence] | None = None) -> Answered:
    """Answer a study's question; `sentences` as in `write_report`."""
    papers, by_rule = papers_cases(study), selections(study)
    effects = {rule: effects_of(selection) for rule, selection in by_rule.items()}
    asked = (SENTENCES if papers else ()) if sentences is None else sentences
    judged, done = judge_sentences(by_rule, asked), len(study.worlds)
    few, headline = done < min(study.planned, MIN_WORLDS), (by_rule[HEADLINE], effects[HEADLINE])
    found = papers_answer(by_rule, judged) if papers else changes.answer(*headline)
    return Answered(
        study=study,
        papers=papers,
        question=PAPERS_QUESTION if papers else changes.question(study),
        rule="world" if papers else HEADLINE,
        selections=by_rule,
        effects=effects,
        sentences=judged,
        answer=[f"Undecided: too few worlds, {done} of {study.planned}."] * few + found,
        findings=findings(by_rule) if papers else [],
    )


def summary(result: Answered) -> dict[str, Any]:
    """Return the content of a report's ``summary.json``."""
    study, selection, rule = result.study, result.selections[result.rule], result.rule
    effects = result.effects[rule], result.effects[OTHERWISE]
    exclusions = tables.exclusion_rows(study)
    return {
        "format": 1,
        "version": __version__,
        "versions": {"python": platform.python_version()} | {n: version(n) for n in LIBRARIES},
        "study": study.name,
        "seed": study.config.seed,
        "worlds_planned": study.planned,
        "worlds_done": len(study.worlds),
        "partial": len(study.worlds) < study.planned,
        "trials": sum(trials.failed.size for trials in study.trials.values()),
        "filters_cpu_s": study.cpu_s,
        "variables": [
            {"name": v.name, "setting": v.setting, "label": v.label, "values": [*v.words]}
            for v in study.variables
        ],
        "not_the_papers": tables.not_the_papers(study),
        "question": result.question,
        "answer": result.answer,
        "findings": result.findings,
        "answered_by": result.rule,
        "effect_tables": [] if result.papers else tables.effect_tables(selection, *effects),
        "effects": changes.record(result.effects, result.rule),
        "cases": tables.case_rows(selection),
        "scoreboard": scoreboard(result.sentences) if result.sentences else None,
        "claims": judge_claims(result.sentences),
        "sentences": result.sentences,
        "exclusion_rules": dict(RULES),
        "exclusions": exclusions,
        "trials_failed": sum(row["failed"] for row in exclusions),
        "table_ii": tables.table_ii_rows(selection) if result.papers else [],
        "consistency": tables.consistency_rows(selection),
        "failed": [*study.errors],
    }


def write_report(
    study: Study,
    folder: Path,
    *,
    sentences: Sequence[Sentence] | None = None,
    charts: Sequence[Figure] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Write the report of a study: a page with question and answer, figures and a summary.

    `study`: as `read_study` gives it. `folder`: is made if missing; gets ``index.html``,
    ``summary.json`` and ``figures``. `sentences`: to be judged; by default the paper's if the study
    holds its cases. `charts`: functions that return the charts of a figure, with distinct names; by
    default as for `study_charts`. `progress`: is given the name of each figure before it is drawn.
    Returns: the content of ``summary.json``. Raises InputError: as `pipistrelle.files.claim`;
    only an earlier report is replaced.
    """
    own = claim(folder, REPORT, overwrite=True)
    result = answered(study, sentences)
    figures: dict[str, dict[Rule, Chart]] = {}
    for rule in sorted(RULES, key=lambda rule: rule != result.rule):  # the answer's is printed
        for chart in study_charts(result.selections[rule], charts):
            figures.setdefault(chart.name, {})[rule] = chart
    models = model_charts(study)

    def draw(room: Path) -> None:
        for chart in [*(next(iter(views.values())) for views in figures.values()), *models]:
            progress(chart.name)
            _write_figure(chart, room)

    numbers = summary(result)
    written = drawn_files(draw, "figures/")
    for name, text in _csv_texts(result, figures, models).items():
        written[f"figures/{name}.csv"] = text.encode()
    written["index.html"] = page(result, figures, models, numbers).encode()
    written["summary.json"] = (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode()
    own.replace(written)
    return numbers


def page(
    result: Answered,
    figures: Mapping[str, Mapping[Rule, Chart]],
    models: Sequence[Chart],
    numbers: dict[str, Any],
) -> str:
    """Return the HTML page of a report.

    `figures`: under each rule that has them. `numbers`: the content of ``summary.json``.
    """
    study = result.study
    rules = sorted(RULES, key=lambda rule: rule != result.rule)
    shown = [_figure(views, rules) for views in figures.values()]
    return page_of(
        "pipistrelle.report",
        ("page.js",),
        {"number": three_digits, "p": _p, "finding": _shown, "amount": amount},
        study=study,
        papers=result.papers,
        headline=result.rule,
        question=result.question,
        claims=numbers["claims"],
        sentences=result.sentences,
        yardsticks=YARDSTICKS,
        summary=numbers,
        few=MIN_WORLDS,
        intervals=INTERVALS,
        tables=numbers["effect_tables"],
        means=shown_in("cases"),
        in_one_world=IN_ONE_WORLD,
        online=has_numbers(study, ONLINE_POSITION),
        measures=measures_of(study),
        units=UNITS,
        figures=_side_by_side([figure for figure in shown if answers(figure["name"])]),
        further=_side_by_side([figure for figure in shown if not answers(figure["name"])]),
        models=_side_by_side([_figure({"always": chart}, ["always"]) for chart in models]),
        filters=filter_titles(study),
        papers_filters=FILTERS,
        number_word=number_word,
        rules=RULES,
        without=WITHOUT,
        spoken=SPOKEN,
        departures=tables.not_the_papers_line(numbers["not_the_papers"]) if result.papers else "",
        consistency=tables.by_strategy(numbers["consistency"]),
        config=to_toml(study.config),
    )


def _side_by_side(figures: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Set how figures are placed: single-panel figures in pairs, an odd last figure by itself."""
    single = [figure for figure in figures if figure["columns"] == 1]
    for figure in single:
        figure["place"] = "single"
    if len(single) % 2:
        single[-1]["place"] = "lone"
    return figures


def _figure(views: Mapping[Any, Chart], rules: Sequence[str]) -> dict[str, Any]:
    """Return a figure's data for the page under each exclusion rule; None without a chart."""
    by_rule: dict[str, dict[str, Any] | None] = dict.fromkeys(rules)
    for rule, chart in views.items():
        panels = []
        for panel in chart.panels:
            numbers = readings(panel)
            names = list(dict.fromkeys(name for _, _, texts in numbers for name, _ in texts))
            parts = {"panel": panel, "svg": panel_svg(panel), "readings": numbers, "names": names}
            panels.append(parts)
        by_rule[rule] = {"chart": chart, "panels": panels, "legend": legend(chart.panels)}
    first = next(iter(views.values()))
    count = len(first.panels)
    return {
        "name": first.name,
        "title": first.title,
        "by_rule": by_rule,
        "columns": count if count <= 4 else column_count(count),  # the style has four as two by two
        "place": "",
    }


def _write_figure(chart: Chart, folder: Path) -> None:
    """Write a chart as a PNG and a PDF file."""
    save_figure(draw_chart(chart), folder, chart.name)


def _csv_texts(
    result: Answered, figures: Mapping[str, Mapping[Rule, Chart]], models: Sequence[Chart]
) -> dict[str, str]:
    """Return the numbers of each figure as CSV text, with rows for every exclusion rule."""
    texts = {chart.name: csv_text(csv_rows(chart)) for chart in models}
    for name, views in figures.items():
        rows: list[list[str]] = []
        for rule, chart in views.items():
            rows += csv_rows(chart, exclusion=rule)[bool(rows) :]
        texts[name] = csv_text(rows)
    if not result.papers:
        return texts
    table = []
    for rule, selection in result.selections.items():
        for row in tables.table_ii_rows(selection):
            flat = {"exclusion": rule}
            for key, value in row.items():
                pair = isinstance(value, list)
                flat |= {key: value[0], f"{key}_std": value[1]} if pair else {key: value}
            table.append(flat)
    header = list(dict.fromkeys(key for row in table for key in row))
    cells = [["" if row.get(key) is None else str(row[key]) for key in header] for row in table]
    return texts | {"table_ii": csv_text([header, *cells])}


def _p(p: float, sentence: bool = False) -> str:
    """Format a p value; within a sentence it begins with an equals or less-than sign."""
    if p < 1e-4:
        return "< 0.0001"
    return ("= " if sentence else "") + (f"{p:.2g}" if p < 0.1 else f"{p:.2f}")


def _shown(finding: Mapping[str, Any]) -> dict[str, str]:
    """Format a finding of a sentence in its unit, angles in degrees."""
    unit, margin, factor = finding["unit"], finding["margin"], UNITS[finding["unit"]][0]
    edge = finding["least"] if margin is None else margin
    edges = {edge} if margin is None else {edge, -edge}
    words = [
        f"{word} " * (bound in edges) + three_digits(far if bound is None else factor * bound)
        for word, bound, far in zip(
            ("above", "below"), finding["interval"], (-inf, inf), strict=True
        )
    ]
    text = {
        name: "" if finding[name] is None else amount(finding[name], unit)
        for name in ("mean", "band", "papers_error", "standard_error")
    }
    bound = amount(edge, unit) if edge else "0"
    return text | {
        "interval": " to ".join(words),
        "bound": f"> {bound}" if margin is None else f"± {bound}",
    }
