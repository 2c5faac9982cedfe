"""What the smoother believes: the last link of its graph, and what waits to enter it.

A belief is never changed. Each new one (`with_new_pose`, `with_solved_pose`) has a link whose
predecessor is the old one's. All share one solver, which goes to the link that is asked (`graph`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.config import RayConfig
from pipistrelle.estimation.beliefs import NO_INNOVATIONS, Gaussian, Innovations, Landmarks
from pipistrelle.estimation.rays import ray_members
from pipistrelle.estimation.smoother.caller_motion import (
    Chains,
    insert_state,
    place_key,
    propagated_caller,
    state_of,
    walk_factor,
)
from pipistrelle.estimation.smoother.delayed_initialization import Bearing
from pipistrelle.estimation.smoother.graph import (
    Link,
    Solver,
    in_world,
    links,
    odometry_factor,
    pose_key,
    pose_of,
)
from pipistrelle.estimation.smoother.preintegration import (
    NO_ODOMETRY,
    Odometry,
    between,
    placed,
    symmetric,
    turned,
)
from pipistrelle.estimation.smoother.tdoa import ExcessPath


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherBelief:
    """A link of the graph's chain, and what waits to enter it."""

    at: Gaussian
    """The last pose of the graph, (3) and (3, 3), as it was believed when it entered."""
    odometry: Odometry = NO_ODOMETRY  # the steps since
    link: Link
    mapped: tuple[int, ...] = ()  # landmarks in the graph, in order of entry
    waiting: Mapping[int, tuple[Bearing, ...]] = field(default_factory=dict)
    """bearings of each landmark that is not in the graph."""
    excess_paths: tuple[ExcessPath, ...] = ()  # those that wait for their landmark or caller
    chains: Chains = field(default_factory=dict)  # moving callers in the graph, by label
    states: Mapping[int, Gaussian] = field(default_factory=dict)
    """Their places and velocities, (4) and (4, 4), at the last pose of the graph."""
    unplaced: Mapping[int, Bearing] = field(default_factory=dict)
    """last bearing of each moving caller that is not in the graph."""
    walk_std: float = 0.0  # of a caller's velocity after 1 s [m/s]
    gated: int = 0
    innovations: Innovations = NO_INNOVATIONS  # counted only with a gate
    rays: RayConfig
    solver: Solver  # shared with the beliefs before and after

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        if not len(self.odometry.mean):
            return self.at
        steps = placed(self.at, self.odometry)
        return Gaussian(mean=steps.mean[-1], covariance=steps.covariance[-1])

    def path(self) -> Gaussian:
        """Return the start and every control step so far, given all measurements so far."""
        best = self.solver.solve(self.link)
        start = best.pose(0)
        parts = [Gaussian(mean=start.mean[None], covariance=start.covariance[None])]
        for link in links(self.link):
            if link.odometry:
                ends = np.array([best.pose_mean(link.node - 1), best.pose_mean(link.node)])
                parts.append(between(ends, best.joint(link.node - 1, link.node), link.odometry))
        parts.append(placed(best.pose(self.link.node), self.odometry))
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
        """Return moving callers: a row for each in the graph, a ray for each heard just now."""
        now = {
            label: propagated_caller(state, self.odometry.seconds, self.walk_std)
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
        """Return where moving callers were at the poses of the graph, by label.

        A row (2) and (2, 2) for the start and every control step so far, NaN where the graph has
        none.
        """
        best, found = self.solver.solve(self.link), {}
        steps = [0, *(len(link.odometry.mean) for link in links(self.link) if link.odometry)]
        rows = np.cumsum(steps)
        size = rows[-1] + len(self.odometry.mean) + 1
        for label, chain in self.chains.items():
            mean, covariance = np.full((size, 2), np.nan), np.full((size, 2, 2), np.nan)
            for node in range(chain.first, self.link.node + 1):
                place = best.place(place_key(chain, node))
                mean[rows[node]], covariance[rows[node]] = place.mean, place.covariance
            found[label] = Gaussian(mean=mean, covariance=covariance)
        return found


def with_new_pose(belief: SmootherBelief, *, roving: bool) -> SmootherBelief:
    """Return a belief with a new pose in the graph, if the vehicle, or a caller, may have moved."""
    odometry, states = belief.odometry, {}
    if not (odometry.moves() or (roving and odometry.seconds > 0.0)):
        return belief
    node, pose = belief.link.node + 1, belief.pose()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(odometry_factor(node, belief.odometry))
    values.insert(pose_key(node), gtsam.Pose2(*pose.mean))
    for label, chain in belief.chains.items():
        states[label] = propagated_caller(belief.states[label], odometry.seconds, belief.walk_std)
        insert_state(values, chain, node, states[label].mean)
        factors.add(walk_factor(chain, node, odometry.seconds, belief.walk_std))
    link = replace(_after(belief.link, factors, values), node=node, odometry=odometry)
    return replace(belief, at=pose, odometry=NO_ODOMETRY, link=link, states=states)


def next_link(here: SmootherBelief) -> Link:
    """Return a new link to be filled; it replaces the last one if that is new and unsolved."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    last = here.link
    if last.odometry is None or here.solver.at is last:
        return _after(last, factors, values)
    factors.push_back(last.factors)
    values.insert(last.values)
    return replace(last, factors=factors, values=values)


def _after(last: Link, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Link:
    """Return a link after another, of the same pose."""
    return replace(last, before=last, odometry=None, factors=factors, values=values, crossed=False)


def solved(belief: SmootherBelief) -> SmootherBelief:
    """Return the belief with its graph solved, by QR where Cholesky fails.

    It raises RuntimeError where the graph cannot be solved.
    """
    try:
        belief.solver.reach(belief.link)
    except RuntimeError:
        if belief.link.thorough:
            raise
        belief = replace(belief, link=replace(belief.link, thorough=True))
        belief.solver.reach(belief.link)
    return belief


def with_solved_pose(belief: SmootherBelief) -> SmootherBelief:
    """Return the belief with the last pose, and the callers, as the solver has them."""
    belief = solved(belief)
    isam, key = belief.solver.reach(belief.link), pose_key(belief.link.node)
    mean = pose_of(isam.calculateEstimatePose2(key))
    states = {
        label: state_of(isam, chain, belief.link.node) for label, chain in belief.chains.items()
    }
    return replace(belief, at=in_world(mean, isam.marginalCovariance(key)), states=states)


def last_solved(here: SmootherBelief) -> Link | None:
    """Return the last link that is solved."""
    last = here.link
    return last if last.odometry is None or last is here.solver.at else last.before


def poses_of(here: SmootherBelief) -> Float[np.ndarray, "n 3"]:
    """Return the graph's poses by their numbers; the last one is predicted."""
    last, known = here.link, last_solved(here)
    poses = np.empty((0, 3))
    if known is not None:
        poses = gtsam.utilities.extractPose2(here.solver.reach(known).calculateEstimate())
    return np.vstack([poses[: last.node], here.at.mean])


def ahead(pose: Float[np.ndarray, "3"], bearing: float, distance: float) -> np.ndarray:
    """Return the point at a bearing and a range from a pose."""
    angle = pose[2] + bearing
    return pose[:2] + distance * np.array([math.cos(angle), math.sin(angle)])


def _place_in(state: Gaussian) -> Gaussian:
    """Return the place in a caller's place and velocity."""
    return Gaussian(mean=state.mean[:2], covariance=state.covariance[:2, :2])


def _ray(pose: Gaussian, heard: Bearing, rays: RayConfig) -> list[tuple[Gaussian, float]]:
    """Return the members of the ray of a waiting landmark, two or more."""
    ranges, stds = ray_members(rays)
    if len(ranges) == 1:
        ranges, stds = np.repeat(ranges, 2), np.repeat(stds, 2)
    direction = turned(pose.mean[2] + heard.bearing)[:2, :2]
    return [
        (
            Gaussian(
                mean=ahead(pose.mean, heard.bearing, far),
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
    """Return a map of labels, places and weights."""
    rows = [row for part in parts for row in part]
    return Landmarks(
        landmark=np.array([label for label, _, _ in rows], dtype=np.int64),
        mean=np.array([place.mean for _, place, _ in rows]).reshape(-1, 2),
        covariance=np.array([place.covariance for _, place, _ in rows]).reshape(-1, 2, 2),
        weight=np.array([weight for _, _, weight in rows], dtype=float),
    )
