"""Estimators that live outside the package, as a user's would: a wheel of their own."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pipistrelle.config import Config
from pipistrelle.estimation.beliefs import Gaussian, no_landmarks
from pipistrelle.estimation.motion import Motion, motion_jacobians, motion_noise, motion_step

SHIFT = np.array([1.0, 0.0, 0.0])
"""By how much `Shifted` revises its path [m, m, rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reckoned:
    at: Gaussian
    gated: int = 0

    def pose(self):
        return self.at

    def landmarks(self):
        return no_landmarks()


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadReckoning:
    """Goes by its controls alone."""

    motion: Motion
    doubt: float = 1.0

    def init(self, pose):
        return Reckoned(at=pose)

    def predict(self, belief, controls, dt, rng):
        mean, covariance = belief.at.mean, belief.at.covariance
        means, covariances = [], []
        for control, step in zip(controls, dt, strict=True):
            F, U = motion_jacobians(self.motion, mean, control, step)
            Q = motion_noise(self.motion, control) * self.doubt
            mean = motion_step(self.motion, mean, control, step)
            covariance = F @ covariance @ F.T + U @ Q @ U.T
            means.append(mean)
            covariances.append(0.5 * (covariance + covariance.T))
        poses = Gaussian(
            mean=np.reshape(means, (-1, 3)), covariance=np.reshape(covariances, (-1, 3, 3))
        )
        return replace(belief, at=Gaussian(mean=mean, covariance=covariance)), poses

    def update(self, belief, scan, rng):
        return belief


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept(Reckoned):
    """Every pose so far, and the belief that all were a metre further on."""

    mean: tuple = ()
    covariance: tuple = ()

    def path(self):
        return Gaussian(mean=np.array(self.mean) + SHIFT, covariance=np.array(self.covariance))


@dataclass(frozen=True, slots=True, kw_only=True)
class Shifted(DeadReckoning):
    """Reckons, and in the end moves its whole path."""

    title: ClassVar[str] = "shifted reckoning"
    nees_limit: ClassVar[float] = 123.0

    @classmethod
    def from_config(cls, config: Config, motion: Motion):
        return cls(motion=motion, doubt=config.filter.gate)

    def init(self, pose):
        return Kept(at=pose, mean=(pose.mean,), covariance=(pose.covariance,))

    def predict(self, belief, controls, dt, rng):
        after, poses = DeadReckoning.predict(self, belief, controls, dt, rng)
        mean = (*belief.mean, *poses.mean)
        return replace(after, mean=mean, covariance=(*belief.covariance, *poses.covariance)), poses
