"""The smoother's problem by dense normal equations over all nodes and landmarks, with numpy.

Without Huber's loss and moving callers. Gauss-Newton steps, with all derivatives by differences.
"""

import numpy as np

from pipistrelle.geometry import wrap


def solved(belief, passes=30):
    """Return poses (k, 3), landmarks (l, 2), parameters of the least cost, and twice the cost."""
    points, nodes = belief.solution.points, belief.history.nodes
    parts = points.at.entries(0), points.spots, points.parameters
    x = np.concatenate([part.ravel() for part in parts])
    for _ in range(passes):
        r, J = misfits(belief.history, x)
        step = np.linalg.lstsq(J, r, rcond=None)[0]
        x = x - step
        if (np.abs(step) < 1e-9 * (1.0 + np.abs(x))).all():
            break
    r, _ = misfits(belief.history, x)
    first, last = 3 * nodes, 3 * nodes + points.spots.size
    return x[:first].reshape(-1, 3), x[first:last].reshape(-1, 2), x[last:], r @ r


def misfits(history, x):
    """Return all residuals in standard deviations, and their derivatives."""
    mean, noise, _, rows, _, slopes = map(history.legs.entries, range(6))
    misfit, slope, size = [], [], x.size
    first, asked = 3 * history.nodes, history.calibration
    theta = slice(first + 2 * len(history.placed), size)
    for k in range(history.nodes):
        at = slice(3 * max(k - 1, 0), 3 * k + 3)
        root = np.linalg.inv(np.linalg.cholesky(noise[k]))

        def off(ends, parameters, k=k, root=root):
            scale = np.ones(3)
            if k and history.motion[5]:
                scale[:2] = 1.0 + parameters[0]
            led = mean[k] + slopes[k] @ parameters[: asked.odometry.size]
            return root / scale @ odometry(ends, led, k)

        both = x[at], x[theta]
        by = [(at, differences(off, both, 0)), (theta, differences(off, both, 1))]
        add(misfit, slope, size, off(*both), by)
    add(misfit, slope, size, x[theta] / asked.stds, [(theta, np.diag(1.0 / asked.stds))])
    for number, (place, (xx, xy, yy)) in enumerate(zip(*history.known, strict=True)):
        at = slice(first + 2 * number, first + 2 * number + 2)
        root = np.linalg.cholesky(np.array([[xx, xy], [xy, yy]])).T
        add(misfit, slope, size, root @ (x[at] - place), [(at, root)])
    for k, (begin, end) in enumerate(rows):
        for m in range(begin, end):
            hear(history, x, k, m, (misfit, slope))
    return np.concatenate(misfit), np.concatenate(slope)


def hear(history, x, k, m, into):
    """Add the residuals of a measurement."""
    (slot, caller, *_), numbers = history.rows.entries(0)[m], history.rows.entries(1)[m]
    if history.index[slot] == 0:
        return
    bearing, distance, excess_path, across, along, sure, _, lean = numbers
    lean = np.nan_to_num(lean)
    theta = slice(3 * history.nodes + 2 * len(history.placed), x.size)
    ends = [slice(3 * k, 3 * k + 3), place_of(history, slot), theta]

    def seen(pose, point, parameters):
        at, heading, scale, leaning = sensor(history, k, pose, parameters)
        dx, dy = point - at
        turned = np.arctan2(dy, dx) - heading - lean * leaning
        longer, bias = history.calibration.sensor[4:] - 1
        far = (1.0 + (parameters[longer] if longer >= 0 else 0.0)) * np.hypot(dx, dy) / scale
        far += parameters[bias] if bias >= 0 else 0.0
        off = [wrap(turned - bearing) / across, (far - distance) / along]
        return np.array(off)[[np.isfinite(bearing), np.isfinite(distance)]]

    def further(pose, point, parameters, call):
        at, _, scale, _ = sensor(history, k, pose, parameters)
        way = np.hypot(*(call - point)) + np.hypot(*(point - at)) - np.hypot(*(call - at))
        return np.array([(way / scale - excess_path) / sure])

    if np.isfinite(bearing) or np.isfinite(distance):
        by_all(seen, x, ends, into)
    if caller >= 0 and history.index[caller] != 0:
        by_all(further, x, [*ends, place_of(history, caller)], into)


def sensor(history, k, pose, parameters):
    """Return position and heading of the sensor, the scale of ranges, and the skew of bearings."""
    sound, turned, place, clock = history.calibration.sensor[:4] - 1
    off, heading, scale, lean = np.zeros(2), pose[2], 1.0, 0.0
    seconds = history.legs.entries(2)[k]
    if clock >= 0 and seconds:
        x, y, turn = history.legs.entries(0)[k]
        half = 0.5 * turn
        along = half / np.tan(half) if half else 1.0
        share = parameters[clock] / seconds
        chord = np.array([along * x + half * y, along * y - half * x])
        off = off - share * turning(heading - 0.5 * share * turn) @ chord
        heading = heading - share * turn
    if place >= 0:
        off = off + turning(heading) @ parameters[place : place + 2]
    if turned >= 0:
        heading = heading + parameters[turned]
    if sound >= 0:
        scale, lean = 1.0 + parameters[sound], parameters[sound] + parameters[sound + 1]
    return pose[:2] + off, heading, scale, lean


def turning(angle):
    """Return the rotation matrix of an angle."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def by_all(function, x, ends, into):
    """Add the residual of a function of several unknowns, and its derivatives by each."""
    values = [x[at] for at in ends]
    by = [(at, differences(function, values, e)) for e, at in enumerate(ends)]
    add(*into, x.size, function(*values), by)


def place_of(history, slot):
    """Return the indices of a landmark's position among the unknowns."""
    first = 3 * history.nodes + 2 * (history.index[slot] - 1)
    return slice(first, first + 2)


def add(misfit, slope, size, r, by):
    """Append residuals and their derivatives by parts of the unknowns."""
    J = np.zeros((len(r), size))
    for at, part in by:
        J[:, at] += part
    misfit.append(np.asarray(r))
    slope.append(J)


def odometry(ends, mean, k):
    """Return the residual of a motion, or of the start, as the logarithm of SE(2)."""
    a, b = (ends[:3], ends[3:]) if k else (np.zeros(3), ends)
    if k:
        c, s = np.cos(a[2]), np.sin(a[2])
        x, y = np.array([[c, s], [-s, c]]) @ (b - a)[:2] - mean[:2]
    else:
        x, y = (b - mean)[:2]
    half = 0.5 * wrap(b[2] - a[2] - mean[2])
    along = half / np.tan(half) if abs(half) > 1e-9 else 1.0
    return np.array([along * x + half * y, along * y - half * x, 2.0 * half])


def differences(function, values, which, h=1e-3):
    """Return the derivatives of a function by an argument, accurate to the fourth power of h."""

    def apart(step):
        there, back = list(values), list(values)
        there[which], back[which] = values[which] + step, values[which] - step
        return function(*there) - function(*back)

    if not values[which].size:
        return np.zeros((len(function(*values)), 0))
    steps = h * np.eye(values[which].size)
    return np.array([(8.0 * apart(e) - apart(2.0 * e)) / (12.0 * h) for e in steps]).T
