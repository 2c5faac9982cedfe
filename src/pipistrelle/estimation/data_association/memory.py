"""What the association remembers from scan to scan."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.data_association.existence import Known, nobody
from pipistrelle.estimation.data_association.rows import ScanRows
from pipistrelle.estimation.data_association.tracks import Tracks


class CallerPlace(NamedTuple):
    """A caller's place and motion."""

    x: float
    y: float
    """Position [m]."""
    motion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Velocity [m/s], then acceleration [m/s^2], along x and y; 0 of one that stands."""
    time: float = 0.0
    """Time at which the caller is there [s]."""
    since: float = -math.inf
    """Time from which on place and motion hold [s]."""
    agreed: bool = False
    """Whether it is not searched for once more."""

    def at(self, time: float) -> tuple[float, float]:
        """Return the position at a time [m]."""
        t, (vx, vy, ax, ay) = time - self.time, self.motion
        return self.x + t * (vx + 0.5 * t * ax), self.y + t * (vy + 0.5 * t * ay)


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """What is known of a caller."""

    label: int
    place: CallerPlace | None = None
    """Where it was found."""
    told: bool = False
    tracks: Tracks = field(default_factory=Tracks)
    trial: tuple[tuple[int, int], ...] = ()
    """Rows that were of landmarks, and all, of the scans since it is on the map."""
    since: int = 0
    """Number of the scan in which it was placed."""


class EarlyScan(NamedTuple):
    """A scan from before there was a map (`early_scans`)."""

    number: int
    scan: Scan
    """As it was stated."""
    rows: ScanRows
    direct: Int[np.ndarray, " c"]
    """Row of each caller's direct call, or -1."""
    pose: Gaussian
    """The vehicle's pose as it was predicted before the scan corrected it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What the association remembers."""

    scan: int = 0
    labels: int = 0
    """Labels given so far."""
    known: Known = field(default_factory=lambda: nobody(1))
    callers: Mapping[int, Caller] = field(default_factory=dict)
    """By number."""
    early: tuple[EarlyScan, ...] = ()
    """To be labelled by the map."""
