"""Right-invariant EKF-SLAM, slowly: every step over the whole state, the group by its matrices.

The error is the right-invariant error of Zhang et al. (2017): rotation, position and landmarks are
a matrix of SE_n(2), the truth is exp(xi) times the estimate. Rays and bookkeeping are inherited
from the slow EKF.
"""

import numpy as np
from scipy.linalg import expm

from reference.ekf_slam import SlowEkfSlam, moved, noise_of

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


class SlowInvariantEkfSlam(SlowEkfSlam):
    """Right-invariant EKF about the origin of the world; P is the covariance of xi."""

    turns = 0.0

    def points(self):
        """Indices of the positions in the state: the vehicle's, then each hypothesis's."""
        return [slice(0, 2), *(self.at(block) for block in self.all_members())]

    def start(self, mean, covariance):
        SlowEkfSlam.start(self, mean, covariance)
        self.P = self.change() @ self.P @ self.change().T
        return self

    def change(self):
        """Jacobian of xi by the linear error: each position minus its rotation by the heading."""
        T = np.eye(self.X.size)
        for point in self.points():
            T[point, 2] -= QUARTER @ self.X[point]
        return T

    def linear(self):
        """Covariance of the linear error."""
        back = np.linalg.inv(self.change())
        return back @ self.P @ back.T

    def predict(self, controls, dt):
        means, covariances = [], []
        for control, step in zip(controls, dt, strict=True):
            self.X[:3], _, U = moved(self.motion, self.X[:3], control, step)
            Q = noise_of(self.motion, control)
            by_noise = np.zeros((self.X.size, len(Q)))
            by_noise[:3] = U
            by_noise = self.change() @ by_noise
            self.P = self.P + by_noise @ Q @ by_noise.T
            means.append(self.X[:3].copy())
            covariances.append(self.linear()[:3, :3])
        return np.array(means), np.array(covariances)

    def predicted(self, block):
        """Range and bearing without a Jacobian by heading, as the point turns with the vehicle."""
        d, bearing, H = SlowEkfSlam.predicted(self, block)
        H[:, 2] = 0.0
        return d, bearing, H

    def correct(self, block, nu, H, R, inflation=1.0):
        """Update the estimate by the exponential of K nu, all positions by a single matrix."""
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        xi, points = K @ nu, self.points()
        tangent = np.zeros((2 + len(points), 2 + len(points)))
        tangent[:2, :2] = QUARTER * xi[2]
        tangent[:2, 2:] = np.column_stack([xi[point] for point in points])
        group = np.eye(2 + len(points))
        group[:2, 2:] = np.column_stack([self.X[point] for point in points])
        group = expm(tangent) @ group
        for i, point in enumerate(points):
            self.X[point] = group[:2, 2 + i]
        self.X[2] += xi[2]
        self.P = self.P - K @ S @ K.T
        self.P = (self.P + self.P.T) / 2

    def point(self, distance, bearing):
        """Position at a range and bearing, shifted by vehicle and noise but never turned."""
        at, G, by_measurement = SlowEkfSlam.point(self, distance, bearing)
        G[:, 2] = 0.0
        return at, G, by_measurement
