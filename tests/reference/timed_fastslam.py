"""FastSLAM with excess paths, slowly: the joint Gaussian of a caller and all that it lights up.

Nothing here knows that landmarks are independent given their caller: each particle keeps the
covariances of all of them, in one matrix, and corrects them all by every measurement.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from pipistrelle.detection.scans import rows_of
from reference.ekf_slam import NEAREST, wrapped
from reference.fastslam import (
    Member,
    Particle,
    SlowFastSlam,
    kalman,
    log_density,
    semidefinite_cholesky,
)

SURE = 0.2
SOME = 3.0


@dataclass
class Tied(Particle):
    cross: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


class SlowTimedFastSlam(SlowFastSlam):
    """The filter for scans with excess paths, none of which weighs or refines a pose."""

    def __init__(self, *args, excess_path_std, **options):
        super().__init__(*args, **options)
        self.excess_path_variance, self.hub = excess_path_std**2, {}

    def start(self, mean, covariance):
        super().start(mean, covariance)
        self.particles = [Tied(p.pose, p.P) for p in self.particles]
        return self

    # What is tied to whom

    def said_of(self, scan):
        """Landmark, caller and excess path, where the caller is known by its label."""
        callers = scan.callers.tolist()
        rows = zip(
            scan.landmark.tolist(), scan.caller.tolist(), scan.excess_path.tolist(), strict=True
        )
        named = [
            (label, callers[whose] if whose < len(callers) else -1, excess_path)
            for label, whose, excess_path in rows
            if not math.isnan(excess_path)
        ]
        return [row for row in named if row[1] not in (-1, row[0])]

    def tie(self, scan, said):
        """Tie landmarks to callers; excess paths of each landmark by its own, by label."""
        seen, callers = {*self.particles[0].map, *scan.landmark.tolist()}, scan.callers.tolist()
        for label, caller, _ in said:
            free = label in seen and label not in callers and label not in self.hub
            if free and 2 * self.knowing(caller) > len(self.particles):
                self.hub[label] = caller
        return {
            label: excess_path
            for label, caller, excess_path in said
            if self.hub.get(label) == caller
        }

    def knowing(self, label):
        """How many particles know a landmark as one place."""
        return sum(len(p.map.get(label, [])) == 1 for p in self.particles)

    def joined(self, p, label):
        """Whether a particle knows a landmark and its caller as one place each."""
        hub = self.hub.get(label)
        return hub is not None and len(p.map[label]) == 1 and len(p.map.get(hub, [])) == 1

    def whole(self, p, hub):
        """Labels, mean and covariance of a caller and all that is tied to it."""
        labels = [hub] + [
            label
            for label in p.map
            if label != hub and self.hub.get(label) == hub and self.joined(p, label)
        ]
        P = np.zeros((2 * len(labels), 2 * len(labels)))
        for i, one in enumerate(labels):
            for j, other in enumerate(labels):
                block = p.cross.get((one, other), np.zeros((2, 2)))
                P[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = (
                    p.map[one][0].covariance if i == j else block
                )
        return labels, np.concatenate([p.map[label][0].mean for label in labels]), P

    def put_back(self, p, labels, mean, P):
        for i, one in enumerate(labels):
            rows = slice(2 * i, 2 * i + 2)
            p.map[one] = [Member(mean[rows], P[rows, rows])]
            for j, other in enumerate(labels):
                if i != j:
                    p.cross[one, other] = P[rows, 2 * j : 2 * j + 2]

    def sure(self, p, hub):
        if len(p.map.get(hub, [])) != 1:
            return False
        caller = p.map[hub][0]
        way = np.linalg.norm(caller.mean - p.pose[:2])
        return math.sqrt(np.trace(caller.covariance)) <= SURE * way

    # All that was heard of a landmark

    def excess_path_rows(self, pose, landmark, caller, excess_path):
        """Innovation, Jacobians by pose, landmark and caller, and variance."""
        u, w, v = landmark - pose[:2], landmark - caller, caller - pose[:2]
        near, onward, straight = (np.linalg.norm(way) for way in (u, w, v))
        u, w, v = u / near, w / onward, v / straight
        nu = excess_path - (onward + near - straight)
        return nu, np.append(v - u, 0), u + w, -w - v, self.excess_path_variance

    def taken(self, p, label, distance, bearing, excess_path):
        """Correct the whole by a landmark's numbers one by one, by a caller's own together."""
        hub = self.hub.get(label, label)
        numbers = [(math.nan, bearing), (distance, None)] if hub != label else [(distance, bearing)]
        for far, turned in numbers:
            if math.isnan(far) and turned is None:
                continue
            labels, mean, P = self.whole(p, hub)
            own = slice(2 * labels.index(label), 2 * labels.index(label) + 2)
            member = Member(mean[own], P[own, own])
            if self.too_near(p.pose, member):
                continue
            nu, _, Hm, R = self.innovation(p.pose, member, far, turned or 0.0)
            if turned is None:
                nu, Hm, R = nu[:1], Hm[:1], R[:1, :1]
            H = np.zeros((len(nu), len(mean)))
            H[:, own] = Hm
            self.put_back(p, labels, *kalman(mean, P, nu, H, H @ P @ H.T + R))
        if excess_path is not None and self.sure(p, hub):
            labels, mean, P = self.whole(p, hub)
            own, H = 2 * labels.index(label), np.zeros((1, len(mean)))
            nu, _, H[0, own : own + 2], H[0, :2], R = self.excess_path_rows(
                p.pose, mean[own : own + 2], mean[:2], excess_path
            )
            self.put_back(p, labels, *kalman(mean, P, np.array([nu]), H, H @ P @ H.T + R))

    # One frame

    def update(self, scan, rng):
        if not scan.landmark.size:
            return
        rows = list(zip(scan.landmark.tolist(), scan.range, scan.bearing, strict=True))
        inside = {row[0] for row in rows if not math.isnan(row[2]) and self.inside_any(*row)}
        kept = rows_of(scan, np.isnan(scan.bearing) | np.isin(scan.landmark, list(inside)))
        told = self.said_of(kept)
        said = [one for one in told if self.excess_path_inside_any(*one)]
        self.gated += len(told) - len(said)
        self.heard = self.tie(kept, said)
        super().update(rows_of(scan, ~np.isnan(scan.bearing)), rng)

    def excess_path_inside_any(self, label, caller, excess_path):
        """Whether a particle expected an excess path; one that cannot judge lets it in."""
        if self.gate == 1 or self.hub.get(label) != caller:
            return True
        for p in self.particles:
            if not self.joined(p, label) or not self.sure(p, caller):
                return True
            labels, mean, P = self.whole(p, caller)
            own, H = 2 * labels.index(label), np.zeros(len(mean))
            nu, by_pose, H[own : own + 2], H[:2], R = self.excess_path_rows(
                p.pose, mean[own : own + 2], mean[:2], excess_path
            )
            S = by_pose @ p.P @ by_pose + H @ P @ H + R
            if nu**2 <= chi2.ppf(self.gate, 1) * S:
                return True
        return False

    def one_frame(self, p, rows, draw):
        known = [row for row in rows if row[0] in p.map]
        prior = p.pose, p.P
        for label, distance, bearing in known:
            self.refine(p, p.map[label], distance, bearing)
        proposal = p.pose, p.P
        p.pose = p.pose + semidefinite_cholesky(p.P) @ draw
        p.pose[2] = wrapped(p.pose[2])
        p.P = np.zeros((3, 3))
        if self.settings.weights == "sampled":
            p.log_weight += log_density(p.pose, *prior) - log_density(p.pose, *proposal)
            p.log_weight += sum(self.log_weight_gain(p, p.map[row[0]], *row[1:]) for row in known)
        for label, distance, bearing in known:
            lights_up = label in self.hub.values() and len(p.map[label]) == 1
            if lights_up or self.joined(p, label):
                self.taken(p, label, distance, bearing, self.heard.get(label))
            else:
                p.map[label] = self.correct(p.pose, p.map[label], distance, bearing)
        for label, distance, bearing in rows:
            if label not in p.map:
                new = self.ray(p.pose, bearing)
                if not math.isnan(distance):
                    new = [self.placed(p.pose, distance, bearing)]
                p.map[label] = new
            heard = label in self.heard and len(p.map[label]) > 1
            if heard and self.sure(p, self.hub[label]):
                self.place_by_excess_path(p, label, bearing, self.heard[label])

    def place_by_excess_path(self, p, label, bearing, excess_path):
        """Place a ray's landmark, with all its covariances, where that is sure enough."""
        if excess_path <= SOME * math.sqrt(self.excess_path_variance):
            return
        hub = self.hub[label]
        caller, angle = p.map[hub][0], p.pose[2] + bearing
        u, v = np.array([math.cos(angle), math.sin(angle)]), caller.mean - p.pose[:2]
        r = crossing(v, angle, excess_path)
        dz = math.sqrt(self.bearing_variance), math.sqrt(self.excess_path_variance)
        tried = [crossing(v, angle + sign * dz[0], excess_path) for sign in (-1, 1)]
        tried += [crossing(v, angle, excess_path + sign * dz[1]) for sign in (-1, 1)]
        if r == 0 or any(abs(other - r) > SURE * r for other in tried):
            return
        across = r * np.array([-u[1], u[0]])
        _, _, by_landmark, by_caller, _ = self.excess_path_rows(
            p.pose, p.pose[:2] + r * u, caller.mean, excess_path
        )
        steep = by_landmark @ u
        if r <= NEAREST or steep <= NEAREST:
            return
        G = np.column_stack([u / steep, across - u * (by_landmark @ across) / steep])
        A = -np.outer(u, by_caller) / steep
        C = G @ np.diag([self.excess_path_variance, self.bearing_variance]) @ G.T
        P = C + A @ caller.covariance @ A.T
        if math.sqrt(u @ P @ u) > SURE * r:
            return
        labels, _, whole = self.whole(p, hub)
        for i, other in enumerate(labels):
            p.cross[label, other] = A @ whole[:2, 2 * i : 2 * i + 2]
            p.cross[other, label] = p.cross[label, other].T
        p.map[label] = [Member(p.pose[:2] + r * u, P)]


def crossing(v, angle, excess_path):
    """Range at which a ray crosses the ellipse about the vehicle and a caller at v; or 0."""
    d, along = np.linalg.norm(v), v @ [math.cos(angle), math.sin(angle)]
    if d + excess_path - along <= 0:
        return 0.0
    return max(0.0, ((d + excess_path) ** 2 - d**2) / 2 / (d + excess_path - along))
