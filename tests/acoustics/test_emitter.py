"""Pistons by their definition, target strengths by the exact series of rigid bodies."""

import math
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import eval_legendre, h1vp, jvp, spherical_jn, spherical_yn

from pipistrelle.acoustics.emitter import (
    HALF_POWER,
    beamwidth,
    in_front,
    jinc,
    piston_directivity,
    piston_radius,
    target_strength_db,
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


def test_importing_the_package_does_not_import_numpy():
    code = "import sys, pipistrelle.acoustics; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Target strengths

C = 343.0
SHAPES = ["cylinder", "sphere"]
BACKWARD = np.radians(np.linspace(90.0, 180.0, 361))


def modes(kr):
    """Orders that a body of this size excites; the rest are below double precision."""
    return np.arange(int(kr + 10 * np.cbrt(kr)) + 12)


def exact_cylinder(angle, kr):
    """Intensity of a rigid cylinder per unit length, times k (Neumann series)."""
    n = modes(kr)
    amplitude = np.where(n == 0, 1.0, 2.0) * jvp(n, kr) / h1vp(n, kr)
    return 2.0 / np.pi * np.abs(amplitude @ np.cos(np.outer(n, angle))) ** 2


def exact_sphere(angle, kr):
    """Intensity of a rigid sphere, times k squared (Neumann series)."""
    n = modes(kr)
    j, y = spherical_jn(n, kr, derivative=True), spherical_yn(n, kr, derivative=True)
    amplitude = (2 * n + 1) * j / (j + 1j * y)
    return np.abs(amplitude @ eval_legendre(n[:, None], np.cos(angle))) ** 2


EXACT = {"cylinder": exact_cylinder, "sphere": exact_sphere}
BACKSCATTER = {"cylinder": lambda kr: kr / 2, "sphere": lambda kr: kr**2 / 4}
"""Short-wave I(pi): r/2, times k, and r^2/4, times k^2."""


def wave_number(frequency):
    return 2 * np.pi * frequency / C


def rms_error_db(shape, radius, frequency, *, truth=None):
    kr = wave_number(frequency) * radius
    ours = target_strength_db(
        BACKWARD, radius=radius, frequency=frequency, shape=shape, speed_of_sound=C
    ) + 10 * np.log10(BACKSCATTER[shape](kr))
    exact = 10 * np.log10(EXACT[truth or shape](BACKWARD, kr))
    if truth not in (None, shape):  # compare the shapes alone
        exact += ours[-1] - exact[-1]
    return np.sqrt(np.mean((ours - exact) ** 2))


@pytest.mark.parametrize(("shape", "node"), [("cylinder", 2.0), ("sphere", 1.5)])
def test_the_exact_series_has_rayleighs_limit_for_long_waves(shape, node):
    angle = np.linspace(0.0, np.pi, 13)
    ratio = EXACT[shape](angle, 0.01) / EXACT[shape](np.array([np.pi]), 0.01)
    rayleigh = ((1 - node * np.cos(angle)) / (1 + node)) ** 2
    np.testing.assert_allclose(ratio, rayleigh, atol=1e-3)


@pytest.mark.parametrize("frequency", [30e3, 35e3])
@pytest.mark.parametrize("shape", SHAPES)
def test_strength_is_within_the_bounds_of_the_exact_series(shape, frequency):
    assert rms_error_db(shape, 0.01, frequency) <= 0.9
    for radius in np.linspace(0.02, 0.10, 41):
        assert rms_error_db(shape, radius, frequency) <= 0.45


@pytest.mark.parametrize(("shape", "other"), [SHAPES, SHAPES[::-1]])
def test_the_formula_of_a_shape_does_not_fit_the_other(shape, other):
    assert all(rms_error_db(shape, r, 35e3, truth=other) > 0.45 for r in (0.02, 0.05, 0.10))


@pytest.mark.parametrize(("shape", "total"), [("cylinder", 8.0), ("sphere", 4.0)])
def test_a_short_wave_loses_twice_the_power_on_the_cross_section(shape, total):
    # Lit side and shadow each scatter the power that falls on the body: 2r or pi r^2.
    angle = np.linspace(0.0, np.pi, 400_001)
    ratio = 10 ** (
        target_strength_db(angle, radius=1.0, frequency=1e5, shape=shape, speed_of_sound=C) / 10
    )
    solid = 2.0 if shape == "cylinder" else np.sin(angle)
    # What is left out is of the order of 1 / kr, here 1 / 1832.
    assert np.trapezoid(ratio * solid, angle) == pytest.approx(total, rel=2e-3)


@given(radius=st.floats(1e-3, 0.2), frequency=st.floats(2e4, 5e4))
@law
def test_straight_on_the_limits_are_closed_forms(radius, frequency):
    kr = wave_number(frequency) * radius
    for shape, limit in (("cylinder", 4 * kr / math.pi), ("sphere", 1 + kr**2)):
        at = {"radius": radius, "frequency": frequency, "shape": shape, "speed_of_sound": C}
        straight, nearly = target_strength_db(np.array([0.0, 1e-7]), **at)
        assert straight == pytest.approx(10 * math.log10(limit), abs=1e-12)
        assert nearly == pytest.approx(straight, abs=1e-5)


@given(angle=st.floats(-7.0, 7.0), radius=st.floats(1e-3, 0.2), shape=st.sampled_from(SHAPES))
@law
def test_strength_is_even_periodic_and_finite(angle, radius, shape):
    at = {"radius": radius, "frequency": 30e3, "shape": shape, "speed_of_sound": C}
    turned = target_strength_db(np.array([angle, -angle, angle + 2 * math.pi]), **at)
    assert np.isfinite(turned).all()
    assert turned[1] == pytest.approx(turned[0], abs=1e-12)
    assert turned[2] == pytest.approx(turned[0], abs=1e-9)


@given(angle=st.floats(0.05, math.pi), radius=st.floats(1e-3, 0.2), shape=st.sampled_from(SHAPES))
@law
def test_target_strength_matches_the_documented_formula(angle, radius, shape):
    from scipy.special import j1

    k = wave_number(30e3)
    cot2, x = 1 / math.tan(angle / 2) ** 2, k * radius * math.sin(angle)
    if shape == "cylinder":
        intensity = radius / 2 * math.sin(angle / 2) + cot2 * math.sin(x) ** 2 / (2 * math.pi * k)
        back = radius / 2
    else:
        intensity, back = radius**2 / 4 * (1 + cot2 * j1(x) ** 2), radius**2 / 4
    ours = target_strength_db(angle, radius=radius, frequency=30e3, shape=shape, speed_of_sound=C)
    assert ours == pytest.approx(10 * math.log10(intensity / back), abs=1e-9)


def test_an_unknown_shape_is_refused():
    with pytest.raises(InputError, match=r"target\.shape: found 'cube'"):
        target_strength_db(1.0, radius=0.01, frequency=3e4, shape="cube", speed_of_sound=C)
