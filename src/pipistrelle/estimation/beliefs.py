"""Records of estimation results, and the protocols of beliefs, estimators and associations.

An `Association` receives the predicted belief and a scan without labels, and returns an
`Assignment` with labels, and landmarks to remove or merge. Its memory of tentative landmarks is
passed in and out like a belief. Measurements of the same label are merged, and unlabelled
measurements are discarded (`pipistrelle.detection.scans.labelled`) before the update.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MethodType
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar, cast, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import Scan
from pipistrelle.jit import kernel

T = TypeVar("T")
M = TypeVar("M")

MAX_CALLER_STD = 2.0
"""Largest standard deviation [m] of the position of a moving caller that counts as located."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    """A normal distribution, or an array of them: mean and covariance."""

    mean: Float[np.ndarray, "*n d"]
    """Mean, (*n, d)."""
    covariance: Float[np.ndarray, "*n d d"]
    """Covariance of true value minus mean, (*n, d, d); to first order if another error is normal.
    """
    invariant: bool = False
    """Whether the right-invariant error of a pose is normal (`estimation.ekf.gaussian`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """A map: a row per Gaussian hypothesis; a landmark with a single row is fully initialised."""

    landmark: Int[np.ndarray, " h"]
    """Label of each row's landmark."""
    mean: Float[np.ndarray, "h 2"]
    """Position, (h, 2) [m]."""
    covariance: Float[np.ndarray, "h 2 2"]
    """Covariance, (h, 2, 2) [m^2]."""
    weight: Float[np.ndarray, " h"]
    """Aggregated likelihood, with sum 1 over the rows of a landmark."""


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
    """Return the part of a map that a mask of its rows selects."""
    return Landmarks(
        **{part.name: getattr(landmarks, part.name)[rows] for part in fields(Landmarks)}
    )


def joined(some: Landmarks, others: Landmarks) -> Landmarks:
    """Return a map that contains the landmarks of two maps, in this order."""
    names = [part.name for part in fields(Landmarks)]
    return Landmarks(
        **{name: np.concatenate((getattr(some, name), getattr(others, name))) for name in names}
    )


def placed(landmarks: Landmarks) -> Bool[np.ndarray, " h"]:
    """Return a mask of the rows of a map that are fully initialised landmarks.

    A landmark of several rows is partially initialised (Bradley & Abaid, Sec. V-A).

    >>> mean, covariance = np.zeros((3, 2)), np.zeros((3, 2, 2))
    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> placed(Landmarks(mean=mean, covariance=covariance, **rows))
    array([ True, False, False])
    """
    _, row, count = np.unique(landmarks.landmark, return_inverse=True, return_counts=True)
    return count[row] == 1


def in_sight(moving: Landmarks) -> Landmarks:
    """Select the located moving callers: a single row, with a std up to `MAX_CALLER_STD`.

    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> spread = np.eye(2) * np.array([0.01, 1.0, 1.0])[:, None, None]
    >>> in_sight(Landmarks(mean=np.zeros((3, 2)), covariance=spread, **rows)).landmark
    array([4])
    """
    widest = np.linalg.eigvalsh(moving.covariance)[:, -1]
    return some_of(moving, placed(moving) & (widest <= MAX_CALLER_STD * MAX_CALLER_STD))


@dataclass(frozen=True, slots=True, kw_only=True)
class JointGaussian:
    """Joint Gaussian of pose and n initialised landmarks, for errors in x, y and heading."""

    landmark: Int[np.ndarray, " n"]
    """Labels of the landmarks."""
    mean: Float[np.ndarray, " d"]
    """Mean, (3 + 2n): x, y [m], heading [rad]; then x, y [m] of each landmark."""
    covariance: Float[np.ndarray, "d d"]


class Innovations(NamedTuple):
    """Sum of squared normalised innovations, and its degrees of freedom."""

    squared: float = 0.0
    """Squared innovations, each divided by its expected variance."""
    degrees: float = 0.0
    """Degrees of freedom: two for range and bearing, else one per measurement."""

    def plus(self, squared: float, degrees: float) -> "Innovations":
        """Return the sums with a further squared innovation and its degrees of freedom added."""
        return Innovations(self.squared + squared, self.degrees + degrees)


NO_INNOVATIONS = Innovations()


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """An estimated trajectory (poses at the start and after each control step) and map."""

    time: Float[np.ndarray, " k"]
    """Times, (k) [s]."""
    pose: Gaussian
    """Poses x, y [m], heading [rad], (k, 3) and (k, 3, 3), after the update by a scan; from a
    smoother, the final trajectory."""
    landmarks: Landmarks
    """The final map."""
    gated: int
    """Number of gated measurements."""
    innovations: Innovations = NO_INNOVATIONS
    corrections: Innovations = NO_INNOVATIONS
    """Sums of innovations and of corrections, zero if the estimator does not provide them."""
    cloud: Float[np.ndarray, "p 3"] | None = None
    """Final poses of the particles [m, m, rad], if any."""
    full: float | None = None
    """Weighted mean number of fully initialised landmarks over particles."""
    online: Gaussian | None = None
    """Pose estimates at their time, from a smoother."""
    labels: tuple[Int[np.ndarray, " m"], ...] = ()
    """Final labels of the measurements of each scan by data association."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """Further results of data association (`Association.report`)."""
    calibration: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Calibrated parameters of the vehicle: value and standard deviation, by name."""
    callers: Mapping[int, Gaussian] = field(default_factory=dict)
    """Positions of moving callers by label, (k, 2) and (k, 2, 2), NaN if unknown: online, after
    scans that locate them (`in_sight`), or from a smoother the final estimate."""


def at_steps(track: Track, steps: Int[np.ndarray, " k"]) -> Track:
    """Return a track with the trajectories at selected steps only."""
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


@dataclass(frozen=True, kw_only=True)
class Belief(ABC):
    """State of an estimator; immutable. Pose, map and `gated` are required, the rest is optional.

    A class need not inherit from it: `completed` adds the defaults.
    """

    gated: int = 0
    """Number of gated measurements so far."""
    innovations: Innovations = NO_INNOVATIONS
    corrections: Innovations = NO_INNOVATIONS
    full: float | None = None
    """Weighted mean number of fully initialised landmarks over particles."""

    @abstractmethod
    def pose(self) -> Gaussian:
        """Return the vehicle's pose: mean [m, m, rad] and 3 x 3 covariance."""

    @abstractmethod
    def landmarks(self) -> Landmarks:
        """Return the map of landmarks, a row per Gaussian hypothesis."""

    def moving(self) -> Landmarks:
        """Return the estimated positions of moving callers; an empty map by default."""
        return no_landmarks()

    def path(self) -> Gaussian | None:
        """Return a smoother's trajectory, the start and k steps; None for other estimators."""
        return None

    def tracks(self) -> Mapping[int, Gaussian] | None:
        """Return a smoother's past positions of callers by label, NaN if unknown; else None."""
        return None

    def calibration(self) -> Mapping[str, tuple[float, float]]:
        """Return each calibration parameter's value and standard deviation, by name."""
        return {}

    def cloud(self) -> Float[np.ndarray, "p 3"] | None:
        """Return the poses of all particles [m, m, rad], or None without particles."""
        return None

    def joint(self) -> JointGaussian:
        """Return the joint Gaussian of pose and map, for data association."""
        raise InputError(f"association: found a {type(self).__name__}, expected one with joint()")

    def labels(self) -> Sequence[int] | None:
        """Return the labels of all landmarks and callers, or None if not supported."""
        return None

    def edited(self, remove: Sequence[int], merge: Sequence[tuple[int, int]]) -> Self:
        """Return the belief without some landmarks, and with pairs of duplicates merged."""
        raise InputError(
            f"association: found landmarks to remove or to merge, but a {type(self).__name__} "
            "cannot; expected a belief with edited(remove, merge) and labels(), as the EKFs' have"
        )


def revises_path(belief: Belief) -> bool:
    """Return whether a belief's class provides a smoothed trajectory (`Belief.path`)."""
    return getattr(type(belief), "path", Belief.path) is not Belief.path


class Completed:
    """Wrapper of an external object that takes missing methods from a base class."""

    def __init__(self, part: Any, base: type) -> None:
        self.part, self.base = part, base

    def __getattr__(self, name: str) -> Any:
        if hasattr(self.part, name):
            return getattr(self.part, name)
        default = getattr(self.base, name)
        return MethodType(default, self.part) if callable(default) else default


def completed(part: Any, base: type[T]) -> T:
    """Wrap an object so that methods that its class lacks come from a base class."""
    return part if isinstance(part, base) else cast(T, Completed(part, base))


B = TypeVar("B", bound=Belief)


@runtime_checkable
class AcceptsMap(Protocol[B]):
    """An estimator that accepts a map of known landmarks at the start."""

    def knowing(self, belief: B, known: Landmarks) -> B:
        """Return the initial belief with known landmarks on its map, with independent errors."""
        ...


@runtime_checkable
class Estimator(Protocol[B]):
    """A SLAM estimator: an immutable record of settings, with beliefs passed in and out."""

    def init(self, pose: Gaussian) -> B:
        """Return the initial belief at a start pose with its covariance, without landmarks."""
        ...

    def predict(
        self,
        belief: B,
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
        rng: np.random.Generator,
    ) -> tuple[B, Gaussian]:
        """Predict a belief through control steps; return it, and the pose after each step."""
        ...

    def update(self, belief: B, scan: Scan, rng: np.random.Generator) -> B:
        """Update a belief with the measurements of a scan, and return it."""
        ...


KNOWN = "known"
"""Method that uses the labels of the scan (Bradley & Abaid, Sec. III-B)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """Result of data association: a label for each measurement of a scan, and map changes."""

    label: Int[np.ndarray, " m"]
    """Label of each measurement: a mapped landmark, a new number, or UNLABELLED for clutter."""
    remove: tuple[int, ...] = ()
    """Landmarks to remove from the map before the update; the session repeats the scans in its
    memory without their measurements."""
    merge: tuple[tuple[int, int], ...] = ()
    """Pairs of duplicate landmarks: the first label, perhaps new, replaces the second."""
    scan: Scan | None = None
    """The scan with changes by the association, such as callers' labels or a caller's range; the
    same measurements in the same order."""
    revised: Mapping[int, Scan | None] = field(default_factory=dict)
    """Earlier scans, by number from 0: with changes, or labels for measurements without; the
    session repeats them, and all later scans, before the update. None makes it associate the scan
    and all later ones again, from the memory before it as changed by ``carried``, and ignore the
    rest of the assignment."""


class Association(ABC, Generic[M]):
    """A method of data association, which assigns each measurement of a scan to a landmark.

    A class need not inherit from it (`beliefs.completed`).
    """

    __slots__ = ()

    @abstractmethod
    def start(self) -> M:
        """Return the memory of data association, its state between scans, before the first scan."""

    @abstractmethod
    def associate(self, memory: M, belief: Belief, scan: Scan) -> tuple[M, Assignment]:
        """Return the new memory and a scan's assignment to landmarks; change no argument."""

    def carried(self, memory: M, later: M) -> M:
        """Return an earlier memory with the facts that a later one adds, as callers' positions."""
        raise InputError(
            f"association: found scans to be associated again, but a {type(self).__name__} has no "
            "carried(memory, later)"
        )

    def knowing(self, memory: M, known: Landmarks, callers: Int[np.ndarray, " c"]) -> M:
        """Return the initial memory, given the landmarks and callers of a known initial map."""
        return memory

    def tentative(self, memory: M) -> Sequence[int]:
        """Return the labels of uncertain landmarks, to be left out of the reported map."""
        return ()

    def report(self, memory: M) -> Mapping[str, Any]:
        """Return further results for ``summary.json``, by name; none by default."""
        return {}


@kernel
def is_among(label: Int[np.ndarray, " m"], labels: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " m"]:
    """Return a mask of the labels that are in a set; faster than `np.isin` for few labels."""
    among = np.zeros(label.size, np.bool_)
    for m in range(label.size):
        for other in labels:
            among[m] |= label[m] == other
    return among
