"""What a study varies: settings with their values in order, named as a reader names them."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import CallerConfig, caller_names
from pipistrelle.settings import known_settings

BEAM = "beamwidth"
"""The name of the variable that the piston's radius is where it alone decides the beam."""
BEAMWIDTHS = (11.4, 14.2, 17.6, 21.8, 26.8, 33.2, 41.6, 51.4, 64.8, 83.0, 108.6, 180.0)
"""Bradley & Abaid, Appendix B [deg]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """A setting that a study varies."""

    name: str
    """As a reader calls it."""
    setting: str
    """Dotted."""
    given: tuple[Any, ...]
    """Its values, as the plan has them: rising where they are numbers, else as they are listed."""
    words: tuple[str, ...]
    """How each is written."""
    numbers: tuple[float, ...] | None
    """Of the axis; None where the values are no numbers."""
    label: str
    """Of the axis, with the unit."""
    column: str
    """Of a CSV."""
    meaning: str
    """What the setting says of itself."""
    base: int = 0
    """Which of the values the others are compared with: the truth, where the setting is what is
    assumed of it and the truth is among them; else the first."""


def setting_variable(setting: str, values: Sequence[Any]) -> Variable:
    """Make a variable of a setting.

    `setting`: dotted. `values`: as a plan's grid has them.

    Examples
    --------
    >>> level = setting_variable("beacon.level_db", [48.8, 36.8])
    >>> level.words, level.label
    (('36.8', '48.8'), 'beacon.level_db [dB]')
    """
    field = known_settings().get(tuple(setting.split(".")))
    meaning = " ".join(((field.description if field else None) or "").split())
    numeric = all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in values)
    given = tuple(sorted(values)) if numeric else tuple(values)
    unit = re.search(r"\[([^\d\]][^\]]*)\]", meaning)
    return Variable(
        name=setting,
        setting=setting,
        given=given,
        words=written(given),
        numbers=tuple(map(float, given)) if numeric else None,
        label=f"{setting} [{unit[1]}]" if unit and numeric else setting,
        column=setting,
        meaning=meaning,
    )


def beam_variable(setting: str, radii: Sequence[float], degrees: Sequence[float]) -> Variable:
    """Make a variable of the beamwidth, narrowest first.

    `setting`: of the radius. `radii` [m]. `degrees` [deg]: the half-power beamwidth of each.

    Examples
    --------
    >>> beam_variable("emitter.radius", [0.0025, 0.0088], [180.0, 33.28]).words
    ('33°', '180°')
    """
    order = np.argsort(degrees)
    widths = tuple(float(degrees[i]) for i in order)
    names = tuple(map(width_name, widths))
    if len(set(names)) < len(names):
        names = tuple(f"{word}°" for word in written(widths))
    return Variable(
        name=BEAM,
        setting=setting,
        given=tuple(radii[i] for i in order),
        words=names,
        numbers=widths,
        label="half-power beamwidth [°]",
        column="beamwidth_deg",
        meaning="Full angle within which the vehicle's call has half the power of its axis [°]",
    )


def width_name(beamwidth: float) -> str:
    """Name a beamwidth of a study: by its three digits where it has no more, else as near.

    `beamwidth` [deg]. Returns: what a paper's radius makes has the paper's name.

    Examples
    --------
    >>> width_name(11.5), width_name(11.575), width_name(42.123)
    ('11.5°', '11°', '42.1°')
    """
    short = f"{beamwidth:.3g}"
    if abs(float(short) - beamwidth) > 1e-6 * beamwidth and _near(beamwidth):
        return beam_name(beamwidth)
    return f"{short}°"


def beam_name(beamwidth: float) -> str:
    """Name a beamwidth: as the paper does where it is one of the paper's, within 0.2 degrees.

    `beamwidth` [deg].

    Examples
    --------
    >>> beam_name(11.575), beam_name(12.5)
    ('11°', '12°')
    """
    return f"{_near(beamwidth) or beamwidth:.0f}°"


def written(values: Sequence[Any]) -> tuple[str, ...]:
    """Write values as short as tells them apart.

    Examples
    --------
    >>> written([1.0, 2.5]), written([1.0, 1.0000001]), written([True, "paper", [0.5, 20.0]])
    (('1', '2.5'), ('1.0', '1.0000001'), ('true', 'paper', '[0.5, 20]'))

    Callers are counted, or named:

    >>> written([[], [{}], [{"course": "walk"}], [{}, {"frequency": 25e3}]])
    ('nobody', 'beacon', 'walk', '2')
    >>> written([[{}], [{}, {"frequency": 25e3}], [{}, {"frequency": 25e3, "course": "circle"}]])
    ('beacon', 'beacon, caller2', 'beacon, caller2 (circle)')
    """
    for words in (_counted, _calling, _short):
        short = tuple(map(words, values))
        if len(set(short)) == len(short):
            return short
    return tuple(map(_whole, values))


def word_of(variable: Variable, value: Any) -> str:
    """Write a value as its variable does.

    Examples
    --------
    >>> word_of(setting_variable("rays.power", [3.0, 1.0]), 3.0)
    '3'
    """
    return variable.words[list(map(repr, variable.given)).index(repr(value))]


def places(variable: Variable) -> Float[np.ndarray, " k"]:
    """Return where the values stand along an axis.

    Returns: the numbers; of words, 0, 1, 2 and so on.

    Examples
    --------
    >>> places(setting_variable("rays.weights", ["instantaneous", "aggregated"]))
    array([0., 1.])
    """
    if variable.numbers is None:
        return np.arange(len(variable.given), dtype=np.float64)
    return np.array(variable.numbers)


def two_sided(variable: Variable) -> bool:
    """Return whether the reference value lies between smaller and larger values.

    Examples
    --------
    >>> from dataclasses import replace
    >>> sound = setting_variable("assumed.speed_of_sound", [337.0, 343.0, 349.0])
    >>> [two_sided(replace(sound, base=base)) for base in range(3)]
    [False, True, False]
    """
    return variable.numbers is not None and 0 < variable.base < len(variable.given) - 1


def geometric(numbers: Sequence[float]) -> bool:
    """Return whether rising numbers are nearer to a geometric than to an arithmetic series.

    `numbers`: rising. Returns: three or more, above 0, whose ratios vary less than their
    differences.

    Examples
    --------
    >>> geometric([100, 300, 1000]), geometric([0.2, 0.5, 0.8]), geometric([1, 100])
    (True, False, False)
    """
    if len(numbers) < 3 or numbers[0] <= 0.0:
        return False
    ratios, steps = np.diff(np.log(numbers)), np.diff(numbers)
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


def _near(beamwidth: float) -> float | None:
    """Find the paper's beamwidth that this one is, if it is one of them."""
    near = min(BEAMWIDTHS, key=lambda printed: abs(printed - beamwidth))
    return near if abs(near - beamwidth) < 0.2 else None


