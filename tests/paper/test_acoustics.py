"""Bradley & Abaid, Sec. II-A, Sec. II-B and Appendix B: what is printed, and what is misprinted."""

import numpy as np

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.acoustics.propagation import absorption_db_per_m

APPENDIX_B = [11.4, 14.2, 17.6, 21.8, 26.8, 33.2, 41.6, 51.4, 64.8, 83.0, 108.6, 180.0]
RADII = np.logspace(np.log10(2.5e-3), np.log10(25e-3), 12)[::-1]
STANDARD = {"temperature_c": 20.0, "relative_humidity": 0.5, "pressure_kpa": 101.325}


def listed_beamwidths(radii, frequency):
    """As the appendix makes its list: twice the half-angle floored to 0.1 degrees."""
    half = np.degrees(beamwidth(radii, frequency=frequency, speed_of_sound=343.0)) / 2
    return 2 * np.floor(10 * half + 1e-9) / 10


def test_beamwidths_of_the_papers_radii_match_appendix_b():
    listed = listed_beamwidths(np.round(RADII, 4), 35e3)
    np.testing.assert_allclose(listed, APPENDIX_B, rtol=0, atol=0.2 + 1e-9)
    assert np.sum(np.isclose(listed, APPENDIX_B)) >= 10
    assert listed[-1] == 180.0


def test_beamwidths_at_the_beacons_frequency_do_not_match_appendix_b():
    off = np.abs(listed_beamwidths(np.round(RADII, 4), 30e3) - APPENDIX_B)
    assert np.sum(off > 1.0) == 11
    assert off.max() > 30.0


def test_radii_that_are_not_rounded_miss_appendix_b():
    assert np.abs(listed_beamwidths(RADII, 35e3) - APPENDIX_B).max() > 0.5


def test_absorption_of_both_tones_is_as_decided():
    alpha = absorption_db_per_m(np.array([30e3, 35e3]), **STANDARD)
    np.testing.assert_allclose(alpha, [0.937, 1.133], rtol=0, atol=0.0005)


def test_coefficients_of_eq_3_are_as_printed_but_for_one_digit():
    # In dry air at 20 degrees the relaxation frequencies are 24 and 9 Hz: three tones then tell
    # the three coefficients.
    f = np.array([10.0, 30.0, 3e4])
    dry = absorption_db_per_m(f, **{**STANDARD, "relative_humidity": 0.0}) / (8.686 * f**2)
    shapes = np.column_stack([np.ones(3), 24 / (24**2 + f**2), 9 / (9**2 + f**2)])
    classical, oxygen, nitrogen = np.linalg.solve(shapes, dry)
    assert f"{classical:.2e}" == "1.84e-11"
    assert f"{oxygen:.4e}" == "6.1424e-06"
    assert f"{nitrogen:.4e}" == "1.1552e-06"  # printed 1.5552e-6


def test_the_printed_digit_of_eq_3_is_worth_less_than_four_tenths_of_a_percent():
    f, f_n = 30e3, 332.0
    excess = 8.686 * f**2 * (1.5552e-6 - 1.1552e-6) * f_n / (f_n**2 + f**2)
    assert excess / absorption_db_per_m(f, **STANDARD) < 0.004


def test_eq_4_as_printed_sends_nothing_back_and_less_than_nothing_forward():
    r, k = 0.025, 2 * np.pi * 35e3 / 343.0
    angle = np.radians(np.linspace(1.0, 180.0, 718))
    printed = r / 2 * np.sin(angle) + np.sin(r * k * np.sin(angle)) / (
        2 * np.pi * k * np.tan(angle / 2) ** 2
    )
    assert abs(printed[-1]) < 1e-15
    assert printed.min() < 0.0
