"""The posterior Cramér-Rao bound of the vehicle's pose, and the NEES of a consistent filter.

The bound along the true path is the covariance of an extended Kalman filter with every Jacobian at
the truth: it depends on which landmarks were measured and on the stated noise of controls and
measurements, not on any estimate. The start is exact, and landmarks are unknown before their first
measurement (a flat prior). A moving caller deviates from its true path as in the filters' model
(`estimation.ekf.filter`). It gives:

- the least error of any estimator on the same data;
- the NEES of a consistent filter that assumes an uncertain start while the start is exact: less
  than the number of states, as a part of the assumed error never occurs.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import COLUMNS, UNLABELLED, Scan, columns_of
from pipistrelle.estimation.motion import (
    Motion,
    MotionNumbers,
    controls_between,
    motion_numbers,
    propagate_pose,
)
from pipistrelle.estimation.observations.rows import SQUARED, caller_labels
from pipistrelle.estimation.smoother.elimination import (
    advance,
    correct,
    factor,
    predicted,
    spread,
    write_lower,
)
from pipistrelle.estimation.smoother.filter import PRIOR_STD
from pipistrelle.estimation.smoother.observations import hear
from pipistrelle.estimation.smoother.preintegration import NOTHING
from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Arrays,
    Front,
    NoiseModel,
    Places,
    Rows,
    Work,
    work_of,
    write,
    write_identity,
)
from pipistrelle.geometry import carrying
from pipistrelle.jit import Whole, no_alloc, optimised_once

IN_ONE_WORLD = "The bound holds for means over worlds; in a single world an error can be smaller."
"""Sentence shown with a bound beside errors."""
NO_ROUTES: Mapping[int, np.ndarray] = MappingProxyType({})
"""No caller moves."""


def pose_bound(
    motion: Motion,
    controls: Float[np.ndarray, "k c"],
    time: Float[np.ndarray, " t"],
    path: Float[np.ndarray, "t 3"],
    landmarks: tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]],
    scans: Sequence[Scan],
    routes: Mapping[int, Float[np.ndarray, "t 2"]] = NO_ROUTES,
    wander: tuple[float, float] = (1.0, 0.2),
) -> Float[np.ndarray, "t 3 3"]:
    r"""Return the posterior Cramér-Rao bound of the pose at every step, after an exact start.

    .. math:: \bar P = F P F^T + U Q U^T, \qquad P^{-1} = \bar P^{-1} + H^T R^{-1} H

    with F, U and H at the truth: F uses the true motion in a step, and U the speed and steering or
    turn that led to it, not the commanded ones. A rotation of the whole path with its landmarks
    changes no measurement; with any other F the noise of the path would give false information
    about the heading. The same applies to a caller's velocity: if it goes from b, v to b', v' in a
    time T,

    .. math:: \delta b' = \delta b + T \delta v + J (b' - b - T v)\, \delta\theta, \qquad
              \delta v' = \delta v + J (v' - v)\, \delta\theta

    with J a quarter turn and :math:`\delta\theta` the error of the heading.

    `controls`: of the motion model; `time` [s]; `path` [m, m, rad]: true poses, the start first;
    `landmarks` [m]; `scans`: labels, callers and standard deviations are used, but no measured
    values, only whether there is a range or an excess path; other labels are ignored; `routes` [m]:
    true positions of the moving callers; `wander` [m/s]: standard deviation of their initial
    velocity per axis, and of its change in a second. Returns [m, rad, squared], zero at the start:
    no estimator that is unbiased along this path has less. An estimator with prior knowledge of
    paths may be biased along each and have less on average: a mean of such bounds over worlds is a
    reference for errors, not a bound of their mean.

    Source: Tichavsky, Muravchik & Nehorai, IEEE Transactions on Signal Processing 46, 1998.

    A vehicle at rest without measurements keeps its exact start:

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1), noise_at_rest=False)
    >>> nowhere = np.empty(0, int), np.empty((0, 2))
    >>> still, path = np.zeros((2, 2)), np.zeros((3, 3))
    >>> float(pose_bound(motion, still, np.arange(3.0), path, nowhere, []).max())
    0.0
    """
    fixed, places = landmarks
    labels = np.append(fixed, np.array([*routes], np.int64))
    columns = columns_of(scans)
    step, label = np.searchsorted(time, columns["time"] - 1e-9), columns["landmark"]
    known = np.isin(label, labels)
    caller = np.concatenate([np.empty(0, np.int64), *map(caller_labels, scans)])[known]
    caller[~np.isin(caller, labels)] = UNLABELLED
    met = np.column_stack([label[known], np.where(caller == UNLABELLED, label[known], caller)])
    heard, first = np.unique(met, return_index=True)
    heard = heard[np.argsort(first)]  # by first measurement, as in a filter's state
    moving, border = heard[np.isin(heard, [*routes])].tolist(), heard[~np.isin(heard, [*routes])]
    slot = {one: number for number, one in enumerate([*border.tolist(), *moving])}
    index = np.append(
        1 + 2 * np.arange(border.size), -POSE - CALLER * np.arange(len(moving))
    ).astype(np.int64)
    ends = np.zeros((len(met), 4), np.int64)
    ends[:, 0] = [slot[one] for one in label[known].tolist()]
    ends[:, 1] = [slot.get(one, -1) for one in caller.tolist()]
    rows = np.searchsorted(step[known], np.arange(len(path) + 1))
    reached = np.maximum.accumulate(np.append(0, index[ends[:, :2]].max(axis=1, initial=0)))
    place = dict(zip(fixed.tolist(), places, strict=True))
    nowhere = np.zeros(len(moving), np.int64), np.zeros((len(moving), 2))
    points = [np.zeros(1), *(place[one] for one in border.tolist())]
    states = [path]  # then each moving caller's position, and its velocity in the next step
    for route in (routes[one] for one in moving):
        velocity = np.diff(route, axis=0) / np.diff(time)[:, np.newaxis]
        states += [route, np.concatenate([velocity, velocity[-1:]])]
    return _bound(
        np.concatenate(states, axis=1),
        np.concatenate(points),
        (true_controls(motion, controls, time, path), np.diff(time)),
        motion_numbers(motion),
        wander,
        (index, *nowhere, NOTHING.sensor, np.zeros((0, 3)), np.zeros(0)),
        (ends, np.column_stack([columns[name] for name in COLUMNS[2:]])[known]),
        np.column_stack([rows[:-1], rows[1:], reached[rows[1:]] + 2]),
    )


def true_controls(
    motion: Motion,
    controls: Float[np.ndarray, "k c"],
    time: Float[np.ndarray, " t"],
    path: Float[np.ndarray, "t 3"],
) -> Float[np.ndarray, "k c"]:
    """Return the controls that reproduce the true path; controls of 0, or poses, are unchanged."""
    if motion.model == "poses":
        return controls
    commanded = controls.any(axis=1, keepdims=True)
    return np.where(commanded, controls_between(path, np.diff(time), motion), controls)


@no_alloc
def _write_transition(
    work: Work,
    at: Float[np.ndarray, "t d"],
    k: Whole,
    control: tuple[Float[np.ndarray, " c"], float],
    motion: MotionNumbers,
    walk_std: float,
) -> None:
    """Write transition matrix and process noise of true step k, for pose and moving callers."""
    F, Q, (steered, seconds) = work.F, work.Q, control
    write_identity(F)
    Q[:] = 0.0
    F[0, 2], F[1, 2] = at[k - 1, 1] - at[k, 1], at[k, 0] - at[k - 1, 0]
    for a in range(POSE):
        work.u[a] = at[k - 1, a]
    propagate_pose(work.u[:POSE], Q, steered, seconds, motion)
    q = walk_std * walk_std
    for i in range(POSE, work.u.size, CALLER):
        dx, dy = at[k, i + 2] - at[k - 1, i + 2], at[k, i + 3] - at[k - 1, i + 3]
        F[i + 2, 2], F[i + 3, 2] = -dy, dx
        for a in range(i, i + 2):
            F[a, a + 2] = seconds
            Q[a, a], Q[a + 2, a + 2] = q * seconds**3 / 3.0, q * seconds
            Q[a, a + 2] = Q[a + 2, a] = 0.5 * q * seconds * seconds
    work.u[:] = 0.0


@optimised_once
def _bound(
    at: Float[np.ndarray, "t d"],
    border: Float[np.ndarray, " n"],
    driven: tuple[Float[np.ndarray, "k c"], Float[np.ndarray, " k"]],
    motion: MotionNumbers,
    wander: tuple[float, float],
    places: Arrays,
    rows: Arrays,
    heard: Int[np.ndarray, "t 3"],
) -> Float[np.ndarray, "t 3 3"]:
    """Return the bound of each pose by elimination along the true path, as the smoother does.

    ``driven``: true controls and their durations; ``heard``: for each step the first row, the row
    after the last, and the number of separator columns measured so far.
    """
    (steps, d), n = at.shape, border.size
    places, rows, work = Places(*places), Rows(*rows), work_of(d, n, 0)
    front = Front(np.zeros((d, n)), np.zeros((d, d)), np.zeros((n, n)))
    noise = NoiseModel(SQUARED, PRIOR_STD, wander[0], wander[1], 0.0)
    R, Z = np.zeros((n, n)), np.zeros((d, n))
    for j in range(1, n):
        front.information[j, j] = 1.0 / PRIOR_STD**2
    for i in range(POSE, d):
        std = PRIOR_STD if (i - POSE) % CALLER < 2 else wander[0]
        front.P[i, i] = std * std
    bound, total, before = np.zeros((steps, 3, 3)), front.P.copy(), np.zeros((d, d))
    for k in range(steps):
        if k > 0:
            driven_here = driven[0][k - 1], driven[1][k - 1]
            _write_transition(work, at, k, driven_here, motion, wander[1])
            advance(front, work, n)
            write(total, before)
            predicted(work, before, total)
        if heard[k, 1] > heard[k, 0]:
            span = k, heard[k, 0], heard[k, 1]
            hear(work, front, span, rows, places, (at, border), noise)
            correct(front, work, heard[k, 2])
            write_lower(front.information, heard[k, 2], R)
            factor(R, heard[k, 2])
            spread(front.C, front.P, R, heard[k, 2], Z, total)
        for a in range(3):
            for b in range(3):
                bound[k, a, b] = total[a, b]
    return bound


def path_bound(bound: Float[np.ndarray, "t 3 3"]) -> tuple[float, float]:
    r"""Return the least RMSE of position and heading over a path, from the bound at every step.

    .. math:: \sqrt{\tfrac1K \sum_k (B_k)_{xx} + (B_k)_{yy}}, \qquad
              \sqrt{\tfrac1K \sum_k (B_k)_{\theta\theta}}

    `bound` [m, rad, squared]: from `pose_bound`; the start is not counted. Returns position [m] and
    heading [rad]: zero for a path without a step.

    >>> path_bound(np.stack([np.zeros((3, 3)), np.diag([9.0, 16.0, 1.0])]))
    (5.0, 1.0)
    """
    if len(bound) < 2:
        return 0.0, 0.0
    x, y, heading = np.mean(bound[1:], axis=0).diagonal().tolist()
    return math.sqrt(x + y), math.sqrt(heading)


def bound_of_drawn_start(
    bound: Float[np.ndarray, "t 3 3"],
    path: Float[np.ndarray, "t 3"],
    start_covariance: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "t 3 3"]:
    r"""Return the bound of the pose if the start is not exact, but drawn from a distribution.

    .. math:: P_k = B_k + G_k P_0 G_k^T, \qquad
              G_k = \begin{pmatrix} 1 & 0 & y_0 - y_k \\ 0 & 1 & x_k - x_0 \\ 0 & 0 & 1
              \end{pmatrix}

    Measurements are relative to the vehicle, so an error of the start is unobservable: it moves and
    rotates the whole path.

    `bound` [m, rad, squared]: B, from `pose_bound`; `path` [m, m, rad]: true poses;
    `start_covariance` [m, rad, squared]: P_0. Returns [m, rad, squared].

    A heading error of 0.1 rad moves a point 10 m ahead by a metre:

    >>> path, turned = np.array([[0.0, 0, 0], [10, 0, 0]]), np.diag([0.0, 0.0, 0.01])
    >>> float(bound_of_drawn_start(np.zeros((2, 3, 3)), path, turned)[1, 1, 1])
    1.0
    """
    G = carrying(path[:, :2] - path[0, :2])
    return bound + G @ start_covariance @ np.swapaxes(G, 1, 2)


def nees_of_exact_start(
    bound: Float[np.ndarray, "t 3 3"],
    path: Float[np.ndarray, "t 3"],
    start_covariance: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    r"""Return mean and variance of a consistent filter's NEES if its start is in fact exact.

    A filter that assumes P_0 for an error of the start has the covariance P_k of
    `bound_of_drawn_start` at step k; the covariance of its errors is the B_k of an exact start. So

    .. math:: E[\epsilon_k] = \operatorname{tr} P_k^{-1} B_k, \qquad
              \operatorname{Var}[\epsilon_k] = 2 \operatorname{tr} (P_k^{-1} B_k)^2,

    not 3 and 6, as for a start drawn from P_0: the NEES is a sum of squares of normal numbers with
    the eigenvalues of :math:`P_k^{-1} B_k`, all below one, as variances.

    `bound` [m, rad, squared]: B, from `pose_bound`; `path` [m, m, rad]: true poses;
    `start_covariance` [m, rad, squared]: P_0; if it is zero, the mean is the rank of B.

    Bradley & Abaid, Eq. (23), compare with 3, though their filters begin "matching the vehicle's
    initial state" with a P_0 (Sec. IV).

    With a bound equal to P_0: half of each of three numbers.

    >>> mean, variance = nees_of_exact_start(np.eye(3)[None], np.zeros((1, 3)), np.eye(3))
    >>> mean, variance
    (array([1.5]), array([1.5]))
    """
    total = bound_of_drawn_start(bound, path, start_covariance)
    if np.linalg.eigvalsh(start_covariance)[0] > 0.0:
        share = np.linalg.inv(total) @ bound
    else:  # the first step's noise has rank 2
        share = np.linalg.pinv(total, hermitian=True) @ bound
    mean = np.trace(share, axis1=1, axis2=2)
    variance = 2.0 * np.trace(share @ share, axis1=1, axis2=2)
    return mean, variance
