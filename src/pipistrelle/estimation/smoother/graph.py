"""The graph: poses and landmarks with all that is known of them, solved by GTSAM's iSAM2.

What entered it is a chain, each link what one frame added to the one before, and never changed: a
belief is a link. The solver itself changes; it stands at one link, goes on to the next as frames
come, and is built anew where it is asked for a link that it has left behind.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.smoother.legs import SMALLEST_STD, Leg, symmetric, turned

T = TypeVar("T")
RELINEARIZE = 0.1
"""Change of a variable [m, rad] beyond which iSAM2 linearises anew what hangs on it."""
ANEW = 5
"""Times that all is linearised anew where bearings enter that had waited: many of them enter at
once, from poses that they correct, and a graph that was linearised before may never recover.
Without it logs of bearings of 0.003 rad are lost (`test_recorded`); in twelve worlds heard by sound
it changes nothing."""
CONVERGED = 1e-7
"""Change of the squared error, and its share of it, under which the optimum is reached."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """What one frame added to a graph.

    Attributes
    ----------
    before : Link or None
    node : int
        Number of the pose from which the frame was heard.
    leg : Leg or None
        The way to it, where it is new.
    factors : NonlinearFactorGraph
    values : Values
        Where what is new is thought to be.
    thorough : bool
        Whether to solve by QR factors, which cost twice as much as Cholesky's, for these were too
        coarse: some noise is so small beside another.
    crossed : bool
        Whether bearings entered that had waited, or many detours.
    """

    before: "Link | None"
    node: int
    leg: Leg | None
    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    thorough: bool = False
    crossed: bool = False


def links(last: Link) -> Iterator[Link]:
    """Walk through a chain, the first link first."""
    chain: list[Link] = []
    link: Link | None = last
    while link:
        chain.append(link)
        link = link.before
    return reversed(chain)


@dataclass(kw_only=True)
class Solver:
    """iSAM2, standing at one link of a chain."""

    at: Link | None = None
    isam: gtsam.ISAM2 | None = None
    best: "Best | None" = None

    def reach(self, link: Link) -> gtsam.ISAM2:
        """Return iSAM2 as it is after a link.

        Raises
        ------
        RuntimeError
            Where the link makes a graph that cannot be solved; the solver then stands nowhere.
        """
        isam, at = self.isam, self.at
        if isam is None or at is not link:
            way: Iterable[Link] = (link,)
            if isam is None or at is None or at is not link.before or at.thorough != link.thorough:
                isam, way = _new(link.thorough), links(link)
            self.isam, self.at = isam, None
            for step in way:
                isam.update(step.factors, step.values)
                for _ in range(ANEW if step.crossed else 0):
                    isam.update(force_relinearize=True)
                isam.calculateEstimatePose2(pose_key(step.node))  # what is asked changes it
            self.at = link
        return isam

    def solve(self, link: Link) -> "Best":
        """Return the best solution of all that entered up to a link."""
        if self.best is None or self.best.link is not link:
            graph = gtsam.NonlinearFactorGraph()
            for step in links(link):
                graph.push_back(step.factors)
            self.best = Best(link=link, graph=graph, found=self.reach(link).calculateEstimate())
        return self.best


def _new(thorough: bool) -> gtsam.ISAM2:
    """Return a solver that knows nothing."""
    settings = gtsam.ISAM2Params()
    settings.setRelinearizeThreshold(RELINEARIZE)
    settings.setFactorization(_factors(thorough))
    return gtsam.ISAM2(settings)


def _factors(thorough: bool) -> str:
    """Return what solves a linear system, as GTSAM names it."""
    return "QR" if thorough else "CHOLESKY"


@dataclass(kw_only=True)
class Best:
    """The most likely poses and landmarks, all linearised where they are, and their covariances.

    Attributes
    ----------
    link : Link
    graph : NonlinearFactorGraph
    found : Values
        Where iSAM2 thinks them: Levenberg and Marquardt begin there.
    """

    link: Link
    graph: gtsam.NonlinearFactorGraph
    found: gtsam.Values

    @cached_property
    def values(self) -> gtsam.Values:
        """Return the optimum, or what iSAM2 found where none can be reached from there."""
        settings = gtsam.LevenbergMarquardtParams()
        settings.setLinearSolverType(f"MULTIFRONTAL_{_factors(self.link.thorough)}")
        settings.setRelativeErrorTol(CONVERGED)
        settings.setAbsoluteErrorTol(CONVERGED)
        try:
            return gtsam.LevenbergMarquardtOptimizer(self.graph, self.found, settings).optimize()
        except RuntimeError:
            return self.found

    @cached_property
    def there(self) -> gtsam.ISAM2:
        """Return what tells covariances at the optimum."""
        return self._solver(thorough=self.link.thorough)

    def _solver(self, *, thorough: bool) -> gtsam.ISAM2:
        """Return all of the graph, linearised at the optimum."""
        isam = _new(thorough)
        isam.update(self.graph, self.values)
        return isam

    def _asked(self, question: Callable[[gtsam.ISAM2], T]) -> T:
        """Ask for covariances, by QR factors where Cholesky's are too coarse (`Link.thorough`)."""
        try:
            return question(self.there)
        except RuntimeError:
            self.there = self._solver(thorough=True)
            return question(self.there)

    def _covariance(self, key: int) -> Float[np.ndarray, "d d"]:
        """Return the covariance of a pose or a point by its name in the graph."""
        return self._asked(lambda isam: isam.marginalCovariance(key))

    def pose_mean(self, node: int) -> Float[np.ndarray, "3"]:
        """Return where a pose is."""
        return pose_of(self.values.atPose2(pose_key(node)))

    def pose(self, node: int) -> Gaussian:
        """Return a pose, (3) and (3, 3)."""
        mean = self.pose_mean(node)
        return in_world(mean, self._covariance(pose_key(node)))

    def point(self, label: int) -> Gaussian:
        """Return a landmark, (2) and (2, 2)."""
        return self.place(landmark_key(label))

    def place(self, key: int) -> Gaussian:
        """Return a landmark or a caller's place by its name in the graph, (2) and (2, 2)."""
        mean = np.array(self.values.atPoint2(key))
        return Gaussian(mean=mean, covariance=symmetric(self._covariance(key)))

    def joint(self, node: int, other: int) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of two poses."""
        keys = pose_key(node), pose_key(other)
        joint = self._asked(lambda isam: isam.jointMarginalCovariance(list(keys)))
        M = np.zeros((6, 6))
        for part, key in enumerate(keys):
            rows = slice(3 * part, 3 * part + 3)
            M[rows, rows] = turned(self.values.atPose2(key).theta())
        return M @ np.block([[joint.at(a, b) for b in keys] for a in keys]) @ M.T


def pose_key(node: int) -> int:
    """Name a pose in the graph."""
    return gtsam.symbol("x", node)


def landmark_key(label: int) -> int:
    """Name a landmark in the graph."""
    return gtsam.symbol("l", label)


def pose_of(pose: gtsam.Pose2) -> Float[np.ndarray, "3"]:
    """Return GTSAM's pose as ours [m, m, rad]."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def in_world(mean: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> Gaussian:
    """Return a pose whose covariance is told in its own axes, as GTSAM does."""
    M = turned(mean[2])
    return Gaussian(mean=mean, covariance=symmetric(M @ covariance @ M.T))


def start_factor(node: int, pose: Gaussian) -> gtsam.PriorFactorPose2:
    """Return what is known of a pose (3) and (3, 3) beforehand."""
    M = turned(pose.mean[2])
    return gtsam.PriorFactorPose2(
        pose_key(node), gtsam.Pose2(*pose.mean), _gaussian(M.T @ pose.covariance @ M)
    )


def leg_factor(node: int, leg: Leg) -> gtsam.BetweenFactorPose2:
    """Return what the controls say of the way from the pose before to this one."""
    M = turned(leg.mean[-1, 2])
    noise = _gaussian(M.T @ leg.covariance[-1] @ M)
    return gtsam.BetweenFactorPose2(
        pose_key(node - 1), pose_key(node), gtsam.Pose2(*leg.mean[-1]), noise
    )


def _gaussian(covariance: Float[np.ndarray, "3 3"]) -> gtsam.noiseModel.Gaussian:
    """Return a noise model, which must have an inverse; GTSAM may not drop small correlations."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance + SMALLEST_STD**2 * np.eye(3), False)
