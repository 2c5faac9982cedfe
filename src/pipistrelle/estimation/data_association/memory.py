"""What the association remembers from scan to scan."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipistrelle.estimation.data_association.existence import Known, nobody
from pipistrelle.estimation.data_association.tracks import Tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """What is known of a caller."""

    label: int
    place: tuple[float, float] | None = None
    """Where it was found [m], until that was told."""
    told: bool = False
    tracks: Tracks = field(default_factory=Tracks)
    trial: tuple[tuple[int, int], ...] = ()
    """Rows that were of landmarks, and all, of the scans since it is on the map."""
    since: int = 0
    """Number of the scan in which it was placed."""
    refined: float = 0.0
    """If its place is that of a map, the share of the range by which it may be off; else 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What the association remembers."""

    scan: int = 0
    labels: int = 0
    """Labels given so far."""
    known: Known = field(default_factory=lambda: nobody(1))
    callers: Mapping[int, Caller] = field(default_factory=dict)
    """By number."""
