"""EKF-SLAM with rays of Gaussians, implemented slowly from the equations, for comparison.

Every Jacobian is a dense matrix over the whole state, every hypothesis of a ray is a named block,
and no code is shared with the package. Equation numbers are from Bradley & Abaid; the ray is from
Sola (2005). The state is the pose, then the hypotheses in the order of initialisation, then (only
with `carry_correspondence`) a correspondence per landmark.
"""

import math

import numpy as np
from scipy.stats import chi2

POSE = ("pose",)
NEAREST = 1e-3
LEAST_SHARE = 1e-12
LEAST_AGGREGATED = 0.05
CORRESPONDENCE_STD = 1.0
WAITS = -1.0
SURE = 0.2
PARALLAX = 0.48
BELIEVED = 2.0


def wrapped(angle):
    """Wrap an angle to [-pi, pi)."""
    angle = math.remainder(angle, 2 * math.pi)
    return -math.pi if angle == math.pi else angle


def moved(motion, pose, control, dt):
    """Pose after a step, and Jacobians F (3, 3) by the pose and U (3, n) by the noisy controls."""
    models = {"bicycle": bicycle, "unicycle": unicycle, "poses": poses, "ackermann": car}
    return models[motion.model](motion, pose, control, dt)


def noise_of(motion, control):
    """Covariance of the noise in a control step."""
    told = 3 if motion.model == "poses" else 2
    if not motion.noise_at_rest and all(number == 0 for number in control[:told]):
        return np.zeros((told, told))
    if len(control) > 3 and not math.isnan(control[3]):
        xx, xy, xh, yy, yh, hh = control[3:]
        return np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    return np.diag(np.square(motion.control_std))


def bicycle(motion, pose, control, dt):
    """Eq. (5): the front wheel at speed v, steered by g."""
    (x, y, th), (v, g), b = pose, control, motion.wheelbase
    c, s = math.cos(th + g), math.sin(th + g)
    after = [x + v * dt * c, y + v * dt * s, wrapped(th + v * dt / b * math.sin(g))]
    F = [[1, 0, -v * dt * s], [0, 1, v * dt * c], [0, 0, 1]]
    U = [
        [dt * c, -v * dt * s],
        [dt * s, v * dt * c],
        [dt / b * math.sin(g), v * dt / b * math.cos(g)],
    ]
    return np.array(after), np.array(F), np.array(U)


def unicycle(_, pose, control, dt):
    """Exact arc: the chord has length v dt sin(a)/a and direction th + a, with a = w dt / 2."""
    (x, y, th), (v, w) = pose, control
    a = w * dt / 2
    if abs(a) < 1e-4:
        sinc, slope = 1 - a**2 / 6, -a / 3
    else:
        sinc, slope = math.sin(a) / a, (math.cos(a) - math.sin(a) / a) / a
    c, s = math.cos(th + a), math.sin(th + a)
    after = [x + v * dt * sinc * c, y + v * dt * sinc * s, wrapped(th + w * dt)]
    F = [[1, 0, -v * dt * sinc * s], [0, 1, v * dt * sinc * c], [0, 0, 1]]
    by_rate = [v * dt * (slope * c - sinc * s) * dt / 2, v * dt * (slope * s + sinc * c) * dt / 2]
    U = [[dt * sinc * c, by_rate[0]], [dt * sinc * s, by_rate[1]], [0, dt]]
    return np.array(after), np.array(F), np.array(U)


def car(motion, pose, control, dt):
    """Unicycle of the centre of the rear axle, by the chain rule.

    The speed is measured h to the left of the centre, where it is lower by the turn rate times h.
    """
    (v, g), b, h = control, motion.wheelbase, motion.speed_offset
    bend = math.tan(g) / b
    middle = v / (1 - h * bend)
    after, F, by_middle = unicycle(motion, pose, (middle, middle * bend), dt)
    bend_by_g = 1 / (b * math.cos(g) ** 2)
    middle_by_g = v * h * bend_by_g / (1 - h * bend) ** 2
    inner = [[middle / v if v else 1 / (1 - h * bend), middle_by_g], [0, 0]]
    inner[1] = [inner[0][0] * bend, middle_by_g * bend + middle * bend_by_g]
    return after, F, by_middle @ np.array(inner)


