"""The page: one file that holds everything, and beside it the figures and the numbers.

Nothing in it asks for anything outside: style, script and drawings are inside. Every text goes
through the template's escaping. The same folder gives the same bytes.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.evaluation.comparison import INTERVALS, Finding
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.figures.chart import Chart, Panel, columns_of, csv_rows, csv_text
from pipistrelle.figures.style import page_colours
from pipistrelle.files import REPORT, claim, drawn_files, upright
from pipistrelle.report.charts.results import Figure, answers, study_charts
from pipistrelle.report.charts.setting import model_charts
from pipistrelle.report.claims.published import FILTERS
from pipistrelle.report.claims.statements import Claim
from pipistrelle.report.claims.verdicts import WITHOUT, tally, with_everything
from pipistrelle.report.effects.measures import measures_of
from pipistrelle.report.numbers import UNITS, number_word, three_digits
from pipistrelle.report.page import overview
from pipistrelle.report.page.summary import Answered, answered, summary
from pipistrelle.report.page.svg import legend, panel_svg, readings
from pipistrelle.report.studied import (
    ONLINE_POSITION,
    RULES,
    Rule,
    Study,
    filter_titles,
    has_numbers,
)
from pipistrelle.settings import to_toml

if TYPE_CHECKING:
    from jinja2 import Template

SPOKEN = {"reproduced": "Reproduced", "not-reproduced": "Not reproduced", "open": "Open"}
MIN_WORLDS = 20
"""Worlds under which a reader is warned: a few agree by chance on what many do not show."""


def write_report(
    study: Study,
    folder: Path,
    *,
    claims: Sequence[Claim] | None = None,
    charts: Sequence[Figure] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Answer a study's question and write its page, its figures and its summary.

    `study`: as `reading.read_study` gives it. `folder`: made where it is missing; ``index.html``,
    ``summary.json`` and ``figures``. `claims`: to be judged; if not said, the paper's where the
    study holds its cases, else none. `charts`: each gives the charts of a figure; they have names
    of their own. If not said, as `charts.results.study_charts` has it. `progress`: given the name
    of each figure before it is drawn. Returns: as ``summary.json`` holds it. Raises InputError: as
    `pipistrelle.files.claim`: an earlier report is replaced, and nothing else.
    """
    own = claim(folder, REPORT, overwrite=True)
    result = answered(study, claims)
    rules = sorted(RULES, key=lambda rule: rule != result.rule)  # the one that answers is printed
    found = {rule: study_charts(result.selections[rule], charts) for rule in rules}
    models = model_charts(study)
    drawn, texts = [*_distinct(found), *models], _csv_texts(result, found, models)

    def draw(room: Path) -> None:
        for chart in drawn:
            progress(chart.name)
            _write_figure(chart, room)

    numbers = summary(result)
    files = drawn_files(draw, "figures/")
    files |= {f"figures/{name}.csv": text.encode() for name, text in texts.items()}
    files["index.html"] = page(result, found, models, numbers).encode()
    files["summary.json"] = (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode()
    own.replace(files)
    return numbers


def page(
    result: Answered,
    found: dict[Rule, list[Chart]],
    models: list[Chart],
    numbers: dict[str, Any],
) -> str:
    """Write the page.

    `numbers`: as ``summary.json`` holds it. Returns: HTML.
    """
    here, study = files("pipistrelle.report.page"), result.study
    figures = [_figure(chart.name, found) for chart in _distinct(found)]
    text = _template().render(
        study=study,
        papers=result.papers,
        headline=result.rule,
        question=result.question,
        claims=result.claims,
        summary=numbers,
        few=MIN_WORLDS,
        intervals=INTERVALS,
        tables=numbers["effect_tables"],
        means=shown_in("cases"),
        in_one_world=IN_ONE_WORLD,
        online=has_numbers(study, ONLINE_POSITION),
        measures=measures_of(study),
        units=UNITS,
        figures=_side_by_side([figure for figure in figures if answers(figure["name"])]),
        further=_side_by_side([figure for figure in figures if not answers(figure["name"])]),
        models=_side_by_side([_figure(chart.name, {"always": [chart]}) for chart in models]),
        style=Markup((here / "page.css").read_text(encoding="utf-8")),
        script=Markup((here / "page.js").read_text(encoding="utf-8")),
        colours=Markup(page_colours()),
        filters=filter_titles(study),
        papers_filters=FILTERS,
        number_word=number_word,
        rules=RULES,
        without=WITHOUT,
        spoken=SPOKEN,
        tally=tally,
        with_everything=with_everything,
        departures=overview.not_the_papers_line(numbers["not_the_papers"]) if result.papers else "",
        consistency=overview.by_strategy(numbers["consistency"]),
        config=to_toml(study.config),
    )
    return upright(text)


def _template() -> "Template":
    """Read the page's template, which escapes every text."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": three_digits, "p": _p, "finding": _shown}
    text = (files("pipistrelle.report.page") / "page.html").read_text(encoding="utf-8")
    return environment.from_string(text)


def _side_by_side(figures: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Put figures of one panel side by side, and the last of an odd number beside its words."""
    single = [figure for figure in figures if figure["columns"] == 1]
    for figure in single:
        figure["place"] = "single"
    if len(single) % 2:
        single[-1]["place"] = "lone"
    return figures


def _distinct(found: Mapping[Any, list[Chart]]) -> list[Chart]:
    """Return each figure once: under the first rule under which there is one."""
    charts: dict[str, Chart] = {}
    for listed in found.values():
        for chart in listed:
            charts.setdefault(chart.name, chart)
    return list(charts.values())


def _figure(name: str, found: Mapping[Any, list[Chart]]) -> dict[str, Any]:
    """Gather one figure under all exclusion rules; None under those that leave nothing."""
    named = {rule: chart for rule, some in found.items() for chart in some if chart.name == name}
    by_rule: dict[str, dict[str, Any] | None] = dict.fromkeys(found)
    for rule, chart in named.items():
        panels = [_panel(panel) for panel in chart.panels]
        by_rule[rule] = {"chart": chart, "panels": panels, "legend": legend(chart.panels)}
    first = next(iter(named.values()))
    count = len(first.panels)
    columns = count if count <= 4 else columns_of(count)  # the style sheet has four as two by two
    return {"name": name, "title": first.title, "by_rule": by_rule, "columns": columns, "place": ""}


def _panel(panel: Panel) -> dict[str, Any]:
    """Gather a panel: its drawing, its numbers and their names."""
    numbers_read = readings(panel)
    names = list(dict.fromkeys(name for _, _, numbers in numbers_read for name, _ in numbers))
    return {"panel": panel, "svg": panel_svg(panel), "readings": numbers_read, "names": names}


def _write_figure(chart: Chart, folder: Path) -> None:
    """Draw a chart for paper."""
    from pipistrelle.figures.chart import draw_chart
    from pipistrelle.figures.style import save_figure

    save_figure(draw_chart(chart), folder, chart.name)


def _csv_texts(
    result: Answered, found: dict[Rule, list[Chart]], models: list[Chart]
) -> dict[str, str]:
    """Write the numbers behind each figure, under all exclusion rules."""
    texts = {chart.name: csv_text(csv_rows(chart)) for chart in models}
    for chart in _distinct(found):
        rows: list[list[str]] = []
        for rule, listed in found.items():
            for other in listed:
                if other.name == chart.name:
                    new = csv_rows(other, exclusion=rule)
                    rows += new[1:] if rows else new
        texts[chart.name] = csv_text(rows)
    if not result.papers:
        return texts
    table = []
    for rule, selection in result.selections.items():
        for row in overview.table_ii_rows(selection):
            flat = {"exclusion": rule}
            for key, value in row.items():
                pair = isinstance(value, list)
                flat |= {key: value[0], f"{key}_std": value[1]} if pair else {key: value}
            table.append(flat)
    header = list(dict.fromkeys(key for row in table for key in row))
    cells = [["" if row.get(key) is None else str(row[key]) for key in header] for row in table]
    return texts | {"table_ii": csv_text([header, *cells])}


def _p(p: float, sentence: bool = False) -> str:
    """Write a p value, in a sentence with its sign."""
    if p < 1e-4:
        return "< 0.0001"
    return ("= " if sentence else "") + (f"{p:.2g}" if p < 0.1 else f"{p:.2f}")


def _shown(finding: Finding, unit: str) -> dict[str, str]:
    """Word a finding in the unit that a reader expects."""
    factor, sign = UNITS[unit]
    end = f" {sign}" if sign not in ("", "°") else sign
    edges = {finding.margin, -finding.margin} if finding.relation == "within" else {finding.margin}
    low, high = finding.interval
    words = (
        ("above " if low in edges else "") + three_digits(factor * low),
        ("below " if high in edges else "") + three_digits(factor * high),
    )
    margin = three_digits(factor * finding.margin) + (end if finding.margin else "")
    return {
        "mean": three_digits(factor * finding.mean) + end if finding.n else "none",
        "interval": " to ".join(words),
        "margin": f"± {margin}" if finding.relation == "within" else margin,
        "sigmas": three_digits(finding.mean / finding.sigma) if finding.sigma > 0.0 else "",
    }
