"""What is known of a world beforehand: its landmarks, its path, who calls there; or some of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.callers import Caller
from pipistrelle.acoustics.target import Bodies
from pipistrelle.experiments.hearing.courses import Course
from pipistrelle.settings import Layer


@dataclass(frozen=True, slots=True, kw_only=True)
class Visitor:
    """Someone who calls from a place or along a route.

    Attributes
    ----------
    caller : Caller
        Without a place, if there is a route.
    time : (n) [s] or None
        Since the start, rising; before the first and after the last he stands.
    route : (n, 2) [m] or None
        Where he is at these times.
    """

    caller: Caller
    time: Float[np.ndarray, " n"] | None = None
    route: Float[np.ndarray, "n 2"] | None = None

    def at(self, time: Float[np.ndarray, " t"]) -> Caller:
        """Return the caller with a place for each time (t) [s]."""
        if self.time is None or self.route is None:
            return self.caller
        columns = [np.interp(time, self.time, column) for column in self.route.T]
        return replace(self.caller, place=np.column_stack(columns))


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """What is known of a world beforehand; the rest is drawn.

    Attributes
    ----------
    name : str
    landmarks : (n, 2) [m], or None
    bodies : Bodies or None
        Of these landmarks.
    course : Course or None
    callers : tuple of Visitor, or None
        Whoever calls but the vehicle.
    settings : Layer
        Those that belong to the world, beneath all others.
    files : dict of name to content
        What the folder held that said so.
    """

    name: str
    landmarks: Float[np.ndarray, "n 2"] | None = None
    bodies: Bodies | None = None
    course: Course | None = None
    callers: tuple[Visitor, ...] | None = None
    settings: Layer = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)


ANY = World(name="any")
"""Nothing is known: all is drawn."""
