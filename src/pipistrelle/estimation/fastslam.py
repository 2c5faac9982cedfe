r"""FastSLAM 2.0 with rays: each particle a sampled path with its own map.

Given a path, landmarks are independent: a particle (Eqs. (12) and (22)) needs one small Gaussian
per hypothesis and no joint covariance. A frame goes through five steps.

1. **Propose.** Mean and covariance of the pose accumulate over the control steps since the last
   sample, then each measurement of a mapped landmark refines them (Eqs. (13) and (14), in Kalman
   form, each at the refined mean). A particle's weight grows by each measurement's marginal
   likelihood :math:`N(\nu_i; 0, H_x P_{i-1} H_x^T + H_m P_m H_m^T + R)`, the product of which is
   the likelihood of the frame given the particle's past. A bearing of a partial landmark has
   :math:`\log \sum_j \Lambda_j N(\nu_j; 0, S_j)`; a range for a partial landmark and a new
   landmark add no weight.
2. **Sample** the pose, once.
3. **Correct** the landmarks, weigh, share and prune the rays (`rays`), from the sampled pose.
4. **Place** new landmarks from the sampled pose.
5. **Resample** when too few particles count (`resampling`).

``mixture`` says how a bearing treats a ray. ``federated``, the paper's way, corrects every member
with the noise R / share. ``exact`` uses that members are independent given the pose: each is
corrected with R itself and only the weights tell them apart, as in a Gaussian sum filter; the
proposal is refined to the mean and covariance of the mixture of its members' refinements.

A frame without measurements is not sampled: its motion goes on accumulating, which loses nothing.
The start is not sampled either: its covariance P0 is the first that accumulates.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import FastSlamConfig, RayConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.models import Gaussian, Landmarks, Motion, motion_numbers
from pipistrelle.estimation.particle import WEIGHT, XX, XY, YY
from pipistrelle.estimation.rays import Sensing, sensing_of
from pipistrelle.estimation.resampling import effective_particles, normalised, stratified
from pipistrelle.estimation.swarm import advance_swarm, correct_swarm, gated_by_all, summarise

_PAPER = FastSlamConfig()
SMALLEST_STD = 1e-6
"""Added in quadrature to the pose estimate's x, y [m] and heading [rad]: a swarm that stands still
or has one ancestor may have no spread, and its covariance no inverse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FastSlamBelief:
    """Particles, and what they amount to.

    Attributes
    ----------
    mean : (p, 3) [m, m, rad]
        Of each particle's pose.
    covariance : (p, 3, 3)
        Of each particle's pose since its last sample.
    log_weight : (p)
    landmark : (n)
        Labels, in order of entry.
    first : (n + 1)
        First column of each landmark in ``member``, then their number.
    count : (p, n)
        Members of each particle's landmark.
    member : (p, c, 6)
        x, y [m], xx, xy, yy [m^2] and weight of each hypothesis.
    estimate : Gaussian of (3) and (3, 3)
        The swarm's pose, before any resampling.
    best : Landmarks
        The map of the heaviest particle, before any resampling; the first of equals.
    full : float
        Weighted mean number of fully initialised landmarks.
    gated : int
        Measurements rejected so far.
    """

    mean: Float[np.ndarray, "p 3"]
    covariance: Float[np.ndarray, "p 3 3"]
    log_weight: Float[np.ndarray, " p"]
    landmark: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " n+1"]
    count: Int[np.ndarray, "p n"]
    member: Float[np.ndarray, "p c 6"]
    estimate: Gaussian
    best: Landmarks
    full: float
    gated: int

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3): weighted mean and covariance of the swarm."""
        return self.estimate

    def landmarks(self) -> Landmarks:
        """Return the heaviest particle's map, one row per member."""
        return self.best

    def cloud(self) -> Float[np.ndarray, "p 3"]:
        """Return the particles' poses, (p, 3)."""
        return self.mean.copy()


