"""Tables of a study: what was left out, what is not as in the paper, Table II, consistency."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.evaluation.consistency import anees, anees_bounds_about
from pipistrelle.experiments.studies.plan import RADIUS, find_plan, read_plan
from pipistrelle.report.claims.contrasts import anees_departure
from pipistrelle.report.claims.published import (
    EXCLUDED,
    TABLE_II,
    WORLDS,
    cell_of,
    row_name,
)
from pipistrelle.report.studied import (
    Selection,
    Study,
    case_name,
    filter_titles,
    kept,
    lost_worlds,
    mean_std,
    own_cases,
    samples,
)
from pipistrelle.report.variables import setting_variable, width_name
from pipistrelle.settings import derived, known_settings


def exclusion_rows(study: Study) -> list[dict[str, Any]]:
    """Count what each filter lost.

    Returns: per filter: worlds done, those with a diverged or failed case, the paper's count of
    such among its worlds, trials that diverged per strategy, trials that failed, and the NEES
    limit. What diverged is what was stored; None for a limit or a count that is not known here.
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
                "paper": EXCLUDED.get(name),
                "paper_worlds": WORLDS,
                "diverged": {way: int(np.sum(t.diverged & ~t.failed)) for way, t in ways.items()},
                "trials": {way: int(t.failed.size) for way, t in ways.items()},
                "failed": int(sum(np.sum(t.failed) for t in ways.values())),
            }
        )
    return rows


def failed_trials(study: Study) -> int:
    """Count the trials that failed."""
    return int(sum(np.sum(trials.failed) for trials in study.trials.values()))


def not_the_papers(study: Study) -> list[dict[str, Any]]:
    """Name the settings that are not those of the plan `paper`.

    Returns: per setting, strategies and filters among them: its name, its value here and the
    paper's. Seed and number of worlds are none.
    """
    paper = read_plan(find_plan("paper"))
    theirs = _asked(paper.config, paper.grid) | {
        "strategies": sorted(paper.strategies),
        "filters": sorted(paper.filters),
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
    """Say in a line what `not_the_papers` found.

    Returns: empty where there is nothing to say.

    Examples
    --------
    >>> not_the_papers_line([{"setting": "scenario.steps", "here": 200, "paper": 1500}])
    "Not the paper's study: scenario.steps 200 (paper 1500)"
    """
    parts = [f"{r['setting']} {_worded(r['here'])} (paper {_worded(r['paper'])})" for r in rows]
    return f"Not the paper's study: {', '.join(parts)}" if parts else ""


def table_ii_rows(selection: Selection) -> list[dict[str, Any]]:
    """Lay Table II out, ours beside the paper's.

    Returns: per row of the table: the paper's mean and standard deviation, ours and the number of
    worlds; None where the study has no such case. For FastSLAM 2.0 the fully initialised landmarks
    are those of the particle of highest weight, and beside them stands the weighted mean over the
    particles.

    Bradley & Abaid, Table II.
    """
    rows = []
    for printed in TABLE_II:
        cell = cell_of(selection.study, printed)
        row: dict[str, Any] = {
            "filter": printed.filter,
            "beamwidth": row_name(printed),
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
    """Say how consistent each case is.

    Returns: per case: where it is, worlds, time mean of ANEES and of a consistent filter's, the
    means of its 95 % bounds, shares of time inside and above them, and its `anees_departure`.

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
            rows.append(
                {
                    "filter": name,
                    "strategy": strategy,
                    "beamwidth": None
                    if strategy == "passive"
                    else width_name(float(study.beamwidth[number])),
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
    """Average `consistency_rows` over the combinations."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["filter"], row["strategy"]), []).append(row)
    keys = ("anees", "expected", "inside", "above", "departure")
    return [
        {"filter": name, "strategy": strategy, "n": min(row["n"] for row in group)}
        | {key: float(np.mean([row[key] for row in group])) for key in keys}
        for (name, strategy), group in groups.items()
    ]


def _asked(config: Config, grid: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Return every setting but the seed by its dotted name; of what varies, all its values."""
    found: dict[str, Any] = {}
    table = config.model_dump(mode="json")
    for key in known_settings():
        value: Any = table
        for part in key:
            value = value[part]
        found[".".join(key)] = value
    found |= {".".join(key): value for key, value in derived(config).items()}
    del found["seed"]
    varied = {name: setting_variable(name, values).given for name, values in grid.items()}
    return found | {RADIUS: [found[RADIUS]]} | {name: [*given] for name, given in varied.items()}


def _worded(value: Any) -> str:
    """Write a setting's value, of many the ends."""
    if isinstance(value, list):
        if len(value) > 3:
            return f"{len(value)} values from {_worded(value[0])} to {_worded(value[-1])}"
        *first, last = map(_worded, value)
        return f"{', '.join(first)} and {last}" if first else last
    return f"{value:.12g}" if isinstance(value, float) else str(value)
