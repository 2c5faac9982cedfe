"""The page: one file that holds everything, and beside it the figures and the numbers.

Nothing in it asks for anything outside: style, script and drawings are inside. Every text goes
through the template's escaping. The same folder gives the same bytes.
"""

import json
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from pipistrelle import __version__
from pipistrelle.evaluation.comparison import Finding
from pipistrelle.figures.chart import Chart, Panel, columns_of, csv_rows, csv_text
from pipistrelle.figures.style import page_colours
from pipistrelle.files import REPORT, OwnFiles
from pipistrelle.report.charts.results import CHARTS, study_charts
from pipistrelle.report.charts.setting import model_charts
from pipistrelle.report.claims.answer import answer, number_word
from pipistrelle.report.claims.contrasts import selections
from pipistrelle.report.claims.published import FILTERS
from pipistrelle.report.claims.statements import CLAIMS, Claim
from pipistrelle.report.claims.verdicts import (
    WITHOUT,
    JudgedClaim,
    judge_claims,
    record,
    tally,
    with_everything,
)
from pipistrelle.report.page import overview
from pipistrelle.report.page.svg import legend, panel_svg, readings, three_digits
from pipistrelle.report.studied import RULES, Rule, Selection, Study, filter_titles
from pipistrelle.settings import to_toml

FORMAT = 1
UNITS = {"rad": (180.0 / math.pi, "°"), "m": (1.0, "m"), "landmarks": (1.0, ""), "": (1.0, "")}
"""How a number is shown: its factor and its sign."""
SPOKEN = {"reproduced": "Reproduced", "not-reproduced": "Not reproduced", "open": "Open"}
LIBRARIES = ("numpy", "scipy", "numba", "polars", "pydantic", "matplotlib", "jinja2")


