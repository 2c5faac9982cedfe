import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.acoustics.emitter import (
    HALF_POWER,
    beamwidth,
    in_front,
    jinc,
    piston_directivity,
    piston_radius,
)
from pipistrelle.config import InputError

law = settings(deadline=None)
CALL = {"frequency": 35e3, "speed_of_sound": 343.0}
BEARINGS = st.floats(-10.0, 10.0)
RADII = st.floats(1e-4, 0.2)


def exact_jinc(x: float | Fraction) -> Fraction:
    """The power series of 2 J1(x) / x, to far below one unit in the last place for x < 4."""
    q = Fraction(x) ** 2 / 4
    return sum((-q) ** m / Fraction(math.factorial(m) * math.factorial(m + 1)) for m in range(30))


def test_half_power_is_the_root_to_the_last_bit():
    half_a_bit = Fraction(math.ulp(HALF_POWER)) / 2
    root = Fraction(HALF_POWER)
    assert exact_jinc(root - half_a_bit) ** 2 > Fraction(1, 2) > exact_jinc(root + half_a_bit) ** 2


@given(x=st.floats(-4.0, 4.0))
@law
def test_jinc_is_its_power_series(x):
    assert float(jinc(x)) == pytest.approx(float(exact_jinc(x)), abs=1e-15)


def test_jinc_stays_within_its_bounds():
    values = jinc(np.linspace(-200.0, 200.0, 100_001))
    assert values.max() == 1.0
    assert -0.1323 < values.min() < -0.1322


@given(bearing=BEARINGS, radius=RADII)
@law
def test_directivity_is_even_and_between_0_and_1(bearing, radius):
    p = piston_directivity(np.array([bearing, -bearing]), radius=radius, **CALL)
    assert p[1] == pytest.approx(p[0], abs=1e-15)
    assert 0.0 <= p[0] <= 1.0


@given(radius=RADII)
@law
def test_directivity_is_1_on_the_axis(radius):
    assert piston_directivity(0.0, radius=radius, **CALL) == 1.0


@given(bearing=st.floats(-math.pi / 2, math.pi / 2), radius=RADII)
@law
def test_the_baffle_blocks_only_the_backward_half(bearing, radius):
    forward = piston_directivity(bearing, radius=radius, **CALL)
    x = 2 * math.pi * 35e3 / 343.0 * radius * math.sin(bearing)
    assert forward == pytest.approx(abs(float(jinc(x))), abs=1e-12)
    if abs(bearing) < math.pi / 2 - 1e-9:
        assert piston_directivity(math.pi - bearing, radius=radius, **CALL) == 0.0


def test_the_baffle_is_at_90_degrees_for_unwrapped_bearings():
    edge = math.pi / 2
    just_behind = math.nextafter(edge, 4.0)
    assert in_front(np.array([edge, -edge])).all()
    assert not in_front(np.array([just_behind, -just_behind, math.pi, 3 * math.pi])).any()
    assert in_front(np.array([2 * math.pi, -4 * math.pi + 1.5])).all()


@given(radius=st.floats(0.00253, 0.2))
@law
def test_power_is_half_at_the_edge_of_the_beam_and_more_within(radius):
    edge = float(beamwidth(radius, **CALL)) / 2
    p2 = piston_directivity(edge * np.array([0.999, 1.0]), radius=radius, **CALL) ** 2
    assert p2[1] == pytest.approx(0.5, abs=1e-12)
    assert p2[0] > p2[1]


def test_a_small_piston_never_falls_to_half_power():
    narrowest_wide = float(piston_radius(math.pi, **CALL))
    p2 = piston_directivity(np.pi / 2, radius=0.999 * narrowest_wide, **CALL) ** 2
    assert p2 > 0.5
    assert beamwidth(0.999 * narrowest_wide, **CALL) == math.pi
    assert beamwidth(1.001 * narrowest_wide, **CALL) < math.pi


@given(radius=st.floats(0.00253, 0.2))
@law
def test_the_radius_of_a_beamwidth_is_recovered(radius):
    assert piston_radius(beamwidth(radius, **CALL), **CALL) == pytest.approx(radius, rel=1e-13)


@given(width=st.floats(0.01, math.pi))
@law
def test_the_beamwidth_of_a_radius_is_recovered(width):
    # The arc sine loses half of the digits at pi.
    tolerance = 1e-14 + 4e-16 / max(math.cos(width / 2), 1e-8)
    assert beamwidth(piston_radius(width, **CALL), **CALL) == pytest.approx(width, abs=tolerance)


@pytest.mark.parametrize("radius", [0.0, -0.01, math.nan, math.inf])
def test_a_piston_without_a_size_is_refused(radius):
    with pytest.raises(InputError, match=r"radius: found .* expected metres above 0"):
        beamwidth(radius, **CALL)


@pytest.mark.parametrize("width", [0.0, -1.0, 3.15, math.nan])
def test_a_beamwidth_that_no_piston_makes_is_refused(width):
    with pytest.raises(InputError, match=r"beamwidth: found .* up to 180"):
        piston_radius(width, **CALL)
