r"""Rows of a scan against landmarks of the map: how far off, and how surely.

A row of the vehicle's own call has a bearing and a range, one of another caller a bearing and, once
the caller is on the map, an excess path. Of each pair of a row and a landmark

.. math:: d^2 = \nu^T S^{-1} \nu, \qquad S = H P H^T + R

with the joint covariance P of pose, landmark and caller. The cost of a pair compares what the row
would be of that landmark with what it would be of clutter of a density :math:`\lambda`, less for a
row with a sure bearing (`rows`):

.. math:: c = d^2 + \ln |2 \pi S| + 2 \ln (\lambda / p_D)

A pair of a cost below 0 is likelier than clutter. After a long way among other landmarks pose and
landmark may be so unsure of each other that a row of the vehicle's own call tells nothing of the
pair, however well it fits (`Chances.vague`): such a row is of something new, until it is seen to be
one with what is known (`doubles`).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.measurement import excess_path_slopes, observe
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc


class Rows(NamedTuple):
    """Rows of one caller."""

    bearing: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    way: Float[np.ndarray, " m"]
    """Range of the vehicle's own call, excess path of another's [m], or NaN."""
    way_std: Float[np.ndarray, " m"]
    clutter: Float[np.ndarray, " m"]
    """Density of clutter with a way over that of `Chances`."""


class Chances(NamedTuple):
    """What is assumed of detections."""

    gate: float
    """Largest squared distance."""
    clutter: float
    """Rows of clutter per radian and metre."""
    bearing_clutter: float
    """The same of rows that have a bearing alone, per radian."""
    detection: float
    """Probability that a landmark which can be heard is."""
    vague: float
    """Largest root of the determinant of H P H^T, of bearing and range [rad m]."""


PlainChances = tuple[float, float, float, float, float]
"""`Chances` as kernels take them."""
BARELY = 2.0
"""Nobody knows a landmark better that was heard once: the least that is vague, over the deviations
of bearing and range of the row itself."""
OWN_CALL, UNPLACED = -1, -2
"""In place of a caller's index in the joint mean: the vehicle, and one that is not on the map."""


@kernel
def pair_costs(
    rows: tuple[np.ndarray, ...],
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " n"],
    caller: Whole,
    chances: PlainChances,
) -> Float[np.ndarray, "m n"]:
    """Return the cost of each pair of a row and a landmark; infinite beyond the gate, or if vague.

    ``at``: where the landmarks stand in the mean; ``caller``: where that of the rows stands.
    """
    heard, made = Rows(*rows), Chances(*chances)
    costs = np.full((heard.bearing.size, at.size), np.inf)
    H, index = np.zeros((2, 7)), np.zeros(7, np.int64)
    for n in range(at.size):
        if at[n] == caller:
            continue
        bearing, way = _expected(mean, at[n], caller, H, index)
        across, b, along = _spread(covariance, H, index, 5 if caller < 0 else 7)
        unsure = across * along - b * b if caller == OWN_CALL else 0.0
        for m in range(heard.bearing.size):
            if unsure > max(made.vague, BARELY * heard.bearing_std[m] * heard.way_std[m]) ** 2:
                continue
            nu = wrap_angle(heard.bearing[m] - bearing)
            a = across + heard.bearing_std[m] ** 2
            if math.isnan(heard.way[m]) or caller == UNPLACED:
                squared, size = nu * nu / a, 2.0 * math.pi * a
                density = made.bearing_clutter
            else:
                off = heard.way[m] - way
                c = along + heard.way_std[m] ** 2
                det = a * c - b * b
                squared = (c * nu * nu - 2.0 * b * nu * off + a * off * off) / det
                size, density = (2.0 * math.pi) ** 2 * det, made.clutter * heard.clutter[m]
            if squared < made.gate and size > 0.0:  # else lost to rounding
                costs[m, n] = squared + math.log(size) + 2.0 * math.log(density / made.detection)
    return costs


