"""Propagation in air or water: spreading, absorption, Doppler shift, and the medium's properties.

Losses are positive decibels, relative to a distance of 1 m.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.config import AirConfig, InputError, WaterConfig


def spreading_loss_db(
    path: Float[np.ndarray, "*n"] | float, *, ways: Literal[1, 2] = 1
) -> Float[np.ndarray, "*n"]:
    r"""Return the spherical spreading loss over a path [dB], relative to 1 m.

    .. math:: \beta = r \, 20 \log_{10} \frac{d}{r}
       :label: eq-2

    `path` [m]: total distance d that the sound has travelled, > 0; `ways`: r, 1 from a source to a
    receiver, 2 to a scatterer and back, as the sound spreads again from there. Returns [dB].

    Bradley & Abaid, Eq. (2). An echo from 10 m away loses 40 log10(10):

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
    r"""Return the spreading loss from a caller by way of a landmark to the vehicle [dB].

    .. math:: \beta_\text{paper} = 20 \log_{10}(d_1 + d_2), \qquad
              \beta_\text{bistatic} = 20 \log_{10} d_1 + 20 \log_{10} d_2

    `outward` [m]: from the source to the landmark, > 0; `homeward` [m]: from the landmark to the
    receiver, > 0; `law`: a mirror, as in the paper (r = 1), or a point scatterer. Returns [dB].

    Bradley & Abaid, Eq. (2) with r = 1; the bistatic law is a departure (e.g. Urick's bistatic
    sonar equation). If source and receiver coincide, the bistatic law is that of an active echo;
    the mirror is far louder:

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
    r"""Return the absorption of a pure tone by moist air [dB/m].

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

    `frequency` [Hz]; `temperature_c` [degrees Celsius]; `relative_humidity` in [0, 1];
    `pressure_kpa` [kPa]. Returns [dB/m].

    Bradley & Abaid, Eq. (3), which is this formula at 20 °C and 101.325 kPa, with its last
    coefficient corrected: 1.1552e-6, printed 1.5552e-6. Source: ISO 9613-1:1993, Eqs. (3) to (5)
    and Annex B.

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


