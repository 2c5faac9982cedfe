"""The graph of poses and landmarks, with all factors, solved by GTSAM's iSAM2.

What entered it is a chain: each link holds what one frame added, and is never changed; a belief is
a link. The solver does change: it is at one link, goes on to the next as frames come, and is built
anew where it is asked for a link that it has passed.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.smoother.preintegration import SMALLEST_STD, Odometry, symmetric, turned

T = TypeVar("T")
RELINEARISE_THRESHOLD = 0.1
"""Change of a variable [m, rad] beyond which iSAM2 relinearises its factors."""
RELINEARISE_PASSES = 5
"""How often everything is relinearised where waiting bearings enter: many of them enter at once,
from poses that they correct, and a graph that was linearised before may never recover. Without it
logs of bearings of 0.003 rad are lost (`test_recorded`); in twelve worlds heard by sound it changes
nothing."""
CONVERGED = 1e-7
"""Change of the squared error, absolute and relative, under which the optimum is reached."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """What one frame added to a graph."""

    before: "Link | None"
    node: int  # number of the pose from which the frame was heard
    odometry: Odometry | None  # the steps to it, where the pose is new
    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values  # initial estimates of what is new
    thorough: bool = False
    """Whether to solve by QR, which costs twice as much as Cholesky and is needed where some noise
    is very small beside another."""
    crossed: bool = False  # whether waiting bearings entered, or many excess paths


def links(last: Link) -> Iterator[Link]:
    """Return a chain's links, the first one first."""
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

        It raises RuntimeError where the graph cannot be solved; the solver is then at no link.
        """
        isam, at = self.isam, self.at
        if isam is None or at is not link:
            way: Iterable[Link] = (link,)
            if isam is None or at is None or at is not link.before or at.thorough != link.thorough:
                isam, way = _new(link.thorough), links(link)
            self.isam, self.at = isam, None
            for step in way:
                isam.update(step.factors, step.values)
                for _ in range(RELINEARISE_PASSES if step.crossed else 0):
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
    """Return an empty solver."""
    settings = gtsam.ISAM2Params()
    settings.setRelinearizeThreshold(RELINEARISE_THRESHOLD)
    settings.setFactorization(_factors(thorough))
    return gtsam.ISAM2(settings)


def _factors(thorough: bool) -> str:
    """Return GTSAM's name of the factorisation."""
    return "QR" if thorough else "CHOLESKY"


@dataclass(kw_only=True)
class Best:
    """The most likely poses and landmarks, linearised at the optimum, and their covariances."""

    link: Link
    graph: gtsam.NonlinearFactorGraph
    found: gtsam.Values  # iSAM2's estimate, where Levenberg-Marquardt begins

    @cached_property
    def values(self) -> gtsam.Values:
        """Return the optimum, or iSAM2's estimate where the optimiser fails."""
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
        """Return the solver for covariances at the optimum."""
        return self._solver(thorough=self.link.thorough)

    def _solver(self, *, thorough: bool) -> gtsam.ISAM2:
        """Return a solver of the whole graph, linearised at the optimum."""
        isam = _new(thorough)
        isam.update(self.graph, self.values)
        return isam

    def _asked(self, question: Callable[[gtsam.ISAM2], T]) -> T:
        """Ask for covariances, by QR where Cholesky fails (`Link.thorough`)."""
        try:
            return question(self.there)
        except RuntimeError:
            self.there = self._solver(thorough=True)
            return question(self.there)

    def _covariance(self, key: int) -> Float[np.ndarray, "d d"]:
        """Return the covariance of a pose or a point by its key."""
        return self._asked(lambda isam: isam.marginalCovariance(key))

    def pose_mean(self, node: int) -> Float[np.ndarray, "3"]:
        """Return the mean of a pose."""
        return pose_of(self.values.atPose2(pose_key(node)))

    def pose(self, node: int) -> Gaussian:
        """Return a pose, (3) and (3, 3)."""
        mean = self.pose_mean(node)
        return in_world(mean, self._covariance(pose_key(node)))

    def point(self, label: int) -> Gaussian:
        """Return a landmark, (2) and (2, 2)."""
        return self.place(landmark_key(label))

    def place(self, key: int) -> Gaussian:
        """Return a landmark or a caller's place by its key, (2) and (2, 2)."""
        mean = np.array(self.values.atPoint2(key))
        return Gaussian(mean=mean, covariance=symmetric(self._covariance(key)))

    def joint(self, node: int, other: int) -> Float[np.ndarray, "6 6"]:
        """Return the joint covariance of two poses."""
        keys = pose_key(node), pose_key(other)
        joint = self._asked(lambda isam: joint_covariance(isam, *keys))
        M = np.zeros((6, 6))
        for part, key in enumerate(keys):
            rows = slice(3 * part, 3 * part + 3)
            M[rows, rows] = turned(self.values.atPose2(key).theta())
        return M @ joint @ M.T


def joint_covariance(isam: gtsam.ISAM2, *keys: int) -> Float[np.ndarray, "d d"]:
    """Return the joint covariance of some variables, a pose's in its own axes."""
    joint = isam.jointMarginalCovariance(list(keys))
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def pose_key(node: int) -> int:
    """Return the key of a pose in the graph."""
    return gtsam.symbol("x", node)


def landmark_key(label: int) -> int:
    """Return the key of a landmark in the graph."""
    return gtsam.symbol("l", label)


def pose_of(pose: gtsam.Pose2) -> Float[np.ndarray, "3"]:
    """Return GTSAM's pose as an array [m, m, rad]."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def in_world(mean: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> Gaussian:
    """Return a pose whose covariance GTSAM gives in its own axes."""
    M = turned(mean[2])
    return Gaussian(mean=mean, covariance=symmetric(M @ covariance @ M.T))


def start_factor(node: int, pose: Gaussian) -> gtsam.PriorFactorPose2:
    """Return the prior of a pose (3) and (3, 3)."""
    M = turned(pose.mean[2])
    return gtsam.PriorFactorPose2(
        pose_key(node), gtsam.Pose2(*pose.mean), _gaussian(M.T @ pose.covariance @ M)
    )


def odometry_factor(node: int, odometry: Odometry) -> gtsam.BetweenFactorPose2:
    """Return the factor of the odometry between the pose before and this one."""
    M = turned(odometry.mean[-1, 2])
    noise = _gaussian(M.T @ odometry.covariance[-1] @ M)
    return gtsam.BetweenFactorPose2(
        pose_key(node - 1), pose_key(node), gtsam.Pose2(*odometry.mean[-1]), noise
    )


def _gaussian(covariance: Float[np.ndarray, "3 3"]) -> gtsam.noiseModel.Gaussian:
    """Return a noise model: it needs an inverse, and GTSAM must not drop small correlations."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance + SMALLEST_STD**2 * np.eye(3), False)
