"""Tables of effects, and of every case of a study beside them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipistrelle.evaluation.comparison import Finding
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.report.effects.comparing import STRATEGY, Contrast, Effect
from pipistrelle.report.effects.levels import times_the_bound
from pipistrelle.report.effects.measures import measures_of
from pipistrelle.report.effects.wording import direction, variable_of, with_article
from pipistrelle.report.numbers import amount, interval, three_digits
from pipistrelle.report.studied import (
    POSITION,
    Selection,
    Study,
    case_name,
    filter_titles,
    mean_std,
    own_cases,
    samples,
)
from pipistrelle.report.variables import two_sided

MAX_COMBINATIONS = 6
"""Of so many combinations each has a row; of more, those at which the opposite is shown."""


def effect_tables(
    selection: Selection, effects: Sequence[Effect], otherwise: Sequence[Effect]
) -> list[dict[str, Any]]:
    """Lay out what each variable changes, then strategies and filters, where there are several.

    `otherwise` holds the same effects without the cases that diverged. A table has a name, a title,
    a meaning, whether it is one of the study's variables, and rows: a filter, strategy and value
    each, with a cell per measure. Rows that are no `end` stand between a number's ends; a row
    below another says what it is at one combination of the rest, or without diverged cases; it is
    contrary where the position RMSE then changes in another direction.
    """
    study = selection.study
    titles = [measure.title for measure in measures_of(study)]
    tables: dict[str, dict[str, Any]] = {}
    rows: dict[Contrast, list[tuple[Effect, Effect]]] = {}
    for pair in zip(effects, otherwise, strict=True):
        rows.setdefault(pair[0].contrast, []).append(pair)
    for contrast, pairs in rows.items():
        first = pairs[0][0]
        if contrast.factor not in tables:
            tables[contrast.factor] = _heading(study, first) | {"measures": titles, "rows": []}
        label, found = _label(study, first), [effect for effect, _ in pairs]
        cells = [(label, {e.measure.score: _cell(e, e.finding, e.untouched) for e in found}, False)]
        cells += _apart(found)
        changed = {
            kept.measure.score: _cell(kept, kept.finding, kept.untouched)
            for effect, kept in pairs
            if not effect.untouched and direction(kept.finding) != direction(effect.finding)
        }
        cells += [("without diverged cases", changed, POSITION in changed)] if changed else []
        tables[contrast.factor]["rows"] += [
            {
                "label": name,
                "strategy": contrast.strategy,
                "end": contrast.end,
                "below": below > 0,
                "contrary": contrary,
                "cells": [by_score.get(measure.score) for measure in measures_of(study)],
            }
            for below, (name, by_score, contrary) in enumerate(cells)
        ]
    for cell in (c for t in tables.values() for row in t["rows"] for c in row["cells"] if c):
        if 1 < cell["n"] < len(study.worlds):
            cell["text"] += f" ({cell['n']} of {len(study.worlds)} worlds)"
    return list(tables.values())


def _apart(effects: Sequence[Effect]) -> list[tuple[str, dict[str, Any], bool]]:
    """Lay out a contrast at combinations of the rest: each of a few, or where the opposite is."""
    rows = []
    for i, name in enumerate(effects[0].contrast.names if effects[0].apart else ()):
        opposite = any(
            direction(e.apart[i]) and direction(e.apart[i]) != direction(e.finding)
            for e in effects
            if e.measure.score == POSITION
        )
        if len(effects[0].apart) <= MAX_COMBINATIONS or opposite:
            cells = {e.measure.score: _cell(e, e.apart[i]) for e in effects}
            rows.append((f"at {name}", cells, opposite))
    return rows


def case_rows(selection: Selection) -> list[dict[str, Any]]:
    """Lay out where every case stands, as ``summary.json`` has it.

    A row has filter, strategy, values of the variables, the worlds that count, mean and standard
    deviation of each measure over them (of NEES those of its logarithm, as a number and a factor),
    the means of what is shown besides, how many times the bound the position RMSE is, and the
    share of trials that diverged.
    """
    study, rows = selection.study, []
    for way, trials in study.trials.items():
        for column, i in enumerate(own_cases(trials).tolist()):
            cell = (*way, i)
            found: dict[str, Any] = {}
            for measure in measures_of(study):
                (sample,) = samples(selection, measure.score, [cell])
                found["n"] = found.get("n", len(sample))
                found[measure.score] = _moments(sample, ratio=measure.ratio)
            for name in shown_in("cases"):
                (sample,) = samples(selection, name, [cell])
                found[name] = float(np.mean(sample)) if len(sample) else None
            rows.append(
                {"filter": way[0], "strategy": way[1], "at": case_name(study, way, i), **found}
                | {"times_the_bound": times_the_bound(selection, cell)}
                | {"diverged": float(np.mean(trials.diverged[:, column]))}
            )
    return rows


def _moments(sample: np.ndarray, *, ratio: bool) -> list[float] | None:
    """Return mean and standard deviation; of a ratio those of logarithms, back as numbers."""
    if ratio:
        sample = np.log(sample[sample > 0.0])
    if len(sample) == 0:
        return None
    mean, std = mean_std(sample)
    return [float(np.exp(mean)), float(np.exp(std))] if ratio else [mean, std]


def _heading(study: Study, effect: Effect) -> dict[str, Any]:
    """Say what a table is of."""
    contrast, variable = effect.contrast, variable_of(study, effect)
    if variable is None:
        what = "Strategies" if contrast.factor == STRATEGY else "Filters"
        return {"name": contrast.factor, "title": what, "meaning": "", "varied": False}
    ends = f", {contrast.after} instead of {contrast.before}" * (len(variable.words) == 2)
    if variable.numbers is not None:
        ends = f", from {contrast.before} to {variable.words[0 if variable.base else -1]}"
    if two_sided(variable):
        ends = f", against {contrast.before}"
    title = with_article(variable) + ends
    return {
        "name": variable.name,
        "title": title[0].upper() + title[1:] if title.startswith("the ") else title,
        "meaning": variable.meaning,
        "varied": True,
    }


def _label(study: Study, effect: Effect) -> str:
    """Name a row."""
    contrast, variable = effect.contrast, variable_of(study, effect)
    titles = filter_titles(study)
    if variable is None:
        whose = titles.get(contrast.filter, f"{contrast.strategy} sensing")
        return f"{whose}: {contrast.after} instead of {contrast.before}"
    whose = f"{contrast.strategy} {titles[contrast.filter]}"
    if effect.measure.over:
        whose = f"gain of {whose} over {effect.measure.over}"
    if variable.numbers is not None and not two_sided(variable):
        return whose if contrast.end else f"{whose}, to {contrast.after}"
    if len(variable.words) == 2:
        return whose
    return f"{whose}: {contrast.after} instead of {contrast.before}"


def _cell(effect: Effect, finding: Finding, untouched: bool = False) -> dict[str, Any]:
    """Word a finding on an effect, with its interval."""
    measure = effect.measure
    cell = {"shown": direction(finding) != 0, "n": finding.n, "interval": ""}
    if untouched:
        return cell | {"text": "same"}
    if finding.n < 2:
        return cell | {"text": "?"}
    low, high = finding.family
    if measure.ratio:
        mean, low, high = np.exp(np.clip([finding.mean, low, high], -700.0, 700.0)).tolist()
        text, ends = f"× {three_digits(mean)}", interval((low, high), "")
    else:
        text = "+" * (finding.mean > 0.0) + amount(finding.mean, measure.unit)
        ends = interval((low, high), measure.unit)
    alike = not finding.std > 0.0
    return cell | {"text": text, "interval": "in every world" if alike else ends}
