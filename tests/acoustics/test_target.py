"""The short-wave target strengths against the exact scattering series of rigid bodies."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import eval_legendre, h1vp, jvp, spherical_jn, spherical_yn

from pipistrelle.acoustics.emitter import target_strength_db
from pipistrelle.config import InputError

law = settings(deadline=None)
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


def test_large_cylinders_mirror_and_large_spheres_scatter_evenly_off_the_shadow():
    at = {"radius": 1.0, "frequency": 35e3, "speed_of_sound": C}
    angle = np.radians([60.0, 90.0, 120.0])
    cylinder = target_strength_db(angle, shape="cylinder", **at)
    sphere = target_strength_db(angle, shape="sphere", **at)
    # The shadow's side lobes add at most cot^2(30) / (pi kr) = 0.0015 to sin(30), and to the
    # sphere's 1 at most 2 cot^2(30) / (pi kr sin(60)) = 0.0034, with kr = 641.
    np.testing.assert_allclose(cylinder, 10 * np.log10(np.sin(angle / 2)), atol=0.02)
    np.testing.assert_allclose(sphere, 0.0, atol=0.02)


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


@pytest.mark.parametrize("shape", SHAPES)
def test_backscatter_is_the_reference(shape):
    at = {"radius": 0.025, "frequency": 30e3, "shape": shape, "speed_of_sound": C}
    assert target_strength_db(math.pi, **at) == 0.0


def test_an_unknown_shape_is_refused():
    with pytest.raises(InputError, match=r"target\.shape: found 'cube'"):
        target_strength_db(1.0, radius=0.01, frequency=3e4, shape="cube", speed_of_sound=C)
