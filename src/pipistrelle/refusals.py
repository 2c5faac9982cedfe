"""What a refusal says: where it is, what was found, what was expected, and the fix.

Settings, plans and logs are all written by hand, and refused in the same words. Most are checked
by pydantic first; here its faults become words, and a misspelt name the one that was meant.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any, get_args

from pydantic.fields import FieldInfo

from pipistrelle.config import InputError

_MAX_LENGTH = 80
_PREFIXES = ("Value error, ", "Input should be ", "Value should ")
_IN_WORDS = {"bool_parsing": "true or false", "bool_type": "true or false", "tuple_type": "a list"}
"""What pydantic says of these kinds of fault is about Python."""


def refusal(where: object, found: str, expected: str, fix: str) -> InputError:
    """Return the error that says where it is, what was found, what was expected and the fix.

    `where`: A path, perhaps with a line or a key, as text.

    >>> str(refusal("posts.csv, line 3", "x 'left'", "a finite number", "correct the field"))
    "posts.csv, line 3: found x 'left', expected a finite number; correct the field"
    """
    return InputError(f"{where}: found {found}, expected {expected}; {fix}")


def shown(value: Any) -> str:
    """Return the text of a found value, shortened to one line.

    Parameters
    ----------
    value : object

    Returns
    -------
    str

    Examples
    --------
    >>> shown("left"), shown([1] * 1000)[-10:]
    ("'left'", '1, 1, 1...')
    """
    text = repr(value)
    return text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 3]}..."


def expectation(fault: Any) -> str:
    """Describe the expected value of a setting.

    `fault` is one of the errors of pydantic's ValidationError.

    >>> expectation({"msg": "Input should be greater than 0"})
    'greater than 0'
    """
    message = _IN_WORDS.get(fault.get("type"), fault["msg"])
    for prefix in _PREFIXES:
        message = message.removeprefix(prefix)
    return message


def values_expected(fault: Any, field: FieldInfo) -> int | None:
    """Return the expected number of values of a tuple, if the number is the fault.

    `field` is the setting that was refused.

    >>> from pipistrelle.config import FilterConfig
    >>> field = FilterConfig.model_fields["initial_pose_std"]
    >>> values_expected({"type": "missing", "loc": ("filter", "initial_pose_std", 2)}, field)
    3
    """
    few = fault["type"] == "missing" and isinstance(fault["loc"][-1], int)
    return len(get_args(field.annotation)) if few or fault["type"] == "too_long" else None


def meant(name: str, known: Iterable[str]) -> str | None:
    """Find the name that was probably meant: one spelt alike, or one that ends in the same part.

    Dots separate the parts of the `name`.

    >>> meant("ray.powr", ["rays.power", "air.pressure_kpa"])
    'rays.power'
    >>> meant("filter.prune", ["rays.prune", "seed"])
    'rays.prune'
    """
    known = list(known)
    close = get_close_matches(name, known, n=1)
    close += [other for other in known if other.split(".")[-1] == name.split(".")[-1]]
    return close[0] if close else None
