"""Excess paths in the slow EKFs: Jacobians by differences, ranges by a search along the ray."""

import math

import numpy as np
from scipy.optimize import brentq

from reference.ekf_slam import BELIEVED, NEAREST, POSE, WAITS, SlowEkfSlam, normalised
from reference.invariant_ekf import QUARTER, SlowInvariantEkfSlam

SURE = 0.2
SOME = 3.0
FARTHER = 3.0
TINY = 1e-6
FARTHEST = 1e4


def excess_path(vehicle, landmark, caller):
    """Length of the path over a landmark, minus the direct path."""
    return math.dist(caller, landmark) + math.dist(landmark, vehicle) - math.dist(caller, vehicle)


def slopes(function, z):
    """Derivatives of a function of a vector, by central differences."""
    columns = []
    for i in range(len(z)):
        ahead, behind = z.copy(), z.copy()
        ahead[i] += TINY
        behind[i] -= TINY
        columns.append((np.asarray(function(ahead)) - np.asarray(function(behind))) / (2 * TINY))
    return np.array(columns).T


def range_on_ray(vehicle, direction, other, e, *, of_caller):
    """Range of the point on a ray with a given excess path, by search; NaN without such a point."""
    u = np.array([math.cos(direction), math.sin(direction)])

    def off(r):
        point = vehicle + r * u
        ends = (other, point) if of_caller else (point, other)
        return excess_path(vehicle, *ends) - e

    if off(NEAREST) * off(FARTHEST) >= 0:
        return math.nan
    return brentq(off, NEAREST, FARTHEST, xtol=1e-13, rtol=1e-14)


