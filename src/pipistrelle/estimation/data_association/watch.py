r"""Watch over a drive without labels: alarms if old landmarks are no longer detected as before.

**Alarm** (`ratios`). Old landmarks are confirmed, and were first detected before the failure. A
call detects one with the probability p of its level (without levels: its range) and bearing,
learned from the drive: h detections in n scans with such a landmark give h / (n + 1). Such a
landmark goes on to be detected with the probability 1 - q, after a failure (a moved caller, a wrong
pose) with q, by chance. If the call failed in a scan k, all scans since then have the log
likelihood ratio

.. math:: G_k = \sum_{missed} \ln \frac{1 - q + q m}{q + (1 - q) m}
                + \sum_{detected} \ln \frac{q}{1 - q}, \qquad m = \prod (1 - p)

where a landmark counts as missed if it is in none of these scans, so a hidden or false landmark
counts once. In a scan at most as many landmarks are missed as precise measurements are unexplained,
and none with a measurement within the gate, though it may be too uncertain to match. The largest G
over the last scans above :math:`\ln n` is an alarm, less than 1 in n scans without failures.
Willsky & Jones, IEEE Transactions on Automatic Control 21 (1976).

**Cause**. If another call's measurements fit as before, the caller was moved or renamed, else the
pose is wrong. **Pose** (`placed_again`). Two points measured from the vehicle and two landmarks at
the same distance fix a pose; the measured points are echoes of the vehicle's own call, or a caller
and an echo of its call. With the angle :math:`\psi` between them, the excess path e and the
distance a of landmark and caller, the caller is at the distance D of

.. math:: D^2 + k D = \frac{a^2 - k^2}{2 (1 - \cos \psi)}, \qquad k = e - a.

The total cost adds twice the expected number of detections to the costs of measurements (`pairs`),
and that of a wide prior, as in `recovery`. The pose of least cost is accepted if it is 1,000 times
likelier than the predicted pose.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.detection.scans import OWN
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.catalogue import GATE as CONFIDENCE
from pipistrelle.estimation.data_association.existence import FAINTEST, LEVEL_STD, WINDOW, Known
from pipistrelle.estimation.data_association.pairs import OWN_CALL, PlainChances, Rows, pair_costs
from pipistrelle.geometry import wrap

BOUND = math.log(1e5)
"""Log likelihood ratio of an alarm: less than 1 false alarm in 100,000 scans."""
RINGS, SECTORS = 12, 8
"""Bins of detection probabilities: levels, `LEVEL_STD` wide, else ranges from 1 m by factors of the
root of 2, and bearings."""
BINS = RINGS * SECTORS
CHANCE = 0.1
"""Probability q that a landmark is still detected after a failure, and hidden without failure."""
SPOILT = 3
"""Least scans of a caller in a failure: an echo may have been taken for its direct call."""
SETTLED = 12
"""Scans for which a lost pose is searched."""
POSE = -1
"""Number that replaces a call's in alarms about the pose."""
NEAREST, TRIED = 100, 1000
"""Most landmarks compared, of the nearest, and most poses tried."""
NEAR = 9.0
"""Gate on the squared distance of two points and two landmarks."""

Pairs = tuple[Complex[np.ndarray, "2 p"], Complex[np.ndarray, "2 p"], Float[np.ndarray, " p"]]
"""Pairs of points in the vehicle's frame, of landmarks [m], and sums of the points' variances."""


class Watched(NamedTuple):
    """Detections of old landmarks by each call during a drive, and alarms."""

    hits: Float[np.ndarray, "c b"]
    """Detections of old landmarks by call and bin; ``asked``: landmarks in the bin, by scan."""
    asked: Float[np.ndarray, "c b"]
    heard: Float[np.ndarray, " c"]
    """Detected old landmarks, summed over scans; ``expected``: their expected number."""
    expected: Float[np.ndarray, " c"]
    times: Float[np.ndarray, " w"]
    """Times of the last `existence.WINDOW` scans, the present one last [s]."""
    alarms: Float[np.ndarray, "a 3"]
    """Time of the failure [s], number of the call or `POSE`, and whether it was repaired (0, 1)."""
    lost: int = 0
    """Scans since the alarm about the pose, with that of the alarm; 0 without an alarm."""


def of_calls(calls: int, before: Watched | None = None) -> Watched:
    """Return the records of a watch over a number of calls, with earlier records."""
    table, sums = np.zeros((2, calls, BINS)), np.zeros((2, calls))
    new = Watched(table[0], table[1], sums[0], sums[1], np.zeros(WINDOW), np.empty((0, 3)))
    if before is None:
        return new
    for after, old in zip(new[:4], before[:4], strict=True):
        after[: len(old)] = old
    return new._replace(times=before.times, alarms=before.alarms.copy(), lost=before.lost)


