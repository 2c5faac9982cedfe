"""Tables of a report: effects, cases, exclusions, Table II, consistency, unlike settings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.evaluation.consistency import anees, anees_bounds_about, anees_departure
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.experiments.studies.plan import RADIUS, find_plan, read_plan
from pipistrelle.report import effects as changes
from pipistrelle.report import sentences as paper
from pipistrelle.report.study import (
    POSITION,
    Selection,
    Study,
    case_name,
    filter_titles,
    kept,
    lost_worlds,
    mean_std,
    own_cases,
    samples,
    times_the_bound,
)
from pipistrelle.report.variables import (
    Variable,
    amount,
    interval,
    setting_variable,
    three_digits,
    two_sided,
    width_name,
    with_article,
)
from pipistrelle.settings import derived, known_settings, leaves

MAX_COMBINATIONS = 6
"""Most combinations with a row each; of more, only those with an opposite effect have one."""


def effect_tables(
    selection: Selection, effects: Sequence[changes.Effect], otherwise: Sequence[changes.Effect]
) -> list[dict[str, Any]]:
    """Return the effect tables of a report: by variable, then for strategies and filters.

    `otherwise`: the same effects without diverged cases. A table has name, title, meaning, whether
    it is of a variable (`varied`), and rows: filter, strategy and value, with a cell per measure.
    `end` is false between a number's ends. A `below` row gives the effect at a combination or
    without diverged cases; it is `contrary` if the position RMSE changes in another direction.
    """
    study, measures = selection.study, changes.measures_of(selection.study)
    variables = {variable.name: variable for variable in study.variables}
    tables: dict[str, dict[str, Any]] = {}
    rows: dict[changes.Pairing, list[tuple[changes.Effect, changes.Effect]]] = {}
    for pair in zip(effects, otherwise, strict=True):
        rows.setdefault(pair[0].pairing, []).append(pair)
    for pairing, pairs in rows.items():
        variable = variables.get(pairing.factor)
        own = [effect for effect, _ in pairs]
        if pairing.factor not in tables:
            heading = _heading(pairing, variable) | {"measures": [m.title for m in measures]}
            tables[pairing.factor] = heading | {"rows": []}
        cells = [(_label(study, own[0], variable), _cells(own), False), *_apart(own)]
        changed = [
            less
            for effect, less in pairs
            if not effect.untouched
            and changes.direction(less.finding) != changes.direction(effect.finding)
        ]
        if changed:
            first = any(less.measure.score == POSITION for less in changed)
            cells.append(("without diverged cases", _cells(changed), first))
        tables[pairing.factor]["rows"] += [
            {
                "label": name,
                "strategy": pairing.strategy,
                "end": pairing.end,
                "below": below > 0,
                "contrary": contrary,
                "cells": [by_score.get(measure.score) for measure in measures],
            }
            for below, (name, by_score, contrary) in enumerate(cells)
        ]
    for cell in (c for t in tables.values() for row in t["rows"] for c in row["cells"] if c):
        if 1 < cell["n"] < len(study.worlds):
            cell["text"] += f" ({cell['n']} of {len(study.worlds)} worlds)"
    return list(tables.values())


def _heading(pairing: changes.Pairing, variable: Variable | None) -> dict[str, Any]:
    """Return name, title and meaning of the effect table that a pair of values belongs to."""
    if variable is None:
        title = "Strategies" if pairing.factor == changes.STRATEGY else "Filters"
        return {"name": pairing.factor, "title": title, "meaning": "", "varied": False}
    ends = f", {pairing.after} instead of {pairing.before}" * (len(variable.words) == 2)
    if variable.numbers is not None:
        ends = f", from {pairing.before} to {variable.words[0 if variable.base else -1]}"
    if two_sided(variable):
        ends = f", against {pairing.before}"
    title = with_article(variable) + ends
    return {
        "name": variable.name,
        "title": title[0].upper() + title[1:] if title.startswith("the ") else title,
        "meaning": variable.meaning,
        "varied": True,
    }


def _label(study: Study, effect: changes.Effect, variable: Variable | None) -> str:
    """Return the label of an effect's row in its table."""
    pairing, titles = effect.pairing, filter_titles(study)
    change = f"{pairing.after} instead of {pairing.before}"
    if variable is None:
        return f"{titles.get(pairing.filter, f'{pairing.strategy} sensing')}: {change}"
    whose = f"{pairing.strategy} {titles[pairing.filter]}"
    if effect.measure.over:
        whose = f"gain of {whose} over {effect.measure.over}"
    if variable.numbers is not None and not two_sided(variable):
        return whose if pairing.end else f"{whose}, to {pairing.after}"
    return whose if len(variable.words) == 2 else f"{whose}: {change}"


