"""Counter-based complex normal noise: each sample is computed from its stream and number.

Number i of the stream with a 64-bit key is a hash of key and i (the SplitMix64 finaliser of Steele,
Lea & Flood 2014), transformed to a complex normal by Box and Muller. There is no state, so neither
order nor workers can change a result, and the loops vectorise, as 180,000 normals per frame
require. Logarithm, sine and cosine are short series, good to single precision.
"""

import hashlib
import math

import numpy as np
from jaxtyping import Complex

from pipistrelle.jit import kernel

_CHUNK = 512
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_F = np.float32
_LN2 = _F(math.log(2.0))
_ROOT2 = _F(math.sqrt(2.0))
_QUARTER_TURN = _F(0.5 * math.pi)


def stream_key(seed: int, iteration: int, purpose: str, frame: int = 0) -> int:
    """Return the 64-bit key of a random stream, a hash of seed, iteration, purpose and frame.

    `purpose`: use of the numbers; streams of different purposes are independent.

    >>> stream_key(7, 0, "noise", 3) == stream_key(7, 0, "noise", 3)
    True
    >>> stream_key(7, 0, "noise", 3) == stream_key(7, 0, "noise", 4)
    False
    """
    digest = hashlib.sha256(purpose.encode()).digest()
    words = (iteration, int.from_bytes(digest[:8]), frame)
    state = np.random.SeedSequence(seed, spawn_key=words).generate_state(1, np.uint64)
    return int(state[0])


def stream_from(key: int, number: int) -> int:
    """Return the key of a stream that begins with a given number of another key's."""
    return (key + number * int(_GOLDEN)) % 2**64


def complex_noise(
    shape: tuple[int, ...], std: float, key: int, out: Complex[np.ndarray, "..."] | None = None
) -> Complex[np.ndarray, "..."]:
    """Draw an array of circular complex normal noise from the random stream of a key.

    Sample i, in C order, is number i of the stream. `std`: root of the mean of abs(noise)**2;
    `key`: from `stream_key`; `out`: contiguous, written and returned instead of a new array.

    >>> noise = complex_noise((1000, 10), 2.0, stream_key(7, 0, "example"))
    >>> bool(abs(np.mean(abs(noise) ** 2) - 4.0) < 5 * 4.0 / np.sqrt(noise.size))
    True
    """
    noise = np.empty(shape, dtype=np.complex128) if out is None else out
    _fill(noise.reshape(-1).view(noise.real.dtype), _F(std * std), np.uint64(key))
    return noise


@kernel
def _fill(out, variance, key):
    """Fill an array with a stream's complex normal noise, real and imaginary parts interleaved."""
    count = out.size // 2
    radial, angular = np.empty(_CHUNK, dtype=np.uint32), np.empty(_CHUNK, dtype=np.uint32)
    modulus, mantissa = np.empty(_CHUNK, dtype=np.float32), np.empty(_CHUNK, dtype=np.uint32)
    real, imaginary = np.empty(_CHUNK, dtype=np.float32), np.empty(_CHUNK, dtype=np.float32)
    for start in range(0, count, _CHUNK):
        length = min(_CHUNK, count - start)
        for i in range(length):
            x = key + np.uint64(start + i + 1) * _GOLDEN
            x = (x ^ (x >> np.uint64(30))) * _MIX_1
            x = (x ^ (x >> np.uint64(27))) * _MIX_2
            x ^= x >> np.uint64(31)
            radial[i] = np.uint32(x >> np.uint64(32))
            angular[i] = np.uint32(x)
        for i in range(length):
            modulus[i] = _F(radial[i]) + _F(0.5)
        _split(modulus.view(np.uint32), mantissa, radial, length)
        _modulus(mantissa.view(np.float32), radial, length, variance, modulus)
        _turn(modulus, angular, length, real, imaginary)
        parts = out[2 * start :]
        for i in range(length):
            parts[2 * i], parts[2 * i + 1] = real[i], imaginary[i]


@kernel
def _split(bits, mantissa, exponent, length):
    """Write the mantissa bits and the biased exponent of 32-bit floats, which are given as bits."""
    for i in range(length):
        exponent[i] = bits[i] >> np.uint32(23)
        mantissa[i] = (bits[i] & np.uint32(0x7FFFFF)) | np.uint32(0x3F800000)


@kernel
def _modulus(mantissa, exponent, length, variance, modulus):
    """Write moduli of complex normal noise: sqrt(-variance ln w) of random numbers w in (0, 1]."""
    for i in range(length):
        m = mantissa[i]
        halvings = _F(127 + 32) - _F(exponent[i])
        upper = m > _ROOT2
        m = _F(0.5) * m if upper else m
        halvings = halvings - _F(1.0) if upper else halvings
        s = (m - _F(1.0)) / (m + _F(1.0))
        ss = s * s
        log_m = _F(2.0) * s * (_F(1) + ss * (_F(1 / 3) + ss * (_F(1 / 5) + ss * _F(1 / 7))))
        modulus[i] = math.sqrt(max(variance * (halvings * _LN2 - log_m), _F(0.0)))


@kernel
def _turn(modulus, angular, length, real, imaginary):
    """Write the parts x and y of complex numbers from their moduli and random 32-bit angles."""
    for i in range(length):
        fraction = _F(np.int32(angular[i] & np.uint32(0x3FFFFFFF))) * _F(2.0**-30)
        x = (fraction - _F(0.5)) * _QUARTER_TURN
        xx = x * x
        sine = x * (_F(1) - xx * (_F(1 / 6) - xx * (_F(1 / 120) - xx * _F(1 / 5040))))
        cosine = _F(1) - xx * (
            _F(1 / 2) - xx * (_F(1 / 24) - xx * (_F(1 / 720) - xx * _F(1 / 40320)))
        )
        odd = (angular[i] & np.uint32(0x40000000)) != 0
        radius = -modulus[i] if (angular[i] & np.uint32(0x80000000)) != 0 else modulus[i]
        real[i] = radius * (-sine if odd else cosine)
        imaginary[i] = radius * (cosine if odd else sine)
