r"""The bound: how surely any estimator can know the vehicle's pose, from what it is given.

The posterior Cramér-Rao bound along the true path is the covariance that an extended Kalman filter
would have with every Jacobian taken at the truth: it hangs on what was heard and on how noisy
controls and measurements are said to be, and on no estimate. The start is exact, and landmarks are
not known before they are heard (a flat prior). A caller that moves strays as filters
believe that it does (`estimation.ekf.caller_motion`), from the way that it truly went. It tells two
things:

- how much of an estimator's error is its own fault;
- what NEES a consistent filter has that believes its start uncertain while it is exact: less than
  the number of states, since part of what it allows for never happens.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH_STD,
    NUMBERS,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
)
from pipistrelle.estimation.ekf.caller_motion import propagate_callers, velocity_of
from pipistrelle.estimation.ekf.gaussian import (
    LINEAR,
    WAITING,
    Joint,
    correct_active,
    correct_bearing,
    flush,
    joint_of,
)
from pipistrelle.estimation.ekf.tdoa import correct_covariance_by_excess_path
from pipistrelle.estimation.measurement import (
    NEAREST,
    columns_of,
    excess_paths,
    observe,
    timings_of,
)
from pipistrelle.estimation.motion import (
    Motion,
    MotionNumbers,
    controls_between,
    motion_numbers,
    propagate_pose,
)
from pipistrelle.jit import Whole, kernel, no_alloc

IN_ONE_WORLD = (
    "The bound is the least root mean square without bias on a path: in one world luck may beat it."
)
"""The sentence that stands wherever a bound is shown beside errors."""
PRIOR_STD = 20.0
"""Of a landmark before it is heard [m]."""
NO_ROUTES: Mapping[int, np.ndarray] = MappingProxyType({})
"""No caller moves."""


_Timed = tuple[Int[np.ndarray, " m"], Float[np.ndarray, "v t 2"], tuple[float, float]]
"""The place of each row's caller, the ways of those who move, and what is known of these."""


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

    with F, U and H at the truth: F holds the way that the vehicle truly went in a step, and U the
    speed and steering or turn that led it, not what was commanded. A whole path with its landmarks
    may be turned, and nothing that is heard of it changes; with any other F the noise of the path
    would tell of a heading that nothing tells. So would that of a caller's velocity: of one that
    goes from b, v to b', v' in a time T,

    .. math:: \delta b' = \delta b + T \delta v + J (b' - b - T v)\, \delta\theta, \qquad
              \delta v' = \delta v + J (v' - v)\, \delta\theta

    with J a quarter turn and :math:`\delta\theta` the error of the heading.

    `controls`: as the motion model has them; `time` [s]; `path` [m, m, rad]: true poses, the start
    first; `landmarks` [m]; `scans`: who was heard when, with a range or an excess path or without,
    and how surely: of the measurements the standard deviations alone count. Rows of other labels
    are left out; `routes` [m]: true places of the callers that move; `wander` [m/s]: what is known
    of their velocities: the standard deviation of each along an axis at the start, and that of how
    far it strays in a second. Returns [m, rad, squared]: no estimator that is without bias along
    this path has less. Zero at the start. One that knows what paths are like may be biased along
    each and have less in the mean: a mean of such bounds over worlds is a measure to hold errors
    against, no bound of their mean.

    Source: Tichavsky, Muravchik & Nehorai, IEEE Transactions on Signal Processing 46, 1998.

    A standing vehicle that hears nothing stays where it was.

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1), noise_at_rest=False)
    >>> nowhere = np.empty(0, int), np.empty((0, 2))
    >>> still, path = np.zeros((2, 2)), np.zeros((3, 3))
    >>> float(pose_bound(motion, still, np.arange(3.0), path, nowhere, []).max())
    0.0
    """
    fixed, places = landmarks
    labels = np.append(fixed, np.array([*routes], np.int64))
    count = [len(scan.landmark) for scan in scans]
    step = np.repeat(np.searchsorted(time, [scan.time - 1e-9 for scan in scans]), count)
    label = np.concatenate([np.empty(0, np.int64), *(scan.landmark for scan in scans)])
    numbers = np.concatenate([np.empty((NUMBERS, 0)), *(scan.numbers for scan in scans)], axis=1)
    known = np.isin(label, labels)
    caller = np.concatenate([np.empty(0, np.int64), *map(_whose, scans)])[known]
    caller[~np.isin(caller, labels)] = UNLABELLED
    met = np.column_stack([label[known], np.where(caller == UNLABELLED, label[known], caller)])
    heard, first = np.unique(met, return_index=True)
    heard = heard[np.argsort(first)]  # whom it hears first stands first, as in a filter's state
    moving = [one for one in heard.tolist() if one in routes]
    velocities = np.array([velocity_of(one) for one in moving], np.int64)
    state = np.concatenate((velocities, moving, heard[~np.isin(heard, moving)])).astype(np.int64)
    slot = {one: number for number, one in enumerate(state.tolist())} | {UNLABELLED: UNLABELLED}
    place = dict(zip(fixed.tolist(), places, strict=True))
    place |= {one: routes[one][0] for one in moving}
    place |= {velocity_of(one): np.zeros(2) for one in moving}
    ways = np.array([routes[one] for one in moving]).reshape(-1, len(path), 2)
    timed = bool(moving) or np.any(caller != UNLABELLED)
    return _bound(
        path,
        true_controls(motion, controls, time, path),
        np.diff(time),
        motion_numbers(motion),
        (state, np.array([place[one] for one in state.tolist()]).reshape(-1, 2)),
        (step[known], _slots(slot, label[known])),
        np.ascontiguousarray(numbers[:, known]),
        (_slots(slot, caller), ways, wander) if timed else None,
    )


def true_controls(
    motion: Motion,
    controls: Float[np.ndarray, "k c"],
    time: Float[np.ndarray, " t"],
    path: Float[np.ndarray, "t 3"],
) -> Float[np.ndarray, "k c"]:
    """Return the controls that lead along the true path; a step of zero controls keeps them.

    Of poses the noise does not hang on how far they were apart, and they are as they are.
    """
    if motion.model == "poses":
        return controls
    commanded = controls.any(axis=1, keepdims=True)
    return np.where(commanded, controls_between(path, np.diff(time), motion), controls)


def _slots(slot: Mapping[int, int], label: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
    """Look up where labels stand in the state."""
    return np.array([slot[one] for one in label.tolist()], dtype=np.int64)


def _whose(scan: Scan) -> Int[np.ndarray, " m"]:
    """Label of the caller of each row's excess path; UNLABELLED for a row without one."""
    who, timings = np.full(len(scan.landmark), UNLABELLED), timings_of(scan)
    if timings is not None:
        heard = excess_paths(columns_of(scan), timings)
        who[heard.row] = heard.caller
    return who