def _apart(effects: Sequence[changes.Effect]) -> list[tuple[str, dict[str, Any], bool]]:
    """Return table rows of effects at single combinations: all if few, else opposite effects.

    `effects`: of a pairing in every measure. Returns: label, cells by score, and whether the
    effect on the position RMSE is opposite.
    """
    rows = []
    for i, name in enumerate(effects[0].pairing.names if effects[0].apart else ()):
        opposite = any(
            changes.direction(e.apart[i]) not in (0, changes.direction(e.finding))
            for e in effects
            if e.measure.score == POSITION
        )
        if len(effects[0].apart) <= MAX_COMBINATIONS or opposite:
            rows.append((f"at {name}", _cells(effects, i), opposite))
    return rows


def _cells(effects: Sequence[changes.Effect], at: int | None = None) -> dict[str, dict[str, Any]]:
    """Return the table cells (text, interval) of effects by score: averaged or at a combination."""
    cells = {}
    for effect in effects:
        measure, finding = effect.measure, effect.finding if at is None else effect.apart[at]
        low, high = finding.family
        text = "+" * (finding.mean > 0.0) + amount(finding.mean, measure.unit)
        ends = interval((low, high), measure.unit)
        if measure.ratio:
            mean, low, high = np.exp(np.clip([finding.mean, low, high], -700.0, 700.0)).tolist()
            text, ends = f"× {three_digits(mean)}", interval((low, high), "")
        if not finding.std > 0.0:
            ends = "in every world"
        if effect.untouched and at is None:
            text, ends = "same", ""
        elif finding.n < 2:
            text, ends = "?", ""
        shown = changes.direction(finding) != 0
        cells[measure.score] = {"shown": shown, "n": finding.n, "interval": ends, "text": text}
    return cells


def case_rows(selection: Selection) -> list[dict[str, Any]]:
    """Return a row of scores for each case of a study, as in ``summary.json``.

    A row has filter, strategy, values of the variables, number of worlds, mean and standard
    deviation of each measure (of NEES geometric mean and factor), the means of further scores,
    the multiple of the bound, and the share of diverged trials.
    """
    study, rows = selection.study, []
    for way, trials in study.trials.items():
        for column, i in enumerate(own_cases(trials).tolist()):
            cell = (*way, i)
            row: dict[str, Any] = dict(zip(("filter", "strategy"), way, strict=True))
            row["at"] = case_name(study, way, i)
            for measure in changes.measures_of(study):
                (sample,) = samples(selection, measure.score, [cell])
                row["n"] = row.get("n", len(sample))
                row[measure.score] = _moments(sample, ratio=measure.ratio)
            for name in shown_in("cases"):
                (sample,) = samples(selection, name, [cell])
                row[name] = float(np.mean(sample)) if len(sample) else None
            row["times_the_bound"] = times_the_bound(selection, cell)
            row["diverged"] = float(np.mean(trials.diverged[:, column]))
            rows.append(row)
    return rows


def _moments(sample: np.ndarray, *, ratio: bool) -> list[float] | None:
    """Return mean and standard deviation of a sample, or geometric mean and deviation factor."""
    if ratio:
        sample = np.log(sample[sample > 0.0])
    if len(sample) == 0:
        return None
    mean, std = mean_std(sample)
    return [float(np.exp(mean)), float(np.exp(std))] if ratio else [mean, std]


def exclusion_rows(study: Study) -> list[dict[str, Any]]:
    """Return table rows with the numbers of excluded worlds and trials of each filter.

    A row has finished worlds, excluded worlds (`lost_worlds`), the paper's count, diverged
    trials per strategy, failed trials, and the NEES limit; None for unknown limits and counts.
    """
    rows = []
    for name in filter_titles(study):
        ways = {strategy: t for (other, strategy), t in study.trials.items() if other == name}
        rows.append(
            {
                "filter": name,
                "limit": CATALOGUE[name].nees_limit if name in CATALOGUE else None,
                "worlds": len(study.worlds),
                "excluded": int(np.sum(lost_worlds(study, name))),
                "paper": paper.EXCLUDED.get(name),
                "paper_worlds": paper.WORLDS,
                "diverged": {way: int(np.sum(t.diverged & ~t.failed)) for way, t in ways.items()},
                "trials": {way: int(t.failed.size) for way, t in ways.items()},
                "failed": int(sum(np.sum(t.failed) for t in ways.values())),
            }
        )
    return rows