def probabilities(
    watch: Watched,
    mean: Float[np.ndarray, " d"],
    at: Int[np.ndarray, " n"],
    source: Float[np.ndarray, "n c"],
) -> tuple[Float[np.ndarray, "c n"], Int[np.ndarray, "c n"]]:
    """Return each call's detection probability of landmarks at joint-mean indices, and bins.

    ``source``: levels at 1 m, as in `existence.Known`. A call with levels is judged by landmarks
    with levels above `FAINTEST`; others get the probability 0 and the bin -1.
    """
    dx, dy = mean[at] - mean[0], mean[at + 1] - mean[1]
    far = np.maximum(np.hypot(dx, dy), 1.0)
    lost = np.where(np.arange(len(watch.hits)) == OWN, 40.0, 20.0)[:, np.newaxis]
    steps = (source.T - lost * np.log10(far) - FAINTEST) / LEVEL_STD
    heard, faint = ~np.isnan(steps), steps < 0.0
    steps = np.where(heard, steps, 2.0 * np.log2(far)).clip(0, RINGS - 1).astype(np.int64)
    sector = np.minimum(SECTORS * abs(wrap(np.arctan2(dy, dx) - mean[2])) / math.pi, SECTORS - 1)
    bins = SECTORS * steps + sector.astype(np.int64)
    bins[faint | (~heard & heard.any(axis=1, keepdims=True))] = -1
    p = np.take_along_axis(watch.hits / (watch.asked + 1.0), np.maximum(bins, 0), axis=1)
    return np.where(bins < 0, 0.0, p), bins


def observed(
    watch: Watched,
    old: tuple[Float[np.ndarray, "c n"], Int[np.ndarray, "c n"]],
    heard: tuple[Bool[np.ndarray, "c n"], Bool[np.ndarray, "c n"], Int[np.ndarray, " c"]],
) -> tuple[Float[np.ndarray, "c n"], tuple[np.ndarray, ...]]:
    """Return a scan's column of `existence.Known.past` for old landmarks, and changes of counts.

    By call: ``old``, probabilities and bins (`probabilities`); ``heard``, which landmarks are
    detected, which are judged, and how many precise measurements are unexplained.
    """
    (p, bins), (found, judged, strays) = old, heard
    missed, changes = np.where(judged & ~found, p, 0.0), np.zeros((2, *watch.hits.shape))
    share = np.minimum(strays / np.maximum(missed.sum(axis=1), 1e-9), 1.0)[:, np.newaxis]
    for table, which in zip(changes, (found, found | judged), strict=True):
        call, n = np.nonzero(which & (bins >= 0))
        np.add.at(table, (call, bins[call, n]), 1.0)
    counts = *changes, found.sum(axis=1), np.where(found | judged, p, 0.0).sum(axis=1)
    return np.where(found, 1.0, share * np.log1p(-missed)), counts


def ratios(known: Known, old: Bool[np.ndarray, " l"], now: int) -> Float[np.ndarray, "c w"]:
    """Return the log likelihood ratio of a failure of each call in each of the last scans."""
    past = known.past[old][..., ::-1]
    m = np.exp(np.cumsum(np.minimum(past, 0.0), axis=-1, dtype=float))
    each = np.log((1.0 - CHANCE + CHANCE * m) / (CHANCE + (1.0 - CHANCE) * m))
    each[np.maximum.accumulate(past, axis=-1) > 0.0] = math.log(CHANCE / (1.0 - CHANCE))
    before = known.born[old][:, np.newaxis] < now - np.arange(WINDOW)
    return np.where(before[:, np.newaxis], each, 0.0).sum(axis=0)[:, ::-1]


def failed(
    watch: Watched, ratio: Float[np.ndarray, "c w"], least: Int[np.ndarray, " c"]
) -> tuple[list[int], int, bool]:
    """Return the calls that have failed, the scan of `WINDOW` since when, and if the pose has.

    ``least``: for each call, fewest scans in a failure; more than `WINDOW`: not judged.
    """
    judged = least <= WINDOW
    if watch.lost:  # any ratio above 1
        calls = np.flatnonzero(judged & (ratio[:, -1] > 0.0)).tolist()
        return calls, WINDOW, bool(calls)
    told = np.arange(WINDOW) <= WINDOW - least[:, np.newaxis]
    largest = np.where(told, ratio, -math.inf)
    calls = np.flatnonzero(largest.max(axis=1) >= BOUND)
    if not calls.size:
        return [], WINDOW, False
    since = int(largest[calls].argmax(axis=1).min())
    return calls.tolist(), since, not (judged & (ratio[:, since] < 0.0)).any()


def alarmed(watch: Watched, since: int, number: int, repaired: bool) -> Watched:
    """Return a watch with an alarm about a call or the `POSE`, since a scan of `WINDOW`."""
    alarm = watch.times[since], number, float(repaired)
    if (watch.alarms[:, :2] == alarm[:2]).all(axis=1).any():
        return watch
    return watch._replace(alarms=np.vstack((watch.alarms, alarm)))


def reported(watch: Watched) -> dict[str, Any]:
    """Return a watch's results by their names in ``summary.json``, calls by number."""
    alarms = [(time, int(call), bool(repaired)) for time, call, repaired in watch.alarms.tolist()]
    counts = zip(watch.heard.tolist(), watch.expected.tolist(), strict=True)
    shares = (heard / expected if expected else None for heard, expected in counts)
    return {
        "watch": dict(enumerate(shares)),
        "trusted_until_s": min((time for time, _, good in alarms if not good), default=None),
        "alarms": alarms,
    }


