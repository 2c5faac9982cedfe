"""Variables of a study, their axes, and how values and numbers are written for readers."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import CallerConfig, caller_names
from pipistrelle.figures.chart import Axis
from pipistrelle.settings import known_settings

BEAM = "beamwidth"
"""Name of the variable if the piston's radius varies and only it decides the beam."""
BEAMWIDTHS = (11.4, 14.2, 17.6, 21.8, 26.8, 33.2, 41.6, 51.4, 64.8, 83.0, 108.6, 180.0)
"""Bradley & Abaid, Appendix B [deg]."""
UNITS = {"rad": (180.0 / math.pi, "°"), "m": (1.0, "m"), "landmarks": (1.0, ""), "": (1.0, "")}
UNITS |= {
    f"{unit} per doubling".strip(): (factor, f"{sign} per doubling".strip())
    for unit, (factor, sign) in UNITS.items()
}
"""Factor and sign with which a number of a unit is shown."""
NUMBERS = (
    "none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
    "eleven", "twelve",
)  # fmt: skip

SHORTEST = 8
"""Fewest letters of an upright word; words that would be shorter are slanted."""
SLANTED_LETTERS = 12
"""Most letters of a slanted word."""
MAX_LETTERS = 52
"""Letters that fit along an axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """A setting that a study varies, with its values, their texts and an axis label."""

    name: str
    """For readers: `BEAM`, or the setting."""
    setting: str
    """Dotted."""
    given: tuple[Any, ...]
    """Values of the plan: rising numbers, or other values in the plan's order."""
    words: tuple[str, ...]
    """The values as text."""
    numbers: tuple[float, ...] | None
    """Positions of the values along an axis; None if they are not numbers."""
    label: str
    """Label of the axis, with the unit."""
    column: str
    """Column name in a CSV."""
    meaning: str
    """Description of the setting."""
    base: int = 0
    """Index of the reference value: the truth if the setting is an assumption and the truth is
    among its values; otherwise the first."""


def setting_variable(setting: str, values: Sequence[Any]) -> Variable:
    """Return the variable for a setting and the values that a plan's grid gives it."""
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
    """Return the beamwidth as a variable in place of emitter radii, narrowest first.

    `setting`: of the radius. `radii` [m]. `degrees` [deg]: the half-power beamwidth of each.
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
    """Format a beamwidth [deg] with three digits, or as the paper does if it is the paper's."""
    short = f"{beamwidth:.3g}"
    if abs(float(short) - beamwidth) > 1e-6 * beamwidth and _papers_beamwidth(beamwidth):
        return beam_name(beamwidth)
    return f"{short}°"


def beam_name(beamwidth: float) -> str:
    """Format a beamwidth [deg] in whole degrees, as in the paper if within 0.2 degrees of it."""
    return f"{_papers_beamwidth(beamwidth) or beamwidth:.0f}°"


def _papers_beamwidth(beamwidth: float) -> float | None:
    """Return the paper's beamwidth [deg] within 0.2 degrees of a beamwidth; None without any."""
    near = min(BEAMWIDTHS, key=lambda printed: abs(printed - beamwidth))
    return near if abs(near - beamwidth) < 0.2 else None


def written(values: Sequence[Any]) -> tuple[str, ...]:
    """Format values in the shortest form that distinguishes all; callers by number or name."""
    for words in (_counted, _calling, _short):
        short = tuple(map(words, values))
        if len(set(short)) == len(short):
            return short
    return tuple(value if isinstance(value, str) else json.dumps(value) for value in values)


def word_of(variable: Variable, value: Any) -> str:
    """Return the text of a variable's value."""
    return variable.words[list(map(repr, variable.given)).index(repr(value))]


def places(variable: Variable) -> Float[np.ndarray, " k"]:
    """Return a variable's positions along an axis: its numbers, or 0, 1, 2, ... for words."""
    if variable.numbers is None:
        return np.arange(len(variable.given), dtype=np.float64)
    return np.array(variable.numbers)


def two_sided(variable: Variable) -> bool:
    """Return whether a variable has values below and above its reference value."""
    return variable.numbers is not None and 0 < variable.base < len(variable.given) - 1


def with_article(variable: Variable) -> str:
    """Return a variable's name for a sentence: "the beacon level" for `beacon.level_db`."""
    name = re.sub("_(db|deg|c|kpa)$", "", variable.name)
    return f"the {re.sub('[._]', ' ', name)}"


def geometric(numbers: Sequence[float]) -> bool:
    """Return whether rising numbers are nearer to a geometric than to an arithmetic series.

    Returns: true of three or more, above 0, whose ratios vary less than their differences.
    """
    if len(numbers) < 3 or numbers[0] <= 0.0:
        return False
    ratios, steps = np.diff(np.log(numbers)), np.diff(numbers)
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


