r"""FastSLAM 2.0 with rays, written from the paper's equations, so that its details can be changed.

With no detail changed it is `pipistrelle.estimation.fastslam` (a test compares them). A particle is
a pose, its covariance since the last sample, and of each landmark up to N_g hypotheses with their
aggregated likelihoods. A frame has two stages: `propose` refines each pose by the measurements and
weighs it; `settle` samples the pose, then updates and extends the map. A detail is a field of
`Details`.

The public MATLAB package fastslam2 by T. Bailey and J. Nieto (version 2.0, 2006) weighs a particle
by likelihood x prior / proposal at the sampled pose (``at_sample``); its version 1.0 of 2004 weighs
by the likelihood of all measurements before the sample and resamples before it samples (``early``).
Both have one sample after all measurements, stratified resampling, 100 particles, a threshold of
0.75 N on the effective number, and no jitter. Their proposal,

.. math:: P \leftarrow (H_x^T S_f^{-1} H_x + P^{-1})^{-1}, \quad
          x \leftarrow x + P H_x^T S_f^{-1} \nu, \quad S_f = H_m P_m H_m^T + R,

is the Kalman form used here by the matrix inversion lemma. Neither has landmarks without a range.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from own_tracks import Swarm

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Landmarks
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.rays import SMALLEST_SHARE, ray_members
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import kernel

ROUNDING = 1e-12
SHARED, WHOLE, HEAVIEST, NONE, MIXTURE = range(5)
"""How a ray enters proposal or weight: every hypothesis with R / share or with R, the heaviest with
R, not at all, or (weights) the mixture density of its hypotheses."""
AS_BEARING, BEFORE, AFTER = range(3)
"""What a range does to a ray: nothing; or the heaviest hypothesis is moved to it and the others go,
before the proposal from the predicted pose, or after it from the sampled pose."""


class Details(NamedTuple):
    """The details of the filter; the defaults are the package's."""

    proposal: int = SHARED
    weight: int = MIXTURE
    at_sample: bool = False
    """Whether particles are weighed by likelihood x prior / proposal at the sampled pose."""
    early: bool = False
    """Whether particles are resampled before their poses are sampled."""
    printed: bool = False
    """Whether every measurement refines with the covariance of the motion, as Eq. (14) has it with
    Q, instead of that which the measurements before have left; the last one's is sampled from."""
    ranged: int = AS_BEARING
    normalised: bool = True
    """Whether the aggregated likelihoods of a ray are normalised after each bearing."""
    carried: bool = False
    """Whether each hypothesis has a correspondence, measured with a standard deviation of 1."""
    restart: bool = False
    """Whether the hypotheses of a ray become alike again when particles are resampled."""


class Numbers(NamedTuple):
    """Noise of the measurements, and the settings of the rays."""

    range_variance: float
    bearing_variance: float
    power: float
    prune: float
    ranges: np.ndarray
    stds: np.ndarray


class State(NamedTuple):
    """All particles (p), their landmarks (n) and hypotheses (h)."""

    pose: np.ndarray
    """(p, 3) [m, m, rad]."""
    P: np.ndarray
    """(p, 3, 3), since the last sample."""
    count: np.ndarray
    """(p, n) hypotheses; 0 before the first measurement."""
    mean: np.ndarray
    """(p, n, h, 2) [m]."""
    cov: np.ndarray
    """(p, n, h, 3): xx, xy, yy [m^2]."""
    log_weight: np.ndarray
    """(p, n, h), log of the aggregated likelihood."""
    correspondence: np.ndarray
    """(p, n, h), variance of the correspondence."""


@kernel
def by_bearing(pose, m, C, bearing):
    """Return innovation, its slopes by x and y, its variance by the landmark; None is too near."""
    dx, dy = m[0] - pose[0], m[1] - pose[1]
    squared = dx * dx + dy * dy
    far = squared >= NEAREST * NEAREST
    squared = max(squared, NEAREST * NEAREST)
    h0, h1 = dy / squared, -dx / squared
    spread = h0 * h0 * C[0] + 2.0 * h0 * h1 * C[1] + h1 * h1 * C[2]
    return wrap_angle(bearing - math.atan2(dy, dx) + pose[2]), h0, h1, spread, far


@kernel
def pose_variance(P, h0, h1):
    """Return the covariance of a pose with a bearing, and the bearing's variance by the pose."""
    a0 = P[0, 0] * h0 + P[0, 1] * h1 - P[0, 2]
    a1 = P[1, 0] * h0 + P[1, 1] * h1 - P[1, 2]
    a2 = P[2, 0] * h0 + P[2, 1] * h1 - P[2, 2]
    return a0, a1, a2, h0 * a0 + h1 * a1 - a2