def poses(_, pose, control, dt):
    """Relative motion in the axes of the previous pose: forward f, sideways g, and a turn."""
    (x, y, th), (f, g, turn) = pose, control[:3]
    c, s = math.cos(th), math.sin(th)
    after = [x + f * c - g * s, y + f * s + g * c, wrapped(th + turn)]
    F = [[1, 0, -f * s - g * c], [0, 1, f * c - g * s], [0, 0, 1]]
    U = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    return np.array(after), np.array(F), np.array(U)


def ray_ranges(rays):
    """Ranges of the hypotheses of a new ray, Eq. (17)."""
    alpha, beta, (near, far) = rays.relative_std, rays.range_ratio, rays.range_bounds
    count = 1 + math.ceil(math.log((1 - alpha) / (1 + alpha) * far / near, beta))
    ranges = [near / (1 - alpha)]
    while len(ranges) < count:
        ranges.append(beta * ranges[-1])
    return ranges


def normalised(logs):
    """Weights that sum to 1, from unnormalised logarithms."""
    weights = [math.exp(value - max(logs)) for value in logs]
    return [weight / sum(weights) for weight in weights]


def logarithm(weight):
    return math.log(weight) if weight > 0 else -math.inf


def crossing(z):
    """Crossing of p + r u and p0 + t (q - p0), for z = (p, heading, p0, q, bearing): x, y, r, t."""
    p, p0, q = z[:2], z[3:5], z[5:7]
    u = np.array([np.cos(z[2] + z[7]), np.sin(z[2] + z[7])])
    r, t = np.linalg.solve(np.column_stack([u, p0 - q]), p0 - p)
    return np.array([*(p + r * u), r, t])


