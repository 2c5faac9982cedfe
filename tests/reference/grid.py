"""Exact posterior of a short drive past a landmark, by numerical integration.

All unknowns are standard normal: the landmark's range and bearing from the known start, and the
noise of each control. Their posterior is integrated on a lattice along its principal axes: for a
smooth density a spacing of a standard deviation is accurate to 1e-8.
"""

import math

import numpy as np

HALF_WIDTH = 5


def drive(start, controls, dt, stds, wheelbase, noise):
    """Poses (k + 1, 3, n) of a bicycle for noises (2k, n), Eq. (5)."""
    x, y, heading = (np.full(noise.shape[1], value) for value in start)
    poses = [np.stack([x, y, heading])]
    for k, (speed, steering) in enumerate(controls):
        v, g = speed + stds[0] * noise[2 * k], steering + stds[1] * noise[2 * k + 1]
        x, y = x + v * dt * np.cos(heading + g), y + v * dt * np.sin(heading + g)
        heading = heading + v * dt / wheelbase * np.sin(g)
        poses.append(np.stack([x, y, heading]))
    return np.array(poses)


class Posterior:
    """Moments of the last pose and the landmark given rows (range or NaN, bearing) per pose.

    The first row initialises the landmark: at its range, or at several ranges (mean, std) in turn.
    """

    def __init__(self, start, controls, dt, stds, wheelbase, rows, range_std, bearing_std):
        self.drive = (start, controls, dt, stds, wheelbase)
        self.rows, self.range_std, self.bearing_std = rows, range_std, bearing_std
        self.unknown = 2 + 2 * len(controls)

    def state(self, u, placed):
        """Last pose and landmark (5, n), and residuals of the later rows in standard deviations."""
        poses = drive(*self.drive, u[2:])
        distance = placed[0] + placed[1] * u[0]
        direction = poses[0, 2] + self.rows[0][1] + self.bearing_std * u[1]
        point = poses[0, :2] + distance * np.stack([np.cos(direction), np.sin(direction)])
        residuals = []
        for pose, (distance, bearing) in zip(poses[1:], self.rows[1:], strict=True):
            dx, dy = point - pose[:2]
            residuals.append((bearing - np.arctan2(dy, dx) + pose[2]) / self.bearing_std)
            if not math.isnan(distance):
                residuals.append((distance - np.hypot(dx, dy)) / self.range_std)
        return np.concatenate([poses[-1], point]), np.array(residuals)

    def objective(self, u, placed):
        """Stacked residuals of prior and measurements, for least squares."""
        return np.concatenate([u, self.state(u, placed)[1]])

    def centre(self, placed):
        """The most probable noises, and the principal axes of the posterior there."""
        u, units = np.zeros((self.unknown, 1)), 1e-6 * np.eye(self.unknown)
        for _ in range(20):
            J = self.objective(u + units, placed) - self.objective(u - units, placed)
            J = J / 2e-6
            u = u - np.linalg.solve(J.T @ J, J.T @ self.objective(u, placed))
        return u, np.linalg.inv(np.linalg.cholesky(J.T @ J)).T

    def one(self, placed):
        """Evidence, mean (5) and second moment (5, 5) for a single initial range."""
        centre, axes = self.centre(placed)
        nodes = np.arange(-HALF_WIDTH, HALF_WIDTH + 1.0)
        inner = np.array(np.meshgrid(*[nodes] * (self.unknown - 1))).reshape(self.unknown - 1, -1)
        total, mean, second = 0.0, np.zeros(5), np.zeros((5, 5))
        for node in nodes:
            lattice = np.vstack([np.full((1, inner.shape[1]), node), inner])
            u = centre + axes @ lattice
            state, residuals = self.state(u, placed)
            density = np.exp(-((u**2).sum(axis=0) + (residuals**2).sum(axis=0)) / 2)
            total += density.sum()
            mean += state @ density
            second += (state * density) @ state.T
        volume = abs(np.linalg.det(axes))
        return volume * total, volume * mean, volume * second

    def moments(self, placings=None):
        """Mean (5), covariance (5, 5) and probability of each initial range, equal beforehand."""
        placings = placings or [(self.rows[0][0], self.range_std)]
        parts = [self.one(placed) for placed in placings]
        total = sum(part[0] for part in parts)
        mean = sum(part[1] for part in parts) / total
        covariance = sum(part[2] for part in parts) / total - np.outer(mean, mean)
        return mean, covariance, np.array([part[0] for part in parts]) / total