def axis_of(variable: Variable) -> Axis:
    """Return the chart axis for a variable of a study, with a tick at each value.

    Returns: logarithmic for beamwidths and for geometric series.
    """
    at = places(variable).tolist()
    if variable.name == BEAM:
        degrees = (word.removesuffix("°") for word in variable.words)
        ticks = tuple(zip(at, degrees, strict=True))
        limits = (0.9 * at[0], 1.12 * at[-1])
        return Axis(label=variable.label, limits=limits, log=True, ticks=ticks)
    named = tuple(zip(at, variable.words, strict=True))
    if variable.numbers is None:
        return replace(axis_of_words(variable.words), label=variable.label)
    log = geometric(variable.numbers)
    room = 0.06 * (at[-1] - at[0])
    limits = (at[0] - room, at[-1] + room)
    if log:
        ratio = (at[-1] / at[0]) ** 0.06
        limits = (at[0] / ratio, at[-1] * ratio)
    return Axis(
        label=variable.label, limits=limits, log=log, ticks=_thinned(named, limits, log=log),
        named=tuple((x, f"{variable.name} = {word}") for x, word in named),
    )  # fmt: skip


def axis_of_words(words: Sequence[str]) -> Axis:
    """Return a chart axis with words as ticks; long words are slanted or shortened."""
    named = tuple((float(i), word) for i, word in enumerate(words))
    longest = MAX_LETTERS // len(named)
    slanted = longest < SHORTEST and max(map(len, words)) > longest
    longest = SLANTED_LETTERS if slanted else max(longest, 3)
    return Axis(
        label="",
        limits=(-0.6, len(named) - 0.4),
        ticks=tuple((i, _shortened(word, longest)) for i, word in named),
        named=named,
        words=True,
        slanted=slanted,
    )


def _thinned(
    named: Sequence[tuple[float, str]], limits: tuple[float, float], *, log: bool
) -> tuple[tuple[float, str], ...]:
    """Remove axis ticks with a text that would overlap the text of the tick before."""
    kept: list[tuple[float, str]] = []
    for value, word in named:
        if kept:
            ends = np.array([kept[-1][0], value])
            share = np.diff(np.log(ends) if log else ends)[0]
            share /= np.diff(np.log(limits) if log else limits)[0]
            if share * MAX_LETTERS < 0.5 * (len(word) + len(kept[-1][1])) + 1.0:
                continue
        kept.append((value, word))
    return tuple(kept)


def _shortened(word: str, most: int) -> str:
    """Replace the middle of a word by an ellipsis if it has more than `most` letters."""
    if len(word) <= most:
        return word
    return f"{word[: most - most // 2 - 1]}…{word[len(word) - most // 2 :]}"


def _callers(value: Any) -> tuple[CallerConfig, ...] | None:
    """Convert a setting's value to callers; None if it is not a list of callers."""
    if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
        return None
    return tuple(CallerConfig(**one) for one in value)


def _counted(value: Any) -> str:
    """Format a list of callers: the name or course of a single caller, else their number."""
    callers = _callers(value)
    if callers is None:
        return _short(value)
    if len(callers) != 1:
        return str(len(callers)) if callers else "nobody"
    (caller,), (name,) = callers, caller_names(callers)
    return name if caller.name or caller.way == "stand" else caller.way


def _calling(value: Any) -> str:
    """Format a list of callers by their names and courses."""
    callers = _callers(value)
    if callers is None:
        return _short(value)
    names = zip(caller_names(callers), (caller.way for caller in callers), strict=True)
    return ", ".join(f"{name} ({way})".removesuffix(" (stand)") for name, way in names) or "nobody"


def _short(value: Any) -> str:
    """Format a setting's value with few digits; a caller's route by its number of rows."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_short, value))}]"
    if isinstance(value, dict):
        value = {key: f"{len(one)} rows" if key == "route" else one for key, one in value.items()}
        return f"{{{', '.join(f'{key} = {_short(one)}' for key, one in value.items())}}}"
    if isinstance(value, str):
        return value
    return json.dumps(value) if isinstance(value, bool) else f"{value:g}"


def three_digits(value: float) -> str:
    """Format a number with three significant digits."""
    if not math.isfinite(value):
        return "∞" if value > 0 else ("−∞" if value < 0 else "no number")
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    text = f"{value:.{min(digits, 4)}f}" if abs(value) < 1e5 else f"{value:.2e}"
    text = text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text
    return text.replace("-", "−") if float(text) else "0"


def amount(value: float, unit: str) -> str:
    """Format a number with its unit; radians become degrees."""
    factor, sign = UNITS[unit]
    return three_digits(factor * value) + (f" {sign}" if sign not in ("", "°") else sign)


def interval(ends: Sequence[float], unit: str) -> str:
    """Format an interval in brackets, converted to its unit but without the unit's sign."""
    factor, _ = UNITS[unit]
    return "[" + ", ".join(three_digits(factor * end) for end in ends) + "]"


def number_word(count: int) -> str:
    """Format a count as a word up to twelve, else in digits."""
    return NUMBERS[count] if count < len(NUMBERS) else str(count)


def listed(words: Sequence[str]) -> str:
    """Join words with commas, and the last two with "and"."""
    *first, end = words
    return f"{', '.join(first)} and {end}" if first else end
