r"""The smoother: nothing is linearised for good, and the whole path is thought over again.

A filter folds what it hears into one Gaussian, linearised where it then thought it was. Here all
that was ever heard stays a *factor* between a pose and a landmark, and a sparse solver (GTSAM's
iSAM2: Kaess et al., International Journal of Robotics Research 31, 2012) goes on to linearise what
has moved. Poses are those from which something was heard (`legs` has the steps between).

A landmark enters with its first range, and else where two of its bearings cross clearly
(`crossing`), with all its bearings so far: until then it waits, its bearings say nothing, and it
counts as partial. Where the calls of another are timed, it enters with the first detour that makes
its range sure (`placing`), for which its caller must be in the graph; a caller, likewise, by the
detour over a landmark that is. A detour is a factor between pose, landmark and caller (`detours`),
and waits, too, until both are there. What enters does so with a prior of `PRIOR_STD`, which says
next to nothing and leaves no graph without a solution. What cannot be solved with new landmarks is
solved without them: they go on waiting.

``robust`` takes each measurement by Huber's loss. What is believed at a frame is the pose of iSAM2;
`SmootherBelief.path` and the map are the optimum of everything so far.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.measurement import BELIEVED
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.rays import ray_members
from pipistrelle.estimation.smoother.crossing import Bearing, crossing
from pipistrelle.estimation.smoother.detours import Detour, detour_factors, detours_of, parted
from pipistrelle.estimation.smoother.gating import detours_inside, rows_inside
from pipistrelle.estimation.smoother.graph import (
    Link,
    Solver,
    in_world,
    landmark_key,
    leg_factor,
    links,
    pose_key,
    pose_of,
    start_factor,
)
from pipistrelle.estimation.smoother.legs import (
    NOWHERE,
    Leg,
    between,
    longer,
    placed,
    symmetric,
    turned,
)
from pipistrelle.estimation.smoother.placing import Around, clues_of, placed_by

PRIOR_STD = 20.0
"""Of a landmark about the place where it enters [m]."""
MANY = 20
"""Detours that had waited, beyond which all is linearised anew when they enter: they correct many
poses at once, as do bearings that had waited (`graph.ANEW`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherBelief:
    """A link of the graph's chain, and what waits to enter it.

    Attributes
    ----------
    at : Gaussian of (3) and (3, 3)
        The last pose of the graph, as it was believed when it entered.
    leg : Leg
        The steps since.
    link : Link
    mapped : tuple of int
        Landmarks in the graph, in order of entry.
    waiting : dict of label to tuple of Bearing
    detours : tuple of Detour
        Those that wait, for their landmark or for their caller.
    gated : int
    rays : RayConfig
    solver : Solver
        Shared with the beliefs before and after.
    """

    at: Gaussian
    leg: Leg = NOWHERE
    link: Link
    mapped: tuple[int, ...] = ()
    waiting: Mapping[int, tuple[Bearing, ...]] = field(default_factory=dict)
    detours: tuple[Detour, ...] = ()
    gated: int = 0
    rays: RayConfig
    solver: Solver

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        if not len(self.leg.mean):
            return self.at
        steps = placed(self.at, self.leg)
        return Gaussian(mean=steps.mean[-1], covariance=steps.covariance[-1])

    def path(self) -> Gaussian:
        """Return the start and every control step so far, by all that is known now."""
        best = self.solver.solve(self.link)
        start = best.pose(0)
        parts = [Gaussian(mean=start.mean[None], covariance=start.covariance[None])]
        for link in links(self.link):
            if link.leg:
                ends = np.array([best.pose_mean(link.node - 1), best.pose_mean(link.node)])
                parts.append(between(ends, best.joint(link.node - 1, link.node), link.leg))
        parts.append(placed(best.pose(self.link.node), self.leg))
        return Gaussian(
            mean=np.concatenate([part.mean for part in parts]),
            covariance=np.concatenate([part.covariance for part in parts]),
        )

    def landmarks(self) -> Landmarks:
        """Return the map: a row for each landmark in the graph, a ray for each that waits."""
        best = self.solver.solve(self.link) if self.mapped or self.waiting else None
        if best is None:
            return _rows([], [])
        points = [(label, best.point(label), 1.0) for label in self.mapped]
        rays = [
            (label, member, weight)
            for label, bearings in self.waiting.items()
            for member, weight in _ray(best.pose(bearings[-1].node), bearings[-1], self.rays)
        ]
        return _rows(points, rays)


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoother:
    """Incremental smoothing and mapping by iSAM2.

    Attributes
    ----------
    motion : Motion
    rays : RayConfig
        How far a landmark may be that waits; nothing else is done with rays.
    gate : float
        A measurement outside this share of its predicted distribution (chi-square) is dropped;
        1 drops none.
    robust : bool
        Whether a measurement that surprises counts less.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = Smoother(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> known = {"range": np.array([2.0, np.nan]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.2]), **known)
    >>> slam.update(belief, scan).landmarks().landmark.tolist()
    [4, 9, 9, 9, 9]
    """

    motion: Motion
    rays: RayConfig
    gate: float = 1.0
    robust: bool = False

    def init(self, pose: Gaussian) -> SmootherBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(start_factor(0, pose))
        values.insert(pose_key(0), gtsam.Pose2(*pose.mean))
        return SmootherBelief(
            at=Gaussian(mean=pose.mean.astype(float), covariance=pose.covariance.astype(float)),
            link=Link(before=None, node=0, leg=None, factors=factors, values=values),
            rays=self.rays,
            solver=Solver(),
        )

    def predict(
        self,
        belief: SmootherBelief,
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator | None = None,
    ) -> tuple[SmootherBelief, Gaussian]:
        """Carry the belief through the control steps of a frame.

        Parameters
        ----------
        belief : SmootherBelief
        controls : (k, c)
            As the motion model has them.
        dt : (k) [s]
        rng : Generator, optional
            Not used: nothing is drawn.

        Returns
        -------
        belief : SmootherBelief
        poses : Gaussian of (k, 3) and (k, 3, 3)
            After each step.
        """
        leg = longer(belief.leg, self.motion, controls, dt)
        steps, new = placed(belief.at, leg), len(leg.mean) - len(dt)
        poses = Gaussian(mean=steps.mean[new:], covariance=steps.covariance[new:])
        return replace(belief, leg=leg), poses

    def update(
        self, belief: SmootherBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> SmootherBelief:
        """Let a frame's measurements enter the graph, and what they place.

        Parameters
        ----------
        belief : SmootherBelief
        scan : Scan
        rng : Generator, optional
            Not used: nothing is drawn.

        Returns
        -------
        SmootherBelief
        """
        if scan.landmark.size == 0:
            return belief
        here = _arrived(belief)
        if self.gate < 1.0 and belief.mapped:
            here, scan, detours = self._gated(_solved(here), scan)
        else:
            detours = detours_of(scan, here.link.node)
        for placing in (True, False):
            heard = self._heard(here, scan, detours, placing=placing)
            try:
                return _settled(heard)
            except RuntimeError:  # what entered cannot be solved
                continue
        return _settled(here)

    def _gated(
        self, here: SmootherBelief, scan: Scan
    ) -> tuple[SmootherBelief, Scan, tuple[Detour, ...]]:
        """Return what is inside the gate, and count what is not."""
        isam, node, rows = here.solver.reach(here.link), here.link.node, scan.landmark.size
        scan = rows_of(scan, rows_inside(isam, node, here.mapped, scan, self.gate))
        heard = detours_of(scan, node)
        detours = detours_inside(isam, here.mapped, heard, self.gate)
        dropped = rows - scan.landmark.size + len(heard) - len(detours)
        return replace(here, gated=here.gated + dropped), scan, detours

    def _heard(
        self, here: SmootherBelief, scan: Scan, detours: tuple[Detour, ...], *, placing: bool
    ) -> SmootherBelief:
        """Add a frame's factors, and those of what it places, if it may, as a link."""
        link = _next_to(here)
        factors, values, node = link.factors, link.values, link.node
        mapped, waiting, crossed = list(here.mapped), dict(here.waiting), False
        poses = _poses(here)
        columns = (scan.landmark, scan.bearing, scan.range, scan.bearing_std, scan.range_std)
        for label, bearing, distance, across, along in zip(
            *map(np.ndarray.tolist, columns), strict=True
        ):
            if math.isnan(bearing):  # but a detour
                continue
            heard, passive = Bearing(node, bearing, across), math.isnan(distance)
            if label not in mapped:
                place, sure = _ahead(poses[node], bearing, distance), False
                if passive:
                    waiting[label], place = (*waiting.get(label, ()), heard), None
                    if placing:
                        place, sure = _placed(here, poses, waiting[label], label, detours)
                if place is None:
                    continue
                mapped.append(label)
                values.insert(landmark_key(label), place)
                factors.add(_prior(label, place))
                crossed |= label in here.waiting and not sure
                for earlier in waiting.pop(label, ()):
                    factors.add(self._bearing(earlier, label))
                if passive:
                    continue
            if passive:
                factors.add(self._bearing(heard, label))
            else:
                factors.add(self._range(node, label, (bearing, distance), (across, along)))
        here = replace(here, link=replace(link, crossed=crossed))
        return self._timed(replace(here, mapped=tuple(mapped), waiting=waiting), detours)

    def _timed(self, here: SmootherBelief, detours: tuple[Detour, ...]) -> SmootherBelief:
        """Add the detours to the last link whose ends are both in the graph; the others wait."""
        link, known = here.link, set(here.mapped)
        entering, late = parted((*here.detours, *detours), known)
        for factor in detour_factors(entering, robust=self.robust):
            link.factors.add(factor)
        many = sum(one.node < link.node for one in entering) > MANY
        return replace(here, link=replace(link, crossed=link.crossed or many), detours=late)

    def _bearing(self, heard: Bearing, label: int) -> gtsam.BearingFactor2D:
        """Return what a bearing says."""
        noise = self._noise(gtsam.noiseModel.Isotropic.Sigma(1, heard.std))
        keys = pose_key(heard.node), landmark_key(label)
        return gtsam.BearingFactor2D(*keys, gtsam.Rot2(heard.bearing), noise)

    def _range(
        self, node: int, label: int, heard: tuple[float, float], std: tuple[float, float]
    ) -> gtsam.BearingRangeFactor2D:
        """Return what a bearing and a range say."""
        noise = self._noise(gtsam.noiseModel.Diagonal.Sigmas(np.array(std)))
        bearing, distance = heard
        keys = pose_key(node), landmark_key(label)
        return gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(bearing), distance, noise)

    def _noise(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """Return a noise model, with Huber's loss where that is asked for."""
        if not self.robust:
            return noise
        huber = gtsam.noiseModel.mEstimator.Huber.Create(BELIEVED)
        return gtsam.noiseModel.Robust.Create(huber, noise)


def _arrived(belief: SmootherBelief) -> SmootherBelief:
    """Let the leg enter the graph, where the vehicle has moved, and its end be the last pose."""
    if not belief.leg.moves():
        return belief
    node, pose = belief.link.node + 1, belief.pose()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(leg_factor(node, belief.leg))
    values.insert(pose_key(node), gtsam.Pose2(*pose.mean))
    link = _after(belief.link, factors, values)
    return replace(belief, at=pose, leg=NOWHERE, link=replace(link, node=node, leg=belief.leg))


def _next_to(here: SmootherBelief) -> Link:
    """Return a new link, still to be filled: in the place of the leg's, where none has asked it."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    last = here.link
    if last.leg is None or here.solver.at is last:
        return _after(last, factors, values)
    factors.push_back(last.factors)
    values.insert(last.values)
    return replace(last, factors=factors, values=values)


def _after(last: Link, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Link:
    """Return a link after another, of the same pose."""
    return replace(last, before=last, leg=None, factors=factors, values=values, crossed=False)


def _solved(belief: SmootherBelief) -> SmootherBelief:
    """Return the belief when its graph is solved, thoroughly where it must be.

    Raises RuntimeError where it cannot be solved.
    """
    try:
        belief.solver.reach(belief.link)
    except RuntimeError:
        if belief.link.thorough:
            raise
        belief = replace(belief, link=replace(belief.link, thorough=True))
        belief.solver.reach(belief.link)
    return belief


def _settled(belief: SmootherBelief) -> SmootherBelief:
    """Return the belief with the last pose as the solver has it."""
    belief = _solved(belief)
    isam, key = belief.solver.reach(belief.link), pose_key(belief.link.node)
    mean = pose_of(isam.calculateEstimatePose2(key))
    return replace(belief, at=in_world(mean, isam.marginalCovariance(key)))


def _known(here: SmootherBelief) -> Link | None:
    """Return the last link that has been solved."""
    last = here.link
    return last if last.leg is None or last is here.solver.at else last.before


def _placed(
    here: SmootherBelief,
    poses: Float[np.ndarray, "n 3"],
    waiting: tuple[Bearing, ...],
    label: int,
    detours: tuple[Detour, ...],
) -> tuple[Float[np.ndarray, "2"] | None, bool]:
    """Return where one stands that was only ever heard, if it shows, and whether by a detour."""
    known, clues = _known(here), clues_of(label, detours, here.mapped)
    if clues and known is not None:
        leg, isam = None if known is here.link else here.link.leg, here.solver.reach(known)
        around = Around(isam=isam, node=known.node, leg=leg, pose=here.at.mean)
        place = placed_by(around, waiting[-1], label, clues)
        if place is not None:
            return place, True
    return crossing(poses, waiting), False


def _poses(here: SmootherBelief) -> Float[np.ndarray, "n 3"]:
    """Return the graph's poses by their numbers, the last as it is expected."""
    last, known = here.link, _known(here)
    poses = np.empty((0, 3))
    if known is not None:
        poses = gtsam.utilities.extractPose2(here.solver.reach(known).calculateEstimate())
    return np.vstack([poses[: last.node], here.at.mean])


def _ahead(pose: Float[np.ndarray, "3"], bearing: float, distance: float) -> np.ndarray:
    """Return the point at a bearing and a range from a pose."""
    angle = pose[2] + bearing
    return pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])


