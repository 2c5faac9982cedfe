"""What a filter believes while it runs, kept for a film or a page."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import Scan, rows_of
from pipistrelle.estimation.beliefs import (
    Belief,
    Landmarks,
    answer,
    in_sight,
    no_landmarks,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """A filter's measurements and belief at one frame."""

    scan: Scan
    pose: Float[np.ndarray, "3"]
    """[m, m, rad] After the update."""
    covariance: Float[np.ndarray, "3 3"]
    """Of the pose."""
    landmarks: Landmarks
    """After the update."""
    moving: Landmarks = field(default_factory=no_landmarks)
    """The callers that move and are in sight, of a filter that follows them."""
    cloud: Float[np.ndarray, "p 3"] | None = None
    """[m, m, rad] The poses of the particles, where there are any."""
    path: Float[np.ndarray, "t 2"] | None = None
    """[m] Where the vehicle was at the start and after every control step so far, as it is believed
    now: of a filter that revises its path, where it was asked."""


def heard_from(scan: Scan) -> Scan:
    """Return the rows of a scan that have a bearing.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = np.array([8, 8]), np.array([0.4, np.nan])
    >>> heard_from(make_scan(0.0, *rows, excess_path=np.array([3.0, 5.0]))).landmark
    array([8])
    """
    return rows_of(scan, ~np.isnan(scan.bearing))


class MissionRecorder:
    """Watch filters and keep a snapshot of each frame, a few kilobytes, in `snapshots`.

    An instance is called after each update, as the ``watch`` of a trial; ``snapshots`` holds a
    list for each (strategy, filter), in the order of their first frames.

    Parameters
    ----------
    rest : int, optional
        A filter that revises its path thinks all of it over, each time that it is asked for its
        map: ask at the first frame and then so many frames later, or a sixtieth of those that it
        has seen if that is more, and for the path every fifth time. In between the map stays.
        Without it such a filter is asked for its map at every frame, and never for its path.

    Examples
    --------
    >>> from pipistrelle.estimation.beliefs import Gaussian, no_landmarks
    >>> class Lost:
    ...     gated = 0
    ...
    ...     def pose(self):
    ...         return Gaussian(mean=np.zeros(3), covariance=np.eye(3))
    ...
    ...     def landmarks(self):
    ...         return no_landmarks()
    >>> from pipistrelle.detection.scans import make_scan
    >>> watch = MissionRecorder()
    >>> watch("fused", "ekf", make_scan(0.5, np.empty(0), np.empty(0)), Lost())
    >>> [(key, len(frames)) for key, frames in watch.snapshots.items()]
    [(('fused', 'ekf'), 1)]
    """

    def __init__(self, rest: int | None = None) -> None:
        self.snapshots: dict[tuple[str, str], list[Snapshot]] = {}
        self._rest = rest
        self._asked: dict[tuple[str, str], list[int]] = {}

    def __call__(self, strategy: str, estimator: str, scan: Scan, belief: Belief) -> None:
        """Keep a snapshot."""
        frames = self.snapshots.setdefault((strategy, estimator), [])
        path, landmarks = None, None
        if self._rest is not None and hasattr(belief, "path"):
            asked = self._asked.setdefault((strategy, estimator), [])
            if asked and len(frames) - asked[-1] < max(self._rest, len(frames) // 60):
                landmarks = frames[-1].landmarks
            else:
                path = answer(belief, "path").mean[:, :2] if len(asked) % 5 == 0 else None
                asked.append(len(frames))
        pose, moving = belief.pose(), answer(belief, "moving")
        snapshot = Snapshot(
            scan=scan,
            pose=pose.mean,
            covariance=pose.covariance,
            landmarks=belief.landmarks() if landmarks is None else landmarks,
            moving=no_landmarks() if moving is None else in_sight(moving),
            cloud=answer(belief, "cloud"),
            path=path,
        )
        frames.append(snapshot)
