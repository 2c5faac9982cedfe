"""The way through the air: spreading, absorption and the shift of the tone by motion.

Losses are positive decibels. A reference distance of 1 m makes spreading loss 0 there.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError


def spreading_loss_db(
    path: Float[np.ndarray, "*n"] | float, *, ways: Literal[1, 2] = 1
) -> Float[np.ndarray, "*n"]:
    r"""Return the spherical spreading over a path, re 1 m.

    .. math:: \beta = r \, 20 \log_{10} \frac{d}{r}
       :label: eq-2

    Parameters
    ----------
    path : (*n) [m]
        Whole distance d that the sound has travelled, > 0.
    ways : 1 or 2
        r: 1 from a source to a receiver, 2 to a scatterer and back to its source, where the sound
        spreads anew from the scatterer.

    Returns
    -------
    (*n) [dB]

    Notes
    -----
    Bradley & Abaid, Eq. (2).

    Examples
    --------
    An echo from 10 m away loses 40 log10(10).

    >>> float(spreading_loss_db(20.0, ways=2))
    40.0
    """
    return np.asarray(ways * 20.0 * np.log10(path / ways))


def passive_spreading_loss_db(
    outward: Float[np.ndarray, "*n"] | float,
    homeward: Float[np.ndarray, "*n"] | float,
    *,
    law: Literal["paper", "bistatic"],
) -> Float[np.ndarray, "*n"]:
    r"""Return the spreading of someone else's call on its way over a landmark, re 1 m.

    .. math:: \beta_\text{paper} = 20 \log_{10}(d_1 + d_2), \qquad
              \beta_\text{bistatic} = 20 \log_{10} d_1 + 20 \log_{10} d_2

    `outward` [m]: from the source to the landmark, > 0; `homeward` [m]: from the landmark to the
    receiver, > 0; `law`: A mirror, as the paper's r = 1 has it, or a point scatterer that sends the
    sound out anew. Returns [dB].

    Bradley & Abaid, Eq. (2) with r = 1; the bistatic law is a departure (physics, e.g. Urick's
    bistatic sonar equation).

    Back at the source the bistatic law is that of an active echo; the mirror is far louder.

    >>> float(passive_spreading_loss_db(10.0, 10.0, law="bistatic"))
    40.0
    >>> round(float(passive_spreading_loss_db(10.0, 10.0, law="paper")), 3)
    26.021
    """
    if law == "paper":
        return spreading_loss_db(outward + homeward)
    if law == "bistatic":
        return spreading_loss_db(outward * homeward)
    raise InputError(f"air.spreading: found {law!r}, expected 'paper' or 'bistatic'; choose one")


def absorption_db_per_m(
    frequency: Float[np.ndarray, "*n"] | float,
    *,
    temperature_c: float,
    relative_humidity: float,
    pressure_kpa: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the absorption of a pure tone by moist air.

    .. math:: \alpha = 8.686 f^2 \left[ 1.84 \cdot 10^{-11} \frac{\tau^{1/2}}{p}
              + \tau^{-5/2} \left( 0.01275 e^{-2239.1/T} \frac{f_{rO}}{f_{rO}^2 + f^2}
              + 0.1068 e^{-3352/T} \frac{f_{rN}}{f_{rN}^2 + f^2} \right) \right]
       :label: eq-3

    with the temperature :math:`\tau = T / 293.15` K and the pressure p in units of 101.325 kPa, the
    relaxation frequencies of oxygen and nitrogen

    .. math:: f_{rO} = p \left( 24 + 4.04 \cdot 10^4 h \frac{0.02 + h}{0.391 + h} \right), \quad
              f_{rN} = p \tau^{-1/2} \left( 9 + 280 h e^{-4.17 (\tau^{-1/3} - 1)} \right)

    and the molar concentration of water vapour :math:`h` [%], relative humidity times saturation
    pressure over p.

    Parameters
    ----------
    frequency : (*n) [Hz]
    temperature_c : [degrees Celsius]
    relative_humidity : in [0, 1]
    pressure_kpa : [kPa]

    Returns
    -------
    (*n) [dB/m]

    Notes
    -----
    Bradley & Abaid, Eq. (3), which is this formula at 20 °C and 101.325 kPa, with its last
    coefficient mended: 1.1552e-6, printed 1.5552e-6. Source: ISO 9613-1:1993, Eqs. (3) to (5) and
    Annex B.

    Examples
    --------
    >>> air = dict(temperature_c=20.0, relative_humidity=0.5, pressure_kpa=101.325)
    >>> absorption_db_per_m(np.array([30e3, 35e3]), **air).round(3)
    array([0.937, 1.133])
    """
    T = temperature_c + 273.15
    tau, p = T / 293.15, pressure_kpa / 101.325
    saturation = 10.0 ** (4.6151 - 6.8346 * (273.16 / T) ** 1.261)  # of water vapour [101.325 kPa]
    h = 100.0 * relative_humidity * saturation / p
    f2 = np.square(frequency)
    frO = p * (24.0 + 4.04e4 * h * (0.02 + h) / (0.391 + h))
    frN = p * tau**-0.5 * (9.0 + 280.0 * h * np.exp(-4.170 * (tau ** (-1.0 / 3.0) - 1.0)))
    oxygen = 0.01275 * np.exp(-2239.1 / T) * frO / (frO**2 + f2)
    nitrogen = 0.1068 * np.exp(-3352.0 / T) * frN / (frN**2 + f2)
    classical = 1.84e-11 * tau**0.5 / p
    return np.asarray(8.686 * f2 * (classical + tau**-2.5 * (oxygen + nitrogen)))


def doppler_frequency(
    frequency: Float[np.ndarray, "*n"] | float,
    *,
    receiver_speed: Float[np.ndarray, "*n"] | float,
    source_speed: Float[np.ndarray, "*n"] | float = 0.0,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the frequency that a receiver hears, source and receiver moving through still air.

    .. math:: f' = f \frac{c + v_r}{c - v_s}

    A vehicle's own echo has both speeds, the vehicle's towards the landmark. A beacon's call, or
    its echo, has the receiver's alone, towards where the sound comes from. A reflector on the move
    receives and sends in turn.

    `frequency` [Hz]: as emitted; `receiver_speed` [m/s]: towards the sound; `source_speed` [m/s]:
    along the sound; `speed_of_sound` [m/s]. Returns [Hz].

    Bradley & Abaid, Sec. II-B, which calls the shift not appreciable: it is not negligible in a
    matched filter of 2.8 ms.

    >>> echo = doppler_frequency(35e3, receiver_speed=0.75, source_speed=0.75, speed_of_sound=343.0)
    >>> round(float(echo) - 35e3)
    153
    """
    fastest = np.maximum(np.abs(receiver_speed), np.abs(source_speed))
    if not np.all(fastest < speed_of_sound):
        raise InputError(
            f"velocity: found {np.max(fastest)} m/s along the sound, expected less than the speed "
            f"of sound, {speed_of_sound} m/s; slow down"
        )
    ratio = (speed_of_sound + receiver_speed) / (speed_of_sound - source_speed)
    return np.asarray(frequency * ratio)
