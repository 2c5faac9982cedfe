r"""Poses as odometry: the motion of the vehicle between poses, and its covariance.

The frame of odometry has an arbitrary origin and drifts, so only the motion between poses is used,
in the vehicle's axes at the first of them:

.. math:: (d_x, d_y) = R(\theta_k)^T (p_{k+1} - p_k), \quad d_\theta = \theta_{k+1} - \theta_k

Motions are composed, so rows merge into steps without loss. A step that ends between two rows ends
on the curve of constant forward, sideways and angular velocity between them.

A row may state the covariance of the motion from the row before. The covariance of a step is the
sum of its motions', each carried to the start of the step, as an error of heading turns all later
motion; a motion that is cut has its covariance divided in proportion to time.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import FARTHEST
from pipistrelle.geometry import carrying, wrap
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import Table, place_of, points_of

POSE = ("x", "y", "heading")
"""Columns of a row of poses, besides its time."""
MOTION_COVARIANCE = ("motion_xx", "motion_xy", "motion_xh", "motion_yy", "motion_yh", "motion_hh")
"""Optional columns: covariance of the motion since the row before, in the vehicle's axes there."""

RESOLUTION = 1e-6  # [s], within which a step ends with a row
_INDEFINITE = 1e-6  # largest negative eigenvalue, relative, by rounding of a file's numbers
_FULL = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
_JUMP_RATIO = 10.0  # ratio to the usual speed
_MIN_JUMP = 0.5  # [m] or [rad], smallest motion in a step that is a jump


