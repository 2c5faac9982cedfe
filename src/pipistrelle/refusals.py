"""Error messages for invalid input: place, found value, expected value and fix.

Settings, plans and logs are written by hand, and rejected with the same form of message. Most are
validated by pydantic; its errors are reworded here, and a correction of a misspelt name suggested.
"""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from pipistrelle.config import InputError

_PREFIXES = ("Value error, ", "Input should be ", "Value should ")
_IN_WORDS = {"bool_parsing": "true or false", "bool_type": "true or false", "tuple_type": "a list"}
_IN_WORDS |= {"dict_type": "a table"}
"""Replacements of pydantic messages in terms of Python."""


def refusal(where: object, found: str, expected: str, fix: str) -> InputError:
    """Return the error of an invalid input, with place, found value, expected value and fix.

    `where`: a path, perhaps with a line or a key.

    >>> str(refusal("posts.csv, line 3", "x 'left'", "a finite number", "correct the field"))
    "posts.csv, line 3: found x 'left', expected a finite number; correct the field"
    """
    return InputError(f"{where}: found {found}, expected {expected}; {fix}")


def shown(value: Any) -> str:
    """Format a found value for an error, shortened to 80 characters.

    >>> shown("left"), shown([1] * 1000)[-10:]
    ("'left'", '1, 1, 1...')
    """
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def expectation(fault: Any) -> str:
    """Return a description of the expected value, from an error of pydantic.

    `fault` is one of the errors of pydantic's ValidationError.
    """
    message = _IN_WORDS.get(fault.get("type"), fault["msg"])
    for prefix in _PREFIXES:
        message = message.removeprefix(prefix)
    return message


def values_expected(fault: Any, field: FieldInfo) -> int | None:
    """Return how many values a setting must have, if a wrong number is the error; else None.

    `field`: the rejected setting.
    """
    few = fault["type"] == "missing" and isinstance(fault["loc"][-1], int)
    return len(get_args(field.annotation)) if few or fault["type"] == "too_long" else None


def table_refusal(
    where: object, error: ValidationError, model: type[BaseModel], *first: str, every: bool = False
) -> InputError:
    """Convert pydantic's validation error of a table to an `InputError` about the first fault.

    Faults of the keys `first` precede unknown keys, and these all other faults; with `every`, the
    others follow, a line each, unless a fault of the keys `first` explains them. The missing
    keys of a table are named at once. Tables in a list are numbered from 1.
    """
    faults = sorted(error.errors(include_url=False), key=lambda f: f["type"] != "extra_forbidden")
    leading = [fault for name in first for fault in faults if fault["loc"][:1] == (name,)]
    inner = {fault["loc"][:n] for fault in faults for n in range(len(fault["loc"]))}
    rest = [fault for fault in faults if fault["loc"] not in inner]
    named = (leading[:1] or rest)[: None if every else 1]
    lines = (str(_fault_refusal(where, fault, faults, model)) for fault in named)
    return InputError("\n".join(dict.fromkeys(lines)))


def _fault_refusal(where: object, fault: Any, faults: Sequence[Any], model: Any) -> InputError:
    """Convert one of a table's faults to an `InputError`."""
    if fault["type"] == "json_invalid":
        return refusal(where, "text that is no JSON", "JSON", "restore the file or make it again")
    if not fault["loc"] and fault["type"].startswith("model"):
        return refusal(where, shown(fault["input"]), "a table", "correct it")
    if not fault["loc"]:
        return refusal(where, "keys that do not go together", expectation(fault), "correct them")
    *within, last = fault["loc"]
    key, known, field = "", model.model_fields, None
    tables: list[Any] = [model]
    for part in fault["loc"]:
        if isinstance(part, int):
            key += f".{part + 1}" if tables else f"[{part}]"
            continue
        if not tables:  # in a table with keys of the user
            key += f".{part}".removesuffix(".[key]")
            continue
        key, known = f"{key}.{part}".removeprefix("."), tables[0].model_fields
        field = known.get(part)
        kinds = () if field is None else (field.annotation, *get_args(field.annotation))
        tables = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
    if fault["type"] == "missing" and isinstance(last, str):
        gone = [f["loc"] for f in faults if f["type"] == "missing"]
        names = [name for *around, name in gone if around == within and name in known]
        named = ", ".join(repr(key.removesuffix(last) + str(name)) for name in names)
        needed = ", ".join(name for name, one in known.items() if one.is_required())
        found = f"no key{'s' * (', ' in named)} {named}"
        return refusal(where, found, f"the keys {needed}", f"add {named}")
    if fault["type"] == "extra_forbidden":
        near = meant(str(last), known)
        fix = f"did you mean {near!r}?" if near else "remove it"
        return refusal(where, f"the unknown key {key!r}", f"one of {', '.join(known)}", fix)
    if field is not None and (count := values_expected(fault, field)) is not None:
        most = f"at most {fault['ctx']['max_length']}" if tables else f"{count}"
        key = key.removesuffix(f"[{last}]")
        found = f"{len(fault['input'])} values"
        return refusal(f"{where}, key {key!r}", found, most, "correct the list")
    found = shown(fault["input"])
    return refusal(f"{where}, key {key!r}", found, expectation(fault), "correct the value")


def meant(name: str, known: Iterable[str]) -> str | None:
    """Return the known name closest to a misspelt one, by spelling or by equal last part.

    Dots separate the parts of the `name`.

    >>> meant("ray.merg", ["rays.merge", "air.pressure_kpa"])
    'rays.merge'
    >>> meant("filter.merge", ["rays.merge", "seed"])
    'rays.merge'
    """
    known = list(known)
    close = get_close_matches(name, known, n=1)
    close += [other for other in known if other.split(".")[-1] == name.split(".")[-1]]
    return close[0] if close else None