@kernel
def pair_innovations(
    rows: tuple[np.ndarray, ...],
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    at: Int[np.ndarray, " n"],
    caller: Whole,
    pairs: tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"], Int[np.ndarray, " p"]]:
    """Return the joint innovation of pairs of a row and a landmark, and its covariance.

    Each pair has two numbers, bearing and way, and how many of them count is returned, too: what a
    row does not have is 0 of variance 1, and correlated with nothing.
    """
    heard, (row, landmark) = Rows(*rows), pairs
    nu, S, numbers = np.zeros(2 * row.size), np.zeros((2 * row.size, 2 * row.size)), row.copy()
    H, index = np.zeros((row.size, 2, 7)), np.zeros((row.size, 7), np.int64)
    for p in range(row.size):
        m, k = row[p], 2 * p
        bearing, way = _expected(mean, at[landmark[p]], caller, H[p], index[p])
        nu[k], S[k, k] = wrap_angle(heard.bearing[m] - bearing), heard.bearing_std[m] ** 2
        if math.isnan(heard.way[m]) or caller == UNPLACED:
            H[p, 1], S[k + 1, k + 1], numbers[p] = 0.0, 1.0, 1
        else:
            nu[k + 1], S[k + 1, k + 1] = heard.way[m] - way, heard.way_std[m] ** 2
            numbers[p] = 2
        for q in range(p + 1):
            for a in range(2):
                for b in range(2):
                    both = 0.0
                    for i in range(7):
                        for j in range(7):
                            spread = covariance[index[p, i], index[q, j]]
                            both += H[p, a, i] * spread * H[q, b, j]
                    S[k + a, 2 * q + b] += both
                    if q < p:
                        S[2 * q + b, k + a] += both
    return nu, S, numbers


@no_alloc
def _expected(
    mean: Float[np.ndarray, " d"],
    i: Whole,
    caller: Whole,
    H: Float[np.ndarray, "2 7"],
    index: Int[np.ndarray, "7"],
) -> tuple[float, float]:
    """Return bearing and way of a landmark; write the slopes, and by what they are."""
    x, y = mean[0], mean[1]
    distance, bearing, c, s, k = observe(x, y, mean[2], mean[i], mean[i + 1])
    for e, column in enumerate((0, 1, 2, i, i + 1, max(caller, 0), max(caller, 0) + 1)):
        index[e] = column
    for e, slope in enumerate((s * k, -c * k, -1.0, -s * k, c * k, 0.0, 0.0)):
        H[0, e] = slope
    if caller < 0:
        for e, slope in enumerate((-c, -s, 0.0, c, s, 0.0, 0.0)):
            H[1, e] = slope
        return bearing, distance
    bx, by = mean[caller], mean[caller + 1]
    path, lx, ly, cx, cy = excess_path_slopes(x, y, mean[i], mean[i + 1], bx, by)
    for e, slope in enumerate((-lx - cx, -ly - cy, 0.0, lx, ly, cx, cy)):
        H[1, e] = slope
    return bearing, path


@no_alloc
def _spread(
    P: Float[np.ndarray, "d d"],
    H: Float[np.ndarray, "2 7"],
    index: Int[np.ndarray, "7"],
    size: Whole,
) -> tuple[float, float, float]:
    """Return the three numbers of H P H^T."""
    across, both, along = 0.0, 0.0, 0.0
    for a in range(size):
        for b in range(size):
            covariance = P[index[a], index[b]]
            across += H[0, a] * covariance * H[0, b]
            both += H[0, a] * covariance * H[1, b]
            along += H[1, a] * covariance * H[1, b]
    return across, both, along


def with_points(
    joint: JointGaussian, labels: list[int], points: tuple[Float[np.ndarray, " n"], ...]
) -> JointGaussian:
    """Return a joint Gaussian with new landmarks, each measured by bearing and range.

    ``points``: bearings [rad], ranges [m], and the standard deviations of both.

    >>> here = JointGaussian(
    ...     landmark=np.empty(0, int), mean=np.zeros(3), covariance=np.diag([0.0, 0.0, 0.01]))
    >>> there = with_points(here, [7], tuple(np.array([[0.0], [2.0], [0.1], [0.2]])))
    >>> there.mean[3:], there.covariance[3:, 3:].round(9)
    (array([2., 0.]), array([[0.04, 0.  ],
           [0.  , 0.08]]))
    """
    mean, covariance = _with_points(joint.mean, joint.covariance, points)
    landmark = np.append(joint.landmark, labels)
    return JointGaussian(landmark=landmark, mean=mean, covariance=covariance)


@kernel
def _with_points(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    points: tuple[Float[np.ndarray, " n"], ...],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e e"]]:
    """Return mean and covariance with new points: bearings, ranges and their deviations."""
    bearing, distance, bearing_std, range_std = points
    size, whole = mean.size, mean.size + 2 * bearing.size
    more, P = np.empty(whole), np.empty((whole, whole))
    more[:size], P[:size, :size] = mean, covariance
    for n in range(bearing.size):
        d, far = size + 2 * n, distance[n]
        towards = math.cos(mean[2] + bearing[n]), math.sin(mean[2] + bearing[n])
        turn = -far * towards[1], far * towards[0]
        for a in range(2):
            more[d + a] = mean[a] + far * towards[a]
            for i in range(d):
                P[d + a, i] = P[i, d + a] = P[a, i] + turn[a] * P[2, i]
        for a in range(2):
            for b in range(2):
                across = (turn[a] * bearing_std[n]) * (turn[b] * bearing_std[n])
                along = (towards[a] * range_std[n]) * (towards[b] * range_std[n])
                P[d + a, d + b] = P[d + a, b] + P[d + a, 2] * turn[b] + (across + along)
    return more, P
