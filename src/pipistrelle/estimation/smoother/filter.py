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

A caller that moves has a place and a velocity of each node (`roaming`), once a range or a detour
places it: bearings that cross say nothing of what has moved between them. It is no landmark.

``robust`` takes each measurement by Huber's loss. What is believed at a frame is the pose of iSAM2;
path, tracks of callers and map are the optimum of everything so far (`belief`).
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.measurement import BELIEVED
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.smoother.belief import (
    SmootherBelief,
    ahead,
    arrived,
    last_solved,
    next_link,
    poses_of,
    settled,
    solved,
)
from pipistrelle.estimation.smoother.crossing import Bearing, crossing
from pipistrelle.estimation.smoother.detours import Detour, detour_factors, detours_of, parted
from pipistrelle.estimation.smoother.gating import detours_inside, rows_inside
from pipistrelle.estimation.smoother.graph import Link, Solver, landmark_key, pose_key, start_factor
from pipistrelle.estimation.smoother.legs import longer, placed
from pipistrelle.estimation.smoother.placing import Around, clues_of, placed_by
from pipistrelle.estimation.smoother.roaming import (
    Chain,
    Chains,
    insert_state,
    known_of,
    place_key,
    speed_factor,
)

PRIOR_STD = 20.0
"""Of a landmark about the place where it enters [m]."""
MANY = 20
"""Detours that had waited, beyond which all is linearised anew when they enter: they correct many
poses at once, as do bearings that had waited (`graph.ANEW`)."""


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
    speed_std, walk_std : float
        Of callers that move: the velocity [m/s] along an axis before anything is known of it, and
        how far it strays in a second (`estimation.smoother.roaming`).

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
    speed_std: float = 1.0
    walk_std: float = 0.2

    def __post_init__(self) -> None:
        """Refuse a gate that is no share."""
        check_gate(self.gate)

    def init(self, pose: Gaussian) -> SmootherBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        pose = usable_pose(pose)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(start_factor(0, pose))
        values.insert(pose_key(0), gtsam.Pose2(*pose.mean))
        return SmootherBelief(
            at=pose,
            link=Link(before=None, node=0, leg=None, factors=factors, values=values),
            rays=self.rays,
            walk_std=self.walk_std,
            solver=Solver(),
        )

    def knowing(self, belief: SmootherBelief, known: Landmarks) -> SmootherBelief:
        """Return a first belief that has landmarks in its map.

        Parameters
        ----------
        belief : SmootherBelief
            As `init` gives it.
        known : Landmarks
            One row each.

        Returns
        -------
        SmootherBelief
        """
        check_belief(belief, SmootherBelief)
        known = usable_known(known)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values(belief.link.values)
        factors.push_back(belief.link.factors)
        for label, place, spread in zip(
            known.landmark.tolist(), known.mean, known.covariance, strict=True
        ):
            noise = gtsam.noiseModel.Gaussian.Covariance(spread, False)
            values.insert(landmark_key(label), place)
            factors.add(gtsam.PriorFactorPoint2(landmark_key(label), place, noise))
        link = replace(belief.link, factors=factors, values=values)
        return replace(belief, link=link, mapped=tuple(known.landmark.tolist()))

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
        check_belief(belief, SmootherBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
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
        check_belief(belief, SmootherBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        try:
            return self._updated(belief, scan)
        except RuntimeError:  # a covariance that Cholesky's factors are too coarse for
            belief = replace(belief, link=replace(belief.link, thorough=True))
            return self._updated(solved(belief), scan)

    def _updated(self, belief: SmootherBelief, scan: Scan) -> SmootherBelief:
        """Let a frame's measurements enter the graph, and what they place."""
        here = arrived(belief, roving=bool(scan.moving.size or belief.chains))
        if self.gate < 1.0 and (belief.mapped or belief.chains):
            here, scan, detours = self._gated(solved(here), scan)
        else:
            detours = detours_of(scan, here.link.node)
        for placing in (True, False):
            heard = self._heard(here, scan, detours, placing=placing)
            try:
                return settled(heard)
            except RuntimeError:  # what entered cannot be solved
                continue
        return settled(here)

    def _gated(
        self, here: SmootherBelief, scan: Scan
    ) -> tuple[SmootherBelief, Scan, tuple[Detour, ...]]:
        """Return what is inside the gate, and count what is not."""
        isam, node, rows = here.solver.reach(here.link), here.link.node, scan.landmark.size
        heard = detours_of(scan, node)  # of all rows: a bearing that is wrong is nothing to them
        inside, off_by = rows_inside(isam, node, here.mapped, scan, self.gate, here.chains)
        scan = rows_of(scan, inside)
        detours = detours_inside(isam, here.mapped, heard, self.gate, here.chains)
        dropped = rows - scan.landmark.size + len(heard) - len(detours)
        innovations = here.innovations.plus(*off_by)
        return replace(here, gated=here.gated + dropped, innovations=innovations), scan, detours

    def _heard(
        self, here: SmootherBelief, scan: Scan, detours: tuple[Detour, ...], *, placing: bool
    ) -> SmootherBelief:
        """Add a frame's factors, and those of what it places, if it may, as a link."""
        link = next_link(here)
        factors, values, node = link.factors, link.values, link.node
        mapped, waiting, crossed = list(here.mapped), dict(here.waiting), False
        poses, moving = poses_of(here), {*scan.moving.tolist(), *here.chains}
        chains, unplaced = self._roving(here, link, scan, detours, moving, placing=placing)
        for label, bearing, distance, across, along in _directions(scan):
            if label in moving:
                continue
            heard, passive = Bearing(node, bearing, across), math.isnan(distance)
            if label not in mapped:
                place, sure = ahead(poses[node], bearing, distance), False
                if passive:
                    waiting[label], place = (*waiting.get(label, ()), heard), None
                    if placing:
                        place, sure = _placed(here, poses, waiting[label], label, detours)
                if place is None:
                    continue
                mapped.append(label)
                values.insert(landmark_key(label), place)
                factors.add(_prior(landmark_key(label), place))
                crossed |= label in here.waiting and not sure
                for earlier in waiting.pop(label, ()):
                    factors.add(self._bearing(earlier, landmark_key(label)))
                if passive:
                    continue
            told = (bearing, distance), (across, along)
            factors.add(self._direction(node, landmark_key(label), *told))
        here = replace(here, link=replace(link, crossed=crossed), chains=chains, unplaced=unplaced)
        return self._timed(replace(here, mapped=tuple(mapped), waiting=waiting), detours, moving)

    def _roving(
        self,
        here: SmootherBelief,
        link: Link,
        scan: Scan,
        detours: tuple[Detour, ...],
        moving: Collection[int],
        *,
        placing: bool,
    ) -> tuple[Chains, dict[int, Bearing]]:
        """Add to a link what a frame tells of callers that move, and of those it places, if it may.

        Returns those in the graph, and the bearings of those that are not.
        """
        chains, unplaced = dict(here.chains), dict(here.unplaced)
        for label, bearing, distance, across, along in _directions(scan) if moving else ():
            if label not in moving:
                continue
            if label not in chains:
                place = ahead(here.at.mean, bearing, distance)
                if math.isnan(distance):
                    unplaced[label] = Bearing(link.node, bearing, across)
                    place = _by_detour(here, unplaced[label], label, detours) if placing else None
                if place is None:
                    continue
                unplaced.pop(label, None)
                chains[label] = Chain(len(chains), link.node)
                self._begin(link, chains[label], place)
            told = (bearing, distance), (across, along)
            link.factors.add(self._direction(link.node, place_key(chains[label], link.node), *told))
        return chains, unplaced

    def _begin(self, link: Link, chain: Chain, place: Float[np.ndarray, "2"]) -> None:
        """Add to a link where a caller enters that moves, how fast, nobody knows."""
        insert_state(link.values, chain, link.node, np.append(place, np.zeros(2)))
        link.factors.add(_prior(place_key(chain, link.node), place))
        link.factors.add(speed_factor(chain, self.speed_std))

    def _timed(
        self, here: SmootherBelief, detours: tuple[Detour, ...], moving: Collection[int]
    ) -> SmootherBelief:
        """Add the detours to the last link whose ends are both in the graph; the others wait."""
        link, known = here.link, set(here.mapped)
        entering, late = parted((*here.detours, *detours), known, here.chains, moving)
        for factor in detour_factors(entering, robust=self.robust, chains=here.chains):
            link.factors.add(factor)
        many = sum(one.node < link.node for one in entering) > MANY
        return replace(here, link=replace(link, crossed=link.crossed or many), detours=late)

    def _bearing(self, heard: Bearing, point: int) -> gtsam.BearingFactor2D:
        """Return what a bearing says of what has this name in the graph."""
        noise = self._noise(gtsam.noiseModel.Isotropic.Sigma(1, heard.std))
        keys = pose_key(heard.node), point
        return gtsam.BearingFactor2D(*keys, gtsam.Rot2(heard.bearing), noise)

    def _direction(
        self, node: int, point: int, heard: tuple[float, float], std: tuple[float, float]
    ) -> gtsam.BearingRangeFactor2D | gtsam.BearingFactor2D:
        """Return what a bearing says, and a range, where there is one."""
        bearing, distance = heard
        if math.isnan(distance):
            return self._bearing(Bearing(node, bearing, std[0]), point)
        noise = self._noise(gtsam.noiseModel.Diagonal.Sigmas(np.array(std)))
        return gtsam.BearingRangeFactor2D(
            pose_key(node), point, gtsam.Rot2(bearing), distance, noise
        )

    def _noise(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """Return a noise model, with Huber's loss where that is asked for."""
        if not self.robust:
            return noise
        huber = gtsam.noiseModel.mEstimator.Huber.Create(BELIEVED)
        return gtsam.noiseModel.Robust.Create(huber, noise)


def _directions(scan: Scan) -> Iterator[tuple[int, float, float, float, float]]:
    """Walk through label, bearing, range and their deviations, but for what is a detour alone."""
    columns = (scan.landmark, scan.bearing, scan.range, scan.bearing_std, scan.range_std)
    for row in zip(*map(np.ndarray.tolist, columns), strict=True):
        if not math.isnan(row[1]):
            yield row


def _placed(
    here: SmootherBelief,
    poses: Float[np.ndarray, "n 3"],
    waiting: tuple[Bearing, ...],
    label: int,
    detours: tuple[Detour, ...],
) -> tuple[Float[np.ndarray, "2"] | None, bool]:
    """Return where one stands that was only ever heard, if it shows, and whether by a detour."""
    place = _by_detour(here, waiting[-1], label, detours)
    return (crossing(poses, waiting), False) if place is None else (place, True)


def _by_detour(
    here: SmootherBelief, heard: Bearing, label: int, detours: tuple[Detour, ...]
) -> Float[np.ndarray, "2"] | None:
    """Return where one stands by its bearing and the surest of its detours, if any is sure."""
    known, clues = last_solved(here), clues_of(label, detours, known_of(here.mapped, here.chains))
    if not clues or known is None:
        return None
    around = Around(
        isam=here.solver.reach(known),
        node=known.node,
        leg=None if known is here.link else here.link.leg,
        pose=here.at.mean,
        chains=here.chains,
        walk_std=here.walk_std,
    )
    return placed_by(around, heard, label, clues)


def _prior(point: int, place: Float[np.ndarray, "2"]) -> gtsam.PriorFactorPoint2:
    """Return what is known beforehand of where one stands: next to nothing."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, PRIOR_STD)
    return gtsam.PriorFactorPoint2(point, place, noise)
