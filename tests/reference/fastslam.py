"""FastSLAM 2.0 with rays, implemented slowly from the equations, for comparison.

Particles, measurements and small matrices are handled sequentially; no code is shared with the
package. Equation numbers are from Bradley & Abaid. A particle is a pose with its covariance since
the last sample, a log weight, and a map from labels to hypotheses: a single hypothesis for a full
landmark, several, near to far, for a partial landmark.
"""

import copy
import math
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from reference.ekf_slam import (
    LEAST_AGGREGATED,
    LEAST_SHARE,
    NEAREST,
    logarithm,
    moved,
    noise_of,
    normalised,
    ray_ranges,
    wrapped,
)

SMALLEST_STD = 1e-6


@dataclass
class Member:
    mean: np.ndarray
    covariance: np.ndarray
    weight: float = 1.0


@dataclass
class Particle:
    pose: np.ndarray
    P: np.ndarray
    log_weight: float = 0.0
    map: dict[int, list[Member]] = field(default_factory=dict)


def log_normal(nu, S):
    """Log of the density N(nu; 0, S)."""
    sign, log_determinant = np.linalg.slogdet(2 * math.pi * S)
    assert sign > 0
    return -(nu @ np.linalg.solve(S, nu) + log_determinant) / 2


def log_sum(logs):
    """Log of a sum of exponentials."""
    return max(logs) + math.log(sum(math.exp(value - max(logs)) for value in logs))


def kalman(mean, P, nu, H, S):
    """Update a Gaussian with an innovation of covariance S."""
    K = P @ H.T @ np.linalg.inv(S)
    P = P - K @ S @ K.T
    return mean + K @ nu, (P + P.T) / 2


def semidefinite_cholesky(P):
    """Lower factor of a covariance of any rank; a pivot within rounding gives a zero column."""
    A, L = np.array(P, float), np.zeros_like(P)
    for k in range(len(A)):
        if A[k, k] > 1e-12 * P[k, k]:
            L[k:, k] = A[k:, k] / math.sqrt(A[k, k])
            A -= np.outer(L[:, k], L[:, k])
    return L


def log_density(pose, mean, P):
    """Log of a Gaussian density over the directions with a nonzero variance."""
    L = semidefinite_cholesky(P)
    spread = np.flatnonzero(np.diag(L))
    error = np.array(pose) - mean
    error[2] = wrapped(error[2])
    L, error = L[np.ix_(spread, spread)], error[spread]
    white = np.linalg.solve(L, error)
    return -(white @ white) / 2 - sum(np.log(math.sqrt(2 * math.pi) * np.diag(L)))


def heaviest(members):
    return max(range(len(members)), key=lambda j: members[j].weight)


