"""How large the position's error is, by itself and beside its bound."""

import numpy as np

from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.report.numbers import amount, interval
from pipistrelle.report.studied import (
    ONLINE_POSITION,
    POSITION,
    POSITION_BOUND,
    Cell,
    Selection,
    Way,
    filter_titles,
    has_numbers,
    own_cases,
    samples,
)


def error_of(selection: Selection, way: Way) -> str:
    """Say how large the position RMSE of a study's only case is; nothing where no world is left."""
    (errors,) = samples(selection, POSITION, [(*way, 0)])
    if not len(errors):
        return ""
    (mean,) = judge([Statement(label="", sample=errors)])
    how_sure = interval(mean.alone, "m") if mean.n > 1 else "in the one world"
    title = filter_titles(selection.study)[way[0]]
    return f"{title}'s position RMSE is {amount(mean.mean, 'm')} {how_sure} by {way[1]} sensing"


def times_the_bound(selection: Selection, cell: Cell) -> float | None:
    """Return the position RMSE over the bound, each as the root of its mean square over worlds.

    The bound is one of squares: the plain mean of an efficient estimator's RMSEs, of which most is
    one normal number, a heading once lost, is down to 0.8 of it. Where the filter revises its path,
    this is the path as it was believed at its time. None where there is no bound.
    """
    score = ONLINE_POSITION if has_numbers(selection.study, ONLINE_POSITION) else POSITION
    errors, least = (samples(selection, name, [cell])[0] for name in (score, POSITION_BOUND))
    if score == ONLINE_POSITION and not len(errors):
        errors = samples(selection, POSITION, [cell])[0]
    if not len(errors) or not len(least):
        return None
    return float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(least))))


def times_by_strategy(selection: Selection, name: str) -> dict[str, str]:
    """Word by strategy how many times the bound a filter's position RMSE is, least to most."""
    words = {}
    for way, trials in selection.study.trials.items():
        times = [times_the_bound(selection, (*way, int(i))) for i in own_cases(trials)]
        known = [one for one in times if one is not None]
        if way[0] == name and len(known) == len(times):
            low, high = f"{min(known):.2f}", f"{max(known):.2f}"
            words[way[1]] = low if low == high else f"{low} to {high}"
    return words
