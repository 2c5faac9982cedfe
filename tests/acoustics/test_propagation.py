"""None"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.acoustics.propagation import (
    absorption_db_per_m,
    doppler_frequency,
    medium_of,
    passive_spreading_loss_db,
    spreading_loss_db,
    water_absorption_db_per_m,
)
from pipistrelle.config import AirConfig, Config, InputError, ScenarioConfig, WaterConfig

law = settings(deadline=None)
DISTANCES = st.floats(0.01, 1e3)
SPEEDS = st.floats(-30.0, 30.0)
STANDARD = {"temperature_c": 20.0, "relative_humidity": 0.5, "pressure_kpa": 101.325}


@given(path=DISTANCES)
@law
def test_ten_times_as_far_loses_20_db_one_way_and_40_db_both(path):
    for ways in (1, 2):
        step = spreading_loss_db(10 * path, ways=ways) - spreading_loss_db(path, ways=ways)
        assert step == pytest.approx(20.0 * ways, abs=1e-12)


@given(distance=DISTANCES)
@law
def test_an_active_echo_is_bistatic_with_the_vehicle_as_source(distance):
    active = spreading_loss_db(2 * distance, ways=2)
    bistatic = passive_spreading_loss_db(distance, distance, law="bistatic")
    mirror = passive_spreading_loss_db(distance, distance, law="paper")
    assert active == pytest.approx(bistatic, abs=1e-12)
    assert active - mirror == pytest.approx(20 * math.log10(distance / 2), abs=1e-12)


@given(outward=DISTANCES, homeward=DISTANCES, name=st.sampled_from(["paper", "bistatic"]))
@law
def test_passive_loss_is_symmetric_in_the_two_legs(outward, homeward, name):
    there = passive_spreading_loss_db(outward, homeward, law=name)
    assert there == passive_spreading_loss_db(homeward, outward, law=name)


@given(outward=DISTANCES, homeward=DISTANCES)
@law
def test_bistatic_loss_exceeds_the_mirrors_by_the_parallel_sum_of_legs(outward, homeward):
    mirror = passive_spreading_loss_db(outward, homeward, law="paper")
    bistatic = passive_spreading_loss_db(outward, homeward, law="bistatic")
    apart = outward * homeward / (outward + homeward)
    assert bistatic - mirror == pytest.approx(20 * math.log10(apart), abs=1e-11)


def test_an_unknown_law_is_refused():
    with pytest.raises(InputError, match=r"air\.spreading: found 'mirror'"):
        passive_spreading_loss_db(1.0, 1.0, law="mirror")


@pytest.mark.parametrize("humidity", [0.1, 0.3, 0.5, 0.7, 0.9])
@pytest.mark.parametrize("temperature", [0.0, 10.0, 20.0, 30.0, 40.0])
@pytest.mark.parametrize("pressure", [101.325, 110.0, 140.0])
def test_absorption_agrees_with_pyfar_to_four_digits(temperature, humidity, pressure):
    from pyfar.constants import air_attenuation

    tones = np.array([1e3, 20e3, 30e3, 35e3, 50e3])
    # Of the same vapour a mole fraction falls with the pressure of the air around it; pyfar 0.8.1
    # lets it rise. A humidity that makes the two fractions equal leaves all else to compare.
    as_pyfar_has_it = humidity * (101.325 / pressure) ** 2
    theirs = air_attenuation(temperature, tones, as_pyfar_has_it, 1e3 * pressure)[0]
    ours = absorption_db_per_m(
        tones, temperature_c=temperature, relative_humidity=humidity, pressure_kpa=pressure
    )
    # Half a unit of the fourth digit is at least 5e-5 of the number.
    np.testing.assert_allclose(ours, np.ravel(theirs), rtol=5e-5)


@pytest.mark.parametrize(
    ("temperature", "humidity", "printed"),
    [
        (10.0, 0.7, [0.1, 0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117]),
        (20.0, 0.7, [0.1, 0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6]),
        (30.0, 0.7, [0.1, 0.3, 1.0, 3.1, 7.4, 12.7, 23.1, 59.3]),
        (15.0, 0.2, [0.3, 0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202]),
        (15.0, 0.5, [0.1, 0.5, 1.2, 2.2, 4.2, 10.8, 36.2, 129]),
        (15.0, 0.8, [0.1, 0.3, 1.1, 2.4, 4.1, 8.3, 23.7, 82.8]),
    ],
)
def test_absorption_in_air_matches_the_octave_table_of_iso_9613_2(temperature, humidity, printed):
    octaves = 1e3 * 10 ** (0.3 * np.arange(-4, 4))
    db_per_km = 1e3 * absorption_db_per_m(
        octaves, temperature_c=temperature, relative_humidity=humidity, pressure_kpa=101.325
    )
    digit = np.where(np.array(printed) > 100, 1.0, 0.1)
    # Half of the last digit, and half of a third one: the table rounds that of ISO 9613-1.
    assert np.all(np.abs(db_per_km - printed) <= 0.55 * digit)


@given(
    frequency=st.floats(100.0, 2e5),
    temperature=st.floats(-20.0, 50.0),
    humidity=st.floats(0.0, 1.0),
    pressure=st.floats(50.0, 150.0),
)
@law
def test_absorption_is_positive_and_rises_with_frequency(
    frequency, temperature, humidity, pressure
):
    low, high = absorption_db_per_m(
        frequency * np.array([1.0, 1.01]),
        temperature_c=temperature,
        relative_humidity=humidity,
        pressure_kpa=pressure,
    )
    assert 0.0 < low < high < math.inf


@given(frequency=st.floats(1e3, 1e5), humidity=st.floats(0.05, 0.5), scale=st.floats(0.5, 2.0))
@law
def test_absorption_scales_with_pressure_at_the_same_molar_humidity(frequency, humidity, scale):
    thin = absorption_db_per_m(
        frequency, temperature_c=20.0, relative_humidity=humidity, pressure_kpa=101.325
    )
    dense = absorption_db_per_m(
        frequency * scale,
        temperature_c=20.0,
        relative_humidity=humidity * scale,
        pressure_kpa=101.325 * scale,
    )
    assert dense == pytest.approx(scale * thin, rel=1e-12)


SEA = {"salinity": 35.0, "depth": 0.0, "ph": 8.0}


@pytest.mark.parametrize(
    ("frequency", "temperature", "salinity", "printed"),
    [
        (0.4e3, 10.0, 30.0, "0.015"),
        (2e3, 10.0, 35.0, "0.123"),
        (10e3, 30.0, 35.0, "0.606"),
        (10e3, -1.8, 35.0, "1.36"),
        (14e3, 20.0, 35.0, "1.29"),
        (20e3, -1.8, 35.0, "4.40"),
        (20e3, 10.0, 35.0, "3.35"),
        (40e3, 4.0, 35.0, "11.5"),
        (50e3, 20.0, 35.0, "13.0"),
        (60e3, -1.8, 30.0, "13.6"),
        (80e3, 16.0, 35.0, "28.6"),
        (100e3, 0.0, 30.0, "21.0"),
        (100e3, 10.0, 35.0, "33.6"),
        (140e3, 25.0, 35.0, "58.4"),
        (200e3, 0.0, 35.0, "40.6"),
        (200e3, 30.0, 30.0, "79.3"),
        (300e3, 10.0, 35.0, "73.1"),
        (500e3, 10.0, 35.0, "125"),
        (700e3, 4.0, 35.0, "228"),
        (1e6, 0.0, 30.0, "513"),
        (1e6, 30.0, 35.0, "344"),
    ],
)
def test_absorption_in_seawater_matches_table_iv_of_francois_and_garrison(
    frequency, temperature, salinity, printed
):
    # J. Acoust. Soc. Am. 72 (1982), part II, Table IV: dB/km at the surface, pH 8; as transcribed
    # in the tests of github.com/jmrplens/phonometry.
    water = SEA | {"temperature_c": temperature, "salinity": salinity}
    digits = len(printed.partition(".")[2])
    db_per_km = 1e3 * float(water_absorption_db_per_m(frequency, **water))
    assert abs(db_per_km - float(printed)) <= 0.5 * 10.0**-digits


@pytest.mark.parametrize(
    ("frequency", "other", "printed"),
    [
        (200e3, {}, 54.446199),
        (200e3, {"depth": 4000.0}, 32.836398),
        (31.23e3, {}, 7.354640),
        (200e3, {"ph": 7.8}, 54.411284),
        (200e3, {"salinity": 15.000012}, 31.259585),
        (200e3, {"temperature_c": 0.2}, 40.702235),
    ],
)
def test_absorption_of_water_agrees_with_mb_system(frequency, other, printed):
    # What `mbabsorption` prints, by its own tests (github.com/dwcaress/MB-System): dB/km.
    water = SEA | {"temperature_c": 10.0} | other
    expected = pytest.approx(printed, abs=1e-6)
    assert 1e3 * float(water_absorption_db_per_m(frequency, **water)) == expected


@pytest.mark.parametrize(
    ("temperature", "fitted"),
    [(0.0, 4.92700598), (10.0, 3.10935008), (20.0, 2.18550989), (30.0, 1.65777741)],
)
def test_absorption_of_fresh_water_is_within_a_hundredth_of_pinkertons(temperature, fitted):
    # Pinkerton, Proc. Phys. Soc. B 62 (1949), 129, of distilled water, as k-Wave fits it: dB/km at
    # 100 kHz, by the tests of github.com/waltsims/k-wave-python, for 1 MHz and a hundredth of it.
    lake = SEA | {"salinity": 0.0, "temperature_c": temperature}
    assert 1e3 * float(water_absorption_db_per_m(100e3, **lake)) == pytest.approx(fitted, rel=0.01)


@given(frequency=st.floats(1e3, 1e6), temperature=st.floats(-2.0, 35.0))
@law
def test_fresh_water_absorbs_as_the_square_of_the_frequency(frequency, temperature):
    lake = SEA | {"salinity": 0.0, "temperature_c": temperature}
    low, high = water_absorption_db_per_m(np.array([frequency, 2.0 * frequency]), **lake)
    assert high == pytest.approx(4.0 * low, rel=1e-12)
    assert 0.0 < low < water_absorption_db_per_m(frequency, **lake | {"salinity": 1.0})


@given(speed=SPEEDS, distance=st.floats(1.0, 50.0))
@law
def test_doppler_frequency_is_the_arrival_rate_of_crests(speed, distance):
    c, period = 343.0, 1e-3

    def echo(start):  # a crest sent towards a fixed target that the vehicle approaches
        hit = start + (distance - speed * start) / c
        return hit + (distance - speed * hit) / (c + speed)

    def call(start):  # a crest sent by a fixed beacon that the vehicle approaches
        return (distance + c * start) / (c + speed)

    active = doppler_frequency(1.0, receiver_speed=speed, source_speed=speed, speed_of_sound=c)
    passive = doppler_frequency(1.0, receiver_speed=speed, speed_of_sound=c)
    assert period / (echo(period) - echo(0.0)) == pytest.approx(float(active), rel=1e-10)
    assert period / (call(period) - call(0.0)) == pytest.approx(float(passive), rel=1e-10)


@pytest.mark.parametrize("speed", [343.0, -400.0, math.nan])
def test_a_vehicle_as_fast_as_sound_is_refused(speed):
    with pytest.raises(InputError, match=r"velocity: found .* expected less than the speed of"):
        doppler_frequency(35e3, receiver_speed=speed, source_speed=speed, speed_of_sound=343.0)


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
