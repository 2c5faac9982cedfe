r"""Scans from before there was a map, labelled by the map that came of them.

Excess paths say where landmarks are once their caller is on the map, and that it is from the scan
after the one in which its range is stated. Until then a vehicle that only listens has no landmark,
and one whose beam is narrow has few; but at the start the heading is known best, and what was heard
there says how the map lies. So these rows are held against the map when that has settled. Before,
map and vehicle are turned against each other as all rows fit best (`_turn`): their headings are
off by more than bearings are. A bearing alone places no landmark: with it comes the range that the
map has for it, stated so unsurely that little is said twice.

**The turn.** With the mean bearing of all landmarks :math:`\beta = a^T x` of the variance
:math:`a^T P a`, a turn by :math:`\delta` moves the mean to

.. math:: x + \frac{P a}{a^T P a}\, \delta, \qquad
          P - \frac{P a a^T P}{a^T P a}

being the covariance of what is left.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import RANGE, RANGE_STD, UNLABELLED, Scan
from pipistrelle.estimation.association import is_among
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.data_association.matching import NOTHING, Match
from pipistrelle.estimation.data_association.memory import EarlyScan
from pipistrelle.estimation.data_association.pairs import (
    UNPLACED,
    PlainChances,
    pair_costs,
    pair_innovations,
)
from pipistrelle.estimation.data_association.rows import part_of
from pipistrelle.estimation.data_association.turns import fit

FEW = 3
"""A scan is early if fewer landmarks are known at its end, and no caller was on the map before."""
MOST, SETTLED = 16, 12
"""How many early scans are remembered, and after how many more the map is taken to have settled."""
TURNS = np.linspace(-3.5, 3.5, 141)
"""Turns that are tried, in standard deviations."""
APART, CLEARER = 0.04, 10.0
"""All turns that are so far from the best [rad] must cost so much more."""
RANGE_SHARE = 0.2
"""Deviation of a range that is taken from the map, as a share of it."""


def direct_row(direct: Int[np.ndarray, " c"], number: int) -> int:
    """Return the row of a caller's direct call, or -1, of the rows of all direct calls."""
    return int(direct[number]) if number < direct.size else -1


def labelled_by_map(
    early: EarlyScan,
    joint: JointGaussian,
    sure: Int[np.ndarray, " s"],
    callers: Mapping[int, int],
    match: Match,
    chances: PlainChances,
) -> Scan:
    """Return an early scan, its callers' rows with labels by a map that is known now.

    In place of the pose of ``joint`` comes that of the early scan, as if the errors of map and
    pose had nothing in common. ``sure``: labels of landmarks that are some; ``callers``: where
    callers stand in the mean, by number, or UNPLACED of those that were elsewhere.
    """
    mean, covariance = joint.mean.copy(), joint.covariance.copy()
    mean[:3], covariance[:3], covariance[:, :3] = early.pose.mean, 0.0, 0.0
    covariance[:3, :3] = early.pose.covariance
    kept = np.flatnonzero(is_among(joint.landmark, sure))
    there, names = 3 + 2 * kept, np.append(joint.landmark[kept], UNLABELLED)
    label, numbers = np.full(early.scan.caller.size, UNLABELLED), early.scan.numbers.copy()
    for number, place in callers.items():
        direct = direct_row(early.direct, number)
        at, rows = place if direct >= 0 else UNPLACED, early.rows
        heard = rows.usable if at == UNPLACED else rows.with_way
        used = np.flatnonzero(heard & (rows.caller == number))
        used = used[used != direct]
        found = _matched(part_of(rows, used, 0.0), (mean, covariance), there, at, match, chances)
        label[used] = names[found]
        if at == UNPLACED:
            used, i = used[found != NOTHING], there[found[found != NOTHING]]
            far = np.hypot(mean[i] - mean[0], mean[i + 1] - mean[1])
            numbers[RANGE, used], numbers[RANGE_STD, used] = far, RANGE_SHARE * far
    return replace(early.scan, landmark=label, numbers=numbers)


def _matched(
    rows: tuple[np.ndarray, ...],
    gaussian: tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]],
    there: Int[np.ndarray, " n"],
    at: int,
    match: Match,
    chances: PlainChances,
) -> Int[np.ndarray, " r"]:
    """Return which landmark each row is of, NOTHING of all if they fit at more than one turn."""
    (mean, _), (spread, variance, left) = gaussian, _turn(*gaussian, there)
    turns = math.sqrt(variance) * TURNS
    means = [mean + spread * (turn / variance) for turn in turns]
    costs = [pair_costs(rows, turned, left, there, at, chances) for turned in means]
    total = np.array([fit(cost)[0] for cost in costs]) + TURNS * TURNS
    best = int(total.argmin())
    others = total[np.abs(turns - turns[best]) > APART]
    if others.min(initial=0.0) < total[best] + CLEARER:
        return np.full(rows[0].size, NOTHING)
    return match(costs[best], partial(pair_innovations, rows, means[best], left, there, at))


def _turn(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    there: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " d"], float, Float[np.ndarray, "d d"]]:
    """Return P a, a^T P a, and the covariance without the turn."""
    dx, dy = mean[there] - mean[0], mean[there + 1] - mean[1]
    squared = there.size * (dx * dx + dy * dy)
    slope = np.zeros(mean.size)
    slope[there], slope[there + 1] = -dy / squared, dx / squared
    slope[:3] = -slope[there].sum(), -slope[there + 1].sum(), -1.0
    spread = covariance @ slope
    variance = float(slope @ spread)
    return spread, variance, covariance - np.outer(spread, spread) / variance