@dataclass(frozen=True, slots=True, kw_only=True)
class FastSlam:
    """FastSLAM 2.0 (Bradley & Abaid, Sec. III-B) with rays (Sec. III-C).

    Attributes
    ----------
    motion : Motion
    range_std, bearing_std : [m], [rad]
        What the filter assumes of a measurement (R, squared).
    rays : RayConfig
    gate : float
        A measurement that is outside this share of every particle's predicted distribution is
        dropped; 1 drops none.
    swarm : FastSlamConfig
        Number of particles, when to resample, how to treat rays.

    Examples
    --------
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = FastSlam(motion=motion, range_std=0.2, bearing_std=0.15, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> heard = {"landmark": np.array([4, 9]), "bearing": np.array([0.1, 0.2])}
    >>> scan = Scan(time=0.0, range=np.array([2.0, np.nan]), **heard)
    >>> belief = slam.update(belief, scan, np.random.default_rng(1))
    >>> belief.landmarks().landmark.tolist(), belief.full
    ([4, 9, 9, 9, 9], 1.0)
    """

    motion: Motion
    range_std: float
    bearing_std: float
    rays: RayConfig
    gate: float = 1.0
    swarm: FastSlamConfig = _PAPER

    def init(self, pose: Gaussian) -> FastSlamBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        particles = self.swarm.particles
        return FastSlamBelief(
            mean=np.tile(pose.mean.astype(float), (particles, 1)),
            covariance=np.tile(pose.covariance.astype(float), (particles, 1, 1)),
            log_weight=np.zeros(particles),
            landmark=np.empty(0, dtype=np.int64),
            first=np.zeros(1, dtype=np.int64),
            count=np.empty((particles, 0), dtype=np.int64),
            member=np.empty((particles, 0, 6)),
            estimate=_regular(pose.mean.astype(float), pose.covariance.astype(float)),
            best=_rows(np.empty(0, np.int64), np.zeros(1, np.int64), None, np.empty((0, 6))),
            full=0.0,
            gated=0,
        )

    def predict(
        self,
        belief: FastSlamBelief,
        controls: Float[np.ndarray, "k 2"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator | None = None,
    ) -> tuple[FastSlamBelief, Gaussian]:
        """Carry every particle's pose and its covariance through the control steps of a frame.

        Parameters
        ----------
        belief : FastSlamBelief
        controls : (k, 2) [m/s, rad or rad/s]
        dt : (k) [s]
        rng : Generator, optional
            Not used: poses are drawn once a frame, by `update`.

        Returns
        -------
        belief : FastSlamBelief
        poses : Gaussian of (k, 3) and (k, 3, 3)
            After each step.

        Notes
        -----
        Bradley & Abaid, Eq. (10), per particle.
        """
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        poses = Gaussian(mean=np.empty((len(dt), 3)), covariance=np.empty((len(dt), 3, 3)))
        weight = normalised(belief.log_weight)
        numbers = motion_numbers(self.motion)
        advance_swarm(mean, covariance, weight, controls, dt, numbers, poses.mean, poses.covariance)
        poses = _regular(poses.mean, poses.covariance)
        estimate = (
            Gaussian(mean=poses.mean[-1], covariance=poses.covariance[-1])
            if len(dt)
            else belief.estimate
        )
        return replace(belief, mean=mean, covariance=covariance, estimate=estimate), poses

    def update(
        self, belief: FastSlamBelief, scan: Scan, rng: np.random.Generator
    ) -> FastSlamBelief:
        """Refine, sample, correct, place and resample with a frame's measurements.

        Parameters
        ----------
        belief : FastSlamBelief
        scan : Scan
        rng : Generator
            Draws three normals per particle, then one uniform number per particle; nothing for a
            scan without measurements, which a recorded log cannot hold.

        Returns
        -------
        FastSlamBelief

        Notes
        -----
        Bradley & Abaid, Eqs. (12) to (22).
        """
        if scan.landmark.size == 0:
            return belief
        particles = self.swarm.particles
        normal, uniform = rng.standard_normal((particles, 3)), rng.random(particles)
        sensing = sensing_of(self.range_std, self.bearing_std, self.rays, self.gate)
        dropped = self._dropped(belief, scan, sensing)
        if dropped.any():
            scan = Scan(
                time=scan.time,
                landmark=scan.landmark[~dropped],
                bearing=scan.bearing[~dropped],
                range=scan.range[~dropped],
            )
        mean, covariance, log_weight, landmark, first, count, member = correct_swarm(
            belief.mean, belief.covariance, belief.log_weight, belief.landmark, belief.first,
            belief.count, belief.member, scan.landmark, scan.bearing, scan.range, normal,
            sensing, self.swarm.mixture == "exact",
        )  # fmt: skip
        weight = normalised(log_weight)
        best = int(np.argmax(weight))
        corrected = FastSlamBelief(
            mean=mean,
            covariance=covariance,
            log_weight=np.log(weight, where=weight > 0.0, out=np.full(particles, -np.inf)),
            landmark=landmark,
            first=first,
            count=count,
            member=member,
            estimate=_regular(*summarise(mean, covariance, weight)),
            best=_rows(landmark, first, count[best], member[best]),
            full=float(weight @ np.count_nonzero(count == 1, axis=1)),
            gated=belief.gated + int(np.count_nonzero(dropped)),
        )
        if effective_particles(weight) >= self.swarm.resample_below * particles:
            return corrected
        return _descend(corrected, stratified(weight, uniform))

    def _dropped(self, belief: FastSlamBelief, scan: Scan, sensing: Sensing) -> np.ndarray:
        """Tell which measurements no particle expected."""
        if self.gate >= 1.0:
            return np.zeros(scan.landmark.size, dtype=np.bool_)
        return gated_by_all(
            belief.mean, belief.covariance, belief.landmark, belief.first, belief.count,
            belief.member, scan.landmark, scan.bearing, scan.range, sensing,
        )  # fmt: skip


def _descend(belief: FastSlamBelief, ancestor: Int[np.ndarray, " p"]) -> FastSlamBelief:
    """Put copies of the ancestors in the particles' places, all of one weight."""
    return replace(
        belief,
        mean=belief.mean[ancestor],
        covariance=belief.covariance[ancestor],
        log_weight=np.full(ancestor.size, -np.log(ancestor.size)),
        count=belief.count[ancestor],
        member=belief.member[ancestor],
    )


def _regular(mean: Float[np.ndarray, "*k 3"], covariance: Float[np.ndarray, "*k 3 3"]) -> Gaussian:
    """Return an estimate whose covariance has an inverse."""
    return Gaussian(mean=mean, covariance=covariance + SMALLEST_STD**2 * np.eye(3))


def _rows(
    landmark: Int[np.ndarray, " n"],
    first: Int[np.ndarray, " n+1"],
    count: Int[np.ndarray, " n"] | None,
    member: Float[np.ndarray, "c 6"],
) -> Landmarks:
    """Lay out one particle's map, one row per member."""
    count = np.zeros(landmark.size, dtype=np.int64) if count is None else count
    label = np.repeat(landmark, count)
    offset = np.arange(label.size) - np.repeat(np.cumsum(count) - count, count)
    rows = member[np.repeat(first[:-1], count) + offset]
    covariance = rows[:, [XX, XY, XY, YY]].reshape(-1, 2, 2)
    return Landmarks(
        landmark=label, mean=rows[:, :2].copy(), covariance=covariance, weight=rows[:, WEIGHT]
    )
