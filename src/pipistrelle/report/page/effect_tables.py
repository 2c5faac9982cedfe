"""Tables of effects, and of every case of a study beside them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipistrelle.report.effects.comparing import STRATEGY, Contrast, Effect
from pipistrelle.report.effects.measures import MEASURES
from pipistrelle.report.effects.wording import direction, the, variable_of
from pipistrelle.report.numbers import amount, interval, three_digits
from pipistrelle.report.studied import (
    POSITION_BOUND,
    Selection,
    Study,
    case_name,
    filter_titles,
    mean_std,
    own_cases,
    samples,
)
from pipistrelle.report.variables import two_sided


def effect_tables(study: Study, effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Lay out what each variable changes, a row per filter, strategy and value.

    Parameters
    ----------
    study : Study
    effects : sequence of Effect
        Under one exclusion rule.

    Returns
    -------
    list of dict
        Per variable, then of strategies and filters, where there are several: its name and what it
        means, whether it is one of the study's variables, and the rows; those that are no `end`
        stand between a number's ends.
    """
    tables: dict[str, dict[str, Any]] = {}
    rows: dict[Contrast, list[Effect]] = {}
    for effect in effects:
        rows.setdefault(effect.contrast, []).append(effect)
    for contrast, mine in rows.items():
        if contrast.factor not in tables:
            tables[contrast.factor] = _heading(study, mine[0]) | {"rows": []}
        cells = {effect.measure.score: _cell(effect) for effect in mine}
        row = {
            "label": _label(study, mine[0]),
            "strategy": contrast.strategy,
            "end": contrast.end,
            "cells": [cells.get(measure.score) for measure in MEASURES],
            "apart": len(mine[0].apart),
        }
        tables[contrast.factor]["rows"].append(row)
    return list(tables.values())


def case_rows(selection: Selection) -> list[dict[str, Any]]:
    """Lay out where every case stands.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of dict
        Per case: filter, strategy, values of the variables, worlds that count, mean and standard
        deviation of each measure over them (of NEES those of its logarithm, as a number and a
        factor), the mean bound of the position, and the share of trials that diverged.
    """
    study, rows = selection.study, []
    for way, trials in study.trials.items():
        for column, i in enumerate(own_cases(trials).tolist()):
            cell = (*way, i)
            found: dict[str, Any] = {}
            for measure in MEASURES:
                (sample,) = samples(selection, measure.score, [cell])
                found["n"] = found.get("n", len(sample))
                found[measure.score] = _moments(sample, ratio=measure.ratio)
            (least,) = samples(selection, POSITION_BOUND, [cell])
            rows.append(
                {"filter": way[0], "strategy": way[1], "at": case_name(study, way, i), **found}
                | {POSITION_BOUND: float(np.mean(least)) if len(least) else None}
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
    title = the(variable) + ends
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


def _cell(effect: Effect) -> dict[str, Any]:
    """Word an effect in a measure, with its interval."""
    finding, measure = effect.finding, effect.measure
    cell = {"shown": direction(finding) != 0, "n": finding.n, "interval": ""}
    if effect.untouched:
        return cell | {"text": "same"}
    if finding.n < 2:
        return cell | {"text": "?"}
    low, high = finding.family
    if measure.ratio:
        mean, low, high = np.exp(np.clip([finding.mean, low, high], -700.0, 700.0)).tolist()
        text, between = f"× {three_digits(mean)}", interval((low, high), "")
    else:
        text = "+" * (finding.mean > 0.0) + amount(finding.mean, measure.unit)
        between = interval((low, high), measure.unit)
    alike = not finding.std > 0.0
    return cell | {"text": text, "interval": "in every world" if alike else between}
