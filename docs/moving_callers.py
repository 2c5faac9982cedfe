"""Print the table of callers that move, in `association.md`, anew.

    python docs/moving_callers.py [WORLDS]

Worlds of a seed that no study uses, whose beacon goes in a circle or walks, are driven through with
the settings of the study `association`, with labels and by `marginal`.
"""

import sys

import numpy as np
from association_tables import BEAMS, planned, worlds_lost

import pipistrelle

SEED, WORLDS = 6601, 16
COURSES = {
    "circle": {"course": "circle", "radius": 15.0, "speed": 0.75},
    "walk": {"course": "walk"},
}
FILTERS = {"iekf": "invariant EKF", "smoother": "smoother"}
NAMES = (
    "position [m]", "aligned [mm]", "caller, aligned [m]", "rows right", "missed", "false", "twice",
    "worlds lost",
)  # fmt: skip


def trials_of(course, worlds):
    """Return the trials of worlds whose caller goes a course, one a row."""
    config = {"seed": SEED, "emitter.radius": BEAMS["33°"], "callers": [COURSES[course]]}
    plan = planned({"association.method": ["known", "marginal"]}, **config)
    plan |= {"strategies": ["fused", "passive"], "filters": [*FILTERS]}
    return pipistrelle.study(plan, iterations=worlds).trials.sort("iteration").to_dicts()


def cells(known, found):
    """Return the cells of a row: with labels and without, then without."""

    def of(trials, score):
        return np.array([trial[score] for trial in trials], float)

    raw = [np.sqrt(np.mean(of(one, "position_rmse_m") ** 2)) for one in (known, found)]
    aligned = [of(one, "position_rmse_aligned_m") for one in (known, found)]
    caller = [np.nanmean(of(one, "caller_rmse_aligned_m")) for one in (known, found)]
    yield " → ".join(f"{error:.2f}" for error in raw)
    yield " → ".join(f"{1e3 * error.mean():.0f}" for error in aligned)
    yield " → ".join(f"{error:.2f}" for error in caller)
    yield f"{np.mean(of(found, 'associated_right')):.3f}"
    for what in ("missed", "false", "twice"):
        yield f"{np.mean(of(found, f'landmarks_{what}')):.1f}"
    yield str(worlds_lost(*aligned))


def main(worlds=WORLDS):
    """Print the table."""
    print("| | " + " | ".join(NAMES) + " |\n|---" + "|--:" * len(NAMES) + "|")
    for course in COURSES:
        trials = trials_of(course, worlds)
        for strategy in ("fused", "passive"):
            for name, words in FILTERS.items():
                here = [t for t in trials if (t["strategy"], t["filter"]) == (strategy, name)]
                pair = (
                    [t for t in here if t["association.method"] == method]
                    for method in ("known", "marginal")
                )
                print(f"| {course}, {strategy}, {words} | " + " | ".join(cells(*pair)) + " |")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