def not_the_papers(study: Study) -> list[dict[str, Any]]:
    """Return the settings, strategies and filters that differ between a study and plan `paper`.

    Returns: name, value here and value of the paper. Seed and number of worlds are ignored.
    """
    plan = read_plan(find_plan("paper"))
    theirs = _asked(plan.config, plan.grid) | {
        "strategies": sorted(plan.strategies),
        "filters": sorted(plan.filters),
    }
    ours = _asked(study.config, study.grid) | {
        "strategies": sorted({strategy for _, strategy in study.trials}),
        "filters": sorted({name for name, _ in study.trials}),
    }
    return [
        {"setting": name, "here": ours[name], "paper": value}
        for name, value in theirs.items()
        if ours[name] != value
    ]


def not_the_papers_line(rows: list[dict[str, Any]]) -> str:
    """Format a study's differences from the plan `paper` in a line; empty without any."""
    parts = [f"{r['setting']} {_worded(r['here'])} (paper {_worded(r['paper'])})" for r in rows]
    return f"Not the paper's study: {', '.join(parts)}" if parts else ""


def _asked(config: Config, grid: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Return every setting of a study except the seed, by dotted name, with all varied values."""
    settings = dict(leaves(config.model_dump(mode="json"), known_settings())) | derived(config)
    asked = {".".join(key): value for key, value in settings.items()}
    del asked["seed"]
    varied = {name: setting_variable(name, values).given for name, values in grid.items()}
    return asked | {RADIUS: [asked[RADIUS]]} | {name: [*given] for name, given in varied.items()}


def _worded(value: Any) -> str:
    """Format the value of a setting; a long list by its length and its ends."""
    if isinstance(value, list):
        if len(value) > 3:
            return f"{len(value)} values from {_worded(value[0])} to {_worded(value[-1])}"
        *first, last = map(_worded, value)
        return f"{', '.join(first)} and {last}" if first else last
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def table_ii_rows(selection: Selection) -> list[dict[str, Any]]:
    """Return the rows of Table II: landmark counts (mean, deviation) of the paper and the study.

    None if the study has no such case. With FastSLAM 2.0 `full` counts the particle of highest
    weight and `full_mean` is the weighted mean over the particles.
    """
    rows = []
    for printed in paper.TABLE_II:
        cell = paper.cell_of(selection.study, printed)
        row: dict[str, Any] = {
            "filter": printed.filter,
            "beamwidth": paper.row_name(printed),
            "paper_full": list(printed.full),
            "paper_total": list(printed.total),
        }
        for kind in ("full", "total", "full_mean"):
            count = f"landmarks_{kind}"
            sample = np.empty(0) if cell is None else samples(selection, count, [cell])[0]
            row["n"] = len(sample)
            row[kind] = list(mean_std(sample)) if len(sample) else None
        rows.append(row)
    return rows


def consistency_rows(selection: Selection) -> list[dict[str, Any]]:
    """Return a table row on the consistency (ANEES) of each case.

    A row has the case, the number of worlds, the time means of ANEES, of a consistent filter's and
    of its 95 % bounds, the shares of time inside and above them, and its `anees_departure`.

    Bradley & Abaid, Eqs. (24) and (25).
    """
    rows, study = [], selection.study
    for (name, strategy), trials in study.trials.items():
        for i, number in enumerate(own_cases(trials).tolist()):
            counts = kept(selection, [(name, strategy, number)])
            frames = np.isfinite(trials.consistent[0, i])
            nees = trials.nees[:, i, frames]
            counts &= np.all(np.isfinite(nees), axis=1)
            if not counts.any() or not nees.shape[1]:
                continue
            mean = anees(nees[counts])
            expected, variance = trials.consistent[:, i, frames]
            low, high = anees_bounds_about(expected, variance, int(counts.sum()))
            width = width_name(float(study.beamwidth[number]))
            rows.append(
                {
                    "filter": name,
                    "strategy": strategy,
                    "beamwidth": None if strategy == "passive" else width,
                    "at": case_name(study, (name, strategy), number),
                    "n": int(counts.sum()),
                    "anees": float(np.mean(mean)),
                    "expected": float(np.mean(expected)),
                    "bounds": [float(np.mean(low)), float(np.mean(high))],
                    "inside": float(np.mean((mean >= low) & (mean <= high))),
                    "above": float(np.mean(mean > high)),
                    "departure": float(anees_departure(mean, expected)),
                }
            )
    return rows


def by_strategy(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Average the rows of `consistency_rows` by filter and strategy."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["filter"], row["strategy"]), []).append(row)
    keys = ("anees", "expected", "inside", "above", "departure")
    return [
        {"filter": name, "strategy": strategy, "n": min(row["n"] for row in group)}
        | {key: float(np.mean([row[key] for row in group])) for key in keys}
        for (name, strategy), group in groups.items()
    ]
