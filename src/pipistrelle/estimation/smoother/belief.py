"""What the smoother believes: the last link of its graph, and what waits to enter it.

A belief is never changed. What comes next is a new one (`arrived`, `settled`) whose link has the
old one's before it, and the solver, which all share, goes to whichever is asked (`graph`).
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
from pipistrelle.estimation.smoother.crossing import Bearing
from pipistrelle.estimation.smoother.detours import Detour
from pipistrelle.estimation.smoother.graph import (
    Link,
    Solver,
    in_world,
    leg_factor,
    links,
    pose_key,
    pose_of,
)
from pipistrelle.estimation.smoother.legs import NOWHERE, Leg, between, placed, symmetric, turned
from pipistrelle.estimation.smoother.roaming import (
    Chains,
    gone_on,
    insert_state,
    place_key,
    state_of,
    walk_factor,
)


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
    innovations : Innovations
        Where there is a gate: without one nothing is foreseen.
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
    innovations: Innovations = NO_INNOVATIONS
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


def arrived(belief: SmootherBelief, *, roving: bool) -> SmootherBelief:
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


def next_link(here: SmootherBelief) -> Link:
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


def solved(belief: SmootherBelief) -> SmootherBelief:
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


def settled(belief: SmootherBelief) -> SmootherBelief:
    """Return the belief with the last pose as the solver has it."""
    belief = solved(belief)
    isam, key = belief.solver.reach(belief.link), pose_key(belief.link.node)
    mean = pose_of(isam.calculateEstimatePose2(key))
    states = {
        label: state_of(isam, chain, belief.link.node) for label, chain in belief.chains.items()
    }
    return replace(belief, at=in_world(mean, isam.marginalCovariance(key)), states=states)


def last_solved(here: SmootherBelief) -> Link | None:
    """Return the last link that has been solved."""
    last = here.link
    return last if last.leg is None or last is here.solver.at else last.before


def poses_of(here: SmootherBelief) -> Float[np.ndarray, "n 3"]:
    """Return the graph's poses by their numbers, the last as it is expected."""
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
    """Lay out a map of labels, places and weights."""
    rows = [row for part in parts for row in part]
    return Landmarks(
        landmark=np.array([label for label, _, _ in rows], dtype=np.int64),
        mean=np.array([place.mean for _, place, _ in rows]).reshape(-1, 2),
        covariance=np.array([place.covariance for _, place, _ in rows]).reshape(-1, 2, 2),
        weight=np.array([weight for _, _, weight in rows], dtype=float),
    )