@no_alloc
def _correct(
    joint: Joint, size: Whole, i: Whole, numbers: Float[np.ndarray, "7 m"], m: Whole
) -> None:
    """Correct with measurement m, at its expected value, of the landmark at state index i."""
    if math.isnan(numbers[BEARING, m]):
        return
    mean, across = joint.mean, numbers[BEARING_STD, m] ** 2
    near, angle, _, _, _ = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if near >= NEAREST and not math.isnan(numbers[RANGE, m]):
        along = numbers[RANGE_STD, m] ** 2
        correct_active(joint, size, i, near, angle, along, across, np.inf)
    elif near >= NEAREST:
        correct_bearing(joint, size, i, angle, across, np.inf)


@no_alloc
def _carry(
    covariance: Float[np.ndarray, "n _"], dx: float, dy: float, noise: Float[np.ndarray, "3 3"]
) -> None:
    """Carry a covariance through a step of (dx, dy), in place: F C F^T, and the noise."""
    for j in range(covariance.shape[0]):
        covariance[0, j] -= dy * covariance[2, j]
        covariance[1, j] += dx * covariance[2, j]
    for i in range(covariance.shape[0]):
        covariance[i, 0] -= dy * covariance[i, 2]
        covariance[i, 1] += dx * covariance[i, 2]
    for a in range(3):
        for b in range(3):
            covariance[a, b] += noise[a, b]


