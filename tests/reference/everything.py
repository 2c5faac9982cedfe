"""Maximum-likelihood path, control noise and map of a whole drive, slowly, with numpy only.

The unknowns are the start, the noise of every control step in standard deviations, a slack at the
end of each segment (between scans), and the landmarks. A segment's poses are linear in its noise
about the nominal controls; its end and the start use the exponential of SE(2). Dense
Levenberg-Marquardt steps until convergence.
"""

import numpy as np

from pipistrelle.geometry import wrap
from reference.ekf_slam import moved

SLACK, BELIEVED = 1e-6, 2.0


class Everything:
    """A drive in segments with the measurements at their ends, and its optimum.

    `legs` are pairs of controls (k, 2) and durations (k). `rows` are tuples of the number of the
    segment that ends with the measurement (0: the start), label, bearing, range or NaN, and their
    standard deviations. `priors` are the position of each landmark and its standard deviation.
    `excess_paths` are tuples of the number of the segment, the labels of landmark and caller, the
    excess path and its standard deviation.
    """

    def __init__(self, motion, start, legs, rows, priors, *, excess_paths=(), robust=False):
        self.start, self.robust, self.labels = start, robust, list(priors)
        self.rows = [row for row in rows if row[1] in priors]
        self.excess_paths = [one for one in excess_paths if one[1] in priors and one[2] in priors]
        both = [priors[label] for label in self.labels]
        self.priors = np.array([place for place, _ in both]).reshape(-1, 2)
        self.widths = np.repeat([std for _, std in both], 2)
        self.legs, column = [], 3
        for controls, dt in legs:
            columns = slice(column, column + 2 * len(dt) + 3)
            self.legs.append((*relative_poses(motion, controls, dt), columns))
            column = columns.stop
        self.first, self.size = column, column + self.priors.size

    def begun(self, places):
        """Return the unknowns of a noise-free drive among landmarks at given positions."""
        x = np.zeros(self.size)
        x[self.first :] = np.ravel([places[one] for one in self.labels])
        return x

    def poses(self, x):
        """Return start and poses of all steps, their derivatives, and indices of segment ends."""
        pose, own = shaken(self.start.mean, x[:3])
        mean, slope, ends = [pose], [own @ np.eye(3, self.size)], [0]
        for relative, by_noise, columns in self.legs:
            a, by_a, turn = mean[ends[-1]], slope[ends[-1]], turned(mean[ends[-1]][2])
            for j, (nominal, by_own) in enumerate(zip(relative, by_noise, strict=True)):
                pose, own = nominal + by_own @ x[columns], by_own
                if j + 1 == len(relative):
                    pose, own = shaken(nominal, by_own @ x[columns], by_own)
                ahead, J = turn @ pose, by_a.copy()
                J[0] -= ahead[1] * by_a[2]
                J[1] += ahead[0] * by_a[2]
                J[:, columns] += turn @ own
                mean.append(a + ahead)
                slope.append(J)
            ends.append(len(mean) - 1)
        return np.array(mean), np.array(slope), ends

    def misfits(self, x):
        """Yield the residuals in standard deviations with their derivatives, part by part."""
        root = np.linalg.inv(np.linalg.cholesky(self.start.covariance + SLACK**2 * np.eye(3)))
        yield root @ x[:3], root @ np.eye(3, self.size)
        yield x[3 : self.first], np.eye(self.size)[3 : self.first]
        far = x[self.first :] - self.priors.ravel()
        yield far / self.widths, np.eye(self.size)[self.first :] / self.widths[:, None]
        mean, slope, ends = self.poses(x)
        for leg, label, bearing, distance, across, along in self.rows:
            pose, by_pose = mean[ends[leg]], slope[ends[leg]]
            i = self.first + 2 * self.labels.index(label)
            (dx, dy), D = x[i : i + 2] - pose[:2], -by_pose[:2]
            D[:, i : i + 2] += np.eye(2)
            d = np.hypot(dx, dy)
            r = [wrap(np.arctan2(dy, dx) - pose[2] - bearing) / across]
            J = [(np.array([-dy, dx]) / d**2 @ D - by_pose[2]) / across]
            if not np.isnan(distance):
                r.append((d - distance) / along)
                J.append(np.array([dx, dy]) / d @ D / along)
            less = np.sqrt(min(1.0, BELIEVED / np.linalg.norm(r))) if self.robust else 1.0
            yield less * np.array(r), less * np.array(J)
        for leg, label, caller, excess_path, along in self.excess_paths:
            pose, by_pose = mean[ends[leg]][:2], slope[ends[leg]][:2]
            places = [self.first + 2 * self.labels.index(one) for one in (label, caller)]
            (point, D), (call, E) = [(x[i : i + 2], np.eye(2, self.size, i)) for i in places]
            over, by_over = length(call - point, E - D)
            back, by_back = length(point - pose, D - by_pose)
            straight, by_straight = length(call - pose, E - by_pose)
            r = np.array([over + back - straight - excess_path]) / along
            J = (by_over + by_back - by_straight)[None] / along
            less = np.sqrt(min(1.0, BELIEVED / np.linalg.norm(r))) if self.robust else 1.0
            yield less * r, less * J

    def stacked(self, x):
        """Return all residuals with their derivatives, and the total cost."""
        parts = list(self.misfits(x))
        lost = [huber(r) if self.robust and i > 2 else r @ r for i, (r, _) in enumerate(parts)]
        return (*map(np.concatenate, zip(*parts, strict=True)), sum(lost))

    def solved(self, x):
        """Return the optimum that is reached from x."""
        damping, (r, J, lost) = 1e-4, self.stacked(x)
        for _ in range(200):
            step = np.linalg.solve(J.T @ J + damping * np.eye(self.size), -J.T @ r)
            tried = self.stacked(x + step)
            if tried[2] <= lost * (1.0 + 1e-12):
                less, x = lost - tried[2], x + step
                (r, J, lost), damping = tried, damping * 0.01
                if less < 1e-12 * (lost + 1e-6):
                    break
            else:
                damping *= 100.0
        return x

    def told(self, x):
        """Return means and covariances of each pose and each landmark at x."""
        _, J, _ = self.stacked(x)
        C = np.linalg.inv(J.T @ J)
        mean, slope, _ = self.poses(x)
        mean[:, 2] = wrap(mean[:, 2])
        of_map = C[self.first :, self.first :].reshape(len(self.labels), 2, -1, 2)
        own = np.arange(len(self.labels))
        places = x[self.first :].reshape(-1, 2)
        return mean, slope @ C @ np.swapaxes(slope, 1, 2), places, of_map[own, :, own]