@kernel
def log_normal(innovation, S):
    """Return the log of a normal density."""
    return -0.5 * (innovation * innovation / S + math.log(2.0 * math.pi * S))


@kernel
def log_bearing(pose, P, m, C, bearing, variance):
    """Return the log density of a bearing to a hypothesis; 0 if it is too near."""
    nu, h0, h1, spread, far = by_bearing(pose, m, C, bearing)
    _, _, _, S = pose_variance(P, h0, h1)
    return log_normal(nu, S + spread + variance) if far else 0.0


@kernel
def refine_by_bearing(pose, P, m, C, bearing, variance):
    """Update a pose by a bearing to a hypothesis."""
    nu, h0, h1, spread, far = by_bearing(pose, m, C, bearing)
    a0, a1, a2, S = pose_variance(P, h0, h1)
    S += spread + variance
    if far:
        _apply(pose, P, (a0, a1, a2), nu / S, (a0, a1, a2), 1.0 / S)


@kernel
def _apply(pose, P, k, scale, a, factor):
    """Move a pose by a gain, and reduce its covariance by an outer product."""
    for i in range(3):
        pose[i] += k[i] * scale
        for j in range(3):
            P[i, j] -= a[i] * a[j] * factor


@kernel
def active(pose, P, m, C, distance, bearing, numbers):
    """Return innovations, the whitened columns of P H^T, and the log density of range, bearing."""
    nu1, h0, h1, _, far = by_bearing(pose, m, C, bearing)
    dx, dy = m[0] - pose[0], m[1] - pose[1]
    d = max(math.sqrt(dx * dx + dy * dy), NEAREST)
    c, s, nu0 = dx / d, dy / d, distance - d
    a0, a1, a2 = (
        -c * P[0, 0] - s * P[0, 1], -c * P[1, 0] - s * P[1, 1], -c * P[2, 0] - s * P[2, 1],
    )  # fmt: skip
    b0, b1, b2, S11 = pose_variance(P, h0, h1)
    u0, u1, v0, v1 = _landmark_columns(c, s, h0, h1, C)
    S00 = -c * a0 - s * a1 + c * u0 + s * u1 + numbers.range_variance
    S01 = h0 * a0 + h1 * a1 - a2 - h0 * u0 - h1 * u1
    S11 += -h0 * v0 - h1 * v1 + numbers.bearing_variance
    e0, e1, i0, L10, i1 = _whitened(nu0, nu1, S00, S01, S11)
    a = (a0 * i0, a1 * i0, a2 * i0)
    b = ((b0 - L10 * a[0]) * i1, (b1 - L10 * a[1]) * i1, (b2 - L10 * a[2]) * i1)
    log = -0.5 * (e0 * e0 + e1 * e1) + math.log(i0 * i1) - math.log(2.0 * math.pi)
    return e0, e1, a, b, log, far


@kernel
def _landmark_columns(c, s, h0, h1, C):
    """Return the columns of P_m H_m^T for range and bearing."""
    return (
        c * C[0] + s * C[1], c * C[1] + s * C[2], -h0 * C[0] - h1 * C[1], -h0 * C[1] - h1 * C[2],
    )  # fmt: skip


@kernel
def _whitened(nu0, nu1, S00, S01, S11):
    """Return two innovations whitened by their covariance, and the factors."""
    i0 = 1.0 / math.sqrt(S00)
    L10 = S01 * i0
    i1 = 1.0 / math.sqrt(S11 - L10 * L10)
    e0 = nu0 * i0
    return e0, (nu1 - L10 * e0) * i1, i0, L10, i1


@kernel
def likelihoods(pose, P, m, C, correspondence, bearing, numbers, carried):
    """Return the log likelihoods of a ray's hypotheses, and the shares of the bearing (Eq. 19)."""
    logs, share = np.empty(len(m)), np.empty(len(m))
    for j in range(len(m)):
        logs[j] = log_bearing(pose, P, m[j], C[j], bearing, numbers.bearing_variance)
        if carried:
            logs[j] += log_normal(0.0, correspondence[j] + 1.0)
    largest, total = logs.max(), 0.0
    for j in range(len(m)):
        share[j] = math.exp(numbers.power * (logs[j] - largest))
        total += share[j]
    for j in range(len(m)):
        share[j] = share[j] / total if share[j] / total >= SMALLEST_SHARE else 0.0
    return logs, share


