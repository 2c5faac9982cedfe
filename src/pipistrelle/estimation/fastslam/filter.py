r"""FastSLAM 2.0 with rays: particles, each with a sampled path and a map.

Given a path, landmarks are independent: a particle needs a small Gaussian for each, but no joint
covariance (Eq. (12)),

.. math:: Y^{[j]} = \bigl\langle \hat x^{[j]}, \{\hat m_1^{[j]}, \hat P_1^{[j]}\}, \dots,
          \{\hat m_N^{[j]}, \hat P_N^{[j]}\} \bigr\rangle
   :label: eq-12

and for each hypothesis of a ray, with its aggregated likelihood (Eq. (22)):

.. math:: \{\hat m_i^{[j]}, \hat P_i^{[j]}\} \to
          \{\hat m_{i,1}^{[j]}, \hat P_{i,1}^{[j]}, \Lambda_{i,1}^{[j]}\}, \dots,
          \{\hat m_{i,N_g}^{[j]}, \hat P_{i,N_g}^{[j]}, \Lambda_{i,N_g}^{[j]}\}
   :label: eq-22

The update by a frame has five steps; frames without measurements only extend the motion.

1. **Propose.** Mean and covariance of the pose accumulate over the control steps since the last
   sample (from the start's covariance P0), then each measurement of a mapped landmark refines them
   (Eqs. (13) and (14), in Kalman form, each at the refined mean):

   .. math:: S_i = H_x P_{i-1} H_x^T + H_m P_m H_m^T + R, \qquad
             K_i = P_{i-1} H_x^T S_i^{-1}, \\
             \hat x_i = \hat x_{i-1} + K_i \nu_i, \qquad
             P_i = (I - K_i H_x) P_{i-1}
      :label: eq-14

   A particle's weight is multiplied by each marginal likelihood :math:`N(\nu_i; 0, S_i)`, for a
   partially initialised landmark by the mixture :math:`\sum_j \Lambda_j N(\nu_j; 0, S_j)`;
   with ``weighed_by = "initialised"`` these do not weigh.
2. **Sample** the pose from this refined Gaussian:

   .. math:: \hat x_k^{[j]} \sim p(x_k \mid \hat x_{k-1}^{[j]}, u_k, z_k)
      :label: eq-13
3. **Correct** the landmarks from the sampled pose; weigh, share and prune the rays (`rays`).
4. **Place** new landmarks from the sampled pose.
5. **Resample** if too few particles are effective (`particles`). The hypotheses of a ray keep their
   weights, or get equal weights with ``resampled_rays = "restart"``.

``mixture = "federated"``, as in the paper, updates every hypothesis of a ray with the noise R /
share. ``exact`` uses their independence given the pose: each is updated with R, only the weights
distinguish them (Gaussian sum filter), and the proposal has the moments of their mixture.

Excess paths are not used: they tie each landmark to a caller, and the paper's FastSLAM has an
independent Gaussian for each landmark.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import FastSlamConfig, InputError, RayConfig
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import Belief, Gaussian, JointGaussian, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.fastslam.block import LANES, MEMBER
from pipistrelle.estimation.fastslam.particles import (
    Arrays,
    correct_particles,
    effective_particles,
    gated_by_all,
    innovations_of,
    mean_full,
    normalised,
    propagate,
    resample_into,
    restart_rays,
    stratified,
    summarise,
)
from pipistrelle.estimation.motion import SMALLEST_STD, Controls, Durations, Motion, motion_numbers
from pipistrelle.estimation.observations.rows import scan_columns
from pipistrelle.estimation.rays import UpdateParams, update_params
from pipistrelle.geometry import wrap

_PAPER = FastSlamConfig()
_PACKED = ([0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2])
"""Indices in a pose's covariance of the rows xx, xy, yy, xh, yh and hh of a block."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FastSlamBelief(Belief):
    """The belief of FastSLAM: particles with poses, maps and weights, and their estimate.

    Innovations are of the heaviest particle before each scan.
    Particles are kept in b blocks of L = `block.LANES`: a row of L numbers is a number of each of a
    block's particles. Spare lanes of the last block repeat the last particle.
    """

    poses: Float[np.ndarray, "b rows"]
    """(b, 9 L): x, y [m], heading [rad], and covariance xx, xy, yy, xh, yh, hh since the last
    sample."""
    log_weight: Float[np.ndarray, " p"]
    landmark: Int[np.ndarray, " n"]  # label, in order of entry
    first: Int[np.ndarray, " n+1"]  # first row of each landmark in ``member``, then their number
    count: Int[np.ndarray, "b n lanes"]  # number of hypotheses of each particle's landmark
    member: Float[np.ndarray, "b c numbers"]
    """(b, c, 6 L): x, y [m], xx, xy, yy [m^2] and log weight of each hypothesis."""
    estimate: Gaussian
    """Pose estimate selected by ``settings.estimate``, before resampling."""
    best_count: Int[np.ndarray, " n"]  # map of the heaviest particle, before resampling
    best_member: Float[np.ndarray, "c 6"]
    full: float  # weighted mean number of fully initialised landmarks
    best: int = 0  # heaviest particle, or its first copy after resampling
    mixed: bool = False  # whether the map combines all particles
    before: "FastSlamBelief | None" = None  # belief before resampling, until the next motion

    def pose(self) -> Gaussian:
        """Return the estimated vehicle pose: mean [m, m, rad] and 3 x 3 covariance."""
        return self.estimate

    def landmarks(self) -> Landmarks:
        """Return the map, a row per hypothesis, from all particles or from the heaviest."""
        if self.mixed:
            return mixture_map(self.before or self)
        return _rows(self.landmark, self.first, self.best_count, self.best_member)

    def labels(self) -> list[int]:
        """Return the labels of all landmarks, initialised or not."""
        return self.landmark.tolist()

    def joint(self) -> JointGaussian:
        """Return the joint Gaussian of pose and initialised landmarks, by `joint_of`."""
        return joint_of(self)

    def edited(self, remove: Sequence[int], merge: Sequence[tuple[int, int]]) -> "FastSlamBelief":
        """Return the belief with some landmarks removed and some pairs of landmarks merged."""
        return replace(self, **edits(self, remove, merge), before=None)

    def cloud(self) -> Float[np.ndarray, "p 3"]:
        """Return the particles' poses, (p, 3) [m, m, rad]."""
        return _numbers(self.poses, 9)[: self.log_weight.size, :3]


