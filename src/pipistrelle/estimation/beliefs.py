"""What estimators believe and how they are asked: records, and the protocols of both."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import Scan

LOST = 2.0
"""Standard deviation [m] beyond which nobody can say where a caller is that moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    """A mean and its covariance; leading axes, if any, count instances.

    Attributes
    ----------
    mean : (*n, d)
    covariance : (*n, d, d)
        Of true value minus mean; to first order, where that is not what is normal.
    invariant : bool
        Of poses: whether the right-invariant error is normal (`estimation.ekf.invariant`).
    """

    mean: Float[np.ndarray, "*n d"]
    covariance: Float[np.ndarray, "*n d d"]
    invariant: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """The map: one row per hypothesis; a landmark with a single row is fully initialised.

    Attributes
    ----------
    landmark : (h)
        Label.
    mean : (h, 2) [m]
    covariance : (h, 2, 2) [m^2]
    weight : (h)
        Aggregated likelihood; sums to 1 over the rows of a landmark.
    """

    landmark: Int[np.ndarray, " h"]
    mean: Float[np.ndarray, "h 2"]
    covariance: Float[np.ndarray, "h 2 2"]
    weight: Float[np.ndarray, " h"]


def no_landmarks() -> Landmarks:
    """Return the map that knows no landmark.

    Examples
    --------
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
    """Take some rows of a map.

    Parameters
    ----------
    landmarks : Landmarks of h rows
    rows : (h)

    Returns
    -------
    Landmarks

    Examples
    --------
    >>> some_of(no_landmarks(), np.zeros(0, bool)).landmark.size
    0
    """
    return Landmarks(
        landmark=landmarks.landmark[rows],
        mean=landmarks.mean[rows],
        covariance=landmarks.covariance[rows],
        weight=landmarks.weight[rows],
    )


def joined(some: Landmarks, others: Landmarks) -> Landmarks:
    """Put the rows of two maps together.

    Parameters
    ----------
    some, others : Landmarks

    Returns
    -------
    Landmarks

    Examples
    --------
    >>> joined(no_landmarks(), no_landmarks()).weight
    array([], dtype=float64)
    """
    return Landmarks(
        landmark=np.concatenate((some.landmark, others.landmark)),
        mean=np.concatenate((some.mean, others.mean)),
        covariance=np.concatenate((some.covariance, others.covariance)),
        weight=np.concatenate((some.weight, others.weight)),
    )


def placed(landmarks: Landmarks) -> Bool[np.ndarray, " h"]:
    """Tell which rows of a map are fully initialised landmarks, not members of a ray.

    A landmark with a single row is fully initialised, one with several partially.

    Parameters
    ----------
    landmarks : Landmarks of h rows

    Returns
    -------
    (h)

    Notes
    -----
    Bradley & Abaid, Sec. V-A, "fully and partially initialize".

    Examples
    --------
    >>> mean, covariance = np.zeros((3, 2)), np.zeros((3, 2, 2))
    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> placed(Landmarks(mean=mean, covariance=covariance, **rows))
    array([ True, False, False])
    """
    _, row, count = np.unique(landmarks.landmark, return_inverse=True, return_counts=True)
    return count[row] == 1


def in_sight(moving: Landmarks) -> Landmarks:
    """Take of callers that move those whose place is known.

    Parameters
    ----------
    moving : Landmarks of h rows
        As a `Following` belief has them.

    Returns
    -------
    Landmarks
        One row for each that has but one, no more than `LOST` unsure in any direction.

    Examples
    --------
    >>> rows = dict(landmark=np.array([4, 9, 9]), weight=np.array([1.0, 0.5, 0.5]))
    >>> spread = np.eye(2) * np.array([0.01, 1.0, 1.0])[:, None, None]
    >>> in_sight(Landmarks(mean=np.zeros((3, 2)), covariance=spread, **rows)).landmark
    array([4])
    """
    widest = np.linalg.eigvalsh(moving.covariance)[:, -1]
    return some_of(moving, placed(moving) & (widest <= LOST * LOST))


class Innovations(NamedTuple):
    """How far off measurements of placed landmarks were that a filter has used.

    Attributes
    ----------
    squared : float
        Sum of the normalised innovations squared, each in the variance that the filter expected.
    degrees : float
        Sum of their degrees of freedom: two of range and bearing, one of a bearing.
    """

    squared: float = 0.0
    degrees: float = 0.0

    def plus(self, squared: float, degrees: float) -> "Innovations":
        """Return the sums with some more added."""
        return Innovations(self.squared + squared, self.degrees + degrees)


NO_INNOVATIONS = Innovations()


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """What a filter made of one mission: the start, then one row per control step.

    Attributes
    ----------
    time : (k) [s]
    pose : Gaussian of (k, 3) and (k, 3, 3)
        x, y [m], heading [rad]; at the steps that hold a scan, after its update. Of a filter that
        revises its path, all as it believes them at the end.
    landmarks : Landmarks
        The final map.
    gated : int
        Measurements that the gate rejected.
    innovations : Innovations
        All zero where the filter does not count them.
    cloud : (p, 3) [m, m, rad] or None
        The particles' last poses, where the filter has particles.
    full : float or None
        Their weighted mean number of fully initialised landmarks.
    online : Gaussian of (k, 3) and (k, 3, 3), or None
        Of a filter that revises its path: each pose as it was believed at its time.
    callers : dict of label to Gaussian of (k, 2) and (k, 2, 2)
        Where callers that move were believed to be at their time: at the steps that hold a scan
        and at which they were `in_sight`, else NaN. Of a filter that revises them
        (`Retracing`), where it believes at the end that they were.
    """

    time: Float[np.ndarray, " k"]
    pose: Gaussian
    landmarks: Landmarks
    gated: int
    innovations: Innovations = NO_INNOVATIONS
    cloud: Float[np.ndarray, "p 3"] | None = None
    full: float | None = None
    online: Gaussian | None = None
    callers: Mapping[int, Gaussian] = field(default_factory=dict)


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
    """What an estimator knows; never changed once it is made."""

    @property
    def gated(self) -> int:
        """Measurements rejected so far."""
        ...

    def pose(self) -> Gaussian:
        """Return the vehicle's pose, (3) and (3, 3)."""
        ...

    def landmarks(self) -> Landmarks:
        """Return the map."""
        ...


@runtime_checkable
class Following(Protocol):
    """A belief that follows callers that move, which are no landmarks of its map."""

    def moving(self) -> Landmarks:
        """Return where they are now, a row per hypothesis."""
        ...


@runtime_checkable
class ParticleCloud(Protocol):
    """A belief that is made of particles."""

    @property
    def full(self) -> float:
        """Weighted mean number of fully initialised landmarks."""
        ...

    def cloud(self) -> Float[np.ndarray, "p 3"]:
        """Return the particles' poses, (p, 3) [m, m, rad]."""
        ...


@runtime_checkable
class Trajectory(Protocol):
    """A belief that may revise its path: what is heard later changes where it was before."""

    def path(self) -> Gaussian:
        """Return the start and every control step so far, (k + 1, 3) and (k + 1, 3, 3)."""
        ...


@runtime_checkable
class Retracing(Protocol):
    """A belief that may revise where callers that move have been."""

    def tracks(self) -> Mapping[int, Gaussian]:
        """Return of each caller by its label (k + 1, 2) and (k + 1, 2, 2), NaN where not known.

        A row for the start and one for every control step so far.
        """
        ...


B = TypeVar("B", bound=Belief)


@runtime_checkable
class Informed(Protocol[B]):
    """An estimator that may be told of landmarks beforehand."""

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
