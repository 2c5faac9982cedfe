"""Elementary functions that vectorise: a loop that calls them computes several arguments at once.

The C library's functions take one number and branch, so a loop that calls them is not vectorised.
These have no branches and no tables: each reduces its argument to near zero, sums a Taylor series
to double precision, and undoes the reduction. The compiler then computes as many arguments at once
as the processor has lanes, with bit-identical results.

They are exact to three units in the last place on the stated domains, and undefined outside and for
NaN.
"""

import math

import numpy as np

from pipistrelle.jit import inlined

_INTEGER = 1.5 * 2.0**52
"""Adding it rounds a number to an integer, in the last bits of the sum."""
_MANTISSA = 52
_TINY = 2.0**-1022
_LN2_HEAD = float.fromhex("0x1.62e42fee00000p-1")
_LN2_TAIL = float.fromhex("0x1.a39ef35793c76p-33")
_QUARTER_HEAD = float.fromhex("0x1.921fb544p+0")
_QUARTER_TAIL = float.fromhex("0x1.0b4611a626331p-34")
"""ln 2 and pi / 2 in two parts: a small integer times the head has no rounding."""
_ROOT_HALF = int(np.float64(math.sqrt(0.5)).view(np.int64))

_EXPONENTIAL = tuple(1.0 / math.factorial(n) for n in reversed(range(14)))
_SINE = tuple((-1) ** n / math.factorial(2 * n + 1) for n in reversed(range(9)))
_COSINE = tuple((-1) ** n / math.factorial(2 * n) for n in reversed(range(10)))
_ARCTANGENT = tuple((-1) ** n / (2 * n + 1) for n in reversed(range(10)))
_LOGARITHM = tuple(2.0 / (2 * n + 1) for n in reversed(range(12)))
_KNOWN = tuple(math.atan(slope) for slope in (0.25, 0.5, 0.75, 1.0))


@inlined
def _series(coefficients, x):
    """Evaluate a polynomial at x from its coefficients, the highest power first."""
    total = 0.0
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


@inlined
def exponential(x):
    """Return e to the power of x, for x below 700; zero below -708."""
    bounded = max(x, -708.0)
    shifted = bounded * (1.0 / math.log(2.0)) + _INTEGER
    twos = shifted - _INTEGER
    rest = (bounded - twos * _LN2_HEAD) - twos * _LN2_TAIL
    bits = np.float64(_series(_EXPONENTIAL, rest)).view(np.int64)
    bits += np.float64(shifted).view(np.int64) << _MANTISSA
    power = np.int64(bits).view(np.float64)
    return power if x >= -708.0 else 0.0


@inlined
def logarithm(x):
    """Return the natural logarithm of a normal positive number."""
    bits = np.float64(x).view(np.int64)
    twos = (bits - _ROOT_HALF) >> _MANTISSA
    rest = np.int64(bits - (twos << _MANTISSA)).view(np.float64)  # between the roots of 1/2 and 2
    ratio = (rest - 1.0) / (rest + 1.0)
    return twos * _LN2_HEAD + (ratio * _series(_LOGARITHM, ratio * ratio) + twos * _LN2_TAIL)


@inlined
def cosine_and_sine(angle):
    """Return cosine and sine of an angle of a few turns [rad]."""
    shifted = angle * (2.0 / math.pi) + _INTEGER
    quarters = shifted - _INTEGER
    rest = (angle - quarters * _QUARTER_HEAD) - quarters * _QUARTER_TAIL
    square = rest * rest
    c, s = _series(_COSINE, square), rest * _series(_SINE, square)
    quadrant = np.float64(shifted).view(np.int64)
    c, s = (s, c) if quadrant & 1 else (c, s)
    return -c if (quadrant + 1) & 2 else c, -s if quadrant & 2 else s


@inlined
def arctangent(y, x):
    """Return the direction of the point (x, y) in [-pi, pi] [rad]; zero for the origin.

    Within an eighth of a turn, it is the tabulated direction of the nearest of five slopes plus the
    arctangent of the remainder.
    """
    across, along = abs(y), abs(x)
    small, large = min(across, along), max(across, along)
    slope, known = 0.0, 0.0
    slope, known = (0.25, _KNOWN[0]) if small > 0.125 * large else (slope, known)
    slope, known = (0.50, _KNOWN[1]) if small > 0.375 * large else (slope, known)
    slope, known = (0.75, _KNOWN[2]) if small > 0.625 * large else (slope, known)
    slope, known = (1.00, _KNOWN[3]) if small > 0.875 * large else (slope, known)
    rest = (small - slope * large) / max(large + slope * small, _TINY)
    angle = known + rest * _series(_ARCTANGENT, rest * rest)
    angle = 0.5 * math.pi - angle if across > along else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@inlined
def wrapped(angle):
    """Wrap an angle to [-pi, pi) as `pipistrelle.geometry.wrap_angle` does, without a branch."""
    inside = angle - 2.0 * math.pi * np.floor((angle + math.pi) / (2.0 * math.pi))
    inside = inside - 2.0 * math.pi if inside >= math.pi else inside
    return angle if -math.pi <= angle and angle < math.pi else inside
