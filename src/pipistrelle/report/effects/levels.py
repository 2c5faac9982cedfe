"""Where a study stands, whatever it varies: errors, how near the bound, what diverged."""

from collections.abc import Sequence

import numpy as np

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.report.numbers import amount, interval, listed, three_digits
from pipistrelle.report.studied import (
    ONLINE_POSITION,
    POSITION,
    POSITION_BOUND,
    Cell,
    Selection,
    Study,
    Way,
    filter_titles,
    mean_std,
    own_cases,
    samples,
)


def errors_of(selection: Selection) -> list[str]:
    """Say how far off each filter is, by strategy, in a study of a single combination.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of str
        A sentence per filter.
    """
    sentences = []
    for name, title in filter_titles(selection.study).items():
        said = [words for way in _ways(selection.study, name) if (words := _error(selection, way))]
        if said:
            sentences.append(f"{title}'s position error is {listed(said)}.")
    return sentences


def times_the_bound(selection: Selection, name: str) -> tuple[str, bool]:
    """Tell how many times the bound a filter's position error is, by strategy.

    Parameters
    ----------
    selection : Selection
    name : str
        The filter.

    Returns
    -------
    str
        Least and largest over the combinations; empty where there is no bound.
    bool
        Whether it is of the path as it was believed at its time.
    """
    study = selection.study
    ways = _ways(study, name)
    online = any(np.isfinite(study.trials[way].scores[ONLINE_POSITION]).any() for way in ways)
    score, said = ONLINE_POSITION if online else POSITION, []
    for way in ways:
        cells = [(*way, int(i)) for i in own_cases(study.trials[way])]
        times = [_over_bound(selection, score, cell) for cell in cells]
        if np.isfinite(times).all():
            low, high = f"{min(times):.2f}", f"{max(times):.2f}"
            said.append(f"{way[1]} {low}" + (f" to {high}" if high != low else ""))
    return ", ".join(said), online


def diverged(study: Study) -> str:
    """Say which strategies diverged how often.

    Parameters
    ----------
    study : Study

    Returns
    -------
    str
        Empty where none did.
    """
    said = []
    for name, title in filter_titles(study).items():
        shares = {
            way[1]: float(np.mean(trials.diverged))
            for way, trials in study.trials.items()
            if way[0] == name and trials.diverged.any()
        }
        if shares:
            parts = ", ".join(f"{way} in {100.0 * share:.1f} %" for way, share in shares.items())
            said.append(f"with {title} {parts}")
    return f"The filter diverged, of the trials, {'; '.join(said)}." if said else ""


def _ways(study: Study, name: str) -> Sequence[Way]:
    """List a filter's ways in the order of the strategies."""
    return [(name, strategy) for strategy in STRATEGIES if (name, strategy) in study.trials]


def _error(selection: Selection, way: Way) -> str:
    """Word the position error of a way, and the bound beside it."""
    (errors,) = samples(selection, POSITION, [(*way, 0)])
    (least,) = samples(selection, POSITION_BOUND, [(*way, 0)])
    if not len(errors):
        return ""
    (mean,) = judge([Statement(label="", sample=errors)])
    said = amount(mean.mean, "m")
    said += f" {interval(mean.alone, 'm')}" if mean.n > 1 else " in the one world"
    beside = f" (the bound: {three_digits(mean_std(least)[0])} m)" if len(least) else ""
    return f"{said} by {way[1]} sensing{beside}"


def _over_bound(selection: Selection, score: str, cell: Cell) -> float:
    """Return the error of position over the bound, each the root of its mean square.

    The bound is one of squares: the plain mean of an efficient estimator's RMSEs, of which most is
    one normal number, a heading once lost, is down to 0.8 of it.
    """
    errors, least = (samples(selection, name, [cell])[0] for name in (score, POSITION_BOUND))
    if not len(errors) or not len(least):
        return np.nan
    return float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(least))))
