"""An estimator at work: it is carried by controls, and corrected by scans as they come."""

from typing import Generic

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.detection.merging import labelled
from pipistrelle.detection.noise import Noise
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.association import Assignment, Association, edited
from pipistrelle.estimation.beliefs import AcceptsMap, B, Estimator, Gaussian, Landmarks
from pipistrelle.estimation.checking import usable_scan


class Session(Generic[B]):
    """A vehicle's estimate while it drives and listens.

    Parameters
    ----------
    estimator : Estimator
    start : Gaussian
        The first pose, (3) and (3, 3).
    rng : Generator
        Of what the estimator draws.
    known : Landmarks, optional
        What is on the map beforehand, for an estimator that accepts it (`AcceptsMap`).
    association : Association, optional
        Labels the rows of scans; without one they bear labels already.
    noise : callable, optional
        States the noise of rows that an association has merged (`pipistrelle.detection.noise`).

    Examples
    --------
    >>> from pipistrelle.config import Config
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.catalogue import entry
    >>> from pipistrelle.estimation.motion import Motion
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    >>> session = Session(entry("iekf").build(Config(), motion), start, np.random.default_rng(7))
    >>> session.move(np.array([[1.0, 0.0]]), np.array([1.0])).mean
    array([[1., 0., 0.]])
    >>> ahead = {"range": np.array([2.0]), "range_std": 0.1, "bearing_std": 0.1}
    >>> used = session.hear(make_scan(1.0, np.array([7]), np.zeros(1), **ahead))
    >>> session.belief.landmarks().mean
    array([[3., 0.]])
    """

    belief: B
    """The present belief of the estimator."""

    def __init__(
        self,
        estimator: Estimator[B],
        start: Gaussian,
        rng: np.random.Generator,
        *,
        known: Landmarks | None = None,
        association: Association | None = None,
        noise: Noise | None = None,
    ) -> None:
        self._estimator, self._rng = estimator, rng
        self._association, self._noise = association, noise
        self._memory = association.start() if association else None
        self.belief = estimator.init(start)
        if known is not None and known.landmark.size and isinstance(estimator, AcceptsMap):
            self.belief = estimator.knowing(self.belief, known)

    def move(self, controls: Float[np.ndarray, "k c"], dt: Float[np.ndarray, " k"]) -> Gaussian:
        """Predict through control steps and return the pose after each, (k, 3) and (k, 3, 3).

        `controls`: as the estimator's motion model has them; `dt` [s].
        """
        predicted = self._estimator.predict(self.belief, controls, dt, self._rng)
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            expected = "the belief and the pose of each step"
            raise _wrong_return(self._estimator, "predict", predicted, expected)
        self.belief, poses = predicted
        check_poses("predict", poses, len(dt))
        return poses

    def hear(self, scan: Scan) -> Scan:
        """Associate a scan's rows and correct the belief; return the scan as it was used."""
        used = usable_scan(self._labelled(scan))
        belief = self._estimator.update(self.belief, used, self._rng)
        if not hasattr(belief, "pose"):
            raise _wrong_return(self._estimator, "update", belief, "the belief after the scan")
        self.belief = belief
        return used

    def _labelled(self, scan: Scan) -> Scan:
        """Return a scan as the association labels it; the belief is edited as that asks for."""
        if self._association is None:
            return scan
        stated = self._noise(scan) if self._noise else scan
        answer = self._association.associate(self._memory, self.belief, stated)
        if not (isinstance(answer, tuple) and len(answer) == 2 and type(answer[1]) is Assignment):
            raise _wrong_return(
                self._association, "associate", answer, "the memory and an Assignment"
            )
        self._memory, assignment = answer
        self.belief = edited(self.belief, assignment)
        merged = labelled(scan, assignment.label)
        return self._noise(merged) if self._noise else merged


def check_poses(method: str, poses: Gaussian, size: int) -> None:
    """Refuse poses of an estimator's method that are not so many, or lack their covariances."""
    found = np.shape(poses.mean), np.shape(poses.covariance)
    expected = (size, 3), (size, 3, 3)
    if found != expected:
        which = "the start and every control step" if method == "path" else "one after each step"
        raise InputError(
            f"{method}: found arrays of {found[0]} and {found[1]}, expected {expected[0]} and "
            f"{expected[1]}: {which}"
        )


def _wrong_return(part: object, method: str, found: object, expected: str) -> InputError:
    """Say what a method from outside returned in place of what is expected."""
    name = f"{type(part).__module__}.{type(part).__qualname__}.{method}"
    fix = "does it lack its return?" if found is None else "correct it"
    return InputError(f"{name}: found {type(found).__name__} returned, expected {expected}; {fix}")