def _callers(value: Any) -> tuple[CallerConfig, ...] | None:
    """Return the callers that a value lists, if it is such a list."""
    if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
        return None
    return tuple(CallerConfig(**one) for one in value)


def _counted(value: Any) -> str:
    """Write one caller by its name, or the way that it goes, several by their number."""
    callers = _callers(value)
    if callers is None:
        return _short(value)
    if len(callers) != 1:
        return str(len(callers)) if callers else "nobody"
    (caller,), (name,) = callers, caller_names(callers)
    return name if caller.name or caller.way == "stand" else caller.way


def _calling(value: Any) -> str:
    """Write a list of callers by their names and ways, and any other value in a few digits."""
    callers = _callers(value)
    if callers is None:
        return _short(value)
    names = zip(caller_names(callers), (caller.way for caller in callers), strict=True)
    return ", ".join(f"{name} ({way})".removesuffix(" (stand)") for name, way in names) or "nobody"


def _short(value: Any) -> str:
    """Write a value in a few digits."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_short, value))}]"
    if isinstance(value, dict):  # a route is long
        value = {key: f"{len(one)} rows" if key == "route" else one for key, one in value.items()}
        return f"{{{', '.join(f'{key} = {_short(one)}' for key, one in value.items())}}}"
    if isinstance(value, str):
        return value
    return json.dumps(value) if isinstance(value, bool) else f"{value:g}"


def _whole(value: Any) -> str:
    """Write a value in all its digits."""
    return value if isinstance(value, str) else json.dumps(value)
