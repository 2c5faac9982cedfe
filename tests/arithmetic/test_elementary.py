"""Elementary functions against longer floating-point numbers, in units of the last place."""

import numpy as np
import pytest
from numba import njit

from pipistrelle.arithmetic.elementary import (
    arctangent,
    cosine_and_sine,
    exponential,
    logarithm,
    wrapped,
)
from pipistrelle.geometry import wrap_angle

pytestmark = pytest.mark.skipif(
    np.finfo(np.longdouble).nmant < 60, reason="no longer floating-point numbers here"
)
DRAWS = 20_000


@njit
def _exponentials(x, out):
    for i in range(x.size):
        out[i] = exponential(x[i])


@njit
def _logarithms(x, out):
    for i in range(x.size):
        out[i] = logarithm(x[i])


@njit
def _directions(y, x, out):
    for i in range(x.size):
        out[i] = arctangent(y[i], x[i])


@njit
def _cosines_and_sines(x, cosine, sine):
    for i in range(x.size):
        cosine[i], sine[i] = cosine_and_sine(x[i])


@njit
def _wrapped(x, out):
    for i in range(x.size):
        out[i] = wrapped(x[i])


def made(function, *arguments, results=1):
    outs = [np.empty_like(arguments[0]) for _ in range(results)]
    function(*arguments, *outs)
    return outs if results > 1 else outs[0]


def worst(found, exact):
    """Largest error in units in the last place."""
    units = np.spacing(np.abs(exact).astype(float))
    return float(np.max(np.abs(found.astype(np.longdouble) - exact) / units))


def spread(low, high, seed=1):
    return np.random.default_rng(seed).uniform(low, high, DRAWS)


@pytest.mark.parametrize(("low", "high"), [(-708, 700), (-1, 1), (-1e-8, 1e-8)])
def test_exponential_is_good_to_the_last_place_or_two(low, high):
    x = spread(low, high)
    assert worst(made(_exponentials, x), np.exp(x.astype(np.longdouble))) < 2


def test_the_exponential_is_1_at_zero_and_0_far_below():
    x = np.array([0.0, -0.0, -709.0, -1e300, -np.inf])
    assert made(_exponentials, x).tolist() == [1, 1, 0, 0, 0]


@pytest.mark.parametrize("decades", [300, 3, 1e-3, 1e-9])
def test_logarithm_is_good_to_the_last_three_places(decades):
    x = np.exp(spread(-decades, decades))
    x = x[x != 1]
    assert worst(made(_logarithms, x), np.log(x.astype(np.longdouble))) < 3


def test_the_logarithm_of_1_is_0():
    assert made(_logarithms, np.ones(3)).tolist() == [0, 0, 0]


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1.0, 1e3, 1e8])
def test_direction_of_a_point_is_good_to_the_last_places(scale):
    rng = np.random.default_rng(2)
    y, x = rng.normal(size=DRAWS) * scale, rng.normal(size=DRAWS)
    exact = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    assert worst(made(_directions, y, x), exact) < 3


def test_directions_along_the_axes_and_of_the_origin():
    y, x = np.array([0.0, 2.0, 0.0, -2.0, 0.0]), np.array([3.0, 0.0, -3.0, 0.0, 0.0])
    np.testing.assert_array_equal(made(_directions, y, x), np.array([0, 1, 2, -1, 0]) * np.pi / 2)


def test_cosine_and_sine_are_good_to_the_last_places_over_some_turns():
    x = spread(-20, 20)
    cosine, sine = made(_cosines_and_sines, x, results=2)
    for found, exact in ((cosine, np.cos), (sine, np.sin)):
        error = found.astype(np.longdouble) - exact(x.astype(np.longdouble))
        assert np.abs(error).max() < 2 * np.finfo(float).eps
    assert made(_cosines_and_sines, np.zeros(1), results=2) == [1, 0]


def test_wrapped_arrays_equal_wrapped_scalars():
    edges = np.array([-np.pi, np.nextafter(np.pi, 0), np.pi, -3 * np.pi, 0.0])
    x = np.concatenate([spread(-20, 20), edges])
    np.testing.assert_array_equal(made(_wrapped, x), [wrap_angle(angle) for angle in x])


@pytest.mark.parametrize("function", [_exponentials, _logarithms])
def test_arrays_and_scalars_give_the_same_bits(function):
    x = spread(1e-3, 5.0)[:1003]
    alone = [made(function, x[i : i + 1])[0] for i in range(x.size)]
    np.testing.assert_array_equal(made(function, x), alone)