class SlowFastSlam:
    """FastSLAM and its particles in a single object that changes in place.

    `swarm` holds particles, resample_below, mixture and weights. `forget_proposal` makes weights at
    the sample wrong on purpose: only the likelihood, without the proposal that has already used the
    measurements.
    """

    def __init__(self, motion, range_std, bearing_std, rays, gate, swarm, *, forget_proposal=False):
        self.motion, self.rays, self.gate, self.settings = motion, rays, gate, swarm
        self.range_variance, self.bearing_variance = range_std**2, bearing_std**2
        self.forget_proposal = forget_proposal

    def start(self, mean, covariance):
        self.particles = [
            Particle(np.array(mean, float), np.array(covariance, float))
            for _ in range(self.settings.particles)
        ]
        self.gated, self.resampled = 0, 0
        return self

    # Estimates from all particles

    @property
    def weights(self):
        return np.array(normalised([p.log_weight for p in self.particles]))

    def estimate(self):
        """Weighted mean with a circular mean heading, and covariance including the particles'."""
        w = self.weights
        x, y, heading = np.array([p.pose for p in self.particles]).T
        mean = [w @ x, w @ y, math.atan2(w @ np.sin(heading), w @ np.cos(heading))]
        covariance = SMALLEST_STD**2 * np.eye(3)
        for weight, p in zip(w, self.particles, strict=True):
            error = p.pose - mean
            error[2] = wrapped(error[2])
            covariance += weight * (np.outer(error, error) + p.P)
        return np.array(mean), covariance

    # Prediction, Eqs. (5) and (10), of every particle

    def predict(self, controls, dt):
        """Predict with the nominal controls; return overall mean and covariance at each step."""
        means, covariances = [], []
        for control, step in zip(controls, dt, strict=True):
            Q = noise_of(self.motion, control)
            for p in self.particles:
                p.pose, F, U = moved(self.motion, p.pose, control, step)
                p.P = F @ p.P @ F.T + U @ Q @ U.T
            mean, covariance = self.estimate()
            means.append(mean)
            covariances.append(covariance)
        return np.array(means), np.array(covariances)

    # Measurement, Eqs. (6) and (7)

    def innovation(self, pose, member, distance, bearing, inflation=1.0):
        """Innovation, Jacobians by pose and landmark, noise; bearing only if distance is NaN."""
        dx, dy = member.mean - pose[:2]
        d = max(math.hypot(dx, dy), NEAREST)
        nu = np.array([distance - d, wrapped(bearing - (math.atan2(dy, dx) - pose[2]))])
        Hx = np.array([[-dx / d, -dy / d, 0], [dy / d**2, -dx / d**2, -1]])
        Hm = np.array([[dx / d, dy / d], [-dy / d**2, dx / d**2]])
        R = np.diag([self.range_variance, self.bearing_variance]) * inflation
        rows = slice(1, 2) if math.isnan(distance) else slice(0, 2)
        return nu[rows], Hx[rows], Hm[rows], R[rows, rows]

    def too_near(self, pose, member):
        return math.dist(pose[:2], member.mean) < NEAREST

    def expected(self, p, member, distance, bearing, inflation=1.0):
        """Innovation, its covariance given the particle's past, and the Jacobian by the pose."""
        nu, Hx, Hm, R = self.innovation(p.pose, member, distance, bearing, inflation)
        return nu, Hx @ p.P @ Hx.T + Hm @ member.covariance @ Hm.T + R, Hx

    def log_likelihoods(self, p, members, bearing, distance=math.nan):
        return [
            float(log_normal(*self.expected(p, member, distance, bearing)[:2]))
            for member in members
        ]

    def log_lambdas(self, p, members, bearing):
        """Log likelihoods that weigh and share a ray: Eq. (19), or its printed form."""
        if self.rays.likelihood == "normal" or self.settings.mixture == "exact":
            return self.log_likelihoods(p, members, bearing)
        logs = []
        for member in members:
            nu, S, _ = self.expected(p, member, math.nan, bearing)
            logs.append(-(nu[0] ** 2) / S[0, 0] / math.sqrt(2 * math.pi * S[0, 0]) / 2)
        return logs

    # One frame

    def update(self, scan, rng):
        rows = list(zip(scan.landmark.tolist(), scan.range, scan.bearing, strict=True))
        if not rows:
            return
        normal = rng.standard_normal((len(self.particles), 3))
        uniform = rng.random(len(self.particles))
        kept = [row for row in rows if self.inside_any(*row)]
        self.gated += len(rows) - len(kept)
        for p, draw in zip(self.particles, normal, strict=True):
            self.one_frame(p, kept, draw)
        for p, weight in zip(self.particles, self.weights, strict=True):
            p.log_weight = logarithm(weight)
        self.before = copy.deepcopy(self.particles)
        self.estimated = self.estimate()
        self.resample(uniform)

    def one_frame(self, p, rows, draw):
        known = [row for row in rows if row[0] in p.map]
        prior = p.pose, p.P
        for label, distance, bearing in known:
            self.refine(p, p.map[label], distance, bearing)
        proposal = p.pose, p.P
        p.pose = p.pose + semidefinite_cholesky(p.P) @ draw
        p.pose[2] = wrapped(p.pose[2])
        p.P = np.zeros((3, 3))
        if self.settings.weights == "sampled" and not self.forget_proposal:
            p.log_weight += log_density(p.pose, *prior) - log_density(p.pose, *proposal)
        for label, distance, bearing in known:
            if self.settings.weights == "sampled":
                p.log_weight += self.log_weight_gain(p, p.map[label], distance, bearing)
            p.map[label] = self.correct(p.pose, p.map[label], distance, bearing)
        for label, distance, bearing in rows:
            if label not in p.map:
                new = self.ray(p.pose, bearing)
                if not math.isnan(distance):
                    new = [self.placed(p.pose, distance, bearing)]
                p.map[label] = new

    def inside_any(self, label, distance, bearing):
        """Return whether a measurement is inside the gate of any particle, or cannot be tested."""
        if self.gate == 1 or label not in self.particles[0].map:
            return True
        bound = chi2.ppf(self.gate, 1 if math.isnan(distance) else 2)
        for p in self.particles:
            members = p.map[label]
            if len(members) > 1 and not math.isnan(distance):
                return True
            for member in members:
                nu, S, _ = self.expected(p, member, distance, bearing)
                if self.too_near(p.pose, member) or nu @ np.linalg.solve(S, nu) <= bound:
                    return True
        return False

    # Proposal and weight, Eqs. (13) and (14) in Kalman form

    def log_weight_gain(self, p, members, distance, bearing):
        """Log likelihood of a measurement given the particle; P = 0 after sampling."""
        if len(members) == 1:
            if self.too_near(p.pose, members[0]):
                return 0.0
            return float(log_normal(*self.expected(p, members[0], distance, bearing)[:2]))
        if self.settings.weighed_by == "initialised":
            return 0.0
        distance = math.nan if self.by_bearing(distance) else distance
        logs = self.log_likelihoods(p, members, bearing, distance)
        return log_sum([logarithm(m.weight) + log for m, log in zip(members, logs, strict=True)])

    def by_bearing(self, distance):
        """Return whether a ray uses only a measurement's bearing."""
        return math.isnan(distance) or self.rays.range_update in ("bearing", "moved")

    def refine(self, p, members, distance, bearing):
        if self.settings.weights == "marginal":
            p.log_weight += self.log_weight_gain(p, members, distance, bearing)
        if len(members) == 1:
            p.pose, p.P = self.refined(p, members[0], distance, bearing)
        elif not self.by_bearing(distance):
            return
        elif self.settings.mixture == "federated":
            logs = self.log_lambdas(p, members, bearing)
            for member, share in zip(members, self.shares(members, logs), strict=True):
                if share > 0:
                    p.pose, p.P = self.refined(p, member, math.nan, bearing, 1 / share)
        else:
            logs = self.log_likelihoods(p, members, bearing)
            weights = self.aggregated(members, logs)
            refined = [self.refined(p, member, math.nan, bearing) for member in members]
            p.pose, p.P = moments(weights, refined)

    def refined(self, p, member, distance, bearing, inflation=1.0):
        """Mean and covariance of the pose after a measurement."""
        if self.too_near(p.pose, member):
            return p.pose, p.P
        nu, S, Hx = self.expected(p, member, distance, bearing, inflation)
        return kalman(p.pose, p.P, nu, Hx, S)

    # Rays, Eqs. (18) to (21)

    def aggregated(self, members, logs):
        return normalised(
            [logarithm(member.weight) + log for member, log in zip(members, logs, strict=True)]
        )

    def shares(self, members, logs):
        """Return each hypothesis's share of a measurement; 0 for skipped hypotheses."""
        if self.rays.weights == "instantaneous":
            least = LEAST_SHARE
        else:
            logs, least = [logarithm(w) for w in self.aggregated(members, logs)], LEAST_AGGREGATED
        shares = normalised([self.rays.exponent * log for log in logs])
        return [share if share >= least else 0 for share in shares]

    def prune(self, members):
        least = self.rays.prune_threshold / len(members)
        best = members[heaviest(members)]
        left = [member for member in members if member.weight >= least or member is best]
        total = sum(member.weight for member in left)
        left = [Member(m.mean, m.covariance, m.weight / total) for m in left]
        return self.merge(left) if self.rays.merge > 0 else left

    def merge(self, members):
        """Merge neighbouring hypotheses that agree: mean and covariance of their mixture."""
        merged = members[:1]
        for other in members[1:]:
            one = merged[-1]
            d, S = other.mean - one.mean, (one.covariance + other.covariance) / 2
            if d @ np.linalg.solve(S, d) > self.rays.merge**2:
                merged.append(other)
                continue
            w = one.weight + other.weight
            pair = [(m.mean, m.covariance) for m in (one, other)]
            merged[-1] = Member(*moments([one.weight / w, other.weight / w], pair), w)
        return merged

    # Landmarks, given the sampled pose: Eq. (11)

    def correct(self, pose, members, distance, bearing):
        if len(members) == 1:
            return [self.corrected(pose, members[0], distance, bearing)]
        if math.isnan(distance):
            return self.correct_ray(pose, members, bearing)
        ranged, best = self.rays.range_update, members[heaviest(members)]
        offset = best.mean - pose[:2]
        at = pose[:2] + distance * offset / np.linalg.norm(offset)
        if ranged == "anew":
            return [self.placed(pose, distance, bearing)]
        if ranged == "bearing":
            return self.correct_ray(pose, members, bearing)
        moved = [Member(at, m.covariance, m.weight) if m is best else m for m in members]
        return self.correct_ray(pose, moved, bearing)

    def corrected(self, pose, member, distance, bearing, inflation=1.0):
        if self.too_near(pose, member):
            return member
        nu, _, H, R = self.innovation(pose, member, distance, bearing, inflation)
        S = H @ member.covariance @ H.T + R
        return Member(*kalman(member.mean, member.covariance, nu, H, S), member.weight)

    def correct_ray(self, pose, members, bearing):
        """Weigh all hypotheses, update each with a share of the bearing or all of it, and prune."""
        logs = self.log_lambdas(Particle(pose, np.zeros((3, 3))), members, bearing)
        shares = self.shares(members, logs)
        if self.settings.mixture == "exact":
            shares = [1] * len(members)
        weights = self.aggregated(members, logs)
        ray = []
        for member, weight, share in zip(members, weights, shares, strict=True):
            if share > 0:
                member = self.corrected(pose, member, math.nan, bearing, 1 / share)
            ray.append(Member(member.mean, member.covariance, weight))
        return self.prune(ray)

    # Initialisation, Eqs. (16) and (17)

    def placed(self, pose, distance, bearing, range_variance=None):
        """Return a landmark at a range and bearing from a known pose."""
        variance = self.range_variance if range_variance is None else range_variance
        c, s = math.cos(pose[2] + bearing), math.sin(pose[2] + bearing)
        Gz = np.array([[c, -distance * s], [s, distance * c]])
        R = np.diag([variance, self.bearing_variance])
        return Member(pose[:2] + distance * np.array([c, s]), Gz @ R @ Gz.T)

    def ray(self, pose, bearing):
        ranges = ray_ranges(self.rays)
        members = [self.placed(pose, s, bearing, (self.rays.relative_std * s) ** 2) for s in ranges]
        for member in members:
            member.weight = 1 / len(ranges)
        return members

    # Resampling, Eq. (15)

    def resample(self, uniform):
        """Stratified resampling: a point in each of as many equal strata as there are particles."""
        weights, count = self.weights, len(self.particles)
        if 1 / sum(weights**2) >= self.settings.resample_below * count:
            return
        chosen = []
        for i, u in enumerate(uniform):
            reached, ancestor = weights[0], 0
            while reached <= (i + u) / count and ancestor < count - 1:
                ancestor += 1
                reached += weights[ancestor]
            chosen.append(copy.deepcopy(self.particles[ancestor]))
        for p in chosen:
            p.log_weight = -math.log(count)
            for members in p.map.values() if self.settings.resampled_rays == "restart" else ():
                for member in members:
                    member.weight = 1 / len(members)
        self.particles = chosen
        self.resampled += 1


def moments(weights, gaussians):
    """Mean and covariance of a mixture."""
    mean = sum(w * m for w, (m, _) in zip(weights, gaussians, strict=True))
    covariance = sum(
        w * (P + np.outer(m - mean, m - mean)) for w, (m, P) in zip(weights, gaussians, strict=True)
    )
    return mean, covariance
