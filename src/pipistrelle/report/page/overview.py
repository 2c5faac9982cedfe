"""Tables of a study: what was left out, what is not as in the paper, Table II, consistency."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipistrelle.config import Config
from pipistrelle.evaluation.consistency import EKF_LIMIT, FASTSLAM_LIMIT, anees, anees_bounds
from pipistrelle.experiments.studies.plan import RADIUS
from pipistrelle.experiments.studies.plan_file import find_plan, read_plan
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.claims.contrasts import STATES
from pipistrelle.report.claims.published import EXCLUDED, TABLE_II, beam_name, cell_of, row_name
from pipistrelle.report.studied import Rule, Study, kept, lost, samples
from pipistrelle.settings import known_settings

LIMITS = {"ekf": EKF_LIMIT, "fastslam": FASTSLAM_LIMIT}


def exclusions(study: Study) -> list[dict[str, Any]]:
    """Count what each filter lost.

    Parameters
    ----------
    study : Study

    Returns
    -------
    list of dict
        Per filter: worlds done, those with a diverged or failed case, the paper's count of such
        among 115, trials that diverged per strategy, trials that failed, and the NEES limit.
    """
    rows = []
    for name in FILTER_NAMES:
        mine = {way: o for way, o in study.outcomes.items() if way[0] == name}
        if not mine:
            continue
        rows.append(
            {
                "filter": name,
                "limit": LIMITS[name],
                "worlds": len(study.worlds),
                "excluded": int(np.sum(lost(study, name))),
                "paper": EXCLUDED[name],
                "paper_worlds": 115,
                "diverged": {
                    way[1]: int(np.sum(o.diverged & ~o.failed)) for way, o in mine.items()
                },
                "trials": {way[1]: int(o.failed.size) for way, o in mine.items()},
                "failed": int(sum(np.sum(o.failed) for o in mine.values())),
            }
        )
    return rows


def failed(study: Study) -> int:
    """Count the trials that failed.

    Parameters
    ----------
    study : Study

    Returns
    -------
    int
    """
    return int(sum(np.sum(outcome.failed) for outcome in study.outcomes.values()))


def departures(study: Study) -> list[dict[str, Any]]:
    """Name the settings that are not those of the plan `paper`.

    Parameters
    ----------
    study : Study

    Returns
    -------
    list of dict
        Per setting, strategies and filters among them: its name, its value here and the paper's.
        Seed and number of worlds are none.
    """
    paper = read_plan(find_plan("paper"))
    theirs = _asked(paper.config, paper.grid) | {
        "strategies": sorted(paper.strategies),
        "filters": sorted(paper.filters),
    }
    ours = _asked(study.config, study.grid) | {
        "strategies": sorted({strategy for _, strategy in study.outcomes}),
        "filters": sorted({name for name, _ in study.outcomes}),
    }
    return [
        {"setting": name, "here": ours[name], "paper": value}
        for name, value in theirs.items()
        if ours[name] != value
    ]


def departures_line(rows: list[dict[str, Any]]) -> str:
    """Say in a line what `departures` found.

    Parameters
    ----------
    rows : list of dict

    Returns
    -------
    str
        Empty where there is nothing to say.

    Examples
    --------
    >>> departures_line([{"setting": "scenario.steps", "here": 200, "paper": 1500}])
    "Not the paper's study: scenario.steps 200 (paper 1500)"
    """
    said = [f"{r['setting']} {_worded(r['here'])} (paper {_worded(r['paper'])})" for r in rows]
    return f"Not the paper's study: {', '.join(said)}" if said else ""


def table_ii(study: Study, rule: Rule = "world") -> list[dict[str, Any]]:
    """Lay Table II out, ours beside the paper's.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    list of dict
        Per row of the table: the paper's mean and standard deviation, ours and the number of
        worlds; None where the study has no such case. For FastSLAM 2.0 the fully initialised
        landmarks are those of the particle of highest weight, and beside them stands the
        weighted mean over the particles.

    Notes
    -----
    Bradley & Abaid, Table II.
    """
    rows = []
    for printed in TABLE_II:
        cell = cell_of(study, printed)
        row: dict[str, Any] = {
            "filter": printed.filter,
            "beamwidth": row_name(printed),
            "paper_full": list(printed.full),
            "paper_total": list(printed.total),
        }
        for kind in ("full", "total", "full_mean"):
            sample = [] if cell is None else samples(study, rule, f"landmarks_{kind}", [cell])[0]
            row["n"] = len(sample)
            row[kind] = [float(np.mean(sample)), _std(sample)] if len(sample) else None
        rows.append(row)
    return rows


def consistency(study: Study, rule: Rule = "world") -> list[dict[str, Any]]:
    """Say how consistent each case is.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    list of dict
        Per case: worlds, time mean of ANEES, shares of time inside and above its 95 % bounds, and
        the mean of ln(ANEES / 3) squared.

    Notes
    -----
    Bradley & Abaid, Eqs. (24) and (25).
    """
    rows = []
    for (name, strategy), outcome in study.outcomes.items():
        for i in range(outcome.nees.shape[1]):
            counts = kept(study, rule, [(name, strategy, i)])
            counts &= np.all(np.isfinite(outcome.nees[:, i]), axis=1)
            if not counts.any() or not outcome.nees.shape[2]:
                continue
            mean = anees(outcome.nees[counts, i])
            low, high = anees_bounds(int(counts.sum()))
            rows.append(
                {
                    "filter": name,
                    "strategy": strategy,
                    "beamwidth": None if strategy == "passive" else beam_name(study.beamwidth[i]),
                    "n": int(counts.sum()),
                    "anees": float(np.mean(mean)),
                    "bounds": [low, high],
                    "inside": float(np.mean((mean >= low) & (mean <= high))),
                    "above": float(np.mean(mean > high)),
                    "departure": float(np.mean(np.square(np.log(mean / STATES)))),
                }
            )
    return rows


def by_strategy(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Average rows of `consistency` over the beamwidths.

    Parameters
    ----------
    rows : list of dict

    Returns
    -------
    list of dict
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["filter"], row["strategy"]), []).append(row)
    keys = ("anees", "inside", "above", "departure")
    return [
        {"filter": name, "strategy": strategy, "n": min(row["n"] for row in mine)}
        | {key: float(np.mean([row[key] for row in mine])) for key in keys}
        for (name, strategy), mine in groups.items()
    ]


def _std(sample: Any) -> float:
    return float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0


def _asked(config: Config, grid: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Return every setting but the seed by its dotted name; of the radius, all its values."""
    found: dict[str, Any] = {}
    table = config.model_dump(mode="json")
    for key in known_settings():
        value: Any = table
        for part in key:
            value = value[part]
        found[".".join(key)] = value
    del found["seed"]
    return found | {RADIUS: sorted(grid.get(RADIUS, [found[RADIUS]]))}


def _worded(value: Any) -> str:
    """Write a setting's value, of many the ends."""
    if isinstance(value, list):
        if len(value) > 3:
            return f"{len(value)} values from {_worded(value[0])} to {_worded(value[-1])}"
        *first, last = map(_worded, value)
        return f"{', '.join(first)} and {last}" if first else last
    return f"{value:.12g}" if isinstance(value, float) else str(value)