@kernel
def _log_sum(logs):
    """Return the log of a sum of exponentials."""
    largest, total = logs.max(), 0.0
    for value in logs:
        total += math.exp(value - largest)
    return largest + math.log(total)


@kernel
def ray_gain(pose, P, ray, logs, share, bearing, numbers, weight):
    """Return the log of what a bearing to a ray multiplies a particle's weight by."""
    m, C, log_weight = ray
    if weight == MIXTURE:
        return _log_sum(log_weight + logs) - _log_sum(log_weight)
    if weight == HEAVIEST:
        return logs[log_weight.argmax()]
    total = 0.0
    for j in range(len(m)):
        if weight == WHOLE:
            total += logs[j]
        elif weight == SHARED and share[j] > 0.0:
            variance = numbers.bearing_variance / share[j]
            total += log_bearing(pose, P, m[j], C[j], bearing, variance)
    return total


@kernel
def to_range(pose, state, p, n, distance):
    """Move the heaviest hypothesis of a ray to a range, and drop the others."""
    count = state.count[p, n]
    best = state.log_weight[p, n, :count].argmax()
    m = state.mean[p, n, best]
    dx, dy = m[0] - pose[0], m[1] - pose[1]
    scale = distance / max(math.sqrt(dx * dx + dy * dy), NEAREST)
    state.mean[p, n, 0, 0], state.mean[p, n, 0, 1] = pose[0] + dx * scale, pose[1] + dy * scale
    state.cov[p, n, 0] = state.cov[p, n, best].copy()
    state.count[p, n], state.log_weight[p, n, 0] = 1, 0.0


@kernel
def propose(columns, rows, numbers, details, gained):
    """Refine all poses by the measurements of known landmarks, and weigh them before the sample."""
    state, (index, distances, bearings) = State(*columns), rows
    for p in range(len(state.pose)):
        pose, P = state.pose[p], state.P[p]
        motion = P.copy()
        for r in range(len(index)):
            n, distance, bearing = index[r], distances[r], bearings[r]
            count = state.count[p, n]
            if details.printed and count > 0:
                P[:] = motion
            if count > 1 and details.ranged == BEFORE and not math.isnan(distance):
                to_range(pose, state, p, n, distance)
                count = 1
            m, C = state.mean[p, n, :count], state.cov[p, n, :count]
            if count == 1 and not math.isnan(distance):
                e0, e1, a, b, log, far = active(pose, P, m[0], C[0], distance, bearing, numbers)
                if far:
                    gained[p] += log
                    _apply(pose, P, a, e0, a, 1.0)
                    _apply(pose, P, b, e1, b, 1.0)
            elif count == 1:
                gained[p] += log_bearing(pose, P, m[0], C[0], bearing, numbers.bearing_variance)
                refine_by_bearing(pose, P, m[0], C[0], bearing, numbers.bearing_variance)
            elif count > 1:
                logs, share = likelihoods(
                    pose, P, m, C, state.correspondence[p, n], bearing, numbers, details.carried
                )
                log_weight = state.log_weight[p, n, :count]
                ray = (m, C, log_weight)
                gained[p] += ray_gain(pose, P, ray, logs, share, bearing, numbers, details.weight)
                for j in range(count):
                    part = share[j]
                    if details.proposal == WHOLE:
                        part = 1.0
                    elif details.proposal == HEAVIEST:
                        part = 1.0 if j == log_weight.argmax() else 0.0
                    if part > 0.0 and details.proposal != NONE:
                        if details.printed:
                            P[:] = motion
                        variance = numbers.bearing_variance / part
                        refine_by_bearing(pose, P, m[j], C[j], bearing, variance)


@kernel
def factor(P):
    """Return the lower Cholesky factor of a covariance of any rank."""
    L = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            left = P[i, j]
            for k in range(j):
                left -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(left) if left > ROUNDING * P[i, i] else 0.0
            elif L[j, j] > 0.0:
                L[i, j] = left / L[j, j]
    return L


@kernel
def log_density(pose, mean, P):
    """Return the log density of a Gaussian at a pose, without constant and singular directions."""
    L, e, total = factor(P), np.zeros(3), 0.0
    for i in range(3):
        left = pose[i] - mean[i]
        left = wrap_angle(left) if i == 2 else left
        for k in range(i):
            left -= L[i, k] * e[k]
        if L[i, i] > 0.0:
            e[i] = left / L[i, i]
            total -= 0.5 * e[i] * e[i] + math.log(L[i, i])
    return total