@no_alloc
def _turn_with(covariance: Float[np.ndarray, "n _"], i: Whole, x: float, y: float) -> None:
    """Let the point at index i turn by (x, y) with the heading: its error gains J (x, y) dtheta."""
    for j in range(covariance.shape[0]):
        covariance[i, j] -= y * covariance[2, j]
        covariance[i + 1, j] += x * covariance[2, j]
    for j in range(covariance.shape[0]):
        covariance[j, i] -= y * covariance[j, 2]
        covariance[j, i + 1] += x * covariance[j, 2]


@kernel
def _let_move(
    joint: Joint,
    ways: Float[np.ndarray, "v t 2"],
    step: tuple[Whole, float, float],
) -> None:
    """Put moving callers where they are at step k, and add their walk's covariance.

    Their velocities are the first of the state, each that of the step which follows, and then their
    places; ``step`` is k with the length of the step to it and of the next.
    """
    k, before, after = step
    onward = min(k + 1, ways.shape[1] - 1)
    for v in range(ways.shape[0]):
        gone, going = ways[v, k] - ways[v, k - 1], ways[v, onward] - ways[v, k]
        dx = going[0] / after - gone[0] / before if onward > k else 0.0
        dy = going[1] / after - gone[1] / before if onward > k else 0.0
        _turn_with(joint.covariance, 3 + 2 * v, dx, dy)
        i = 3 + 2 * (ways.shape[0] + v)
        joint.mean[i], joint.mean[i + 1] = ways[v, k, 0], ways[v, k, 1]


@no_alloc
def _grown(joint: Joint, size: Whole, slot: Whole) -> Whole:
    """Extend the state to include a slot; returns its size."""
    if 3 + 2 * slot < size:
        return size
    flush(joint, size)
    return 5 + 2 * slot


@no_alloc
def _hear(
    joint: Joint,
    size: Whole,
    slot: Whole,
    numbers: Float[np.ndarray, "7 m"],
    m: Whole,
    timed: _Timed | None,
) -> Whole:
    """Correct with measurement m of a place, and its excess path; returns the size of the state."""
    size = _grown(joint, size, slot)
    if timed is not None:
        size = _grown(joint, size, timed[0][m])
    _correct(joint, size, 3 + 2 * slot, numbers, m)
    if timed is not None and timed[0][m] != UNLABELLED:
        i, ib, variance = 3 + 2 * slot, 3 + 2 * timed[0][m], numbers[EXCESS_PATH_STD, m] ** 2
        correct_covariance_by_excess_path(joint, size, i, ib, variance)
    return size


@kernel
def _bound(
    path: Float[np.ndarray, "t 3"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: MotionNumbers,
    world: tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]],
    row: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]],
    numbers: Float[np.ndarray, "7 m"],
    timed: _Timed | None,
) -> Float[np.ndarray, "t 3 3"]:
    """Carry the covariance along the true path; of each row step and place.

    ``world``: labels and places of the state, first the velocities and then the places of those who
    move, which hang together before they are heard.
    """
    (labels, places), moving = world, 0
    room = 3 + 2 * places.shape[0]
    mean, prior = np.zeros(room), np.zeros((room, room))
    mean[3:] = places.ravel()
    for n in range(3, room):
        prior[n, n] = PRIOR_STD**2
    if timed is not None:
        moving = timed[1].shape[0]
        for n in range(3, 3 + 2 * moving):
            prior[n, n] = timed[2][0] ** 2
    joint, size, m = joint_of(mean, prior, room, LINEAR), 3 + 4 * moving, 0
    joint.W[:] = 0.0  # the state grows into columns that wait
    bound = np.zeros((path.shape[0], 3, 3))
    steps, slots = row
    pose, noise = np.empty(3), np.empty((3, 3))
    for k in range(1, path.shape[0]):
        pose[:], noise[:] = path[k - 1], 0.0
        propagate_pose(pose, noise, controls[k - 1], dt[k - 1], motion)
        if timed is not None and moving > 0:
            propagate_callers(joint.mean, joint.covariance, labels, dt[k - 1], timed[2][1])
            _let_move(joint, timed[1], (k, dt[k - 1], dt[min(k, dt.size - 1)]))
        _carry(joint.covariance, path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1], noise)
        for a in range(3):
            joint.mean[a] = path[k, a]
        while m < steps.size and steps[m] <= k:
            size = _hear(joint, size, slots[m], numbers, m, timed)
            m += 1
        if joint.taken[WAITING] > 0:
            flush(joint, size)
        for a in range(3):
            for b in range(3):
                bound[k, a, b] = joint.covariance[a, b]
    return bound


