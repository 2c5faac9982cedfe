"""The smoother's problem by dense normal equations: all nodes, all landmarks, one matrix, numpy.

No Huber's loss, no caller that moves. Steps of Gauss and Newton, the derivatives of odometry by
differences.
"""

import numpy as np

from pipistrelle.geometry import wrap


def solved(belief, passes=30):
    """Return poses (k, 3) and landmarks (l, 2) of the least cost, and that cost, times two."""
    points, nodes = belief.solution.points, belief.history.nodes
    x = np.concatenate([points.at.entries(0).ravel(), points.spots.ravel()])
    for _ in range(passes):
        r, J = misfits(belief.history, x)
        x = x - np.linalg.lstsq(J, r, rcond=None)[0]
    r, _ = misfits(belief.history, x)
    return x[: 3 * nodes].reshape(-1, 3), x[3 * nodes :].reshape(-1, 2), r @ r


def misfits(history, x):
    """Return all misfits in standard deviations, and their derivatives."""
    mean, noise, _, rows = map(history.legs.entries, range(4))
    misfit, slope, size = [], [], x.size
    for k in range(history.nodes):
        at = slice(3 * max(k - 1, 0), 3 * k + 3)
        root = np.linalg.inv(np.linalg.cholesky(noise[k]))
        by = [(at, root @ differences(x[at], mean[k], k))]
        add(misfit, slope, size, root @ odometry(x[at], mean[k], k), by)
    first = 3 * history.nodes
    for number, (place, (xx, xy, yy)) in enumerate(zip(*history.known, strict=True)):
        at = slice(first + 2 * number, first + 2 * number + 2)
        root = np.linalg.cholesky(np.array([[xx, xy], [xy, yy]])).T
        add(misfit, slope, size, root @ (x[at] - place), [(at, root)])
    for k, (begin, end) in enumerate(rows):
        for m in range(begin, end):
            hear(history, x, k, m, (misfit, slope))
    return np.concatenate(misfit), np.concatenate(slope)


def hear(history, x, k, m, into):
    """Add the misfits of one row."""
    (slot, caller, *_), numbers = history.rows.entries(0)[m], history.rows.entries(1)[m]
    if history.index[slot] == 0:
        return
    pose = slice(3 * k, 3 * k + 3)
    point, (dx, dy) = place_of(history, slot), x[place_of(history, slot)] - x[pose][:2]
    bearing, distance, excess_path, across, along, sure = numbers[:6]
    d = np.hypot(dx, dy)
    if np.isfinite(bearing):
        off = wrap(np.arctan2(dy, dx) - x[pose][2] - bearing) / across
        by = np.array([-dy, dx]) / d**2 / across
        add(*into, x.size, [off], [(point, by[None]), (pose, np.append(-by, -1.0 / across)[None])])
    if np.isfinite(bearing) and np.isfinite(distance):
        by = np.array([dx, dy]) / d / along
        parts = [(point, by[None]), (pose, np.append(-by, 0.0)[None])]
        add(*into, x.size, [(d - distance) / along], parts)
    if caller >= 0 and history.index[caller] != 0:
        call = place_of(history, caller)
        onward, straight = x[call] - x[point], x[call] - x[pose][:2]
        w, v, u = onward / np.hypot(*onward), straight / np.hypot(*straight), np.array([dx, dy]) / d
        off = (np.hypot(*onward) + d - np.hypot(*straight) - excess_path) / sure
        by = (point, u - w), (call, w - v), (pose, np.append(v - u, 0.0))
        add(*into, x.size, [off], [(at, part[None] / sure) for at, part in by])


def place_of(history, slot):
    """Return where a slot's place stands among the unknowns."""
    first = 3 * history.nodes + 2 * (history.index[slot] - 1)
    return slice(first, first + 2)


def add(misfit, slope, size, r, by):
    """Append misfits and their derivatives by parts of the unknowns."""
    J = np.zeros((len(r), size))
    for at, part in by:
        J[:, at] += part
    misfit.append(np.asarray(r))
    slope.append(J)


def odometry(ends, mean, k):
    """Return what a motion is off, as the logarithm of SE(2); of the start, what it is off."""
    a, b = (ends[:3], ends[3:]) if k else (np.zeros(3), ends)
    if k:
        c, s = np.cos(a[2]), np.sin(a[2])
        x, y = np.array([[c, s], [-s, c]]) @ (b - a)[:2] - mean[:2]
    else:
        x, y = (b - mean)[:2]
    half = 0.5 * wrap(b[2] - a[2] - mean[2])
    along = half / np.tan(half) if abs(half) > 1e-9 else 1.0
    return np.array([along * x + half * y, along * y - half * x, 2.0 * half])


def differences(ends, mean, k, h=1e-3):
    """Return the derivatives of `odometry`, to the fourth power of h."""

    def apart(step):
        return odometry(ends + step, mean, k) - odometry(ends - step, mean, k)

    steps = h * np.eye(len(ends))
    return np.array([(8.0 * apart(e) - apart(2.0 * e)) / (12.0 * h) for e in steps]).T