class SlowEkfSlam:
    """EKF and belief in a single object that changes in place.

    `carry_correspondence` keeps each landmark's number in the state, as in Eq. (8);
    `common_bearing_noise` correlates the hypotheses of a new ray through their common bearing;
    `joseph` updates the covariance by Joseph's form; `robust` reduces the weight of measurements
    with large innovations, and `tempered` counts them.
    """

    turns = 1.0
    """Factor by which an error of heading turns a bearing."""

    def __init__(
        self,
        motion,
        range_std,
        bearing_std,
        rays,
        gate=1.0,
        *,
        carry_correspondence=False,
        common_bearing_noise=False,
        joseph=False,
        robust=False,
    ):
        self.motion, self.rays, self.gate = motion, rays, gate
        self.range_variance, self.bearing_variance = range_std**2, bearing_std**2
        self.carry_correspondence = carry_correspondence
        self.common_bearing_noise = common_bearing_noise
        self.joseph, self.robust, self.tempered = joseph, robust, 0

    def start(self, mean, covariance):
        self.blocks: list[tuple] = [POSE]
        self.aggregated, self.gated, self.innovations = {}, 0, np.zeros(2)
        self.X, self.P = np.array(mean, float), np.array(covariance, float)
        return self

    # The state as named blocks

    def at(self, block):
        """Return the indices of a block in the state."""
        sizes = {"pose": 3, "member": 2, "correspondence": 1}
        start = 0
        for other in self.blocks:
            if other == block:
                return slice(start, start + sizes[block[0]])
            start += sizes[other[0]]
        raise KeyError(block)

    def members(self, label):
        """Return the hypotheses of a landmark, near to far."""
        return [block for block in self.blocks if block[:2] == ("member", label)]

    def all_members(self):
        return [block for block in self.blocks if block[0] == "member"]

    @property
    def order(self):
        """Indices of pose and hypotheses, without correspondences."""
        kept = [POSE, *self.all_members()]
        return np.concatenate([np.arange(self.X.size)[self.at(block)] for block in kept])

    @property
    def mean(self):
        return self.X[self.order]

    @property
    def covariance(self):
        return self.P[np.ix_(self.order, self.order)]

    @property
    def landmark(self):
        return np.array([block[1] for block in self.all_members()], dtype=int)

    @property
    def weight(self):
        return np.array([self.aggregated[block] for block in self.all_members()])

    def linear(self):
        """Covariance of the linear error."""
        return self.covariance

    def drop(self, blocks):
        """Marginalise blocks out."""
        for block in blocks:
            gone = self.at(block)
            self.X = np.delete(self.X, gone)
            self.P = np.delete(np.delete(self.P, gone, axis=0), gone, axis=1)
            self.blocks.remove(block)
            self.aggregated.pop(block, None)

    def insert(self, position, block, value, G, noise):
        """Augment the state by a function of it with Jacobian G and independent noise."""
        before = sum(self.at(other).stop - self.at(other).start for other in self.blocks[:position])
        X = np.concatenate([self.X, value])
        P = np.block([[self.P, self.P @ G.T], [G @ self.P, G @ self.P @ G.T + noise]])
        old, new = np.arange(self.X.size), np.arange(self.X.size, X.size)
        order = np.concatenate([old[:before], new, old[before:]])
        self.X, self.P = X[order], P[np.ix_(order, order)]
        self.blocks.insert(position, block)

    # Prediction, Eqs. (5) and (10)

    def predict(self, controls, dt):
        """Predict with the nominal controls; return mean and covariance of the pose per step."""
        means, covariances = [], []
        for control, step in zip(controls, dt, strict=True):
            self.X[:3], F, U = moved(self.motion, self.X[:3], control, step)
            Q = noise_of(self.motion, control)
            P = self.P.copy()
            P[:3, :3] = F @ self.P[:3, :3] @ F.T + U @ Q @ U.T
            P[:3, 3:] = F @ self.P[:3, 3:]
            P[3:, :3] = P[:3, 3:].T
            self.P = P
            means.append(self.X[:3].copy())
            covariances.append(P[:3, :3].copy())
        return np.array(means), np.array(covariances)

    # Measurement, Eqs. (6), (7) and (11)

    def predicted(self, block):
        """Range and bearing of a hypothesis, and their Jacobian (2, n) by the whole state."""
        (x, y, th), (mx, my) = self.X[self.at(POSE)], self.X[self.at(block)]
        dx, dy = mx - x, my - y
        d = max(math.hypot(dx, dy), NEAREST)
        H = np.zeros((2, self.X.size))
        H[:, self.at(POSE)] = [[-dx / d, -dy / d, 0], [dy / d**2, -dx / d**2, -1]]
        H[:, self.at(block)] = [[dx / d, dy / d], [-dy / d**2, dx / d**2]]
        return d, wrapped(math.atan2(dy, dx) - th), H

    def too_near(self, block):
        return math.dist(self.X[:2], self.X[self.at(block)]) < NEAREST

    def innovation(self, block, distance, bearing, inflation=1.0):
        """Innovation, Jacobian and noise covariance; only of the bearing if the distance is NaN."""
        d, phi, H = self.predicted(block)
        nu = np.array([distance - d, wrapped(bearing - phi)])
        R = np.diag([self.range_variance, self.bearing_variance]) * inflation
        if math.isnan(distance):
            nu, H, R = nu[1:], H[1:], R[1:, 1:]
            if self.precise:
                bias, variance = self.curvature(block)
                nu, R = nu - bias, R + variance * inflation
        return nu, H, R

    @property
    def precise(self):
        """Return whether bearings are too precise for the width of the rays' hypotheses."""
        linear_to = self.rays.relative_std**2 / 2
        return self.rays.precise_bearings == "auto" and math.sqrt(self.bearing_variance) < linear_to

    def curvature(self, block):
        """Mean and variance of the bearing's second-order term: tr(M P) / 2, tr(M P M P) / 2."""
        dx, dy = self.X[self.at(block)] - self.X[:2]
        M = np.array([[2 * dx * dy, dy**2 - dx**2], [dy**2 - dx**2, -2 * dx * dy]])
        M = M / max(math.hypot(dx, dy), NEAREST) ** 4
        D = np.zeros((2, self.X.size))
        D[:, :2], D[:, self.at(block)] = -np.eye(2), np.eye(2)
        MP = M @ D @ self.P @ D.T
        return np.trace(MP) / 2, np.trace(MP @ MP) / 2

    def correct(self, block, nu, H, R, inflation=1.0):
        """Update the state, Eq. (11); a carried correspondence is measured without error."""
        if self.carry_correspondence:
            row = np.zeros((1, self.X.size))
            row[0, self.at(("correspondence", block[1]))] = 1
            error = block[1] - self.X[self.at(("correspondence", block[1]))]
            noise = np.array([[CORRESPONDENCE_STD**2 * inflation]])
            nu, H = np.concatenate([nu, error]), np.vstack([H, row])
            R = np.block([[R, np.zeros((len(R), 1))], [np.zeros((1, len(R))), noise]])
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.X = self.X + K @ nu
        if self.joseph:
            A = np.eye(self.X.size) - K @ H
            self.P = A @ self.P @ A.T + K @ R @ K.T
        else:
            self.P = self.P - K @ S @ K.T
            self.P = (self.P + self.P.T) / 2

    def distance_squared(self, nu, H, R):
        """Squared Mahalanobis distance of an innovation, and its covariance S."""
        S = H @ self.P @ H.T + R
        return float(nu @ np.linalg.solve(S, nu)), S

    def outside(self, squared, freedom):
        return self.gate < 1 and squared > chi2.ppf(self.gate, freedom)

    # One frame

    def update(self, scan):
        rows = list(zip(scan.landmark.tolist(), scan.range, scan.bearing, strict=True))
        known = set(self.landmark.tolist())
        for label, distance, bearing in rows:
            if label in known:
                self.measure(label, distance, bearing)
        for label, distance, bearing in rows:
            if label not in known:
                self.initialise(label, distance, bearing)
        self.X[2] = wrapped(self.X[2])

    def measure(self, label, distance, bearing):
        """Update with a measurement of a mapped landmark, with robust variances if `robust`."""
        stated = self.range_variance, self.bearing_variance
        if self.robust:
            self.range_variance, self.bearing_variance = self.believed(label, distance, bearing)
        self.measure_known(label, distance, bearing)
        self.range_variance, self.bearing_variance = stated

    def believed(self, label, distance, bearing):
        """Variances of range and bearing by Huber's rule; unchanged in delayed initialization."""
        members, believed = self.members(label), [self.range_variance, self.bearing_variance]
        if self.aggregated[members[0]] == WAITS or any(map(self.too_near, members)):
            return believed
        surprises = []
        for block in members:
            d, phi, H = self.predicted(block)
            spread = H @ self.P @ H.T
            surprises.append(
                self.surprise(wrapped(bearing - phi), spread[1, 1], self.bearing_variance)
            )
            if len(members) == 1 and not math.isnan(distance):
                _, believed[0] = self.surprise(distance - d, spread[0, 0], self.range_variance)
        _, believed[1] = min(surprises)
        self.tempered += (believed[0] > self.range_variance) + (believed[1] > self.bearing_variance)
        return believed

    @staticmethod
    def surprise(nu, expected, variance):
        """Normalised innovation e, and the variance that scales its S to S e / k if e > k."""
        S = expected + variance
        e = abs(nu) / math.sqrt(S)
        return e, S * e / BELIEVED - expected if e > BELIEVED else variance

    def measure_known(self, label, distance, bearing):
        if len(self.members(label)) == 1:
            self.measure_full(label, distance, bearing)
        elif math.isnan(distance) and self.aggregated[self.members(label)[0]] == WAITS:
            self.cross(label, bearing)
        elif math.isnan(distance) or self.rays.range_update == "bearing":
            self.measure_ray(label, bearing)
        else:
            self.measure_ranged_ray(label, distance, bearing)

    def measure_full(self, label, distance, bearing):
        (block,) = self.members(label)
        if self.too_near(block):
            return
        nu, H, R = self.innovation(block, distance, bearing)
        squared, _ = self.distance_squared(nu, H, R)
        if self.outside(squared, len(nu)):
            self.gated += 1
        else:
            self.innovations += squared, len(nu)
            self.correct(block, nu, H, R)

    def measure_ray(self, label, bearing):
        """Weigh all hypotheses, share the measurement among them, prune: Eqs. (19) to (21)."""
        members = self.members(label)
        squared, log_likelihood = [], []
        for block in members:
            nu, H, R = self.innovation(block, math.nan, bearing)
            distance_squared, S = self.distance_squared(nu, H, R)
            squared.append(distance_squared)
            if self.rays.likelihood == "printed":
                log_likelihood.append(-distance_squared / 2 / math.sqrt(2 * math.pi * S[0, 0]))
            else:
                log_likelihood.append(-distance_squared / 2 - math.log(2 * math.pi * S[0, 0]) / 2)
        if all(self.outside(value, 1) for value in squared):
            self.gated += 1
            return
        aggregated = normalised(
            [
                logarithm(self.aggregated[block]) + value
                for block, value in zip(members, log_likelihood, strict=True)
            ]
        )
        self.aggregated.update(zip(members, aggregated, strict=True))
        for block, share in zip(members, self.shares(members, log_likelihood), strict=True):
            if share > 0 and not self.too_near(block):
                nu, H, R = self.innovation(block, math.nan, bearing, 1 / share)
                self.correct(block, nu, H, R, 1 / share)
        self.prune(label)

    def shares(self, members, log_likelihood):
        """Return each hypothesis's share of a measurement; 0 for skipped hypotheses."""
        n = self.rays.exponent
        if self.rays.weights == "instantaneous":
            shares = normalised([n * value for value in log_likelihood])
            return [share if share > LEAST_SHARE else 0 for share in shares]
        shares = normalised([n * logarithm(self.aggregated[block]) for block in members])
        return [share if share >= LEAST_AGGREGATED else 0 for share in shares]

    def prune(self, label):
        members = self.members(label)
        heaviest = max(members, key=self.aggregated.__getitem__)
        least = self.rays.prune_threshold / len(members)
        self.drop([b for b in members if self.aggregated[b] < least and b != heaviest])
        left = self.members(label)
        total = sum(self.aggregated[block] for block in left)
        self.aggregated.update({block: self.aggregated[block] / total for block in left})
        if self.rays.merge > 0:
            self.merge(left)

    def merge(self, members):
        """Merge neighbouring hypotheses that agree: moments of the mixture of two states."""
        one = members[0]
        for other in members[1:]:
            i, j = self.at(one), self.at(other)
            d, S = self.X[j] - self.X[i], (self.P[i, i] + self.P[j, j]) / 2
            if d @ np.linalg.solve(S, d) > self.rays.merge**2:
                one = other
                continue
            w = np.array([self.aggregated[one], self.aggregated[other]])
            a, b = w / w.sum()
            as_one = np.eye(self.X.size)
            as_other = as_one.copy()
            as_other[i] = as_one[j]
            means = as_one @ self.X, as_other @ self.X
            mean = a * means[0] + b * means[1]
            self.P = sum(
                share * (T @ self.P @ T.T + np.outer(m - mean, m - mean))
                for share, T, m in zip((a, b), (as_one, as_other), means, strict=True)
            )
            self.X, self.aggregated[one] = mean, w.sum()
            self.drop([other])

    def measure_ranged_ray(self, label, distance, bearing):
        """Update a ray with a range, by each interpretation of the paper's sentence."""
        members, ranged = self.members(label), self.rays.range_update
        heaviest = max(members, key=self.aggregated.__getitem__)
        if ranged == "anew":
            self.place_again(label, distance, bearing)
        elif ranged == "moved":
            self.move(heaviest, distance)
            self.measure_ray(label, bearing)

    def place_again(self, label, distance, bearing):
        """Initialise a partial landmark again, at the index of its first hypothesis."""
        position = self.blocks.index(self.members(label)[0])
        self.drop(self.members(label))
        self.place(position, label, distance, bearing)
        return self.members(label)[0]

    def move(self, block, distance):
        """Move a hypothesis's mean to a range, in its current direction."""
        offset = self.X[self.at(block)] - self.X[:2]
        self.X[self.at(block)] = self.X[:2] + distance * offset / np.linalg.norm(offset)

    # Initialisation, Eqs. (16) and (17)

    def initialise(self, label, distance, bearing):
        end = 1 + len(self.all_members())
        if self.carry_correspondence:
            G, noise = np.zeros((1, self.X.size)), np.array([[CORRESPONDENCE_STD**2]])
            self.insert(end, ("correspondence", label), [label], G, noise)
        if math.isnan(distance) and self.precise:
            self.await_crossing(end, label, bearing)
        elif math.isnan(distance):
            self.cast_ray(end, label, bearing)
        else:
            self.place(end, label, distance, bearing)

    def point(self, distance, bearing):
        """Position at a range and bearing, with Jacobians by the state and by (range, bearing)."""
        x, y, th = self.X[:3]
        c, s = math.cos(th + bearing), math.sin(th + bearing)
        G = np.zeros((2, self.X.size))
        G[:, :3] = [[1, 0, -distance * s], [0, 1, distance * c]]
        by_measurement = np.array([[c, -distance * s], [s, distance * c]])
        return np.array([x + distance * c, y + distance * s]), G, by_measurement

    def place(self, position, label, distance, bearing):
        m, G, Gz = self.point(distance, bearing)
        R = np.diag([self.range_variance, self.bearing_variance])
        block = ("member", label, 0)
        self.insert(position, block, m, G, Gz @ R @ Gz.T)
        self.aggregated[block] = 1.0

    def await_crossing(self, position, label, bearing):
        """Store the origin of a precise bearing, and a point along it."""
        ranges = ray_ranges(self.rays)
        for j, ahead in enumerate((0.0, ranges[len(ranges) // 2])):
            m, G, Gz = self.point(ahead, bearing)
            block = ("member", label, j)
            self.insert(
                position + j, block, m, G, self.bearing_variance * np.outer(Gz[:, 1], Gz[:, 1])
            )
            self.aggregated[block] = WAITS

    def cross(self, label, bearing):
        """Initialise a landmark where its bearing crosses the stored bearing, if precise enough."""
        origin, through = self.members(label)
        involved = [0, 1, 2]
        for block in (origin, through):
            involved += range(self.at(block).start, self.at(block).stop)
        z = np.append(self.X[involved], bearing)
        found = crossing(z)
        if found[2] < NEAREST or found[3] <= 0:
            return
        ray, heading = z[5:7] - z[3:5], z[2] + bearing
        turn = math.atan2(ray[1], ray[0]) - heading
        if self.robust and abs(math.sin(turn)) < PARALLAX:
            return
        step = 1e-30
        J = np.array([crossing(z + 1j * step * e).imag / step for e in np.eye(z.size)]).T
        G = np.zeros((4, self.X.size))
        G[:, involved] = J[:, :-1]
        G[:, 2] *= self.turns
        range_variance = G[2] @ self.P @ G[2] + J[2, -1] ** 2 * self.bearing_variance
        if math.sqrt(range_variance) > SURE * found[2]:
            return
        position = self.blocks.index(origin)
        noise = self.bearing_variance * np.outer(J[:2, -1], J[:2, -1])
        placed = ("member", label, 2)
        self.insert(position, placed, found[:2].real, G[:2], noise)
        self.aggregated[placed] = 1.0
        self.drop([origin, through])

    def cast_ray(self, position, label, bearing):
        ranges = ray_ranges(self.rays)
        by_bearing = {}
        for j, s in enumerate(ranges):
            m, G, Gz = self.point(s, bearing)
            R = np.diag([(self.rays.relative_std * s) ** 2, self.bearing_variance])
            block = ("member", label, j)
            self.insert(position + j, block, m, G, Gz @ R @ Gz.T)
            self.aggregated[block] = 1 / len(ranges)
            by_bearing[block] = Gz[:, 1]
        if self.common_bearing_noise:
            for one in by_bearing:
                for other in by_bearing.keys() - {one}:
                    common = self.bearing_variance * np.outer(by_bearing[one], by_bearing[other])
                    self.P[self.at(one), self.at(other)] += common
