"""The mission as a film: what was heard, and what the filters believed, frame by frame.

A `MissionRecorder` watches filters while they run. `animate_mission` then draws what never moves
once, and on it, picture by picture, what does: the beam, the bearings of the frame's
measurements, rays being born and thinned out, landmarks as they turn full, the path so far.
"""

import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from pipistrelle.config import InputError
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.models import Gaussian, Landmarks
from pipistrelle.experiments.results import LabelledPoints, TimedPath
from pipistrelle.figures.maps import (
    PLACED,
    RAY,
    beam,
    draw_truth,
    ellipses,
    placed,
    shades,
    span,
    vehicle,
)
from pipistrelle.figures.style import INK, STYLE, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RATE = 12.5
"""Pictures per second: a GIF counts in hundredths of a second."""
FLASH = 4
"""Pictures during which a landmark that has turned full is ringed."""


class Belief(Protocol):
    """What every filter's belief answers."""

    def pose(self) -> Gaussian:
        """Mean (3) and covariance (3, 3) of the pose."""
        ...

    def landmarks(self) -> Landmarks:
        """Return the map as it stands."""
        ...


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
    """

    scan: Scan
    pose: Float[np.ndarray, "3"]
    landmarks: Landmarks


class MissionRecorder:
    """Watch filters and keep a snapshot of each frame, a few kilobytes, in `snapshots`.

    An instance is called after each update, as the ``watch`` of a trial; ``snapshots`` holds a
    list for each (strategy, filter), in the order of their first frames.

    Examples
    --------
    >>> class Lost:
    ...     def pose(self):
    ...         return Gaussian(mean=np.zeros(3), covariance=np.eye(3))
    ...
    ...     def landmarks(self):
    ...         none = np.empty(0)
    ...         mean, covariance = np.empty((0, 2)), np.empty((0, 2, 2))
    ...         return Landmarks(landmark=none, mean=mean, covariance=covariance, weight=none)
    >>> none = np.empty(0)
    >>> watch = MissionRecorder()
    >>> watch("fused", "ekf", Scan(time=0.5, landmark=none, bearing=none, range=none), Lost())
    >>> [(key, len(frames)) for key, frames in watch.snapshots.items()]
    [(('fused', 'ekf'), 1)]
    """

    def __init__(self) -> None:
        self.snapshots: dict[tuple[str, str], list[Snapshot]] = {}

    def __call__(self, strategy: str, estimator: str, scan: Scan, belief: Belief) -> None:
        snapshot = Snapshot(scan=scan, pose=belief.pose().mean, landmarks=belief.landmarks())
        self.snapshots.setdefault((strategy, estimator), []).append(snapshot)


def animate_mission(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]],
    path: Path,
    *,
    true_path: TimedPath | None = None,
    true_landmarks: LabelledPoints | None = None,
    beacon: Float[np.ndarray, "2"] | None = None,
    beamwidth: float | None = None,
    pictures: int = 125,
) -> None:
    """Write the film of a mission, one panel per strategy, as GIF or MP4.

    A panel shows the path so far (true: grey), the vehicle with its beam, the frame's
    measurements (a range: solid to where it ends; a bearing alone: dashed), the rays (each member
    at one standard deviation, the heavier the darker; just pruned ones as dotted outlines) and the
    landmarks that are fully initialised in their 95 % ellipses, ringed when they have just become
    so.

    Parameters
    ----------
    snapshots : for each (strategy, filter), frames in the order of time
        As a `MissionRecorder` keeps them.
    path : Path
        Ends in .gif, or in .mp4, which needs ffmpeg.
    true_path : times (k) [s] and poses (k, 3) [m, m, rad], optional
    true_landmarks : labels (n) and positions (n, 2) [m], optional
    beacon : (2) [m], optional
    beamwidth : [rad], optional
    pictures : int, at least 1
        At most so many frames are shown, evenly spaced, the last among them.

    Raises
    ------
    InputError
        Where the path ends otherwise, or ffmpeg is missing or fails.
    ValueError
        Without a single frame.

    Notes
    -----
    Bradley & Abaid, Sec. III-C, "ray of Gaussians", as it happens.

    Examples
    --------
    >>> animate_mission({}, Path("mission.avi"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: mission.avi: found the ending '.avi', expected .gif or .mp4
    """
    import matplotlib

    write = _writer(path)
    if not any(snapshots.values()):
        raise ValueError("an animation needs at least one frame")
    with matplotlib.rc_context(STYLE):
        figure, panels = _stage(snapshots, true_path, true_landmarks, beacon, beamwidth)
        write(_play(figure, panels, _times(snapshots, pictures)), path)
