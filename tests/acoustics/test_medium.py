"""The media of the settings: the speed of sound in water, and what each absorbs."""

import numpy as np
import pytest

from pipistrelle.acoustics.propagation import medium_of, water_absorption_db_per_m
from pipistrelle.config import AirConfig, Config, ScenarioConfig, WaterConfig


def speed(temperature, salinity, depth=0.0):
    return WaterConfig(temperature_c=temperature, salinity=salinity, depth=depth).sound_speed


@pytest.mark.parametrize(
    ("temperature", "salinity", "printed"),
    [(0, 25, 1435.790), (0, 35, 1449.139), (30, 30, 1540.416)],
)
def test_speed_at_the_surface_matches_the_unesco_table(temperature, salinity, printed):
    # Wong and Zhu, J. Acoust. Soc. Am. 97 (1995), 1732, Table III: Chen and Millero's equation for
    # the temperatures of 1990. Coppens fits Del Grosso's, a tenth of a metre slower.
    assert speed(temperature, salinity) == pytest.approx(printed, abs=0.15)


@pytest.mark.parametrize("temperature", [0.0, 10.0, 20.0, 30.0])
def test_sound_in_fresh_water_is_as_fast_as_in_pure_water(temperature):
    # Del Grosso and Mader, J. Acoust. Soc. Am. 52 (1972), 1442.
    pure = np.polynomial.Polynomial([1402.388, 5.03711, -5.80852e-2, 3.342e-4, -1.478e-6, 3.15e-9])(
        temperature
    )
    assert speed(temperature, 0.0) == pytest.approx(pure, abs=0.1)


@pytest.mark.parametrize(
    ("depth", "printed"),
    [
        (10.0, (1442.55, 1483.85, 1516.03, 1540.46)),
        (1000.0, (1458.83, 1500.21, 1532.46, 1556.97)),
        (2000.0, (1475.70, 1516.96, 1549.09, 1573.47)),
    ],
)
def test_speed_matches_another_program_for_coppens_equation(depth, printed):
    # SonarDocs (gorbatschow.github.io/SonarDocs), its table for a salinity of 30.
    for temperature, other in zip((0.0, 10.0, 20.0, 30.0), printed, strict=True):
        assert speed(temperature, 30.0, depth) == pytest.approx(other, abs=0.006)


def test_the_speed_of_the_deep_sea_is_near_mackenzies():
    # J. Acoust. Soc. Am. 70 (1981), 807: its check value, and its equation at 4000 m.
    assert speed(25.0, 35.0, 1000.0) == pytest.approx(1550.744, abs=0.5)
    T, D = 4.0, 4000.0
    deep = 1448.96 + 4.591 * T - 5.304e-2 * T**2 + 2.374e-4 * T**3
    deep += 1.630e-2 * D + 1.675e-7 * D**2 - 7.139e-13 * T * D**3
    assert speed(T, 35.0, D) == pytest.approx(deep, abs=0.5)


def test_the_medium_is_the_section_that_the_scenario_names():
    config = Config(water=WaterConfig(temperature_c=20.0, salinity=0.0, depth=2.0))
    wet = config.model_copy(update={"scenario": ScenarioConfig(medium="water")})
    assert (config.medium, wet.medium) == (config.air, config.water)
    assert config.assumed_sound_speed == 343.0
    assert wet.assumed_sound_speed == wet.water.sound_speed
    assert WaterConfig(speed_of_sound=1234.0).sound_speed == 1234.0


def test_a_medium_takes_absorption_and_spreading_from_its_settings():
    pool = WaterConfig(temperature_c=28.0, salinity=0.5, depth=2.0, ph=7.2)
    of_pool = {"temperature_c": 28.0, "salinity": 0.5, "depth": 2.0, "ph": 7.2}
    medium = medium_of(pool)
    assert medium.absorption_db_per_m(150e3) == float(water_absorption_db_per_m(150e3, **of_pool))
    assert (medium.speed_of_sound, medium.spreading) == (pool.sound_speed, "bistatic")
    assert medium_of(AirConfig()).spreading == "paper"
