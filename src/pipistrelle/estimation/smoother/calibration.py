"""Calibration: what a vehicle does not know of itself, estimated beside poses and landmarks.

Each parameter is a number or two, constant over the drive, with a normal prior about what is
assumed. Those of odometry change the motion between two nodes (`preintegration`), to first order
about what is assumed, which is exact but for products of errors within one leg; those of the sensor
change what it measures (`observations`).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SIZES = {
    "speed_scale": 1,
    "turn_bias": 1,
    "wheelbase": 1,
    "speed_of_sound": 1,
    "sensor_heading": 1,
    "sensor_place": 2,
}
"""How many numbers each parameter is. They stand in the border in this order."""
OF_ODOMETRY = ("speed_scale", "turn_bias", "wheelbase")
"""Parameters of odometry, by the codes that kernels have for them."""
OF_SENSOR = ("speed_of_sound", "sensor_heading", "sensor_place")
"""Parameters of the sensor, as `records.Places.sensor` has their columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The parameters that are estimated."""

    column: dict[str, int]
    """The first column of each in the border."""
    stds: Float[np.ndarray, " p"]
    """Standard deviation of the prior of each number."""
    odometry: Int[np.ndarray, " q"]
    """Codes of those of odometry (`OF_ODOMETRY`), which stand first."""
    sensor: Int[np.ndarray, "3"]
    """Columns of those of the sensor (`OF_SENSOR`); 0 where one is not estimated."""


def calibration_of(stds: Iterable[tuple[str, float]]) -> Calibration:
    """Return what is estimated, from the names of parameters and the deviations of their priors.

    >>> calibration_of([("sensor_place", 0.1), ("wheelbase", 0.02)]).column
    {'wheelbase': 1, 'sensor_place': 2}
    """
    known, column, after = dict(stds), {}, 1
    names = [name for name in SIZES if name in known]
    for name in names:
        column[name], after = after, after + SIZES[name]
    return Calibration(
        column=column,
        stds=np.array([known[name] for name in names for _ in range(SIZES[name])]),
        odometry=np.array([OF_ODOMETRY.index(one) for one in names if one in OF_ODOMETRY], int),
        sensor=np.array([column.get(name, 0) for name in OF_SENSOR]),
    )


NOTHING = calibration_of(())
"""Nothing is calibrated."""
