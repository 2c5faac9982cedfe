"""Medium: the speed of sound, and the losses on a path."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from pipistrelle.acoustics.propagation import absorption_db_per_m
from pipistrelle.config import AirConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Medium:
    """A homogeneous medium at rest.

    Examples
    --------
    Fresh water loses less than a decibel in 100 m at 35 kHz.

    >>> water = Medium(speed_of_sound=1480.0, absorption_db_per_m=lambda frequency: 2.7e-4)
    >>> water.absorption_db_per_m(35e3) * 100.0 < 1.0
    True
    """

    speed_of_sound: float
    """[m/s]."""
    absorption_db_per_m: Callable[[float], float]
    """Loss of a tone [dB/m], by its frequency [Hz]."""
    spreading: Literal["paper", "bistatic"] = "paper"
    """Law of the loss on the way over a landmark (`propagation.passive_spreading_loss_db`)."""


@lru_cache(maxsize=64)
def medium_of(air: AirConfig) -> Medium:
    """Return the air of the settings, with the absorption of ISO 9613-1.

    >>> air = medium_of(AirConfig())
    >>> air.speed_of_sound, round(air.absorption_db_per_m(30e3), 3)
    (343.0, 0.937)
    """

    @lru_cache(maxsize=64)
    def absorption(frequency: float) -> float:
        return float(
            absorption_db_per_m(
                frequency,
                temperature_c=air.temperature_c,
                relative_humidity=air.relative_humidity,
                pressure_kpa=air.pressure_kpa,
            )
        )

    return Medium(
        speed_of_sound=air.sound_speed,
        absorption_db_per_m=absorption,
        spreading=air.spreading,
    )