def _prior(label: int, place: Float[np.ndarray, "2"]) -> gtsam.PriorFactorPoint2:
    """Return what is known of a landmark beforehand: next to nothing."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, PRIOR_STD)
    return gtsam.PriorFactorPoint2(landmark_key(label), place, noise)


def _ray(pose: Gaussian, heard: Bearing, rays: RayConfig) -> list[tuple[Gaussian, float]]:
    """Return the members of the ray that a landmark lies on which waits: two or more."""
    ranges, stds = ray_members(rays)
    if len(ranges) == 1:
        ranges, stds = np.repeat(ranges, 2), np.repeat(stds, 2)
    direction = turned(pose.mean[2] + heard.bearing)[:2, :2]
    return [
        (
            Gaussian(
                mean=_ahead(pose.mean, heard.bearing, far),
                covariance=symmetric(
                    direction @ np.diag([spread**2, (far * heard.std) ** 2]) @ direction.T
                    + pose.covariance[:2, :2]
                ),
            ),
            1.0 / len(ranges),
        )
        for far, spread in zip(ranges, stds, strict=True)
    ]


def _rows(*parts: list[tuple[int, Gaussian, float]]) -> Landmarks:
    """Lay out a map of labels, places and weights."""
    rows = [row for part in parts for row in part]
    return Landmarks(
        landmark=np.array([label for label, _, _ in rows], dtype=np.int64),
        mean=np.array([place.mean for _, place, _ in rows]).reshape(-1, 2),
        covariance=np.array([place.covariance for _, place, _ in rows]).reshape(-1, 2, 2),
        weight=np.array([weight for _, _, weight in rows], dtype=float),
    )