@kernel
def sample(columns, prior, normal, details, gained):
    """Sample all poses from their Gaussians; ``prior`` holds them before the measurements."""
    state, (before, spread) = State(*columns), prior
    for p in range(len(state.pose)):
        mean, P = state.pose[p].copy(), state.P[p].copy()
        state.pose[p] += factor(P) @ normal[p]
        state.pose[p, 2] = wrap_angle(state.pose[p, 2])
        if details.at_sample:
            gained[p] = log_density(state.pose[p], before[p], spread[p])
            gained[p] -= log_density(state.pose[p], mean, P)
        state.P[p] = 0.0


@kernel
def correct_bearing(pose, m, C, bearing, variance):
    """Update a hypothesis by a bearing from a known pose."""
    nu, h0, h1, spread, far = by_bearing(pose, m, C, bearing)
    if far:
        a0, a1, S = -h0 * C[0] - h1 * C[1], -h0 * C[1] - h1 * C[2], spread + variance
        m[0] += a0 * nu / S
        m[1] += a1 * nu / S
        C[0] -= a0 * a0 / S
        C[1] -= a0 * a1 / S
        C[2] -= a1 * a1 / S


@kernel
def correct_active(pose, m, C, distance, bearing, numbers):
    """Update a landmark by range and bearing from a known pose; return their log density."""
    nu1, h0, h1, spread, far = by_bearing(pose, m, C, bearing)
    if not far:
        return 0.0
    dx, dy = m[0] - pose[0], m[1] - pose[1]
    d = math.sqrt(dx * dx + dy * dy)
    c, s = dx / d, dy / d
    a0, a1, b0, b1 = _landmark_columns(c, s, h0, h1, C)
    S00, S01 = c * a0 + s * a1 + numbers.range_variance, -h0 * a0 - h1 * a1
    e0, e1, i0, L10, i1 = _whitened(distance - d, nu1, S00, S01, spread + numbers.bearing_variance)
    a0, a1 = a0 * i0, a1 * i0
    b0, b1 = (b0 - L10 * a0) * i1, (b1 - L10 * a1) * i1
    m[0] += a0 * e0 + b0 * e1
    m[1] += a1 * e0 + b1 * e1
    C[0] -= a0 * a0 + b0 * b0
    C[1] -= a0 * a1 + b0 * b1
    C[2] -= a1 * a1 + b1 * b1
    return -0.5 * (e0 * e0 + e1 * e1) + math.log(i0 * i1) - math.log(2.0 * math.pi)


@kernel
def correct_ray(state, p, n, bearing, numbers, details):
    """Weigh, update and prune a ray; return the log of its factor in the particle's weight."""
    pose, P, count = state.pose[p], state.P[p], state.count[p, n]
    m, C, log_weight = state.mean[p, n], state.cov[p, n], state.log_weight[p, n, :count]
    c = state.correspondence[p, n]
    logs, share = likelihoods(pose, P, m[:count], C[:count], c, bearing, numbers, details.carried)
    ray = (m[:count], C[:count], log_weight)
    gain = ray_gain(pose, P, ray, logs, share, bearing, numbers, details.weight)
    log_weight += logs
    if details.normalised:
        log_weight -= _log_sum(log_weight)
    best, limit, kept = log_weight.argmax(), math.log(numbers.prune / count), 0
    for j in range(count):
        if share[j] > 0.0:
            correct_bearing(pose, m[j], C[j], bearing, numbers.bearing_variance / share[j])
            c[j] /= 1.0 + share[j] * c[j]
        if j == best or log_weight[j] >= limit:
            m[kept], C[kept], c[kept], log_weight[kept] = m[j], C[j], c[j], log_weight[j]
            kept += 1
    if details.normalised:
        log_weight[:kept] -= _log_sum(log_weight[:kept])
    state.count[p, n] = kept
    return gain


