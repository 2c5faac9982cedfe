"""Records of what estimators compute, and the protocols of estimators and their beliefs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import Scan

MAX_CALLER_STD = 2.0
"""Largest standard deviation [m] at which the place of a moving caller counts as known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    """A mean and its covariance; leading axes, if any, count instances."""

    mean: Float[np.ndarray, "*n d"]
    """(*n, d)."""
    covariance: Float[np.ndarray, "*n d d"]
    """(*n, d, d), of true value minus mean; to first order where another error is normal."""
    invariant: bool = False
    """Of poses: whether the right-invariant error is normal (`estimation.ekf.invariant`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """The map: one row per hypothesis; a landmark with a single row is fully initialised."""

    landmark: Int[np.ndarray, " h"]
    """Label."""
    mean: Float[np.ndarray, "h 2"]
    """(h, 2) [m]."""
    covariance: Float[np.ndarray, "h 2 2"]
    """(h, 2, 2) [m^2]."""
    weight: Float[np.ndarray, " h"]
    """Aggregated likelihood; it sums to 1 over the rows of a landmark."""


def no_landmarks() -> Landmarks:
    """Return an empty map.

    >>> no_landmarks().mean.shape
    (0, 2)
    """
    return Landmarks(
        landmark=np.empty(0, np.int64),
        mean=np.empty((0, 2)),
        covariance=np.empty((0, 2, 2)),
        weight=np.empty(0),
    )


def some_of(landmarks: Landmarks, rows: Bool[np.ndarray, " h"]) -> Landmarks:
    """Return the rows of a map that a mask selects."""
    return Landmarks(
        landmark=landmarks.landmark[rows],
        mean=landmarks.mean[rows],
        covariance=landmarks.covariance[rows],
        weight=landmarks.weight[rows],
    )


def joined(some: Landmarks, others: Landmarks) -> Landmarks:
    """Return the rows of two maps, one after the other."""
    return Landmarks(
        landmark=np.concatenate((some.landmark, others.landmark)),
        mean=np.concatenate((some.mean, others.mean)),
        covariance=np.concatenate((some.covariance, others.covariance)),
        weight=np.concatenate((some.weight, others.weight)),
    )


def placed(landmarks: Landmarks) -> Bool[np.ndarray, " h"]:
    """Return a mask of the rows of a map that are fully initialised landmarks.

    A landmark with a single row is fully initialised, one with several partially (Bradley & Abaid,
    Sec. V-A).

    >>> mean, covariance = np.zeros((3, 2)), np.zeros((3, 2, 2))
    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> placed(Landmarks(mean=mean, covariance=covariance, **rows))
    array([ True, False, False])
    """
    _, row, count = np.unique(landmarks.landmark, return_inverse=True, return_counts=True)
    return count[row] == 1


def in_sight(moving: Landmarks) -> Landmarks:
    """Return the moving callers whose place is known: one row each, std up to `MAX_CALLER_STD`.

    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> spread = np.eye(2) * np.array([0.01, 1.0, 1.0])[:, None, None]
    >>> in_sight(Landmarks(mean=np.zeros((3, 2)), covariance=spread, **rows)).landmark
    array([4])
    """
    widest = np.linalg.eigvalsh(moving.covariance)[:, -1]
    return some_of(moving, placed(moving) & (widest <= MAX_CALLER_STD * MAX_CALLER_STD))


@dataclass(frozen=True, slots=True, kw_only=True)
class JointGaussian:
    """Pose and placed landmarks of a belief together, n of them, with the linear error."""

    landmark: Int[np.ndarray, " n"]
    """Labels."""
    mean: Float[np.ndarray, " d"]
    """(3 + 2n): x, y [m], heading [rad]; then x, y [m] of each landmark."""
    covariance: Float[np.ndarray, "d d"]


class Innovations(NamedTuple):
    """Sums over the measurements of placed landmarks that a filter has used."""

    squared: float = 0.0
    """Innovations squared, each divided by its expected variance."""
    degrees: float = 0.0
    """Degrees of freedom: two of range and bearing, one of a bearing."""

    def plus(self, squared: float, degrees: float) -> "Innovations":
        """Return the sums with more added."""
        return Innovations(self.squared + squared, self.degrees + degrees)


NO_INNOVATIONS = Innovations()


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """The path and the map that a filter estimated: the start, then one row per control step."""

    time: Float[np.ndarray, " k"]
    """(k) [s]."""
    pose: Gaussian
    """x, y [m], heading [rad], (k, 3) and (k, 3, 3); with a scan, after its update. Of a filter
    that revises its path, all as it believes them at the end."""
    landmarks: Landmarks
    """The final map."""
    gated: int
    """Measurements that the gate rejected."""
    innovations: Innovations = NO_INNOVATIONS
    """All zero where the filter does not count them."""
    cloud: Float[np.ndarray, "p 3"] | None = None
    """The particles' last poses [m, m, rad], where the filter has particles."""
    full: float | None = None
    """The particles' weighted mean number of fully initialised landmarks."""
    online: Gaussian | None = None
    """Of a filter that revises its path: each pose as it was believed at its time."""
    labels: tuple[Int[np.ndarray, " m"], ...] = ()
    """Of each scan the labels of its rows, as an association has them at the end."""
    calibration: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """What the filter estimated of the vehicle itself: value and standard deviation, by name."""
    callers: Mapping[int, Gaussian] = field(default_factory=dict)
    """Where moving callers were, by label, (k, 2) and (k, 2, 2): at their time, at steps with a
    scan at which they were `in_sight`, else NaN; or as a filter that revises them believes at the
    end."""


