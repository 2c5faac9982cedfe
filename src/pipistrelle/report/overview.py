"""Tables of a study: what was left out, Table II beside the paper's, consistency in numbers."""

from typing import Any

import numpy as np

from pipistrelle.evaluation.consistency import EKF_LIMIT, FASTSLAM_LIMIT, anees, anees_bounds
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.contrasts import STATES
from pipistrelle.report.outcomes import Rule, Study, kept, lost, samples
from pipistrelle.report.published import EXCLUDED, TABLE_II, beam_name, cell_of, row_name

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
