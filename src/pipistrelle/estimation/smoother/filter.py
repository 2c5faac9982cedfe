"""The smoother: the whole path is estimated again with each frame, by relinearisation.

A filter folds what it hears into one Gaussian, linearised where it then was. Here every measurement
stays a *factor* between a pose and a landmark, and a sparse solver (GTSAM's iSAM2: Kaess et al.,
International Journal of Robotics Research 31, 2012) relinearises what has moved. Poses are those
from which something was heard (`preintegration` has the steps between).

A landmark enters with its first range, or where two of its bearings cross clearly
(`delayed_initialization`), with all its bearings so far: until then it waits, its bearings are not
used, and it counts as partial. With excess paths, it enters with the first one that makes its range
sure (`tdoa_initialization`), for which its caller must be in the graph; a caller enters likewise,
by the excess path over a landmark that is. An excess path is a factor between pose, landmark and
caller (`tdoa`), and waits, too, until both are there. What enters gets a weak prior of `PRIOR_STD`,
so that every graph has a solution. If a graph with new landmarks cannot be solved, they go on
waiting.

A moving caller has a place and a velocity at each node (`caller_motion`), once a range or an excess
path places it: crossing bearings say nothing of what has moved between them. It is no landmark.

``robust`` uses Huber's loss. The belief at a frame is the pose of iSAM2; path, tracks of callers
and map are the optimum of everything so far (`belief`).
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
from pipistrelle.estimation.measurement import HUBER_K
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.smoother.belief import (
    SmootherBelief,
    ahead,
    last_solved,
    next_link,
    poses_of,
    solved,
    with_new_pose,
    with_solved_pose,
)
from pipistrelle.estimation.smoother.caller_motion import (
    Chain,
    Chains,
    insert_state,
    labels_in_graph,
    place_key,
    speed_factor,
)
from pipistrelle.estimation.smoother.delayed_initialization import Bearing, crossing
from pipistrelle.estimation.smoother.gating import excess_paths_inside, rows_inside
from pipistrelle.estimation.smoother.graph import Link, Solver, landmark_key, pose_key, start_factor
from pipistrelle.estimation.smoother.preintegration import extended, placed
from pipistrelle.estimation.smoother.tdoa import (
    ExcessPath,
    excess_path_factors,
    excess_paths_of,
    split_ready,
)
from pipistrelle.estimation.smoother.tdoa_initialization import (
    LastPose,
    place_by_excess_paths,
    usable_excess_paths,
)

PRIOR_STD = 20.0
"""Prior of a landmark about the place where it enters [m]."""
RELINEARISE_ABOVE = 20
"""If more waiting excess paths than this enter, all is relinearised: they correct many poses at
once, as do waiting bearings (`graph.RELINEARISE_PASSES`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoother:
    """Incremental smoothing and mapping by iSAM2.

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
    rays: RayConfig  # how far a waiting landmark may be
    gate: float = 1.0  # as those of `EkfSlam`, and all below
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
            link=Link(before=None, node=0, odometry=None, factors=factors, values=values),
            rays=self.rays,
            walk_std=self.walk_std,
            solver=Solver(),
        )

    def knowing(self, belief: SmootherBelief, known: Landmarks) -> SmootherBelief:
        """Return a first belief with landmarks in its map; ``belief`` is that of `init`."""
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
        """Carry the belief through the control steps of a frame; nothing is drawn.

        Returns the belief and the pose after each step, (k, 3) and (k, 3, 3).
        """
        check_belief(belief, SmootherBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        odometry = extended(belief.odometry, self.motion, controls, dt)
        steps, new = placed(belief.at, odometry), len(odometry.mean) - len(dt)
        poses = Gaussian(mean=steps.mean[new:], covariance=steps.covariance[new:])
        return replace(belief, odometry=odometry), poses

    def update(
        self, belief: SmootherBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> SmootherBelief:
        """Add a frame's measurements to the graph, and the landmarks that they place."""
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
        """Add a frame's measurements to the graph, and the landmarks that they place."""
        here = with_new_pose(belief, roving=bool(scan.moving.size or belief.chains))
        if self.gate < 1.0 and (belief.mapped or belief.chains):
            here, scan, excess_paths = self._gated(solved(here), scan)
        else:
            excess_paths = excess_paths_of(scan, here.link.node)
        for initialize in (True, False):
            heard = self._heard(here, scan, excess_paths, initialize=initialize)
            try:
                return with_solved_pose(heard)
            except RuntimeError:  # what entered cannot be solved
                continue
        return with_solved_pose(here)

    def _gated(
        self, here: SmootherBelief, scan: Scan
    ) -> tuple[SmootherBelief, Scan, tuple[ExcessPath, ...]]:
        """Return belief, scan and excess paths that pass the gate, and count what does not."""
        isam, node, rows = here.solver.reach(here.link), here.link.node, scan.landmark.size
        heard = excess_paths_of(
            scan, node
        )  # of all rows: a bearing that is wrong is nothing to them
        inside, off_by = rows_inside(isam, node, here.mapped, scan, self.gate, here.chains)
        scan = rows_of(scan, inside)
        excess_paths = excess_paths_inside(isam, here.mapped, heard, self.gate, here.chains)
        dropped = rows - scan.landmark.size + len(heard) - len(excess_paths)
        innovations = here.innovations.plus(*off_by)
        return (
            replace(here, gated=here.gated + dropped, innovations=innovations),
            scan,
            excess_paths,
        )

    def _heard(
        self,
        here: SmootherBelief,
        scan: Scan,
        excess_paths: tuple[ExcessPath, ...],
        *,
        initialize: bool,
    ) -> SmootherBelief:
        """Return the belief with a frame's factors; with ``initialize``, also what they place."""
        link = next_link(here)
        factors, values, node = link.factors, link.values, link.node
        mapped, waiting, crossed = list(here.mapped), dict(here.waiting), False
        poses, moving = poses_of(here), {*scan.moving.tolist(), *here.chains}
        chains, unplaced = self._roving(
            here, link, scan, excess_paths, moving, initialize=initialize
        )
        for label, bearing, distance, across, along in _directions(scan):
            if label in moving:
                continue
            heard, passive = Bearing(node, bearing, across), math.isnan(distance)
            if label not in mapped:
                place, sure = ahead(poses[node], bearing, distance), False
                if passive:
                    waiting[label], place = (*waiting.get(label, ()), heard), None
                    if initialize:
                        place, sure = _placed(here, poses, waiting[label], label, excess_paths)
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
            row = (bearing, distance), (across, along)
            factors.add(self._direction(node, landmark_key(label), *row))
        here = replace(here, link=replace(link, crossed=crossed), chains=chains, unplaced=unplaced)
        return self._timed(
            replace(here, mapped=tuple(mapped), waiting=waiting), excess_paths, moving
        )

    def _roving(
        self,
        here: SmootherBelief,
        link: Link,
        scan: Scan,
        excess_paths: tuple[ExcessPath, ...],
        moving: Collection[int],
        *,
        initialize: bool,
    ) -> tuple[Chains, dict[int, Bearing]]:
        """Add to a link the factors of moving callers; with ``initialize``, new callers, too.

        Returns the callers in the graph, and the bearings of those that are not.
        """
        chains, unplaced = dict(here.chains), dict(here.unplaced)
        for label, bearing, distance, across, along in _directions(scan) if moving else ():
            if label not in moving:
                continue
            if label not in chains:
                place = ahead(here.at.mean, bearing, distance)
                if math.isnan(distance):
                    unplaced[label] = Bearing(link.node, bearing, across)
                    place = (
                        _by_excess_path(here, unplaced[label], label, excess_paths)
                        if initialize
                        else None
                    )
                if place is None:
                    continue
                unplaced.pop(label, None)
                chains[label] = Chain(len(chains), link.node)
                self._begin(link, chains[label], place)
            row = (bearing, distance), (across, along)
            link.factors.add(self._direction(link.node, place_key(chains[label], link.node), *row))
        return chains, unplaced

    def _begin(self, link: Link, chain: Chain, place: Float[np.ndarray, "2"]) -> None:
        """Add to a link a new moving caller, of unknown velocity."""
        insert_state(link.values, chain, link.node, np.append(place, np.zeros(2)))
        link.factors.add(_prior(place_key(chain, link.node), place))
        link.factors.add(speed_factor(chain, self.speed_std))

    def _timed(
        self, here: SmootherBelief, excess_paths: tuple[ExcessPath, ...], moving: Collection[int]
    ) -> SmootherBelief:
        """Add the excess paths whose ends are in the graph to the last link; the others wait."""
        link, known = here.link, set(here.mapped)
        entering, late = split_ready(
            (*here.excess_paths, *excess_paths), known, here.chains, moving
        )
        for factor in excess_path_factors(entering, robust=self.robust, chains=here.chains):
            link.factors.add(factor)
        many = sum(one.node < link.node for one in entering) > RELINEARISE_ABOVE
        return replace(here, link=replace(link, crossed=link.crossed or many), excess_paths=late)

    def _bearing(self, heard: Bearing, point: int) -> gtsam.BearingFactor2D:
        """Return the factor of a bearing of the point with this key."""
        noise = self._noise(gtsam.noiseModel.Isotropic.Sigma(1, heard.std))
        keys = pose_key(heard.node), point
        return gtsam.BearingFactor2D(*keys, gtsam.Rot2(heard.bearing), noise)

    def _direction(
        self, node: int, point: int, heard: tuple[float, float], std: tuple[float, float]
    ) -> gtsam.BearingRangeFactor2D | gtsam.BearingFactor2D:
        """Return the factor of a bearing, and of its range, where there is one."""
        bearing, distance = heard
        if math.isnan(distance):
            return self._bearing(Bearing(node, bearing, std[0]), point)
        noise = self._noise(gtsam.noiseModel.Diagonal.Sigmas(np.array(std)))
        return gtsam.BearingRangeFactor2D(
            pose_key(node), point, gtsam.Rot2(bearing), distance, noise
        )

    def _noise(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """Return a noise model, with Huber's loss if ``robust``."""
        if not self.robust:
            return noise
        huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K)
        return gtsam.noiseModel.Robust.Create(huber, noise)


def _directions(scan: Scan) -> Iterator[tuple[int, float, float, float, float]]:
    """Iterate over label, bearing, range and their deviations of the rows that have a bearing."""
    columns = (scan.landmark, scan.bearing, scan.range, scan.bearing_std, scan.range_std)
    for row in zip(*map(np.ndarray.tolist, columns), strict=True):
        if not math.isnan(row[1]):
            yield row


def _placed(
    here: SmootherBelief,
    poses: Float[np.ndarray, "n 3"],
    waiting: tuple[Bearing, ...],
    label: int,
    excess_paths: tuple[ExcessPath, ...],
) -> tuple[Float[np.ndarray, "2"] | None, bool]:
    """Return a landmark's place without a range, if known, and whether an excess path gave it."""
    place = _by_excess_path(here, waiting[-1], label, excess_paths)
    return (crossing(poses, waiting), False) if place is None else (place, True)


def _by_excess_path(
    here: SmootherBelief, heard: Bearing, label: int, excess_paths: tuple[ExcessPath, ...]
) -> Float[np.ndarray, "2"] | None:
    """Return the place of a landmark or caller by its bearing and surest excess path, if sure."""
    known, usable = (
        last_solved(here),
        usable_excess_paths(label, excess_paths, labels_in_graph(here.mapped, here.chains)),
    )
    if not usable or known is None:
        return None
    last = LastPose(
        isam=here.solver.reach(known),
        node=known.node,
        odometry=None if known is here.link else here.link.odometry,
        pose=here.at.mean,
        chains=here.chains,
        walk_std=here.walk_std,
    )
    return place_by_excess_paths(last, heard, label, usable)


def _prior(point: int, place: Float[np.ndarray, "2"]) -> gtsam.PriorFactorPoint2:
    """Return the weak prior of the place where a landmark enters."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, PRIOR_STD)
    return gtsam.PriorFactorPoint2(point, place, noise)