def path_bound(bound: Float[np.ndarray, "t 3 3"]) -> tuple[float, float]:
    r"""Return the least RMSE of position and heading over a path, from the bound at every step.

    .. math:: \sqrt{\tfrac1K \sum_k (B_k)_{xx} + (B_k)_{yy}}, \qquad
              \sqrt{\tfrac1K \sum_k (B_k)_{\theta\theta}}

    `bound` [m, rad, squared]: as `pose_bound` gives it; the start is not counted. Returns
    `position, heading` [m], [rad]: zero of a path without a step.

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
    r"""Return the bound of the pose where the start is not exact, but drawn.

    .. math:: P_k = B_k + G_k P_0 G_k^T, \qquad
              G_k = \begin{pmatrix} 1 & 0 & y_0 - y_k \\ 0 & 1 & x_k - x_0 \\ 0 & 0 & 1
              \end{pmatrix}

    What is heard is relative to the vehicle, so an error of the start is never noticed: it moves
    and turns the whole path.

    `bound` [m, rad, squared]: b, as `pose_bound` gives it; `path` [m, m, rad]: true poses;
    `start_covariance` [m, rad, squared]: p_0. Returns [m, rad, squared].

    A heading that is off by 0.1 rad puts what is 10 m ahead a metre aside.

    >>> path, turned = np.array([[0.0, 0, 0], [10, 0, 0]]), np.diag([0.0, 0.0, 0.01])
    >>> float(bound_of_drawn_start(np.zeros((2, 3, 3)), path, turned)[1, 1, 1])
    1.0
    """
    G = np.tile(np.eye(3), (len(path), 1, 1))
    G[:, 0, 2] = path[0, 1] - path[:, 1]
    G[:, 1, 2] = path[:, 0] - path[0, 0]
    return bound + G @ start_covariance @ np.swapaxes(G, 1, 2)


def nees_of_exact_start(
    bound: Float[np.ndarray, "t 3 3"],
    path: Float[np.ndarray, "t 3"],
    start_covariance: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    r"""Return mean and variance of a consistent filter's NEES if its start is in fact exact.

    A filter that allows for an error of the start with P_0 has the covariance P_k of
    `bound_of_drawn_start` at step k; that of its errors, here, is the B_k of an exact start. So

    .. math:: E[\epsilon_k] = \operatorname{tr} P_k^{-1} B_k, \qquad
              \operatorname{Var}[\epsilon_k] = 2 \operatorname{tr} (P_k^{-1} B_k)^2,

    not 3 and 6, as where the start is drawn from P_0: the NEES is a sum of squares of normal
    numbers whose variances are the eigenvalues of :math:`P_k^{-1} B_k`, all below one.

    `bound` [m, rad, squared]: b, as `pose_bound` gives it; `path` [m, m, rad]: true poses;
    `start_covariance` [m, rad, squared]: p_0; zero, and the mean is the rank of B.

    Bradley & Abaid, Eq. (23), compare with 3, though their filters begin "matching the vehicle's
    initial state" with a P_0 (Sec. IV).

    As uncertain as the start alone: half of each of three numbers.

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