class Timed:
    """Excess paths, added to a slow EKF."""

    excess_path_variance = math.nan

    def update(self, scan):
        at = dict(zip(scan.caller.tolist(), [-1] * len(scan.caller), strict=True))
        at |= dict(enumerate(scan.callers.tolist()))
        heard = np.isfinite(scan.bearing)
        rows = list(
            zip(scan.landmark[heard].tolist(), scan.range[heard], scan.bearing[heard], strict=True)
        )
        self.timed = [
            (label, at[caller], e)
            for label, caller, e in zip(
                scan.landmark.tolist(), scan.caller.tolist(), scan.excess_path, strict=True
            )
            if np.isfinite(e) and at[caller] not in (-1, label)
        ]
        known = set(self.landmark.tolist())
        for label, distance, bearing in rows:
            if label in known and not self.placed_by_excess_path(label, distance, bearing):
                self.measure(label, distance, bearing)
        for label, distance, bearing in rows:
            if label not in known and not self.placed_by_excess_path(label, distance, bearing):
                self.initialise(label, distance, bearing)
        for told in self.timed:
            self.take(*told)
        self.X[2] = (self.X[2] + math.pi) % (2 * math.pi) - math.pi

    # Initialisation

    def placed_by_excess_path(self, label, distance, bearing):
        """Initialise a landmark by the excess path with the smallest relative range error."""
        members = self.members(label)
        if len(members) == 1 or not math.isnan(distance):
            return False
        found = [
            (*self.where(other, e, bearing, of_caller=caller == label), told)
            for told in self.timed
            for landmark, caller, e in [told]
            if label in (landmark, caller) and e > SOME * math.sqrt(self.excess_path_variance)
            for other in self.members(landmark if caller == label else caller)
            if len(self.members(other[1])) == 1
        ]
        found = [place for place in found if place[0] <= SURE]
        if not found:
            return False
        _, point, G, noise, told = min(found, key=lambda place: place[0])
        self.timed.remove(told)
        position = 1 + len(self.all_members())
        if members:
            first = self.blocks.index(members[0])
            kept = [self.at(block) for block in members]
            gone = np.concatenate([np.arange(part.start, part.stop) for part in kept])
            G, position = np.delete(G, gone, axis=1), first
            self.drop(members)
        block = ("member", label, 0)
        self.insert(position, block, point, G, noise)
        self.aggregated[block] = 1.0
        return True

    def deviation(self, z, pose, place, *, of_caller):
        """Standard deviation of the range over eight sigma points; infinite if one has none."""
        J = np.zeros((3, self.X.size))
        J[:2, place], J[:2, pose.start : pose.start + 2] = np.eye(2), -np.eye(2)
        J[2, pose.stop - 1] = self.turns
        across = self.bearing_variance * (FARTHER**2 if self.robust else 1.0)
        C = np.diag([0.0, 0.0, across, self.excess_path_variance])
        C[:3, :3] += J @ self.P @ J.T
        way = np.array([*(z[3:5] - z[:2]), z[2] + z[5], z[6]])

        def ranged(way):
            return range_on_ray(np.zeros(2), way[2], way[:2], way[3], of_caller=of_caller)

        steps = 2.0 * np.linalg.cholesky(C + 1e-18 * np.eye(4)).T
        off = np.array([ranged(way + side * step) for step in steps for side in (1, -1)])
        return math.sqrt(np.mean((off - ranged(way)) ** 2)) if np.isfinite(off).all() else math.inf

    def where(self, block, e, bearing, *, of_caller):
        """Relative standard deviation of the range, the point, its Jacobian by the state, noise."""
        pose, place = self.at(POSE), self.at(block)
        z = np.concatenate([self.X[pose], self.X[place], [bearing, e]])

        def ranged(z):
            return range_on_ray(z[:2], z[2] + z[5], z[3:5], z[6], of_caller=of_caller)

        def pointed(z):
            r, direction = ranged(z), z[2] + z[5]
            return z[:2] + r * np.array([math.cos(direction), math.sin(direction)])

        r = ranged(z)
        if not math.isfinite(r) or not np.isfinite(slopes(ranged, z)).all():
            return math.inf, None, None, None
        by_state, both = np.zeros((2, self.X.size)), slopes(pointed, z)
        by_state[:, pose], by_state[:, place], noise = both[:, :3], both[:, 3:5], both[:, 5:]
        point = pointed(z)
        if self.turns == 0.0:
            by_state = by_state @ np.linalg.inv(self.change())
            by_state[:, 2] -= QUARTER @ point
        return (
            self.deviation(z, pose, place, of_caller=of_caller) / r,
            point,
            by_state,
            noise @ np.diag([self.bearing_variance, self.excess_path_variance]) @ noise.T,
        )

    # Update and weights

    def take(self, label, caller, e):
        members, callers = self.members(label), self.members(caller)
        if len(members) == 1 and len(callers) == 1:
            nu, H, S = self.expected(members[0], callers[0], e)
            R = S - (H @ self.P @ H.T).item()
            if self.robust:
                R += S * max(abs(nu) / math.sqrt(S) / BELIEVED - 1.0, 0.0)
            S = R + (H @ self.P @ H.T).item()
            if self.outside(nu**2 / S, 1):
                self.gated += 1
            else:
                self.correct(members[0], np.array([nu]), H, np.array([[R]]))
        elif members and callers and 1 in (len(members), len(callers)):
            ray = members if len(callers) == 1 else callers
            if self.aggregated[ray[0]] != WAITS:
                pairs = [(m, b) for m in members for b in callers]
                self.weigh(ray, [self.expected(*pair, e) for pair in pairs])

    def weigh(self, ray, expected):
        """Multiply weights by likelihoods, and prune."""
        logs = [
            math.log(self.aggregated[block]) - nu**2 / S / 2 - math.log(S) / 2
            if self.aggregated[block] > 0
            else -math.inf
            for block, (nu, _, S) in zip(ray, expected, strict=True)
        ]
        self.aggregated.update(zip(ray, normalised(logs), strict=True))
        self.prune(ray[0][1])

    def expected(self, block, caller, e):
        """Innovation, Jacobian by the state, and variance, corrected for curvature."""
        where = [slice(0, 2), self.at(block), self.at(caller)]
        z = np.concatenate([self.X[part] for part in where])
        H = np.zeros((1, self.X.size))
        for i, part in enumerate(where):
            H[0, part] = slopes(lambda z: excess_path(z[:2], z[2:4], z[4:]), z)[2 * i : 2 * i + 2]
        near, onward, straight = (
            self.bend(a, b)
            for a, b in [(where[1], where[0]), (where[1], where[2]), (where[2], where[0])]
        )
        S = (
            (H @ self.P @ H.T).item()
            + self.excess_path_variance
            + (near + onward + straight) ** 2 / 2
        )
        nu = e - excess_path(z[:2], z[2:4], z[4:]) - (near + onward - straight) / 2
        return nu, H, S

    def bend(self, a, b):
        """Variance perpendicular to the path between two points, divided by its length."""
        way = self.X[a] - self.X[b]
        D = np.zeros((2, self.X.size))
        D[:, a], D[:, b] = np.eye(2), -np.eye(2)
        across = QUARTER @ way / np.linalg.norm(way)
        return across @ D @ self.P @ D.T @ across / np.linalg.norm(way)


class SlowTimedEkfSlam(Timed, SlowEkfSlam):
    pass


class SlowTimedInvariantEkfSlam(Timed, SlowInvariantEkfSlam):
    pass
