"""Narrowband beamforming with a uniform line array: steering, pattern, scan, accuracy limit."""

import numpy as np
from jaxtyping import Complex, Float


def steering_vector(
    angle: Float[np.ndarray, "*n"] | float,
    *,
    position: Float[np.ndarray, " e"],
    frequency: float,
    speed_of_sound: float,
) -> Complex[np.ndarray, "*n e"]:
    r"""Return the phases of a unit plane wave from an angle at the elements.

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
    r"""Return the power response of a beamformer steered to one angle to waves from others.

    .. math:: B(\theta) = \left| \frac{1}{N} v(\theta_0)^H v(\theta) \right|^2

    `angle` [rad]; `steered` [rad]; `position` [m]; `frequency` [Hz]; `speed_of_sound` [m/s].
    Returns [0, 1]: 1 at the steered angle.

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
    r"""Return the power of a conventional beam over angles: where a snapshot's sound comes from.

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
    r"""Return the least standard deviation of an unbiased bearing (Cramer-Rao) of one snapshot.

    .. math:: \sigma_\theta \ge \sqrt{\frac{6}{\mathrm{SNR}\, N (N^2 - 1)}}
              \Big/ \left( \frac{2\pi d}{\lambda} \cos\theta \right)

    Parameters
    ----------
    snr : float
        Power ratio of one element's matched-filter output.
    angle : [rad]
        Off the array's normal.
    elements : int
    spacing, wavelength : [m]

    Returns
    -------
    [rad]

    Notes
    -----
    Stoica & Nehorai (1989), for an unknown deterministic amplitude.

    Examples
    --------
    >>> bound = bearing_bound(10.0, 0.0, elements=10, spacing=0.5, wavelength=1.0)
    >>> round(float(np.degrees(bound)), 2)
    0.45
    """
    count = elements * (elements**2 - 1)
    slope = 2.0 * np.pi * spacing / wavelength * np.cos(angle)
    return float(np.sqrt(6.0 / (snr * count)) / slope)