@kernel
def settle(columns, rows, numbers, details, gained):
    """Update the measured landmarks of all particles from their sampled poses, then add new."""
    state, (index, distances, bearings) = State(*columns), rows
    for p in range(len(state.pose)):
        pose = state.pose[p]
        for r in range(len(index)):
            n, distance, bearing = index[r], distances[r], bearings[r]
            m, C, log = state.mean[p, n], state.cov[p, n], 0.0
            if state.count[p, n] > 1 and not math.isnan(distance) and details.ranged == AFTER:
                log = ray_of_bearing(state, p, n, bearing, numbers, details)
                to_range(pose, state, p, n, distance)
                correct_active(pose, m[0], C[0], distance, bearing, numbers)
            elif state.count[p, n] > 1:
                log = correct_ray(state, p, n, bearing, numbers, details)
            elif state.count[p, n] == 1 and math.isnan(distance):
                log = log_bearing(pose, state.P[p], m[0], C[0], bearing, numbers.bearing_variance)
                correct_bearing(pose, m[0], C[0], bearing, numbers.bearing_variance)
            elif state.count[p, n] == 1:
                log = correct_active(pose, m[0], C[0], distance, bearing, numbers)
            else:
                place(state, p, n, distance, bearing, numbers)
            if details.at_sample:
                gained[p] += log


@kernel
def ray_of_bearing(state, p, n, bearing, numbers, details):
    """Return the log of what a bearing to a ray multiplies a particle's weight by, at its pose."""
    pose, P, count = state.pose[p], state.P[p], state.count[p, n]
    m, C, c = state.mean[p, n, :count], state.cov[p, n, :count], state.correspondence[p, n]
    logs, share = likelihoods(pose, P, m, C, c, bearing, numbers, details.carried)
    ray = (m, C, state.log_weight[p, n, :count])
    return ray_gain(pose, P, ray, logs, share, bearing, numbers, details.weight)


@kernel
def place(state, p, n, distance, bearing, numbers):
    """Add a landmark at a range and bearing, or a ray (Eqs. 16 to 18)."""
    pose, single = state.pose[p], not math.isnan(distance)
    c, s = math.cos(pose[2] + bearing), math.sin(pose[2] + bearing)
    count = 1 if single else len(numbers.ranges)
    for j in range(count):
        far = distance if single else numbers.ranges[j]
        along = numbers.range_variance if single else numbers.stds[j] ** 2
        across, C = numbers.bearing_variance * far * far, state.cov[p, n, j]
        state.mean[p, n, j, 0], state.mean[p, n, j, 1] = pose[0] + far * c, pose[1] + far * s
        C[0], C[1] = along * c * c + across * s * s, (along - across) * c * s
        C[2] = along * s * s + across * c * c
        state.log_weight[p, n, j], state.correspondence[p, n, j] = -math.log(count), 1.0
    state.count[p, n] = count


@kernel
def move(columns, controls, dt, stds, wheelbase):
    """Predict all poses and covariances through a control step of a bicycle (Eqs. 5 and 10)."""
    pose, P = columns[0], columns[1]
    v, g = controls
    ahead, turn, qv, qg = v * dt, v * dt / wheelbase, stds[0] ** 2, stds[1] ** 2
    u, w = dt / wheelbase * math.sin(g), turn * math.cos(g)
    for p in range(len(pose)):
        c, s = math.cos(pose[p, 2] + g), math.sin(pose[p, 2] + g)
        dx, dy, C = ahead * c, ahead * s, P[p]
        xh, yh, hh = C[0, 2], C[1, 2], C[2, 2]
        a, b, vx, vy = xh - dy * hh, yh + dx * hh, dt * c, dt * s
        C[0, 0] += -dy * (xh + a) + qv * vx * vx + qg * dy * dy
        C[0, 1] += dx * xh - dy * yh - dx * dy * hh + qv * vx * vy - qg * dy * dx
        C[1, 1] += dx * (yh + b) + qv * vy * vy + qg * dx * dx
        C[0, 2] = a + qv * vx * u - qg * dy * w
        C[1, 2] = b + qv * vy * u + qg * dx * w
        C[2, 2] += qv * u * u + qg * w * w
        C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]
        pose[p, 0] += dx
        pose[p, 1] += dy
        pose[p, 2] = wrap_angle(pose[p, 2] + turn * math.sin(g))


PLAIN = Details()


