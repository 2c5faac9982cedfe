"""Consistency of covariance and errors: NEES, ANEES, divergence, stray landmarks."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.detection.scans import Scan, columns_of
from pipistrelle.estimation.beliefs import Gaussian, Track, placed, some_of
from pipistrelle.estimation.motion import SMALLEST_STD
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.rays import gate_bounds
from pipistrelle.evaluation.accuracy import pose_error
from pipistrelle.geometry import carrying, wrap


def nees(
    error: Float[np.ndarray, "*n d"], covariance: Float[np.ndarray, "*n d d"]
) -> Float[np.ndarray, "*n"]:
    r"""Return the normalised estimation error squared.

    .. math:: \epsilon_k = (\hat x_k - x_k)^T P_k^{-1} (\hat x_k - x_k)
       :label: eq-23

    `error` (*n, d): estimated minus true state, angles wrapped; `covariance` (*n, d, d): symmetric.
    Computed by elimination, as the sum of the squared residuals over the pivots. Chi-square with d
    degrees of freedom if the filter is consistent. Infinite, never NaN, if the covariance is not
    positive definite to working precision or an entry is not finite: divergence is a result, not an
    error.

    Bradley & Abaid, Eq. (23).

    >>> nees(np.array([2.0, 1.0]), np.diag([4.0, 0.5]))
    array(3.)
    >>> nees(np.array([2.0, 1.0]), np.diag([4.0, 0.0]))
    array(inf)
    """
    return _eliminated(error, covariance)[0]


@np.errstate(all="ignore")
def _eliminated(
    error: Float[np.ndarray, "*n d"], covariance: Float[np.ndarray, "*n d d"], less: float = 0.0
) -> tuple[Float[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
    """Return the NEES of errors, and whether each covariance, less a variance, is definite."""
    r = np.array(error, dtype=np.float64)
    d = r.shape[-1]
    P = np.array(covariance, dtype=np.float64) - less * np.eye(d)
    smallest = d * np.finfo(np.float64).eps * np.diagonal(P, axis1=-2, axis2=-1)
    epsilon = np.zeros(r.shape[:-1])
    definite = np.ones(r.shape[:-1], dtype=bool)
    for i in range(d):
        pivot = P[..., i, i].copy()
        definite &= pivot > smallest[..., i]
        epsilon += r[..., i] ** 2 / pivot
        factor = P[..., i, :] / pivot[..., None]
        r -= factor * r[..., i, None]
        P -= P[..., :, i, None] * factor[..., None, :]
    return np.where(definite & np.isfinite(epsilon), epsilon, np.inf), definite


@np.errstate(over="ignore", invalid="ignore")
def track_nees(pose: Gaussian, true: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
    """Return the NEES of each pose of a track; NaN if it is undefined.

    After an exact start, the noise of the first control step has rank 2 and leaves the covariance
    singular. This is not divergence: the NEES begins with the first positive definite covariance,
    without the variance that some estimators add to an exact start (`motion.SMALLEST_STD`).

    `pose` [m, m, rad]: with ``invariant``, errors are right-invariant about the first position;
    `true` [m, m, rad]: NaN if unknown. Returns NaN without truth and before the first positive
    definite covariance; elsewhere as `nees`. Infinite also if a covariance is not finite, becomes
    singular later, or no covariance of the track is positive definite.

    Bradley & Abaid, Eq. (23).

    >>> exact_start = np.stack([np.zeros((3, 3)), np.diag([1.0, 0.0, 1.0]), np.eye(3)])
    >>> track_nees(Gaussian(mean=np.ones((3, 3)), covariance=exact_start), np.zeros((3, 3)))
    array([nan, nan,  3.])
    """
    error, covariance = pose_error(pose.mean, true), pose.covariance
    if pose.invariant:
        error, covariance = _right_invariant(pose, error)
    epsilon = nees(error, covariance)
    begun = np.logical_or.accumulate(_eliminated(error, pose.covariance, 2.0 * SMALLEST_STD**2)[1])
    exact = ~begun & begun.any() & np.isfinite(covariance).all(axis=(1, 2))
    return np.where(exact | ~np.isfinite(true).all(axis=1), np.nan, epsilon)


def _right_invariant(
    pose: Gaussian, error: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    r"""Convert pose errors and covariances from linear to right-invariant about the first position.

    With positions relative to it, :math:`\hat p = R(\xi_\theta) p + V(\xi_\theta) \xi_p`; the
    filter's error, from estimate to truth, is the negative.
    """
    shift, turn = pose.mean[:, :2] - pose.mean[0, :2], error[:, 2]
    true_x, true_y = (shift - error[:, :2]).T
    c, s, half = np.cos(turn), np.sin(turn), 0.5 * turn
    x, y = shift[:, 0] - c * true_x + s * true_y, shift[:, 1] - s * true_x - c * true_y
    along = np.where(np.abs(half) > 1e-4, half / np.tan(np.where(half == 0.0, 1.0, half)), 1.0)
    xi = np.column_stack([along * x + half * y, along * y - half * x, turn])
    T = carrying(-shift)
    return xi, T @ pose.covariance @ np.swapaxes(T, 1, 2)


def anees(nees: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    r"""Average the NEES over runs, step by step.

    .. math:: \bar\epsilon_k = \frac{1}{N} \sum_{i=1}^{N} \epsilon_{i_k}
       :label: eq-24

    `nees` (n, k): a row per run, at least one. An infinite NEES makes its step infinite.

    Bradley & Abaid, Eq. (24).

    >>> anees(np.array([[2.0, 3.0], [4.0, 3.0]]))
    array([3., 3.])
    """
    return np.mean(nees, axis=0)


def anees_bounds(runs: int, confidence: float = 0.95, states: int = 3) -> tuple[float, float]:
    r"""Return the interval that contains the ANEES of a consistent filter with a given probability.

    .. math:: \epsilon_1 = \chi^2_{N N_x}(C / 2) / N, \qquad
              \epsilon_2 = \chi^2_{N N_x}(1 - C / 2) / N, \qquad C = 1 - \mathrm{confidence}
       :label: eq-25

    Below it the filter is under-confident, above it over-confident. `runs`: N independent runs, at
    least 1; `confidence`: between 0 and 1; `states`: N_x, length of the error. Returns low, high.

    Bradley & Abaid, Eq. (25).

    >>> low, high = anees_bounds(107)
    >>> round(low, 2), round(high, 2)
    (2.55, 3.48)
    """
    low, high = anees_bounds_about(
        np.array(float(states)), np.array(2.0 * states), runs, confidence
    )
    return float(low), float(high)


def anees_bounds_about(
    mean: Float[np.ndarray, "*k"],
    variance: Float[np.ndarray, "*k"],
    runs: int,
    confidence: float = 0.95,
) -> tuple[Float[np.ndarray, "*k"], Float[np.ndarray, "*k"]]:
    r"""Return the interval of a consistent filter's ANEES from mean and variance of its NEES.

    As after an exact start (`evaluation.bound.nees_of_exact_start`). A weighted sum of chi-squares
    is approximated by the gamma distribution of the same mean m and variance v, exact for equal
    weights:

    .. math:: \Gamma\left(\text{shape } \frac{N m^2}{v}, \text{scale } \frac{v}{N m}\right)

    `mean`, `variance`: of one run's NEES; 3 and 6 give `anees_bounds`. A mean of 0 gives an empty
    interval.

    Source: Welch, Biometrika 29, 1938; Satterthwaite, Biometrics Bulletin 2, 1946.

    >>> low, high = anees_bounds_about(np.array([2.24]), np.array([3.6]), 107)
    >>> low.round(2), high.round(2)
    (array([1.89]), array([2.61]))
    """
    from scipy.special import gammaincinv  # scipy.stats gives the same, and loads for a second

    tail = (1.0 - confidence) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        shape, scale = runs * mean**2 / variance, variance / (runs * mean)
        low, high = (scale * gammaincinv(shape, edge) for edge in (tail, 1.0 - tail))
    return np.where(mean > 0.0, low, 0.0), np.where(mean > 0.0, high, 0.0)


def anees_departure(
    anees: Float[np.ndarray, "*j k"], expected: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "*j"]:
    r"""Return the distance of ANEES from a consistent filter's, over all frames.

    .. math:: T = \frac{1}{K} \sum_k \ln^2(\bar\epsilon_k / E_k)

    `expected`: E, below 3 if the start is exact (`evaluation.bound.nees_of_exact_start`).

    Bradley & Abaid, Eq. (24) and Sec. V-B, compare with 3: over-confident above, under-confident
    below.
    """
    return np.mean(np.square(np.log(anees / expected)), axis=-1)


def diverged(nees: Float[np.ndarray, " k"], limit: float) -> bool:
    r"""Return whether a run has diverged: any NEES is above the limit or not finite.

    .. math:: \max_k \epsilon_k > \epsilon_{max}

    `limit`: the estimator's, from `estimation.catalogue`. Bradley & Abaid, Sec. V-A.

    >>> diverged(np.array([3.0, 49.0]), 50.0), diverged(np.array([3.0, np.nan]), 50.0)
    (False, True)
    """
    return not bool(np.all(np.isfinite(nees) & (nees <= limit)))


CHANCE = 1e-3
"""Probability of a false report of a stray landmark in a sound track."""


def strayed_landmarks(
    track: Track, scans: Sequence[Scan], gate: float, share: float
) -> dict[int, tuple[float, float, int]]:
    r"""Return landmarks with many consecutive measurements far from the final map and path.

    A bearing, with its range if any, is far if its squared residual exceeds the bound of the gate,

    .. math:: d^2 = \nu^T (H_x P_x H_x^T + H_m P_m H_m^T + R)^{-1} \nu

    with the covariances of pose and landmark taken as independent. If a share p of sound
    measurements is far, n of N measurements in a row are far with a probability below N p^n.

    `scans` have labels and standard deviations; `gate`: probability that a measurement is accepted,
    below 1; `share`: p, 1 - gate, and more with outliers. Returns, for the longest sequence of each
    label if less likely than `CHANCE`, the times of its first and last measurement [s] and its
    length.
    """
    rows = columns_of(scans)
    label, time = rows["landmark"], rows["time"]
    squared, size = _residuals(track, rows)
    bounds = np.array([math.inf, *gate_bounds(gate)])
    far, least = squared > bounds[size], math.log(CHANCE / max(label.size, 1)) / math.log(share)
    found = {}
    for one in np.unique(label[far]).tolist():
        mine = (label == one) & (size > 0)
        ends = np.flatnonzero(np.diff(np.concatenate(([False], far[mine], [False])).astype(int)))
        lengths = ends[1::2] - ends[::2]
        longest = int(np.argmax(lengths))
        if lengths[longest] >= least:
            first, last = ends[2 * longest], ends[2 * longest + 1] - 1
            found[one] = (*time[mine][[first, last]].tolist(), int(lengths[longest]))
    return found


def _residuals(track: Track, rows: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return each measurement's squared normalised residual and its dimension; 0 if unmapped."""
    known, label = some_of(track.landmarks, placed(track.landmarks)), rows["landmark"]
    order = np.argsort(known.landmark)
    at = np.searchsorted(known.landmark[order], label).clip(0, max(order.size - 1, 0))
    if not order.size:
        return np.zeros(label.size), np.zeros(label.size, np.int64)
    step = np.searchsorted(track.time, rows["time"] - 1e-9).clip(0, track.time.size - 1)
    n, bearing, distance = order[at], rows["bearing"], rows["range"]
    pose, P, C = track.pose.mean[step], track.pose.covariance[step], known.covariance[n]
    dx, dy = (known.mean[n] - pose[:, :2]).T
    r = np.maximum(np.hypot(dx, dy), NEAREST)
    c, s, none, ones = dx / r, dy / r, np.zeros_like(r), np.ones_like(r)
    H = np.array([[-c, -s, none], [s / r, -c / r, -ones]]).transpose(2, 0, 1)
    S = np.einsum("mia,mab,mjb->mij", H, P, H)
    S = S + np.einsum("mia,mab,mjb->mij", H[..., :2], C, H[..., :2])
    S[:, 0, 0] += rows["range_std"] ** 2
    S[:, 1, 1] += rows["bearing_std"] ** 2
    off, turned = distance - r, wrap(bearing - np.arctan2(dy, dx) + pose[:, 2])
    rest = turned - S[:, 0, 1] / S[:, 0, 0] * off
    both = off**2 / S[:, 0, 0] + rest**2 / (S[:, 1, 1] - S[:, 0, 1] ** 2 / S[:, 0, 0])
    aimed, ranged = ~np.isnan(bearing), ~np.isnan(distance)
    size = np.where(known.landmark[n] == label, aimed * 1 + ranged, 0)
    alone = np.where(aimed, turned**2 / S[:, 1, 1], off**2 / S[:, 0, 0])
    return np.select([size == 2, size == 1], [both, alone], 0.0), size
