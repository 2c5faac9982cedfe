r"""Narrowband beamforming: steering vectors, beam patterns, scan, and the bound of a bearing.

A beam steered to :math:`\phi_0` has for a wave from :math:`\phi` the power response

.. math:: B(\phi) = \left| \sum_m w_m^2 e^{i k\, p_m \cdot (u(\phi) - u(\phi_0))} \right|^2 ,

one where they agree. The beam's width is at half of it; another lobe near one is an ambiguous
bearing. Waves are plane for an array of aperture D from :math:`2 D^2 / \lambda`.

Source: van Trees, Optimum Array Processing (2002), ch. 2.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.arrays.layout import Scattered

STEERED = 360
"""Most steering directions."""
MOST_WAVES = 4096
"""Most wave directions per beam."""
PHASE_STEP = 0.1
"""Root mean square phase between two wave directions [rad], if `MOST_WAVES` suffice."""
ALIKE_DB = -1.0
"""Least height of an ambiguous lobe [dB]."""

UNKNOWN = math.pi / math.sqrt(3.0)
"""Standard deviation of a bearing that is uniform over the circle [rad]."""


class Pattern(NamedTuple):
    """Beamwidths, side lobes and ambiguous bearings of a group of microphones at a frequency."""

    microphones: int
    aperture: float
    """Largest distance of two microphones [m]."""
    nearest: float
    """Largest distance of a microphone from its nearest neighbour [m]."""
    far_field: float
    """Distance from which waves are plane [m]."""
    width: tuple[float, float]
    """Half-power width of the narrowest and of the widest beam [rad]."""
    lobe_db: float
    """Highest side lobe of any beam [dB]."""
    worst: tuple[float, float]
    """Bearing of that beam, and of the lobe [rad]."""
    alike: float
    """Share of the bearings with a lobe of `ALIKE_DB` elsewhere."""
    std: tuple[float, float]
    """Smallest and largest Cramer-Rao bound of a bearing at 20 dB per microphone [rad]."""


def pattern_of(layout: Scattered, g: int, *, frequency: float, speed_of_sound: float) -> Pattern:
    """Compute beamwidths, side lobes and bearing bounds of a group of microphones at a tone [Hz].

    Over all bearings, or for a line on a face within 75 degrees of its normal. `speed_of_sound`
    [m/s].

    >>> from pipistrelle.arrays.layout import microphones_of
    >>> from pipistrelle.arrays.layout import scattered
    >>> line = scattered(microphones_of([(0, 0.0049 * i, 0, 0, "") for i in range(10)]))
    >>> found = pattern_of(line, 0, frequency=35e3, speed_of_sound=343.0)
    >>> round(found.alike, 2), round(found.far_field, 2), round(math.degrees(found.width[0]), 1)
    (0.94, 0.4, 10.2)
    """
    members = layout.group == g
    place, wave = layout.position[members], 2.0 * np.pi * frequency / speed_of_sound
    share = layout.amplitude[members] ** 2 / np.sum(layout.amplitude[members] ** 2)
    bearing, closed = _bearings(layout.normal[g], place, share, wave)
    spread = wave**2 * spread_towards(bearing, place, np.sqrt(share))
    answers = np.exp(1j * wave * np.column_stack((np.cos(bearing), np.sin(bearing))) @ place.T)
    beams = np.linspace(0, len(bearing) - 1, min(STEERED, len(bearing)), dtype=int)
    widths, lobes = [], []
    for i in beams:
        power = np.abs(answers @ (share * answers[i].conj())) ** 2
        width, lobe, at = _width_and_lobe(power, i, closed)
        widths.append(width * float(bearing[1] - bearing[0]))
        lobes.append((lobe, bearing[i], bearing[at]))
    level, steered, other = max(lobes)
    apart = np.linalg.norm(place[:, None] - place, axis=-1)
    aperture = float(apart.max())
    power = 100.0 * np.sum(layout.amplitude[members] ** 2)
    stds = np.minimum((2.0 * power * np.maximum(spread, 1e-9)) ** -0.5, UNKNOWN)
    return Pattern(
        microphones=len(place),
        aperture=aperture,
        nearest=float((apart + np.eye(len(place)) * 1e9).min(axis=1).max()),
        far_field=2.0 * aperture**2 * frequency / speed_of_sound,
        width=(min(widths), max(widths)),
        lobe_db=10.0 * math.log10(max(level, 1e-30)),
        worst=(float(steered), float(other)),
        alike=float(np.mean([lobe >= 10.0 ** (ALIKE_DB / 10.0) for lobe, *_ in lobes])),
        std=(float(stds.min()), float(stds.max())),
    )


def beam_power(
    layout: Scattered,
    g: int,
    steered: float,
    bearing: Float[np.ndarray, " n"],
    *,
    frequency: float,
    speed_of_sound: float,
) -> Float[np.ndarray, " n"]:
    """Return a steered beam's power response to waves from given bearings [rad]; 1 at the peak."""
    members = layout.group == g
    share = layout.amplitude[members] ** 2 / np.sum(layout.amplitude[members] ** 2)
    lead = (layout.lead(bearing) - layout.lead(steered))[:, members]
    return np.abs(np.exp(2j * np.pi * frequency / speed_of_sound * lead) @ share) ** 2