@dataclass
class OwnFastSlam:
    """The filter with its particles, which change in place, for `own_tracks.follow`."""

    config: Config
    motion: Motion
    details: Details = PLAIN
    labels: int = 51
    """Landmarks have the labels 1 to this."""

    def start(self, mean: np.ndarray, covariance: np.ndarray, rng: np.random.Generator) -> None:
        """Put all particles at the start."""
        p, n = self.config.fastslam.particles, self.labels
        ranges, stds = ray_members(self.config.rays)
        filtering, h = self.config.filter, len(ranges)
        self.numbers = Numbers(
            filtering.range_std**2, filtering.bearing_std**2, self.config.rays.exponent,
            self.config.rays.prune_threshold, ranges, stds,
        )  # fmt: skip
        self.state = State(
            np.tile(mean, (p, 1)), np.tile(covariance, (p, 1, 1)), np.zeros((p, n), np.int64),
            np.zeros((p, n, h, 2)), np.zeros((p, n, h, 3)), np.zeros((p, n, h)),
            np.ones((p, n, h)),
        )  # fmt: skip
        self.weight, self.rng, self.resampled = np.full(p, 1.0 / p), rng, 0
        self._remember(self.state.P)

    def move(self, control: np.ndarray, dt: float) -> None:
        """Predict through a control step."""
        speed, turn = self.motion.control_std
        step = tuple(float(number) for number in control)
        move(tuple(self.state), step, dt, (speed, turn), self.motion.wheelbase)
        self._remember(self.state.P)

    def hear(self, scan: Scan) -> None:
        """Update all particles by a scan, and resample them."""
        if not scan.landmark.size:
            return
        particles, details = len(self.weight), self.details
        normal, uniform = self.rng.standard_normal((particles, 3)), self.rng.random(particles)
        rows = (scan.landmark - 1, np.ascontiguousarray(scan.range), scan.bearing.copy())
        gained = np.zeros(particles)
        prior = self.state.pose.copy(), self.state.P.copy()
        propose(tuple(self.state), rows, self.numbers, details, gained)
        if details.early:
            self._weigh(gained)
            chosen = self._resample(uniform)
            prior = prior[0][chosen], prior[1][chosen]
        refined = self.state.P.copy()
        sample(tuple(self.state), prior, normal, details, gained)
        settle(tuple(self.state), rows, self.numbers, details, gained)
        if not details.early:
            self._weigh(gained)
        self._remember(refined)
        if not details.early:
            self._resample(uniform)
            self.after = self.swarm._replace(
                pose=self.state.pose.copy(), weight=self.weight.copy(), P=self.state.P.copy()
            )

    def _weigh(self, gained: np.ndarray) -> None:
        with np.errstate(divide="ignore"):
            log = np.log(self.weight) + gained
        weight = np.exp(log - log[np.isfinite(log)].max(initial=-np.inf))
        total = float(weight.sum())
        even = np.full(len(weight), 1.0 / len(weight))
        self.weight = weight / total if 0.0 < total < math.inf else even

    def _resample(self, uniform: np.ndarray) -> np.ndarray:
        """Resample if too few particles are effective; return each particle's ancestor."""
        count = len(uniform)
        if 1.0 / np.sum(self.weight**2) >= self.config.fastslam.resample_below * count:
            return np.arange(count)
        bounds = np.cumsum(self.weight) / self.weight.sum()
        chosen = np.searchsorted(bounds, (np.arange(count) + uniform) / count, side="right")
        chosen = np.minimum(chosen, np.flatnonzero(self.weight)[-1])
        self.state = State(*(np.ascontiguousarray(part[chosen]) for part in self.state))
        self.weight, self.resampled = np.full(count, 1.0 / count), self.resampled + 1
        if self.details.restart:
            alike = -np.log(np.maximum(self.state.count, 1))
            self.state.log_weight[:] = alike[..., np.newaxis]
        return chosen

    def _remember(self, refined: np.ndarray) -> None:
        """Keep the swarm of this moment and, before a resampling, the map of its heaviest."""
        self.swarm = self.after = Swarm(
            self.state.pose.copy(), self.state.P.copy(), refined.copy(), self.weight.copy()
        )
        best = int(np.argmax(self.weight))
        self.best_map = tuple(part[best].copy() for part in self.state[2:6])
        self.counts = self.state.count.copy()

    def landmarks(self) -> Landmarks:
        """Return the map of the heaviest particle before the last resampling."""
        count, mean, cov, log_weight = self.best_map
        n, j = np.nonzero(np.arange(mean.shape[1]) < count[:, np.newaxis])
        rows = cov[n, j]
        return Landmarks(
            landmark=n + 1, mean=mean[n, j], covariance=rows[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
            weight=np.exp(log_weight[n, j]),
        )  # fmt: skip

    def placed(self) -> dict[str, float]:
        """Count fully initialised landmarks in other ways than by the heaviest particle."""
        full, weight = self.counts == 1, self.swarm.weight
        share = weight @ full
        return {
            "mean of the particles": float(share.sum()),
            "most particles, by weight": float(np.sum(share > 0.5)),
            "all particles": float(full.all(axis=0).sum()),
            "any particle": float(full.any(axis=0).sum()),
        }