def at_steps(track: Track, steps: Int[np.ndarray, " k"]) -> Track:
    """Take a track at some of its steps."""
    if steps.size == track.time.size:
        return track

    def there(path: Gaussian) -> Gaussian:
        return replace(path, mean=path.mean[steps], covariance=path.covariance[steps])

    return replace(
        track,
        time=track.time[steps],
        pose=there(track.pose),
        online=None if track.online is None else there(track.online),
        callers={label: there(path) for label, path in track.callers.items()},
    )


@runtime_checkable
class Belief(Protocol):
    """What an estimator knows; a belief is never changed once it is made.

    Some methods are optional (`answer`): ``moving()`` returns moving callers, which are no
    landmarks of the map, as Landmarks of a row per hypothesis. ``path()`` returns the start and
    every control step so far, (k + 1, 3) and (k + 1, 3, 3), of an estimator that revises its path,
    and ``tracks()`` a Gaussian (k + 1, 2) and (k + 1, 2, 2) of each caller by its label, NaN where
    unknown. ``calibration()`` returns value and standard deviation of what it estimates of the
    vehicle itself, by name. ``cloud()`` returns the poses (p, 3) of particles, with ``full``, the
    weighted mean number of fully initialised landmarks. An association asks for three more:
    ``joint()`` returns a `JointGaussian`, ``labels()`` those of all landmarks and callers, and
    ``edited(remove, merge)`` the belief without the landmarks of the labels ``remove``, and with
    the two of each pair ``merge`` as one, under the first label.
    """

    @property
    def gated(self) -> int:
        """How many measurements were rejected so far."""
        ...

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        ...

    def landmarks(self) -> Landmarks:
        """Return the map."""
        ...


def answer(belief: Belief, question: str) -> Any:
    """Return what a belief's optional method returns (`Belief`); None where it has no such."""
    return getattr(belief, question)() if hasattr(belief, question) else None


B = TypeVar("B", bound=Belief)


@runtime_checkable
class AcceptsMap(Protocol[B]):
    """An estimator that accepts a map of known landmarks beforehand."""

    def knowing(self, belief: B, known: Landmarks) -> B:
        """Return a first belief that has landmarks in its map, placed, each one's error its own."""
        ...


@runtime_checkable
class Estimator(Protocol[B]):
    """A SLAM filter: a frozen record of its settings, with beliefs going in and coming out."""

    def init(self, pose: Gaussian) -> B:
        """Return the belief that knows a pose, (3) and (3, 3), and no landmark."""
        ...

    def predict(
        self,
        belief: B,
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator,
    ) -> tuple[B, Gaussian]:
        """Carry a belief through control steps; the poses are those after each step."""
        ...

    def update(self, belief: B, scan: Scan, rng: np.random.Generator) -> B:
        """Correct a belief with a frame's measurements."""
        ...
