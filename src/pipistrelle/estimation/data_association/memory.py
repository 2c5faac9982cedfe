"""What the association remembers from scan to scan."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pipistrelle.estimation.data_association.existence import Known, nobody
from pipistrelle.estimation.data_association.tracks import Tracks


class Place(NamedTuple):
    """Where a caller is."""

    x: float
    y: float
    """[m]"""
    refined: float = 0.0
    """If that is from the map, the share of its range by which it may be off; else 0."""
    way: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Of one that moves velocity [m/s] and acceleration along x and y [m/s^2]."""
    time: float = 0.0
    """When it was there [s]."""
    since: float = -math.inf
    """From when on that is known [s]."""

    def at(self, time: float) -> tuple[float, float]:
        """Return where it is at a time."""
        t, (vx, vy, ax, ay) = time - self.time, self.way
        return self.x + t * (vx + 0.5 * t * ax), self.y + t * (vy + 0.5 * t * ay)


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """What is known of a caller."""

    label: int
    place: Place | None = None
    """Where it was found."""
    told: bool = False
    tracks: Tracks = field(default_factory=Tracks)
    trial: tuple[tuple[int, int], ...] = ()
    """Rows that were of landmarks, and all, of the scans since it is on the map."""
    since: int = 0
    """Number of the scan in which it was placed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What the association remembers."""

    scan: int = 0
    labels: int = 0
    """Labels given so far."""
    known: Known = field(default_factory=lambda: nobody(1))
    callers: Mapping[int, Caller] = field(default_factory=dict)
    """By number."""