def _bearings(
    normal: float, place: Float[np.ndarray, "k 2"], share: Float[np.ndarray, " k"], wave: float
) -> tuple[Float[np.ndarray, " n"], bool]:
    """Return sampled bearings that a group can receive from, and whether they form a circle."""
    around = np.linspace(-np.pi, np.pi, STEERED, endpoint=False)
    turn = wave * np.sqrt(spread_towards(around, place, np.sqrt(share)).max())
    count = min(max(math.ceil(2.0 * np.pi * turn / PHASE_STEP), STEERED), MOST_WAVES)
    if math.isnan(normal):
        return np.linspace(-np.pi, np.pi, count, endpoint=False), True
    limit = math.radians(75.0)
    return normal + np.linspace(-limit, limit, count), False


def spread_towards(
    bearing: Float[np.ndarray, "*n"],
    position: Float[np.ndarray, "k 2"],
    weight: Float[np.ndarray, " k"],
) -> Float[np.ndarray, "*n"]:
    r"""Return the weighted variance of microphone positions perpendicular to a direction [m^2].

    Weighted by the squared weights. Times the wavenumber squared it is :math:`\kappa`, the squared
    slope of the phases in the bearing in the Cramer-Rao bound
    (`pipistrelle.detection.beams`).

    >>> pair, equal = np.array([[0.0, 0.1], [0.0, -0.1]]), np.full(2, 0.5**0.5)
    >>> spread_towards(np.array([0.0, np.pi / 2]), pair, equal).round(9)
    array([0.01, 0.  ])
    """
    across = np.stack((-np.sin(bearing), np.cos(bearing)), axis=-1) @ position.T
    share = weight * weight
    return across**2 @ share - (across @ share) ** 2