def motions_between(odometry: Table, time: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t-1 c"]:
    """Return the vehicle's motions from each time to the next, interpolated from poses.

    `odometry` has the columns ``time``, ``x``, ``y``, ``heading``, perhaps `MOTION_COVARIANCE`; the
    last of rows at one time is used. `time` [s] increases, within the times of the rows. Returns
    forward, sideways [m] and turn [rad] in [-pi, pi), then the covariance, NaN if a part of the
    step does not state it. Exactly zero if the vehicle is at rest.
    """
    stamp = odometry.column["time"]
    poses = np.column_stack([odometry.column[name] for name in POSE])
    _check_ways(odometry, poses)
    stated = _covariances(odometry)
    last = np.append(np.diff(stamp) > 0.0, True)
    rows = stamp[last]
    after = np.clip(np.searchsorted(rows, time), 1, len(rows) - 1)
    nearest = np.where(time - rows[after - 1] < rows[after] - time, rows[after - 1], rows[after])
    ends = np.where(np.abs(nearest - time) <= RESOLUTION, nearest, time)
    there = _poses_at(ends, rows, poses[last])
    moved = relative_motions(there)
    if np.isnan(stated[1:]).all():
        return moved
    covariance = _step_covariances(ends, there, stamp, poses, stated)
    return np.hstack([moved, covariance[:, *_FULL]])


def turns_in_degrees(odometry: Table) -> bool:
    """Return whether headings beyond a turn, read as degrees, fit the axis of motion better."""
    heading = odometry.column["heading"]
    d = np.diff(odometry.column["x"] + 1j * odometry.column["y"])
    units = np.array([[1.0], [np.pi / 180.0]])
    near, nearer = np.abs(np.exp(-2j * units * heading[:-1]) @ d**2)
    return bool(np.abs(heading).max() > 2.0 * np.pi and nearer > near)


def path_of(table: Table) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return times [s] and poses [m, m, rad] of a table, heading unwrapped.

    The later of two rows with one time is used.
    """
    time = table.column["time"]
    last = np.append(np.diff(time) > 0.0, True)
    heading = np.unwrap(table.column["heading"][last])
    return time[last], np.column_stack((points_of(table)[last], heading))


def relative_motions(poses: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t-1 3"]:
    """Return the motion from each pose to the next: forward, sideways and turn.

    `poses` [m, m, rad]. Returns forward, sideways [m] and the shorter turn [rad].
    """
    d, heading = np.diff(poses[:, :2], axis=0), poses[:, 2]
    ways = _turned(d, -heading[:-1])
    turn = np.diff(heading)
    return np.column_stack([ways, np.where(np.abs(turn) < np.pi, turn, wrap(turn))])


def poses_along(
    motions: Float[np.ndarray, "k _"], start: Sequence[float] = (0.0, 0.0, 0.0)
) -> Float[np.ndarray, "k+1 3"]:
    """Return the poses along a sequence of motions.

    `motions`: forward, sideways [m] and turn [rad]; further columns are ignored. `start` and the
    result [m, m, rad] with wrapped headings. Inverse of `relative_motions`, up to rounding.
    """
    *place, way = start
    heading = np.cumsum(np.append(way, motions[:, 2]))
    ways = _turned(motions[:, :2], heading[:-1])
    return np.column_stack([np.cumsum(np.vstack([place, ways]), axis=0), wrap(heading)])


def jumps(motions: Float[np.ndarray, "k _"], dt: Float[np.ndarray, " k"]) -> Int[np.ndarray, " j"]:
    """Find possible restarts of the odometry's frame: steps of implausible speed.

    `motions` [m, m, rad]; `dt` [s]. Returns the steps of 0.5 m or 0.5 rad or more whose speed, or
    angular rate, exceeds ten times the 90th percentile of the moving steps.
    """
    found = np.zeros(len(dt), dtype=bool)
    for size in (np.hypot(*motions.T[:2]), np.abs(motions[:, 2])):
        speed = size / dt
        usual = np.percentile(speed[size > 0.0], 90.0) if np.any(size > 0.0) else 0.0
        found |= (size >= _MIN_JUMP) & (speed > _JUMP_RATIO * usual)
    return np.flatnonzero(found)


def _turned(
    points: Float[np.ndarray, "k 2"], angle: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 2"]:
    """Rotate each point in the plane by its angle [rad]."""
    c, s, (x, y) = np.cos(angle), np.sin(angle), points.T
    return np.column_stack([c * x - s * y, s * x + c * y])


def _poses_at(
    time: Float[np.ndarray, " t"], rows: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "t 3"]:
    """Interpolate poses at other times, on curves of constant velocity between the rows."""
    ways = np.vstack([relative_motions(poses), np.zeros((1, 3))])
    lengths = np.append(np.diff(rows), 1.0)
    row = np.searchsorted(rows, time, side="right") - 1
    share, way, start = (time - rows[row]) / lengths[row], ways[row], poses[row]
    velocity = _across_arc(way[:, :2], way[:, 2], back=True)
    part = _across_arc(share[:, None] * velocity, share * way[:, 2])
    there = start[:, :2] + _turned(part, start[:, 2])
    return np.column_stack([there, start[:, 2] + share * way[:, 2]])


def _across_arc(
    points: Float[np.ndarray, "k 2"], turn: Float[np.ndarray, " k"], *, back: bool = False
) -> Float[np.ndarray, "k 2"]:
    """Convert arc lengths driven at a constant turn to displacements; with `back`, the inverse."""
    half = 0.5 * turn
    chord = np.sinc(half / np.pi)[:, None]
    return _turned(points / chord, -half) if back else _turned(points * chord, half)


def _step_covariances(
    time: Float[np.ndarray, " t"],
    there: Float[np.ndarray, "t 3"],
    stamp: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 3"],
    stated: Float[np.ndarray, "n 3 3"],
) -> Float[np.ndarray, "t-1 3 3"]:
    """Return the motion covariance of each step in the axes at its start, summed over rows."""
    extra = np.flatnonzero(~np.isin(time, stamp))
    order = np.argsort(np.append(stamp, time[extra]), kind="stable")
    cut, at = np.append(stamp, time[extra])[order], np.vstack([poses, there[extra]])[order]
    way = np.cumsum(order < len(stamp))[:-1]  # index of the row that ends the motion
    whole = stamp[way] - stamp[way - 1]
    share = np.divide(np.diff(cut), whole, out=np.ones(len(whole)), where=whole > 0.0)
    step = np.searchsorted(time, cut[1:]) - 1
    used = (step >= 0) & (step < len(time) - 1)
    step, start, end = step[used], at[:-1][used], at[1:][used]
    first = there[step]
    lever = _turned(there[step + 1, :2] - end[:, :2], -first[:, 2])
    A = carrying(lever, start[:, 2] - first[:, 2])
    parts = A @ (share[used, None, None] * stated[way[used]]) @ np.swapaxes(A, 1, 2)
    total = np.zeros((len(time) - 1, 3, 3))
    np.add.at(total, step, parts)
    return total


def _check_ways(odometry: Table, poses: Float[np.ndarray, "n 3"]) -> None:
    """Raise if two consecutive poses differ by more than a whole turn or by `FARTHEST`."""
    turn = np.abs(np.diff(odometry.column["heading"]))
    far = np.flatnonzero(turn > 2.0 * np.pi * 1.001)
    if far.size:
        row = int(far[0]) + 1
        before, after = odometry.column["heading"][row - 1 : row + 1].tolist()
        expected = "at most a turn between two rows"
        found = f"heading {after!r} after {before!r}"
        raise refusal(place_of(odometry, row), found, expected, "write radians")
    far = np.flatnonzero(np.hypot(*np.diff(poses[:, :2], axis=0).T) > FARTHEST)
    if far.size:
        row = int(far[0]) + 1
        before, after = poses[row - 1 : row + 1, :2].tolist()
        expected = f"at most {FARTHEST:g} m between two rows"
        fix = "write metres, or begin the log where the frame does"
        raise refusal(place_of(odometry, row), f"x, y {after} after {before}", expected, fix)


def _covariances(odometry: Table) -> Float[np.ndarray, "n 3 3"]:
    """Return the covariance of the motion from the row before to each row; NaN if not stated."""
    absent = np.full(len(odometry.line), np.nan)
    column = [odometry.column.get(name, absent) for name in MOTION_COVARIANCE]
    values = np.column_stack(column)
    lacks = np.isnan(values)
    some = lacks.any(axis=1) & ~lacks.all(axis=1)
    if some.any():
        row = int(np.argmax(some))
        missing = ", ".join(np.array(MOTION_COVARIANCE)[lacks[row]])
        fix = "complete the row, or leave all six empty"
        raise refusal(place_of(odometry, row), f"no {missing}", "all of a covariance, or none", fix)
    full = np.empty((len(values), 3, 3))
    full[:, *_FULL] = values
    full[:, *_FULL[::-1]] = values
    said = np.flatnonzero(~lacks.any(axis=1))
    full[said] = _definite(odometry, full[said], said)
    return full


def _definite(
    odometry: Table, covariance: Float[np.ndarray, "n 3 3"], rows: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Set slightly negative eigenvalues of covariances to 0; raise if any is clearly negative."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    std = np.sqrt(np.maximum(variance, 0.0))
    unit = np.where(std > 0.0, std, 1.0)[:, :, None]
    unit = unit * np.swapaxes(unit, 1, 2)
    value, vector = np.linalg.eigh(covariance / unit)
    wrong = (variance < 0.0).any(axis=1) | (value[:, 0] < -_INDEFINITE)
    if wrong.any():
        found = int(np.argmax(wrong))
        numbers = ", ".join(f"{x:g}" for x in covariance[found][_FULL])
        expected = "variances of 0 or more and correlations between -1 and 1"
        fix = f"correct {MOTION_COVARIANCE[0]} to {MOTION_COVARIANCE[-1]}, or write more digits"
        where = place_of(odometry, int(rows[found]))
        raise refusal(where, f"the covariance {numbers}", expected, fix)
    lifted = vector * np.maximum(value, 0.0)[:, None, :] @ np.swapaxes(vector, 1, 2) * unit
    low = value[:, 0] < 0.0
    return np.where(low[:, None, None], 0.5 * (lifted + np.swapaxes(lifted, 1, 2)), covariance)
