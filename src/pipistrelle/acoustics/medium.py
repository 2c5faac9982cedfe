"""Medium: the speed of sound, and the losses on a path."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from pipistrelle.acoustics.propagation import absorption_db_per_m, water_absorption_db_per_m
from pipistrelle.config import AirConfig, WaterConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Medium:
    """A homogeneous medium at rest.

    Examples
    --------
    Helium, if it took nothing from the sound.

    >>> helium = Medium(speed_of_sound=1007.0, absorption_db_per_m=lambda frequency: 0.0)
    >>> helium.spreading
    'paper'
    """

    speed_of_sound: float
    """[m/s]."""
    absorption_db_per_m: Callable[[float], float]
    """Loss of a tone [dB/m], by its frequency [Hz]."""
    spreading: Literal["paper", "bistatic"] = "paper"
    """Law of the loss on the way over a landmark (`propagation.passive_spreading_loss_db`)."""


@lru_cache(maxsize=64)
def medium_of(section: AirConfig | WaterConfig) -> Medium:
    """Return the medium of a section of the settings (`Config.medium`).

    Air absorbs as ISO 9613-1 says, water as Francois and Garrison do.

    >>> air, water = medium_of(AirConfig()), medium_of(WaterConfig())
    >>> air.speed_of_sound, round(air.absorption_db_per_m(30e3), 3)
    (343.0, 0.937)
    >>> round(water.speed_of_sound, 1), round(water.absorption_db_per_m(100e3), 4)
    (1489.8, 0.0336)
    """

    @lru_cache(maxsize=64)
    def absorption(frequency: float) -> float:
        if isinstance(section, WaterConfig):
            of_water = section.model_dump(include={"temperature_c", "salinity", "depth", "ph"})
            return float(water_absorption_db_per_m(frequency, **of_water))
        return float(
            absorption_db_per_m(
                frequency,
                temperature_c=section.temperature_c,
                relative_humidity=section.relative_humidity,
                pressure_kpa=section.pressure_kpa,
            )
        )

    return Medium(
        speed_of_sound=section.sound_speed,
        absorption_db_per_m=absorption,
        spreading=section.spreading,
    )