def _width_and_lobe(power: Float[np.ndarray, " n"], i: int, closed: bool) -> tuple[int, float, int]:
    """Return a beam's half-power width in steps, its highest side lobe, and the lobe's index."""
    n = len(power)
    turned = np.roll(power, n // 2 - i) if closed else power
    i, away = (n // 2, i - n // 2) if closed else (i, 0)
    low, high = i, i
    while low > 0 and turned[low - 1] >= 0.5:
        low -= 1
    while high < n - 1 and turned[high + 1] >= 0.5:
        high += 1
    width = high - low
    while low > 0 and turned[low - 1] <= turned[low]:
        low -= 1
    while high < n - 1 and turned[high + 1] <= turned[high]:
        high += 1
    rest = turned.copy()
    rest[low : high + 1] = 0.0
    at = int(rest.argmax())
    return width, float(rest[at]), (at + away) % n


def steering_vector(
    angle: Float[np.ndarray, "*n"] | float,
    *,
    position: Float[np.ndarray, " e"],
    frequency: float,
    speed_of_sound: float,
) -> Complex[np.ndarray, "*n e"]:
    r"""Return the complex response of each element of a line array to a unit plane wave.

    .. math:: v_e(\theta) = e^{2\pi i f y_e \sin\theta / c}

    `angle` [rad]: off the array's normal; `position` [m]: elements along the array; `frequency`
    [Hz]; `speed_of_sound` [m/s].

    Bradley & Abaid, Sec. II-C; van Trees (2002), ch. 2.

    >>> half_wave = {"position": np.array([0.0, 0.0049]), "frequency": 35e3}
    >>> steering_vector(np.pi / 2, **half_wave, speed_of_sound=343.0).round(9)
    array([ 1.+0.j, -1.+0.j])
    """
    wavenumber = 2.0 * np.pi * frequency / speed_of_sound
    return np.exp(1j * wavenumber * np.multiply.outer(np.sin(angle), position))


def beampattern(
    angle: Float[np.ndarray, "*n"],
    *,
    steered: float,
    position: Float[np.ndarray, " e"],
    frequency: float,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the power response of a line array's beam, steered to an angle, to other waves.

    .. math:: B(\theta) = \left| \frac{1}{N} v(\theta_0)^H v(\theta) \right|^2

    `angle` [rad]; `steered` [rad]; `position` [m]; `frequency` [Hz]; `speed_of_sound` [m/s].
    Returns a ratio in [0, 1], 1 at the steered angle.

    >>> ears = {"position": np.arange(10) * 0.0049, "frequency": 35e3, "speed_of_sound": 343.0}
    >>> null = np.arcsin(0.2)
    >>> beampattern(np.array([0.0, null]), steered=0.0, **ears).round(9)
    array([1., 0.])
    """
    wave = {"position": position, "frequency": frequency, "speed_of_sound": speed_of_sound}
    weights = steering_vector(steered, **wave) / position.size
    return np.abs(steering_vector(angle, **wave) @ weights.conj()) ** 2


def beamscan(
    snapshot: Complex[np.ndarray, " e"],
    angle: Float[np.ndarray, " n"],
    *,
    position: Float[np.ndarray, " e"],
    frequency: float,
    speed_of_sound: float,
) -> Float[np.ndarray, " n"]:
    r"""Return the power that a conventional beam receives from each angle in a snapshot.

    .. math:: P(\theta) = \left| v(\theta)^H x \right|^2

    `snapshot`: one matched-filter output per element; `angle` [rad]; `position` [m]; `frequency`
    [Hz]; `speed_of_sound` [m/s].

    Bradley & Abaid, Sec. II-D. The detector computes the same from ten lag sums.

    >>> ears = {"position": np.arange(10) * 0.0049, "frequency": 35e3, "speed_of_sound": 343.0}
    >>> angles = np.radians([10.0, 20.0, 30.0])
    >>> int(beamscan(steering_vector(angles[1], **ears), angles, **ears).argmax())
    1
    """
    wave = {"position": position, "frequency": frequency, "speed_of_sound": speed_of_sound}
    return np.abs(steering_vector(angle, **wave).conj() @ snapshot) ** 2


def bearing_bound(
    snr: float, angle: float, *, elements: int, spacing: float, wavelength: float
) -> float:
    r"""Return the Cramer-Rao bound of a bearing from one snapshot, as a standard deviation [rad].

    .. math:: \sigma_\theta \ge \sqrt{\frac{6}{\mathrm{SNR}\, N (N^2 - 1)}}
              \Big/ \left( \frac{2\pi d}{\lambda} \cos\theta \right)

    `snr`: power ratio of one element's matched-filter output; `angle` [rad]: off the array's
    normal; `spacing`, `wavelength` [m]. Stoica & Nehorai (1989), for an unknown deterministic
    amplitude.

    >>> bound = bearing_bound(10.0, 0.0, elements=10, spacing=0.5, wavelength=1.0)
    >>> round(float(np.degrees(bound)), 2)
    0.45
    """
    count = elements * (elements**2 - 1)
    slope = 2.0 * np.pi * spacing / wavelength * np.cos(angle)
    return float(np.sqrt(6.0 / (snr * count)) / slope)
