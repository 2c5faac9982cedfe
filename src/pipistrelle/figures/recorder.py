"""What a filter believes while it runs, kept for a film."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Belief, Landmarks, ParticleCloud


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """One frame as a filter saw it.

    Attributes
    ----------
    scan : Scan
    pose : (3) [m, m, rad]
        After the update.
    landmarks : Landmarks
        After the update.
    cloud : (p, 3) [m, m, rad] or None
        The poses of the particles, where there are any.
    """

    scan: Scan
    pose: Float[np.ndarray, "3"]
    landmarks: Landmarks
    cloud: Float[np.ndarray, "p 3"] | None = None


class MissionRecorder:
    """Watch filters and keep a snapshot of each frame, a few kilobytes, in `snapshots`.

    An instance is called after each update, as the ``watch`` of a trial; ``snapshots`` holds a
    list for each (strategy, filter), in the order of their first frames.

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

    def __init__(self) -> None:
        self.snapshots: dict[tuple[str, str], list[Snapshot]] = {}

    def __call__(self, strategy: str, estimator: str, scan: Scan, belief: Belief) -> None:
        """Keep a snapshot."""
        snapshot = Snapshot(
            scan=scan,
            pose=belief.pose().mean,
            landmarks=belief.landmarks(),
            cloud=belief.cloud() if isinstance(belief, ParticleCloud) else None,
        )
        self.snapshots.setdefault((strategy, estimator), []).append(snapshot)
