"""What is known of a world beforehand: its landmarks, its path, who calls there; or some of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.target import Bodies
from pipistrelle.config import CallerConfig
from pipistrelle.experiments.hearing.courses import Course
from pipistrelle.settings import Layer


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
    callers : tuple of CallerConfig, or None
        Whoever calls but the vehicle, unless settings list them.
    settings : Layer
        Those that belong to the world, beneath all others.
    files : dict of name to content
        What the folder held that said so.
    """

    name: str
    landmarks: Float[np.ndarray, "n 2"] | None = None
    bodies: Bodies | None = None
    course: Course | None = None
    callers: tuple[CallerConfig, ...] | None = None
    settings: Layer = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)


ANY = World(name="any")
"""Nothing is known: all is drawn."""
