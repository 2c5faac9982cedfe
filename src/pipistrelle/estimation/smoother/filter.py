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
`SmootherBelief.path`, `SmootherBelief.tracks` and the map are the optimum of everything so far.
"""

import math
from collections.abc import Collection, Iterator, Mapping
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
from pipistrelle.estimation.smoother.roaming import (
    Chain,
    Chains,
    gone_on,
    insert_state,
    known_of,
    place_key,
    speed_factor,
    state_of,
    walk_factor,
)

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
    chains : mapping of label to Chain
        Callers that move and are in the graph.
    states : mapping of label to Gaussian of (4) and (4, 4)
        Their places and velocities at the last pose of the graph, as ``at``.
    unplaced : mapping of label to Bearing
        The last of each caller that moves and is not in the graph.
    walk_std : float
        How far a caller's velocity strays in a second [m/s].
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
    chains: Chains = field(default_factory=dict)
    states: Mapping[int, Gaussian] = field(default_factory=dict)
    unplaced: Mapping[int, Bearing] = field(default_factory=dict)
    walk_std: float = 0.0
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

    def moving(self) -> Landmarks:
        """Return callers that move: a row for each in the graph, a ray for each heard just now."""
        now = {
            label: gone_on(state, self.leg.seconds, self.walk_std)
            for label, state in self.states.items()
        }
        points = [(label, _place_in(state), 1.0) for label, state in now.items()]
        rays = [
            (label, member, weight)
            for label, heard in self.unplaced.items()
            if heard.node == self.link.node
            for member, weight in _ray(self.at, heard, self.rays)
        ]
        return _rows(points, rays)

    def tracks(self) -> dict[int, Gaussian]:
        """Return where callers that move were at the poses of the graph, by all that is known now.

        Of each by its label (k + 1, 2) and (k + 1, 2, 2): a row for the start and every control
        step so far, NaN where the graph has none.
        """
        best, found = self.solver.solve(self.link), {}
        steps = [0, *(len(link.leg.mean) for link in links(self.link) if link.leg)]
        rows = np.cumsum(steps)
        size = rows[-1] + len(self.leg.mean) + 1
        for label, chain in self.chains.items():
            mean, covariance = np.full((size, 2), np.nan), np.full((size, 2, 2), np.nan)
            for node in range(chain.first, self.link.node + 1):
                place = best.place(place_key(chain, node))
                mean[rows[node]], covariance[rows[node]] = place.mean, place.covariance
            found[label] = Gaussian(mean=mean, covariance=covariance)
        return found


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

    def init(self, pose: Gaussian) -> SmootherBelief:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        factors.add(start_factor(0, pose))
        values.insert(pose_key(0), gtsam.Pose2(*pose.mean))
        return SmootherBelief(
            at=Gaussian(mean=pose.mean.astype(float), covariance=pose.covariance.astype(float)),
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
        here = _arrived(belief, roving=bool(scan.moving.size or belief.chains))
        if self.gate < 1.0 and (belief.mapped or belief.chains):
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
        scan = rows_of(scan, rows_inside(isam, node, here.mapped, scan, self.gate, here.chains))
        heard = detours_of(scan, node)
        detours = detours_inside(isam, here.mapped, heard, self.gate, here.chains)
        dropped = rows - scan.landmark.size + len(heard) - len(detours)
        return replace(here, gated=here.gated + dropped), scan, detours

    def _heard(
        self, here: SmootherBelief, scan: Scan, detours: tuple[Detour, ...], *, placing: bool
    ) -> SmootherBelief:
        """Add a frame's factors, and those of what it places, if it may, as a link."""
        link = _next_to(here)
        factors, values, node = link.factors, link.values, link.node
        mapped, waiting, crossed = list(here.mapped), dict(here.waiting), False
        poses, moving = _poses(here), {*scan.moving.tolist(), *here.chains}
        chains, unplaced = self._roving(here, link, scan, detours, moving, placing=placing)
        for label, bearing, distance, across, along in _directions(scan):
            if label in moving:
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
                place = _ahead(here.at.mean, bearing, distance)
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


def _arrived(belief: SmootherBelief, *, roving: bool) -> SmootherBelief:
    """Let the leg enter the graph and its end be the last pose, where any has moved.

    The vehicle may have, and callers that rove, if time has passed.
    """
    leg, states = belief.leg, {}
    if not (leg.moves() or (roving and leg.seconds > 0.0)):
        return belief
    node, pose = belief.link.node + 1, belief.pose()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(leg_factor(node, belief.leg))
    values.insert(pose_key(node), gtsam.Pose2(*pose.mean))
    for label, chain in belief.chains.items():
        states[label] = gone_on(belief.states[label], leg.seconds, belief.walk_std)
        insert_state(values, chain, node, states[label].mean)
        factors.add(walk_factor(chain, node, leg.seconds, belief.walk_std))
    link = replace(_after(belief.link, factors, values), node=node, leg=leg)
    return replace(belief, at=pose, leg=NOWHERE, link=link, states=states)


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
    states = {
        label: state_of(isam, chain, belief.link.node) for label, chain in belief.chains.items()
    }
    return replace(belief, at=in_world(mean, isam.marginalCovariance(key)), states=states)


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
    place = _by_detour(here, waiting[-1], label, detours)
    return (crossing(poses, waiting), False) if place is None else (place, True)


def _by_detour(
    here: SmootherBelief, heard: Bearing, label: int, detours: tuple[Detour, ...]
) -> Float[np.ndarray, "2"] | None:
    """Return where one stands by its bearing and the surest of its detours, if any is sure."""
    known, clues = _known(here), clues_of(label, detours, known_of(here.mapped, here.chains))
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


def _prior(point: int, place: Float[np.ndarray, "2"]) -> gtsam.PriorFactorPoint2:
    """Return what is known beforehand of where one stands: next to nothing."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, PRIOR_STD)
    return gtsam.PriorFactorPoint2(point, place, noise)


def _place_in(state: Gaussian) -> Gaussian:
    """Return the place of a caller's place and velocity."""
    return Gaussian(mean=state.mean[:2], covariance=state.covariance[:2, :2])


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
