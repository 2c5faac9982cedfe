"""Classes from outside, estimators and associations: found, checked and built by their names.

The module is an installed one, or one in the current folder, which goes first, as with
``python -m``. Everything that can be wrong with it is refused in one line.
"""

import sys
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import Any, NamedTuple

from pipistrelle.config import InputError


class Role(NamedTuple):
    """Kind of a class from outside: its name in refusals, and its methods."""

    key: str
    """As a refusal begins: the option or setting that names the class."""
    title: str
    methods: tuple[str, ...]
    """Methods that every such class has."""
    from_config: str
    """How a class is built that is no dataclass."""


ESTIMATOR = Role(
    "filter", "an estimator", ("init", "predict", "update"), "from_config(config, motion)"
)
ASSOCIATION = Role(
    "association.method", "an association", ("start", "associate"), "from_config(config)"
)


def look_in(folder: Path) -> None:
    """Put a folder first among those where modules are found, as ``python -m`` does."""
    if sys.path[:1] != [str(folder)]:
        sys.path[:] = [str(folder), *(place for place in sys.path if place != str(folder))]
    invalidate_caches()  # a module may be younger than the last look


def names_class(name: str) -> bool:
    """Tell whether a name has the form ``module:Class``.

    >>> names_class("mine.filters:Own"), names_class("ekf")
    (True, False)
    """
    module, colon, kind = name.partition(":")
    return all(part.isidentifier() for part in (*module.split("."), kind)) and colon == ":"


def class_of(role: Role, name: str) -> type:
    """Import the class ``module:Class`` and check that it has the methods of its role.

    It raises InputError where module or class is missing, the import fails, or methods are missing.
    """
    module, _, wanted = name.partition(":")
    look_in(Path.cwd())
    try:
        kind = getattr(import_module(module), wanted, None)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            place = f"neither installed nor in {Path.cwd()}"
            fix = f"; write {module[:-3]}:{wanted}" if module.endswith(".py") else ""
            found = f"found no module {error.name}, {place}{fix}"
            raise InputError(f"{role.key} {name}: {found}") from None
        raise InputError(f"{role.key} {name}: importing {module} fails: {worded(error)}") from error
    if not isinstance(kind, type):
        found = f"no class {wanted}" if kind is None else f"{wanted}, which is no class,"
        raise InputError(f"{role.key} {name}: found {found} in {module}; expected {role.title}")
    if lacking := [part for part in role.methods if not callable(getattr(kind, part, None))]:
        has = f"{role.title} has {', '.join(role.methods)}"
        raise InputError(f"{role.key} {name}: lacks {', '.join(lacking)}; {has}")
    return kind


def title_met(name: str) -> str | None:
    """Return the title of a class from outside that is imported already; import nothing.

    It is None where the class is not imported or has no title.

    >>> title_met("never.imported:Here") is None
    True
    """
    module, _, wanted = name.partition(":")
    title = getattr(getattr(sys.modules.get(module), wanted, None), "title", None)
    return title if isinstance(title, str) else None


def build(role: Role, name: str, kind: Any, given: tuple[Any, ...], values: dict[str, Any]) -> Any:
    """Build an object of a class from outside.

    `given`: what its ``from_config`` is given, where it has one; `values`: by name, for the fields
    of a dataclass. It raises InputError where it cannot be built.
    """
    try:
        if hasattr(kind, "from_config"):
            return kind.from_config(*given)
        return kind(**_arguments(role, kind, values))
    except Exception as error:
        raise InputError(f"{role.key} {name}: cannot be built: {worded(error)}") from error


def _arguments(role: Role, kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values for the fields of a dataclass that have one."""
    if not is_dataclass(kind):
        raise InputError(f"it is no dataclass; make it one, or write {role.from_config}")
    asked = [field for field in fields(kind) if field.init]
    needed = [f.name for f in asked if f.default is MISSING and f.default_factory is MISSING]
    if unknown := [name for name in needed if name not in values]:
        raise InputError(
            f"found no value for {', '.join(unknown)}, expected fields among {', '.join(values)}; "
            f"add defaults, or write {role.from_config}"
        )
    return {field.name: values[field.name] for field in asked if field.name in values}


def worded(error: BaseException) -> str:
    r"""Describe an error of a class from outside: its kind, and the first line of its text.

    >>> worded(ArithmeticError("\nno solution\nsee the manual"))
    'ArithmeticError: no solution'
    """
    if isinstance(error, InputError):
        return str(error)
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first}".removesuffix(": ")
