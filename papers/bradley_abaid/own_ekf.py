"""EKF-SLAM with rays in plain NumPy, from the paper's equations, so that details can be changed.

With no detail changed it is `pipistrelle.estimation.ekf` (a test compares them). It reads a range
for a ray as ``rays.range_update = "bearing"`` does: unused until bearings have placed the landmark.
"""

import math
from dataclasses import dataclass

import numpy as np

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Landmarks
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.rays import SMALLEST_SHARE, ray_members
from pipistrelle.geometry import wrap


def _log_normal(nu: np.ndarray, S: np.ndarray) -> np.ndarray:
    return -0.5 * (nu * nu / S + np.log(2.0 * np.pi * S))


def _log_sum(logs: np.ndarray) -> float:
    return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))


@dataclass
class OwnEkf:
    """The filter with its state, which changes in place, for `own_tracks.follow`."""

    config: Config
    motion: Motion
    batch: bool = False
    """Whether all measurements of a scan are one update with one linearisation and one gain (each
    hypothesis of a ray with R / share), instead of one after the other."""
    normalised: bool = True
    """Whether the aggregated likelihoods of a ray are normalised after each bearing."""
    carried: bool = False
    """Whether each hypothesis has a correspondence, measured with a standard deviation of 1."""

    def start(self, mean: np.ndarray, covariance: np.ndarray, rng: object) -> None:
        """Begin at a pose without landmarks."""
        self.X, self.P = np.array(mean), np.array(covariance)
        self.label, self.log_weight, self.c = np.empty(0, np.int64), np.empty(0), np.empty(0)
        self.ranges, self.stds = ray_members(self.config.rays)
        filtering = self.config.filter
        self.R = np.array([filtering.range_std**2, filtering.bearing_std**2])

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of the pose."""
        return self.X[:3].copy(), self.P[:3, :3].copy()

    def landmarks(self) -> Landmarks:
        """Return the map."""
        n, at = len(self.label), np.arange(len(self.label))
        blocks = self.P[3:, 3:].reshape(n, 2, n, 2)[at, :, at, :]
        return Landmarks(
            landmark=self.label, mean=self.X[3:].reshape(n, 2), covariance=blocks,
            weight=np.exp(self.log_weight),
        )  # fmt: skip

    def move(self, control: np.ndarray, dt: float) -> None:
        """Predict through a control step of a bicycle (Eqs. 5 and 10)."""
        v, g = control
        c, s = math.cos(self.X[2] + g), math.sin(self.X[2] + g)
        along = v * dt / self.motion.wheelbase
        F = np.array([[1.0, 0.0, -v * dt * s], [0.0, 1.0, v * dt * c], [0.0, 0.0, 1.0]])
        U = np.array([[dt * c, -v * dt * s], [dt * s, v * dt * c], [0.0, along * math.cos(g)]])
        U[2, 0] = dt / self.motion.wheelbase * math.sin(g)
        self.X[:3] += v * dt * c, v * dt * s, along * math.sin(g)
        self.X[2] = wrap(self.X[2])
        self.P[:3] = F @ self.P[:3]
        self.P[:, :3] = self.P[:, :3] @ F.T
        self.P[:3, :3] += U @ np.diag(np.square(self.motion.control_std)) @ U.T

    def hear(self, scan: Scan) -> None:
        """Update by the measurements of known landmarks, then add the new ones."""
        rows = list(zip(scan.landmark.tolist(), scan.range, scan.bearing, strict=True))
        known = set(self.label.tolist())
        old = [row for row in rows if row[0] in known]
        if self.batch:
            self._at_once(old)
        else:
            for row in old:
                self._one(*row)
        for label, distance, bearing in rows:
            if label not in known:
                self._place(label, distance, bearing)
        self.X[2] = wrap(self.X[2])

    def _rows(
        self, member: int, distance: float, bearing: float, share: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return innovations, their Jacobian by pose and hypothesis (.., 5), and variances."""
        dx, dy = self.X[3 + 2 * member : 5 + 2 * member] - self.X[:2]
        d = max(math.hypot(dx, dy), NEAREST)
        c, s = dx / d, dy / d
        nu = np.array([distance - d, wrap(bearing - math.atan2(dy, dx) + self.X[2])])
        H = np.array([[-c, -s, 0.0, c, s], [s / d, -c / d, -1.0, -s / d, c / d]])
        first = int(math.isnan(distance))
        return nu[first:], H[first:], self.R[first:] / share

    @staticmethod
    def _columns(member: int) -> list[int]:
        return [0, 1, 2, 3 + 2 * member, 4 + 2 * member]

    def _correct(self, member: int, distance: float, bearing: float, share: float = 1.0) -> None:
        """Update the state by one measurement of a hypothesis (Eq. 11)."""
        nu, H, variance = self._rows(member, distance, bearing, share)
        columns = self._columns(member)
        W = self.P[:, columns] @ H.T
        S = H @ W[columns] + np.diag(variance)
        K = W @ np.linalg.inv(S)
        self.X += K @ nu
        self.P -= K @ W.T

    def _shares(self, members: np.ndarray, bearing: float) -> tuple[np.ndarray, np.ndarray]:
        """Return log likelihoods of a ray's hypotheses, and the bearing's shares (Eq. 19)."""
        logs = np.empty(len(members))
        for i, member in enumerate(members):
            nu, H, variance = self._rows(member, math.nan, bearing)
            columns = self._columns(member)
            S = H @ self.P[np.ix_(columns, columns)] @ H.T + variance
            logs[i] = _log_normal(nu, S[0])[0]
        if self.carried:
            logs += _log_normal(np.zeros(len(members)), self.c[members] + 1.0)
        share = np.exp(self.config.rays.exponent * (logs - logs.max()))
        share /= share.sum()
        return logs, np.where(share >= SMALLEST_SHARE, share, 0.0)

    def _one(self, label: int, distance: float, bearing: float) -> None:
        """Update by one measurement of a known landmark."""
        members = np.flatnonzero(self.label == label)
        if len(members) == 1:
            self._correct(members[0], distance, bearing)
            return
        logs, share = self._shares(members, bearing)
        for member, part in zip(members, share, strict=True):
            if part > 0.0:
                self._correct(member, math.nan, bearing, part)
        self._prune(members, logs, share)

    def _at_once(self, rows: list[tuple[int, float, float]]) -> None:
        """Update by all measurements of known landmarks with one linearisation and one gain."""
        parts, rays = [], []
        for label, distance, bearing in rows:
            members = np.flatnonzero(self.label == label)
            if len(members) == 1:
                parts.append((members[0], *self._rows(members[0], distance, bearing)))
                continue
            logs, share = self._shares(members, bearing)
            rays.append((label, logs, share))
            for member, part in zip(members, share, strict=True):
                if part > 0.0:
                    parts.append((member, *self._rows(member, math.nan, bearing, part)))
        if not parts:
            return
        nu, variance = (np.concatenate([part[i] for part in parts]) for i in (1, 3))
        H, row = np.zeros((len(nu), len(self.X))), 0
        for member, _, slopes, _ in parts:
            H[row : row + len(slopes), self._columns(member)] = slopes
            row += len(slopes)
        W = self.P @ H.T
        K = np.linalg.solve(H @ W + np.diag(variance), W.T).T
        self.X += K @ nu
        self.P -= K @ W.T
        self.P = 0.5 * (self.P + self.P.T)
        for label, logs, share in rays:
            self._prune(np.flatnonzero(self.label == label), logs, share)

    def _prune(self, members: np.ndarray, logs: np.ndarray, share: np.ndarray) -> None:
        """Multiply the aggregated likelihoods, and remove the small ones (Eq. 21)."""
        weight = self.log_weight[members] + logs
        self.c[members] /= 1.0 + share * self.c[members]
        if self.normalised:
            weight -= _log_sum(weight)
        keep = weight >= math.log(self.config.rays.prune_threshold / len(members))
        keep[weight.argmax()] = True
        if self.normalised:
            weight -= _log_sum(weight[keep])
        self.log_weight[members] = weight
        if keep.sum() == 1:
            self.log_weight[members] = 0.0
        if not keep.all():
            left = np.setdiff1d(np.arange(len(self.label)), members[~keep])
            at = np.concatenate([[0, 1, 2], (3 + 2 * left[:, np.newaxis] + [0, 1]).ravel()])
            self.X, self.P = self.X[at], self.P[np.ix_(at, at)]
            self.label, self.log_weight, self.c = (
                part[left] for part in (self.label, self.log_weight, self.c)
            )

    def _place(self, label: int, distance: float, bearing: float) -> None:
        """Add a landmark at a range and bearing, or a ray (Eqs. 16 to 18)."""
        single = not math.isnan(distance)
        ranges = [distance] if single else self.ranges
        variances = [self.R[0]] if single else self.stds**2
        for far, along in zip(ranges, variances, strict=True):
            c, s = math.cos(self.X[2] + bearing), math.sin(self.X[2] + bearing)
            G = np.array([[1.0, 0.0, -far * s], [0.0, 1.0, far * c]])
            Z = np.array([[c, -far * s], [s, far * c]])
            cross = G @ self.P[:3]
            own = G @ self.P[:3, :3] @ G.T + Z @ np.diag([along, self.R[1]]) @ Z.T
            self.P = np.block([[self.P, cross.T], [cross, own]])
            self.X = np.append(self.X, (self.X[0] + far * c, self.X[1] + far * s))
        count = len(ranges)
        self.label = np.append(self.label, np.full(count, label))
        self.log_weight = np.append(self.log_weight, np.full(count, -math.log(count)))
        self.c = np.append(self.c, np.ones(count))
