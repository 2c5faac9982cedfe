r"""Watch over a drive without labels: alarms if old landmarks are no longer detected as before.

**Alarm** (`ratios`). Old landmarks are confirmed, and were first detected before the failure. A
call detects them with probabilities p (`existence`). Such a landmark goes on to be detected with
the probability 1 - q, after a failure (a moved caller, a wrong pose) with q, by chance. If the call
failed in a scan k, all scans since then have the log likelihood ratio

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

from pipistrelle.estimation.beliefs import JointGaussian, is_among
from pipistrelle.estimation.catalogue import GATE as CONFIDENCE
from pipistrelle.estimation.data_association.existence import (
    BINS,
    GATE,
    LASTING,
    PERSISTENCE,
    WINDOW,
    Known,
    Place,
    log_ratio,
    probabilities,
)
from pipistrelle.estimation.data_association.pairs import (
    OWN_CALL,
    UNPLACED,
    PlainChances,
    Rows,
    pair_costs,
)
from pipistrelle.jit import Whole, kernel

BOUND = math.log(1e5)
"""Log likelihood ratio of an alarm: less than 1 false alarm in 100,000 scans."""
SPOILT = 3
"""Least scans of a caller in a failure: an echo may have been taken for its direct call."""
SETTLED = 12
"""Scans for which a lost pose is searched."""
POSE = -1
"""Number that replaces a call's in alarms about the pose."""
NEAREST, TRIED = 100, 1000
"""Most landmarks compared, of the nearest, and most poses tried."""

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


@kernel
def observed(
    columns: tuple[np.ndarray, ...],
    sums: tuple[np.ndarray, ...],
    covariance: Float[np.ndarray, "d d"],
    place: Place,
    judged: Bool[np.ndarray, " c"],
    heard: tuple[np.ndarray, ...],
    chances: PlainChances,
    now: Whole,
) -> tuple[np.ndarray, ...]:
    """Add a scan's detections of old landmarks to sums, the first four columns of `Watched`.

    Returns the sums, the later `existence.Known.past`, the probability of a miss of all landmarks,
    and `ratios`, 0 for callers that move. ``heard``: label and caller of measurements, whether they
    are precise, and usable, then the columns of `pairs.Rows`.
    """
    known, (mean, at, callers, moves) = Known(*columns), place
    label, caller, sure, usable, bearing, bearing_std, way, way_std, clutter = heard
    (hits, asked), (found, expected) = np.zeros((2, moves.size, BINS)), np.zeros((2, moves.size))
    hits[: len(sums[0])], asked[: len(sums[1])] = sums[0], sums[1]
    found[: len(sums[2])], expected[: len(sums[3])] = sums[2], sums[3]
    past, missed = np.empty_like(known.past), np.ones(at.size)
    past.reshape(-1)[:-1], old = known.past.reshape(-1)[1:], known.confirmed & (at >= 0)
    past[..., -1] = 0.0
    p, bins = probabilities(hits, asked, known.source, place)
    for c in np.flatnonzero(judged):
        rows, silent = np.flatnonzero(caller == c), np.zeros(at.size)
        seen = is_among(known.label, label[rows])
        past[:, c, -1] = old & seen
        found[c] += (old & seen).sum()
        strays = (sure[rows] & ~is_among(label[rows], known.label[old])).sum()
        quiet, rows = np.flatnonzero(old & ~seen & (p[:, c] > 0.0)), rows[usable[rows]]
        part = bearing[rows], bearing_std[rows], way[rows], way_std[rows], clutter[rows]
        costs = pair_costs(part, mean, covariance, at[quiet], callers[c], chances)
        for k in range(quiet.size):
            if not (costs[:, k] < np.inf).any():
                silent[quiet[k]] = p[quiet[k], c]
        for n in np.flatnonzero(at >= 0):
            here = bins[n, c]
            if here >= 0 and known.count[n] >= LASTING:
                asked[c, here] += 1.0
                hits[c, here] += 1.0 if seen[n] else 0.0
            if not seen[n]:
                missed[n] *= (1.0 - p[n, c]) ** (1.0 / PERSISTENCE)
            expected[c] += p[n, c] if old[n] and seen[n] else silent[n]
        share = min(strays / max(silent.sum(), 1e-9), 1.0)
        past[:, c, -1] += share * np.log1p(-silent)
    ratio = ratios(past, known.born, old, now)
    for c in np.flatnonzero(moves):
        ratio[c] = 0.0
    return hits, asked, found, expected, past, missed, ratio


@kernel
def ratios(
    past: Float[np.ndarray, "l c w"],
    born: Int[np.ndarray, " l"],
    old: Bool[np.ndarray, " l"],
    now: Whole,
) -> Float[np.ndarray, "c w"]:
    """Return the log likelihood ratio of a failure of each call in each of the last scans."""
    total, detected = np.zeros(past.shape[1:]), -log_ratio(0.0)
    for n in np.flatnonzero(old):
        for c in range(len(total)):
            silent, each, first = 0.0, 0.0, max(WINDOW - now + born[n], 0)
            for k in range(WINDOW - 1, first - 1, -1):
                if past[n, c, k] > 0.0:
                    total[c, first : k + 1] += detected
                    break
                if past[n, c, k] < 0.0:
                    silent += past[n, c, k]
                    each = log_ratio(math.exp(silent))
                total[c, k] += each
    return total


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
    calls = np.flatnonzero(largest.max(axis=1) >= BOUND).tolist()
    since = int(largest[calls].argmax(axis=1).min(initial=WINDOW - 1))
    return calls, since, bool(calls) and not (ratio[:, since] < 0.0).any()


def alarmed(watch: Watched, since: int, number: int, repaired: bool) -> Watched:
    """Return a watch with an alarm about a call or the `POSE`, since a scan of `WINDOW`."""
    alarm = watch.times[since], number, float(repaired)
    if (watch.alarms[:, :2] == alarm[:2]).all(axis=1).any():
        return watch
    return watch._replace(alarms=np.vstack((watch.alarms, alarm)))


def reported(watch: Watched) -> dict[str, Any]:
    """Return a watch's results by their names in ``summary.json``."""
    alarms = sorted((time, int(call), bool(good)) for time, call, good in watch.alarms.tolist())
    counts = zip(watch.heard.tolist(), watch.expected.tolist(), strict=True)
    return {
        "watch": [heard / expected if expected else None for heard, expected in counts],
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
    stand = np.full(len(watch.hits), UNPLACED), np.zeros(len(watch.hits), np.bool_)
    points, calls = mean[there] + 1j * mean[there + 1], [call for call, *_ in heard]

    def cost() -> float:
        compared = mean, covariance, there
        each = (pair_costs(tuple(rows), *compared, at, chances) for _, rows, _, at in heard)
        expected = probabilities(*watch[:2], source, (mean, there, *stand))[0][:, calls].sum()
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
    p, q = np.nonzero((off - abs(there[b] - there[a])) ** 2 < GATE * spread[:, np.newaxis])
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
