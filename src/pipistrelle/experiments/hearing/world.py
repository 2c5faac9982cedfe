"""What is known of a world beforehand: its landmarks, its path, who calls there; or some of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.target import Bodies
from pipistrelle.config import CallerConfig
from pipistrelle.experiments.hearing.trajectories import Course
from pipistrelle.settings import Layer


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Known parts of a world; the rest is drawn."""

    name: str
    landmarks: Float[np.ndarray, "n 2"] | None = None
    """Landmarks [m]."""
    bodies: Bodies | None = None
    """Of these landmarks."""
    course: Course | None = None
    callers: tuple[CallerConfig, ...] | None = None
    """Callers besides the vehicle, unless the settings list them."""
    settings: Layer = field(default_factory=dict)
    """Settings of the world, which all others override."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Files that the world was read from."""


ALL_DRAWN = World(name="any")
"""A world of which nothing is known beforehand: all is drawn."""
