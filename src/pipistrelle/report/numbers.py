"""Numbers as a reader reads them: three digits, a unit, an interval, small counts as words."""

import math
from collections.abc import Sequence

UNITS = {"rad": (180.0 / math.pi, "°"), "m": (1.0, "m"), "landmarks": (1.0, ""), "": (1.0, "")}
"""How a number of a unit is shown: its factor and its sign."""
NUMBERS = (
    "none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
    "eleven", "twelve",
)  # fmt: skip


def three_digits(value: float) -> str:
    """Write a number in three digits.

    Examples
    --------
    >>> [three_digits(value) for value in (0.12345, 43.71, -1234.5, float("inf"))]
    ['0.123', '43.7', '−1234', '∞']
    """
    if not math.isfinite(value):
        return "∞" if value > 0 else ("−∞" if value < 0 else "no number")
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    text = f"{value:.{min(digits, 4)}f}" if abs(value) < 1e5 else f"{value:.2e}"
    text = text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text
    return text.replace("-", "−") if float(text) else "0"


def amount(value: float, unit: str) -> str:
    """Write a number with its unit, as a reader expects it.

    Examples
    --------
    >>> amount(0.34, "m"), amount(0.02, "rad"), amount(3.0, "landmarks")
    ('0.34 m', '1.15°', '3')
    """
    factor, sign = UNITS[unit]
    return three_digits(factor * value) + (f" {sign}" if sign not in ("", "°") else sign)


def interval(ends: Sequence[float], unit: str) -> str:
    """Write an interval without its unit, as it stands beside a number that has one.

    Examples
    --------
    >>> interval((0.21, 0.47), "m")
    '[0.21, 0.47]'
    """
    factor, _ = UNITS[unit]
    return "[" + ", ".join(three_digits(factor * end) for end in ends) + "]"


def number_word(count: int) -> str:
    """Write a count as a word, where it has one that is short.

    `count`: not negative.

    Examples
    --------
    >>> number_word(0), number_word(8), number_word(30)
    ('none', 'eight', '30')
    """
    return NUMBERS[count] if count < len(NUMBERS) else str(count)


def listed(words: Sequence[str], last: str = "and") -> str:
    """List words as a sentence does.

    `last`: before the last of them.

    Examples
    --------
    >>> listed(["EKF"]), listed(["active", "fused", "passive"])
    ('EKF', 'active, fused and passive')
    """
    *first, end = words
    return f"{', '.join(first)} {last} {end}" if first else end