@dataclass(frozen=True, slots=True, kw_only=True)
class FastSlam:
    """FastSLAM 2.0 (Bradley & Abaid, Sec. III-B) with bearing-only landmarks (Sec. III-C).

    >>> from pipistrelle.detection.scans import make_scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = FastSlam(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> known = {"range": np.array([2.0, np.nan]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.2]), **known)
    >>> belief = slam.update(belief, scan, np.random.default_rng(1))
    >>> belief.landmarks().landmark.tolist(), belief.full
    ([4, 9, 9, 9, 9], 1.0)
    """

    motion: Motion
    rays: RayConfig
    gate: float = 1.0
    """Gate: measurements outside this share of every particle's predicted distribution are
    discarded; 1 keeps all."""
    settings: FastSlamConfig = _PAPER

    def __post_init__(self) -> None:
        """Raise InputError unless the gate is a probability in (0, 1]."""
        check_gate(self.gate)

    def init(self, pose: Gaussian) -> FastSlamBelief:
        """Return the initial particles at a start pose with its covariance, without landmarks."""
        pose = usable_pose(pose)
        particles = self.settings.particles
        blocks = -(-particles // LANES)
        numbers = np.concatenate([pose.mean, pose.covariance[*_PACKED]])
        return FastSlamBelief(
            poses=np.tile(np.repeat(numbers, LANES), (blocks, 1)),
            log_weight=np.zeros(particles),
            landmark=np.empty(0, dtype=np.int64),
            first=np.zeros(1, dtype=np.int64),
            count=np.empty((blocks, 0, LANES), dtype=np.int64),
            member=np.empty((blocks, 0, MEMBER)),
            estimate=Gaussian(
                mean=pose.mean, covariance=pose.covariance + SMALLEST_STD**2 * np.eye(3)
            ),
            best_count=np.empty(0, dtype=np.int64),
            best_member=np.empty((0, 6)),
            full=0.0,
            mixed=self.settings.estimate == "mixture",
        )

    def knowing(self, belief: FastSlamBelief, known: Landmarks) -> FastSlamBelief:
        """Return the initial belief with known landmarks, the same in every particle."""
        check_belief(belief, FastSlamBelief)
        known = usable_known(known)
        blocks, n = len(belief.poses), known.landmark.size
        spread = known.covariance.reshape(n, 4)[:, [0, 1, 3]]
        rows = np.column_stack([known.mean, spread, np.zeros(n)])
        return replace(
            belief,
            landmark=known.landmark.astype(np.int64),
            first=np.arange(n + 1),
            count=np.ones((blocks, n, LANES), dtype=np.int64),
            member=np.tile(np.repeat(rows, LANES, axis=1), (blocks, 1, 1)),
            best_count=np.ones(n, dtype=np.int64),
            best_member=rows,
            full=float(n),
        )

    def predict(
        self,
        belief: FastSlamBelief,
        controls: Controls,
        dt: Durations,
        rng: np.random.Generator | None = None,
    ) -> tuple[FastSlamBelief, Gaussian]:
        """Predict every particle's pose and covariance through a frame's control steps (Eq. (10)).

        Returns the belief, and the mean pose after each step, (k, 3) and (k, 3, 3).
        """
        check_belief(belief, FastSlamBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        carried, steps = belief.poses.copy(), len(dt)
        poses = Gaussian(mean=np.empty((steps, 3)), covariance=np.empty((steps, 3, 3)))
        weight = self._estimating(normalised(belief.log_weight), belief.best)
        numbers = motion_numbers(self.motion)
        propagate(carried, weight, controls, dt, numbers, poses.mean, poses.covariance)
        if not steps:
            return belief, poses
        estimate = Gaussian(mean=poses.mean[-1], covariance=poses.covariance[-1])
        return replace(belief, poses=carried, estimate=estimate, before=None), poses

    def update(
        self, belief: FastSlamBelief, scan: Scan, rng: np.random.Generator
    ) -> FastSlamBelief:
        """Update the belief by a scan: refine and sample poses, update maps, weigh and resample.

        Draws three normals, then a uniform number, per particle; nothing for an empty scan.
        """
        check_belief(belief, FastSlamBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        if (np.isnan(scan.bearing) & ~np.isnan(scan.range)).any():
            raise InputError(
                f"scan at {scan.time} s: found a range without a bearing, which FastSLAM does not "
                "use; take the filter ekf, iekf or smoother"
            )
        if rng is None:
            raise InputError("update: found no generator, expected one: FastSLAM draws poses by it")
        particles, sampled = self.settings.particles, self.settings.weights == "sampled"
        normal, uniform = rng.standard_normal((particles, 3)), rng.random(particles)
        params = update_params(self.rays, self.gate, swarm=self.settings)
        inside, gated = self._inside(belief, scan, params)
        off = innovations_of(_arrays(belief), scan_columns(inside), int(belief.log_weight.argmax()))
        (poses, landmark, first, count, member), gained = correct_particles(
            _arrays(belief), scan_columns(inside), normal, params, sampled
        )
        weight = normalised(belief.log_weight + gained)
        best = int(np.argmax(weight))
        mean, covariance = summarise(poses, self._estimating(weight, best))
        block, lane = divmod(best, LANES)
        rows = member[block].reshape(-1, MEMBER // LANES, LANES)[..., lane].copy()
        after = FastSlamBelief(
            poses=poses,
            log_weight=np.log(weight, where=weight > 0.0, out=np.full(particles, -np.inf)),
            landmark=landmark,
            first=first,
            count=count,
            member=member,
            estimate=Gaussian(mean=mean, covariance=covariance),
            best_count=count[block, :, lane].copy(),
            best_member=rows,
            full=mean_full(count, weight),
            gated=belief.gated + gated,
            innovations=belief.innovations.plus(*off),
            best=best,
            mixed=belief.mixed,
        )
        if effective_particles(weight) >= self.settings.resample_below * particles:
            return after
        return self._resampled(after, stratified(weight, uniform))

    def _estimating(self, weight: Float[np.ndarray, " p"], best: int) -> Float[np.ndarray, " p"]:
        """Return the weights for the pose estimate: of all particles, or 1 for the heaviest."""
        if self.settings.estimate != "heaviest":
            return weight
        return (np.arange(weight.size) == best).astype(float)

    def _resampled(self, belief: FastSlamBelief, ancestor: Int[np.ndarray, " p"]) -> FastSlamBelief:
        """Replace the particles by copies of their drawn ancestors, with equal weights."""
        poses, count, member = resample_into(_arrays(belief), ancestor)
        if self.settings.resampled_rays == "restart":
            restart_rays(belief.first, count, member)
        return replace(
            belief,
            poses=poses,
            log_weight=np.full(ancestor.size, -math.log(ancestor.size)),
            count=count,
            member=member,
            best=int(np.argmax(ancestor == belief.best)),
            before=belief if belief.mixed else None,
        )

    def _inside(self, belief: FastSlamBelief, scan: Scan, params: UpdateParams) -> tuple[Scan, int]:
        """Discard measurements outside all particles' gates; return the scan and their number."""
        if self.gate >= 1.0:
            return scan, 0
        gated = gated_by_all(_arrays(belief), scan_columns(scan), params)
        return rows_of(scan, ~gated), int(np.count_nonzero(gated))


def _arrays(belief: FastSlamBelief) -> Arrays:
    """Return the arrays of a belief's particles as a tuple for compiled functions."""
    return belief.poses, belief.landmark, belief.first, belief.count, belief.member


def _rows(
    landmark: Int[np.ndarray, " n"],
    first: Int[np.ndarray, " n+1"],
    count: Int[np.ndarray, " n"],
    member: Float[np.ndarray, "c 6"],
) -> Landmarks:
    """Convert a particle's map to a `Landmarks` record, a row per hypothesis."""
    label = np.repeat(landmark, count)
    offset = np.arange(label.size) - np.repeat(np.cumsum(count) - count, count)
    rows = member[np.repeat(first[:-1], count) + offset]
    return Landmarks(
        landmark=label,
        mean=rows[:, :2].copy(),
        covariance=rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2),
        weight=np.exp(rows[:, 5]),
    )


def _placed_by_most(
    belief: FastSlamBelief,
) -> tuple[
    Int[np.ndarray, " k"],
    Float[np.ndarray, " p"],
    Bool[np.ndarray, "p k"],
    Float[np.ndarray, "p k 6"],
    Float[np.ndarray, "p k"],
    Float[np.ndarray, "k 2"],
]:
    """Return landmarks that most particles, by weight, have initialised, and their states.

    Returns their indices, the weight of each particle, whether it has the landmark initialised,
    position, covariance and log weight in each, the weight among the particles that have it, and
    its mean position [m].
    """
    particles = belief.log_weight.size
    weight = np.exp(belief.log_weight - belief.log_weight.max())
    weight /= weight.sum()
    placed = _lanes(belief.count)[:particles] == 1
    there = np.flatnonzero(np.einsum("p,pn->n", weight, placed) > 0.5)
    members = _numbers(belief.member[:, belief.first[there]], 6)[:particles]
    counting = weight[:, np.newaxis] * placed[:, there]
    share = counting / counting.sum(axis=0)
    places = np.einsum("pn,pne->ne", share, members[..., :2])
    return there, weight, placed[:, there], members, share, places


def mixture_map(belief: FastSlamBelief) -> Landmarks:
    r"""Return the map of all particles: mean and covariance of each landmark over particles.

    .. math:: \bar l = \sum_i w_i l_i, \qquad
              P = \sum_i w_i \left( (l_i - \bar l)(l_i - \bar l)^T + P_i \right)

    A landmark is fully initialised if it is so in most particles, by weight. Others are copied from
    the heaviest particle that has them as a ray.
    """
    there, weight, _, members, share, places = _placed_by_most(belief)
    off = members[..., :2] - places
    spread = np.einsum("pn,pna,pnb->nab", share, off, off)
    own = np.einsum("pn,pne->ne", share, members[..., 2:5])[:, [0, 1, 1, 2]]
    numbers, rows = [there], [places]
    spreads, weights = [spread + own.reshape(-1, 2, 2)], [np.ones(there.size)]
    count = _lanes(belief.count)[: weight.size]
    for n in np.setdiff1d(np.arange(belief.landmark.size), there).tolist():
        best = int(np.argmax(np.where(count[:, n] > 1, weight, -1.0)))
        first, size = belief.first[n], count[best, n]
        lane = belief.member[best // LANES, first : first + size]
        members = lane.reshape(size, 6, LANES)[..., best % LANES]
        numbers.append(np.full(size, n))
        rows.append(members[:, :2])
        spreads.append(members[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
        weights.append(np.exp(members[:, 5]))
    number = np.concatenate(numbers)
    order = np.argsort(number, kind="stable")
    return Landmarks(
        landmark=belief.landmark[number[order]],
        mean=np.concatenate(rows)[order],
        covariance=np.concatenate(spreads)[order],
        weight=np.concatenate(weights)[order],
    )


def joint_of(belief: FastSlamBelief) -> JointGaussian:
    r"""Return the joint Gaussian of pose and initialised landmarks over all particles.

    .. math:: \bar x = \sum_i w_i x_i, \qquad
              P = \sum_i w_i \left( (x_i - \bar x)(x_i - \bar x)^T + P_i \right)

    with each particle's covariances :math:`P_i` of pose and landmarks. Only landmarks that most
    particles have initialised are included; in the other particles they have the mean position.
    """
    there, weight, placed, members, share, places = _placed_by_most(belief)
    rows = _numbers(belief.poses, 9)[: weight.size]
    rows[:, 2] = belief.estimate.mean[2] + wrap(rows[:, 2] - belief.estimate.mean[2])
    mean = np.append(np.einsum("p,pe->e", weight, rows[:, :3]), places.ravel())
    points = np.where(placed[..., np.newaxis], members[..., :2], places)
    off = np.hstack([rows[:, :3], points.reshape(weight.size, 2 * there.size)]) - mean
    covariance = np.einsum("p,pd,pe->de", weight, off, off, optimize=True)
    xx, xy, yy, xh, yh, hh = np.einsum("p,pe->e", weight, rows[:, 3:9])
    covariance[:3, :3] += np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    for n, (xx, xy, yy) in enumerate(np.einsum("pn,pne->ne", share, members[..., 2:5]).tolist()):
        covariance[3 + 2 * n : 5 + 2 * n, 3 + 2 * n : 5 + 2 * n] += [[xx, xy], [xy, yy]]
    return JointGaussian(landmark=belief.landmark[there], mean=mean, covariance=covariance)


def _numbers(blocks: np.ndarray, count: int) -> np.ndarray:
    """Rearrange numbers stored by blocks of particles into an array with a row per particle."""
    middle = blocks.shape[1:-1]
    lanes = blocks.reshape(len(blocks), *middle, count, LANES)
    return np.moveaxis(lanes, -1, 1).reshape(len(blocks) * LANES, *middle, count)


def _lanes(count: np.ndarray) -> np.ndarray:
    """Rearrange counts stored by blocks of particles into an array by particle and landmark."""
    return np.swapaxes(count, 1, 2).reshape(len(count) * LANES, count.shape[1])


def edits(
    belief: FastSlamBelief, remove: Sequence[int], merge: Sequence[tuple[int, int]]
) -> dict[str, Any]:
    """Remove and merge landmarks in all particles; return the belief's changed arrays by name.

    A merged pair keeps the landmark that most particles have initialised, the first if both are.
    """
    landmark, gone = belief.landmark.copy(), [*remove]
    for kept, other in merge:
        second = _number(landmark, other)
        if kept not in landmark:
            landmark[second] = kept
            continue
        first = _number(landmark, kept)
        if kept == other:
            raise InputError("association: found a landmark to merge with itself; expected two")
        if np.mean(belief.count[:, first] == 1) <= 0.5 < np.mean(belief.count[:, second] == 1):
            landmark[first], landmark[second] = other, kept
        gone.append(other)
    for label in gone:
        _number(landmark, label)
    return _without(belief, landmark, ~np.isin(landmark, gone))


def _number(landmark: Int[np.ndarray, " n"], label: int) -> int:
    """Return a landmark's index by its label; raise InputError if it is not on the map."""
    found = np.flatnonzero(landmark == label)
    if not found.size:
        raise InputError(f"association: found landmark {label} to change, which is not on the map")
    return int(found[0])


def _without(
    belief: FastSlamBelief, landmark: np.ndarray, kept: Bool[np.ndarray, " n"]
) -> dict[str, Any]:
    """Return the belief's arrays by name, limited to selected landmarks, with changed labels."""
    rows = np.diff(belief.first)
    members = np.repeat(kept, rows)
    return {
        "landmark": landmark[kept],
        "first": np.append(0, np.cumsum(rows[kept])),
        "count": np.ascontiguousarray(belief.count[:, kept]),
        "member": np.ascontiguousarray(belief.member[:, members]),
        "best_count": belief.best_count[kept],
        "best_member": belief.best_member[members],
    }