def huber(r):
    """Return twice the Huber loss of a part with weighted residuals."""
    size = np.linalg.norm(r)  # r = sqrt(BELIEVED / n) times a residual of n deviations
    return size**2 if size <= BELIEVED else 2.0 * size**2 - BELIEVED**2


def length(way, slope):
    """Return the length of a vector, and its derivative."""
    far = np.hypot(*way)
    return far, way / far @ slope


def turned(heading):
    """Return the rotation matrix of a heading for poses."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def shaken(pose, by, slope=None):
    """Return a pose moved by the exponential of a twist in the world's axes, and its derivative."""
    back, h = turned(pose[2]), 1e-6

    def moved_by(twist):
        x, y, turn = back.T @ twist
        along = np.sinc(turn / np.pi)
        across = 0.5 * turn * np.sinc(0.5 * turn / np.pi) ** 2  # (1 - cos) / turn
        return pose + back @ [along * x - across * y, across * x + along * y, turn]

    axes = h * np.eye(3)
    J = np.array([(moved_by(by + one) - moved_by(by - one)) / (2.0 * h) for one in axes]).T
    return moved_by(by), J if slope is None else J @ slope


def relative_poses(motion, controls, dt):
    """Return the poses of a segment in the axes of its start, with derivatives by its noise."""
    pose, slope, poses, slopes = np.zeros(3), np.zeros((3, 2 * len(dt) + 3)), [], []
    for k, (control, step) in enumerate(zip(controls, dt, strict=True)):
        pose, F, U = moved(motion, pose, control, step)
        still = not motion.noise_at_rest and not np.any(control)
        slope = F @ slope
        slope[:, 2 * k : 2 * k + 2] = U * motion.control_std * (not still)
        poses.append(pose)
        slopes.append(slope)
    slopes[-1] = slopes[-1] + np.eye(3, slope.shape[1], slope.shape[1] - 3) * SLACK
    return np.array(poses), np.array(slopes)