def water_absorption_db_per_m(
    frequency: Float[np.ndarray, "*n"] | float,
    *,
    temperature_c: float,
    salinity: float,
    depth: float,
    ph: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the absorption of a pure tone by sea or fresh water [dB/m].

    .. math:: \alpha = A_1 \frac{f_1 f^2}{f_1^2 + f^2} + A_2 P_2 \frac{f_2 f^2}{f_2^2 + f^2}
              + A_3 P_3 f^2

    of boric acid, magnesium sulphate and pure water; in dB/km, with f in kHz, the temperature T in
    degrees Celsius, :math:`\theta = T + 273`, the salinity S in parts per thousand, the depth D in
    metres and the speed of sound :math:`c = 1412 + 3.21\,T + 1.19\,S + 0.0167\,D`,

    .. math:: A_1 &= \frac{8.86}{c} 10^{0.78\,\mathrm{pH} - 5}, \quad
              f_1 = 2.8 \sqrt{S / 35}\; 10^{4 - 1245/\theta} \\
              A_2 &= 21.44 \frac{S}{c} (1 + 0.025\,T), \quad
              f_2 = \frac{8.17 \cdot 10^{8 - 1990/\theta}}{1 + 0.0018\,(S - 35)} \\
              P_2 &= 1 - 1.37 \cdot 10^{-4} D + 6.2 \cdot 10^{-9} D^2 \\
              P_3 &= 1 - 3.83 \cdot 10^{-5} D + 4.9 \cdot 10^{-10} D^2

    and :math:`A_3` a cubic in T, with other coefficients above 20 degrees.

    `frequency` [Hz]; `temperature_c` [degrees Celsius]; `salinity` [parts per thousand], 0 for pure
    water; `depth` [m]; `ph`. Returns [dB/m].

    Source: R. E. Francois and G. R. Garrison, Sound absorption based on ocean measurements, J.
    Acoust. Soc. Am. 72 (1982), part I 896-907, part II 1879-1890; for 200 Hz to 1 MHz. A1, printed
    8.68 in some textbooks, and Table IV are from part II.

    The sea at 10 degrees, and a fresh lake, at 100 and 200 kHz, in dB/km:

    >>> lake = dict(temperature_c=10.0, salinity=0.0, depth=0.0, ph=8.0)
    >>> 1e3 * water_absorption_db_per_m(np.array([1e5, 2e5]), **lake | {"salinity": 35.0}).round(4)
    array([33.6, 54.4])
    >>> 1e3 * water_absorption_db_per_m(np.array([1e5, 2e5]), **lake).round(4)
    array([ 3.1, 12.4])
    """
    T, S, D, kelvin = temperature_c, salinity, depth, temperature_c + 273.0
    f2, c = np.square(np.asarray(frequency) / 1e3), 1412.0 + 3.21 * T + 1.19 * S + 0.0167 * D
    of_boric_acid = 2.8 * np.sqrt(S / 35.0) * 10.0 ** (4.0 - 1245.0 / kelvin)
    boric_acid = 8.86 / c * 10.0 ** (0.78 * ph - 5.0) * of_boric_acid / (of_boric_acid**2 + f2)
    of_sulphate = 8.17 * 10.0 ** (8.0 - 1990.0 / kelvin) / (1.0 + 0.0018 * (S - 35.0))
    sulphate = 21.44 * S / c * (1.0 + 0.025 * T) * of_sulphate / (of_sulphate**2 + f2)
    if T <= 20.0:
        water = 4.937e-4 - 2.59e-5 * T + 9.11e-7 * T**2 - 1.50e-8 * T**3
    else:
        water = 3.964e-4 - 1.146e-5 * T + 1.45e-7 * T**2 - 6.5e-10 * T**3
    sulphate *= 1.0 - 1.37e-4 * D + 6.2e-9 * D**2
    water *= 1.0 - 3.83e-5 * D + 4.9e-10 * D**2
    return np.asarray((boric_acid + sulphate + water) * f2 / 1e3)


def doppler_frequency(
    frequency: Float[np.ndarray, "*n"] | float,
    *,
    receiver_speed: Float[np.ndarray, "*n"] | float,
    source_speed: Float[np.ndarray, "*n"] | float = 0.0,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the received frequency with source and receiver moving in a medium at rest.

    .. math:: f' = f \frac{c + v_r}{c - v_s}

    For a vehicle's own echo both speeds are the vehicle's towards the landmark. For a beacon's call
    or its echo only the receiver moves. Apply it twice for a moving reflector.

    `frequency` [Hz]: as emitted; `receiver_speed` [m/s]: towards the sound; `source_speed` [m/s]:
    along the sound; `speed_of_sound` [m/s]. Returns [Hz]. Raises InputError for speeds of sound or
    more.

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Medium:
    """A homogeneous medium at rest: its speed of sound, absorption and spreading law.

    Helium, without absorption:

    >>> helium = Medium(speed_of_sound=1007.0, absorption_db_per_m=lambda frequency: 0.0)
    >>> helium.spreading
    'paper'
    """

    speed_of_sound: float
    """[m/s]."""
    absorption_db_per_m: Callable[[float], float]
    """Absorption of a tone [dB/m], by its frequency [Hz]."""
    spreading: Literal["paper", "bistatic"] = "paper"
    """Law of the spreading loss over a landmark (`passive_spreading_loss_db`)."""


@lru_cache(maxsize=64)
def medium_of(section: AirConfig | WaterConfig) -> Medium:
    """Build the medium, air or water, from its section of the settings (`Config.medium`).

    Absorption in air is from ISO 9613-1, in water from Francois and Garrison.

    >>> air, water = medium_of(AirConfig()), medium_of(WaterConfig())
    >>> air.speed_of_sound, round(air.absorption_db_per_m(30e3), 3)
    (343.0, 0.937)
    >>> round(water.speed_of_sound, 1), round(water.absorption_db_per_m(100e3), 4)
    (1489.8, 0.0336)
    """

    @lru_cache(maxsize=64)
    def absorption(frequency: float) -> float:
        if isinstance(section, WaterConfig):
            of_water = section.model_dump(include={"temperature_c", "salinity", "depth", "ph"})
            return float(water_absorption_db_per_m(frequency, **of_water))
        return float(
            absorption_db_per_m(
                frequency,
                temperature_c=section.temperature_c,
                relative_humidity=section.relative_humidity,
                pressure_kpa=section.pressure_kpa,
            )
        )

    return Medium(
        speed_of_sound=section.sound_speed,
        absorption_db_per_m=absorption,
        spreading=section.spreading,
    )