Heard = tuple[int, Rows, Float[np.ndarray, "2"], int]
"""Call, its measurements, bearing and std of its caller, and the caller's joint-mean index."""


def placed_again(
    watch: Watched,
    joint: JointGaussian,
    there: Int[np.ndarray, " n"],
    source: Float[np.ndarray, "n c"],
    heard: Sequence[Heard],
    chances: PlainChances,
) -> JointGaussian | None:
    """Return the joint Gaussian with the pose that a scan has on the map; None if none is sure.

    ``there``: joint-mean indices of the landmarks to compare with; ``source``: their levels at 1 m.
    """
    mean, covariance = joint.mean.copy(), joint.covariance.copy()
    far = np.hypot(mean[there] - mean[0], mean[there + 1] - mean[1])
    near = np.argsort(far, kind="stable")[:NEAREST]
    there, source = there[near], source[near]
    points, calls = mean[there] + 1j * mean[there + 1], [call for call, *_ in heard]

    def cost() -> float:
        compared = mean, covariance, there
        each = (pair_costs(tuple(rows), *compared, at, chances) for _, rows, _, at in heard)
        expected = probabilities(watch, mean, there, source)[0][calls].sum()
        return sum(costs.min(axis=1, initial=0.0).sum() for costs in each) + 2.0 * expected

    poses, variances = poses_of(
        [
            own_pairs(rows, points)
            if at == OWN_CALL
            else caller_pairs(rows, direct, complex(*mean[at : at + 2]), points)
            for _, rows, direct, at in heard
        ]
    )
    least = cost() + 2.0 * math.log(1.0 - CONFIDENCE)
    wide = 4.0 * math.log(far.max(initial=1.0)) + 2.0 * math.log(math.pi)
    best, covariance[:3], covariance[:, :3] = None, 0.0, 0.0
    for n, pose in enumerate(poses):
        mean[:3], covariance[range(3), range(3)] = pose, variances[n]
        if (value := cost() + wide - np.log(variances[n]).sum()) < least:
            best, least = n, value
    if best is None:
        return None
    mean[:3], covariance[range(3), range(3)] = poses[best], variances[best]
    return replace(joint, mean=mean, covariance=covariance)


def own_pairs(heard: Rows, there: Complex[np.ndarray, " n"]) -> Pairs:
    """Pair two echoes of the own call with two landmarks at the same distance."""
    points = heard.way * np.exp(1j * heard.bearing)
    variance = heard.way_std**2 + (heard.way * heard.bearing_std) ** 2
    i, j = np.triu_indices(points.size, 1)
    a, b = np.nonzero(~np.eye(there.size, dtype=np.bool_))
    spread, off = variance[i] + variance[j], abs(points[j] - points[i])[:, np.newaxis]
    p, q = np.nonzero((off - abs(there[b] - there[a])) ** 2 < NEAR * spread[:, np.newaxis])
    return np.stack([points[i][p], points[j][p]]), np.stack([there[a][q], there[b][q]]), spread[p]


def caller_pairs(
    heard: Rows, direct: Float[np.ndarray, "2"], place: complex, there: Complex[np.ndarray, " n"]
) -> Pairs:
    """Return pairs of a caller and an echo of its call, with each landmark as its source."""
    away = abs(there - place)
    k = heard.way[:, np.newaxis] - away
    turn = 1.0 - np.cos(heard.bearing - direct[0])[:, np.newaxis]
    with np.errstate(divide="ignore", invalid="ignore"):
        near = 0.5 * (np.sqrt(k * k + 2.0 * (away**2 - k * k) / turn) - k)
    m, n = np.nonzero((near > 0.0) & (near + k > 0.0) & np.isfinite(near))
    near, far = near[m, n], (near + k)[m, n]
    points = near * np.exp(1j * direct[0]), far * np.exp(1j * heard.bearing[m])
    spread = (far * heard.bearing_std[m]) ** 2 + heard.way_std[m] ** 2 + (near * direct[1]) ** 2
    return np.stack(points), np.stack([np.full(n.size, place), there[n]]), spread


def poses_of(pairs: Sequence[Pairs]) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Return the poses that put two points on two landmarks, and their variances.

    These are at most `TRIED`, of the surest headings.
    """
    parts = zip((np.empty((2, 0)), np.empty((2, 0)), np.empty(0)), *pairs, strict=True)
    points, there, spread = (np.concatenate(part, axis=-1) for part in parts)
    across = points[1] - points[0]
    turned = spread / abs(across) ** 2
    kept = np.argsort(turned, kind="stable")[:TRIED]
    heading = np.angle((there[1] - there[0]) / across)[kept]
    middle, turned = points.mean(axis=0)[kept], turned[kept]
    at = there.mean(axis=0)[kept] - np.exp(1j * heading) * middle
    moved = 0.25 * spread[kept] + turned * abs(middle) ** 2
    return np.stack([at.real, at.imag, heading]).T, np.stack([moved, moved, turned]).T