def write_report(
    studies: tuple[Study, ...],
    folder: Path,
    *,
    claims: Sequence[Claim] = CLAIMS,
    charts: Sequence[Callable[[Selection], list[Chart]]] = CHARTS,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[JudgedClaim, ...]:
    """Judge a study and write its page, its figures and its summary.

    Parameters
    ----------
    studies : tuple of Study
        As `reading.read_study` gives them; the first is shown, of further ones the verdicts.
    folder : Path
        Made where it is missing; ``index.html``, ``summary.json`` and ``figures``.
    claims : sequence of Claim
    charts : sequence of functions of a Selection
        Each gives the charts of a figure; they have names of their own.
    progress : callable, optional
        Given the name of each figure before it is drawn.

    Returns
    -------
    tuple of JudgedClaim
        Of the first study.

    Raises
    ------
    InputError
        Where a file cannot be written, or one that would be replaced is not as we wrote it.
    """
    selected = [selections(study) for study in studies]
    judged = [judge_claims(by_rule, claims) for by_rule in selected]
    found = {rule: study_charts(selection, charts) for rule, selection in selected[0].items()}
    models = model_charts(studies[0])
    drawn, texts = [*_distinct(found), *models], _csv_texts(selected[0], found, models)
    own = OwnFiles(folder, REPORT)
    own.clear(["index.html", "summary.json", *_names(drawn, texts)])
    with own.room("figures") as room:
        for chart in drawn:
            progress(chart.name)
            _write_figure(chart, room)
    for name, text in texts.items():
        own.write(f"figures/{name}.csv", text)
    summary = _summary(studies, selected[0], judged)
    own.write("index.html", page(studies[0], judged[0], found, models, summary))
    own.write("summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    return judged[0]


def _names(charts: Sequence[Chart], texts: Mapping[str, str]) -> list[str]:
    """Name the files of the figures."""
    pictures = [f"figures/{chart.name}.{ending}" for chart in charts for ending in ("png", "pdf")]
    return [*pictures, *(f"figures/{name}.csv" for name in texts)]


def page(
    study: Study,
    claims: tuple[JudgedClaim, ...],
    found: dict[Rule, list[Chart]],
    models: list[Chart],
    summary: dict[str, Any],
) -> str:
    """Write the page.

    Parameters
    ----------
    study : Study
    claims : tuple of JudgedClaim
    found : charts by exclusion rule
    models : charts that no exclusion changes
    summary : dict
        As ``summary.json`` holds it.

    Returns
    -------
    str
        HTML.
    """
    from jinja2 import Environment, StrictUndefined

    here = files("pipistrelle.report.page")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": three_digits, "p": _p, "finding": _shown}
    template = environment.from_string((here / "page.html").read_text(encoding="utf-8"))
    return template.render(
        study=study,
        claims=claims,
        summary=summary,
        figures=[_figure(chart.name, found) for chart in _distinct(found)],
        models=[_figure(chart.name, {"always": [chart]}) for chart in models],
        style=Markup((here / "page.css").read_text(encoding="utf-8")),
        script=Markup((here / "page.js").read_text(encoding="utf-8")),
        colours=Markup(page_colours()),
        filters=filter_titles(study),
        papers=FILTERS,
        number_word=number_word,
        rules=RULES,
        without=WITHOUT,
        spoken=SPOKEN,
        units=UNITS,
        tally=tally,
        with_everything=with_everything,
        departures=overview.not_the_papers_line(summary["not_the_papers"]),
        consistency=overview.by_strategy(summary["consistency"]),
        config=to_toml(study.config),
    )


def _distinct(found: Mapping[Any, list[Chart]]) -> list[Chart]:
    """Return each figure once: under the first rule under which there is one."""
    charts: dict[str, Chart] = {}
    for mine in found.values():
        for chart in mine:
            charts.setdefault(chart.name, chart)
    return list(charts.values())


def _figure(name: str, found: Mapping[Any, list[Chart]]) -> dict[str, Any]:
    """Gather one figure under all exclusion rules; None under those that leave nothing."""
    named = {rule: chart for rule, mine in found.items() for chart in mine if chart.name == name}
    by_rule: dict[str, dict[str, Any] | None] = dict.fromkeys(found)
    for rule, chart in named.items():
        panels = [_panel(panel) for panel in chart.panels]
        by_rule[rule] = {"chart": chart, "panels": panels, "legend": legend(chart.panels)}
    first = next(iter(named.values()))
    count = len(first.panels)
    columns = count if count <= 4 else columns_of(count)  # the style sheet has four as two by two
    return {"name": name, "title": first.title, "by_rule": by_rule, "columns": columns}


def _panel(panel: Panel) -> dict[str, Any]:
    """Gather a panel: its drawing, its numbers and their names."""
    said = readings(panel)
    names = list(dict.fromkeys(name for _, _, numbers in said for name, _ in numbers))
    return {"panel": panel, "svg": panel_svg(panel), "readings": said, "names": names}


def _write_figure(chart: Chart, folder: Path) -> None:
    """Draw a chart for paper."""
    from pipistrelle.figures.chart_plot import draw_chart
    from pipistrelle.figures.style import save_figure

    save_figure(draw_chart(chart), folder, chart.name)


def _csv_texts(
    by_rule: Mapping[Rule, Selection], found: dict[Rule, list[Chart]], models: list[Chart]
) -> dict[str, str]:
    """Write the numbers behind each figure, under all exclusion rules."""
    texts = {chart.name: csv_text(csv_rows(chart)) for chart in models}
    for chart in _distinct(found):
        rows: list[list[str]] = []
        for rule, mine in found.items():
            for other in mine:
                if other.name == chart.name:
                    new = csv_rows(other, exclusion=rule)
                    rows += new[1:] if rows else new
        texts[chart.name] = csv_text(rows)
    table = []
    for rule, selection in by_rule.items():
        for row in overview.table_ii_rows(selection):
            flat = {"exclusion": rule}
            for key, value in row.items():
                pair = isinstance(value, list)
                flat |= {key: value[0], f"{key}_std": value[1]} if pair else {key: value}
            table.append(flat)
    header = list(dict.fromkeys(key for row in table for key in row))
    cells = [["" if row.get(key) is None else str(row[key]) for key in header] for row in table]
    return texts | {"table_ii": csv_text([header, *cells])}


def _summary(
    studies: tuple[Study, ...],
    by_rule: Mapping[Rule, Selection],
    judged: list[tuple[JudgedClaim, ...]],
) -> dict[str, Any]:
    """Lay out everything that the page says, for programs."""
    study, claims = studies[0], judged[0]
    return {
        "format": FORMAT,
        "version": __version__,
        "versions": {"python": platform.python_version()} | _versions(),
        "study": study.name,
        "seed": study.config.seed,
        "worlds_planned": study.planned,
        "worlds_done": len(study.worlds),
        "partial": len(study.worlds) < study.planned,
        "trials": sum(trials.failed.size for trials in study.trials.values()),
        "filters_cpu_s": study.cpu_s,
        "settings": study.settings,
        "not_the_papers": overview.not_the_papers(study),
        "answer": answer(by_rule, claims),
        "claims": [record(claim) for claim in claims],
        "exclusion_rules": dict(RULES),
        "exclusions": overview.exclusion_rows(study),
        "trials_failed": sum(overview.failed_trials(other) for other in studies),
        "table_ii": overview.table_ii_rows(by_rule["world"]),
        "consistency": overview.consistency_rows(by_rule["world"]),
        "failed": [
            {"iteration": i, "strategy": s, "filter": f, "beamwidth_deg": b, "error": text}
            | {"settings": other.settings}
            for other in studies
            for i, s, f, b, text in other.errors
        ],
        "variants": [
            {
                "settings": other.settings,
                "worlds_done": len(other.worlds),
                "trials_failed": overview.failed_trials(other),
                "verdicts": [claim.verdict for claim in mine],
            }
            for other, mine in zip(studies, judged, strict=True)
        ],
    }


def _versions() -> dict[str, str]:
    """Read the versions of the libraries that numbers and pictures depend on."""
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


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
