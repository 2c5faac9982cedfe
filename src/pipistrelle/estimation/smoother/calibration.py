"""Calibration: what a vehicle does not know of itself, estimated beside poses and landmarks.

Each parameter is a number or two, constant over the drive, with a normal prior about what is
assumed. Those of odometry change the motion between two nodes (`preintegration`), to first order
about what is assumed, which is exact but for products of errors within one leg; those of the sensor
change what it measures (`observations`). In the border stands how far a number is from what is
assumed, in its unit: the speed of sound as a share of the assumed one.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.motion import Motion

NUMBERS = {
    "speed_scale": ("speed_scale",),
    "turn_bias": ("turn_bias",),
    "wheelbase": ("wheelbase",),
    "speed_of_sound": ("speed_of_sound", "bearing_lean"),
    "sensor_heading": ("sensor_heading",),
    "sensor_place": ("sensor_place_x", "sensor_place_y"),
    "time_offset": ("time_offset",),
}
"""The names of the numbers of each parameter. They stand in the border in this order."""
LEAN_STD = 0.003
"""How much the slopes of bearings by the speed of sound say of it, as a share: what an array's
bearings are off for other reasons grows like them towards its sides. In the sound of `physics`
they lean by 0.1 to 0.3 %."""
OF_ODOMETRY = ("speed_scale", "turn_bias", "wheelbase")
"""Parameters of odometry, by the codes that kernels have for them."""
OF_SENSOR = ("speed_of_sound", "sensor_heading", "sensor_place", "time_offset")
"""Parameters of the sensor, as `records.Places.sensor` has their columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The parameters that are estimated."""

    names: tuple[str, ...]
    """Of their numbers."""
    assumed: Float[np.ndarray, " p"]
    """What is assumed of each number."""
    unit: Float[np.ndarray, " p"]
    """By which a number in the border is multiplied before it is added to that."""
    stds: Float[np.ndarray, " p"]
    """Standard deviation of the prior of each, in the border."""
    odometry: Int[np.ndarray, " q"]
    """Codes of those of odometry (`OF_ODOMETRY`), which stand first."""
    sensor: Int[np.ndarray, "4"]
    """Columns of those of the sensor (`OF_SENSOR`); 0 where one is not estimated."""

    def scale_is_free(self, ranged: bool) -> bool:
        """Tell whether nothing but the speed's scale tells how large the world is.

        Bearings do not, nor do ranges of an unknown speed of sound. The motion is then compared
        with the odometry in the odometry's scale: in its own, the smaller a world, the less its
        odometry would seem to be off.
        """
        return "speed_scale" in self.names and (not ranged or "speed_of_sound" in self.names)


def numbers_of(parameters: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the numbers of some parameters, in the order of the border.

    >>> numbers_of(["sensor_place", "wheelbase"])
    ('wheelbase', 'sensor_place_x', 'sensor_place_y')
    """
    asked = set(parameters)
    return tuple(one for name, parts in NUMBERS.items() if name in asked for one in parts)


def calibration_of(config: Config, motion: Motion) -> Calibration:
    """Return what ``filter.calibrate`` asks for, of a vehicle with a motion model.

    >>> from pipistrelle.config import FilterConfig
    >>> config = Config(filter=FilterConfig(calibrate=("sensor_place", "speed_of_sound")))
    >>> calibration_of(config, Motion(model="unicycle", control_std=(0.1, 0.1))).sensor
    array([1, 0, 3, 0])
    """
    asked, about, sound = (
        set(config.filter.calibrate),
        config.prior,
        config.assumed_sound_speed,
    )
    if "wheelbase" in asked and motion.model != "bicycle":
        raise InputError(
            f'filter.calibrate: found "wheelbase" for a {motion.model} model of motion, which has '
            "none; leave it out"
        )
    names = [name for name in NUMBERS if name in asked]
    units = {"speed_of_sound": sound, "wheelbase": motion.wheelbase}
    assumed = units | {"speed_scale": 1.0}
    stds = {"bearing_lean": LEAN_STD}
    for name in names:
        for number in NUMBERS[name]:
            stds.setdefault(number, getattr(about, f"{name}_std"))
    stds |= {"speed_of_sound": about.speed_of_sound_std / sound}
    numbers = numbers_of(names)
    column = {name: 1 + numbers.index(NUMBERS[name][0]) for name in names}
    return Calibration(
        names=numbers,
        assumed=np.array([assumed.get(number, 0.0) for number in numbers]),
        unit=np.array([units.get(number, 1.0) for number in numbers]),
        stds=np.array([stds[number] for number in numbers]),
        odometry=np.array([OF_ODOMETRY.index(name) for name in names if name in OF_ODOMETRY], int),
        sensor=np.array([column.get(name, 0) for name in OF_SENSOR]),
    )


NOTHING = calibration_of(Config(), Motion(model="unicycle", control_std=(0.0, 0.0)))
"""Nothing is calibrated."""
