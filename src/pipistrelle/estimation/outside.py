"""Estimators from outside: a class of another module, found, checked and built by its name.

The module is an installed one, or one in the current folder, which goes first, as with
``python -m``. Everything that can be wrong with it is refused in one line.
"""

import sys
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import Config, InputError

if TYPE_CHECKING:
    from pipistrelle.estimation.beliefs import Estimator
    from pipistrelle.estimation.motion import Motion

PARTS = ("init", "predict", "update")
"""Methods that every estimator has."""


def look_in(folder: Path) -> None:
    """Put a folder first among those where modules are found, as ``python -m`` does."""
    if sys.path[:1] != [str(folder)]:
        sys.path[:] = [str(folder), *(place for place in sys.path if place != str(folder))]
    invalidate_caches()  # a module may be younger than the last look


def class_of(name: str) -> type:
    """Import the class ``module:Class`` and check that it has what an estimator must have.

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
            raise InputError(f"filter {name}: found no module {error.name}, {place}{fix}") from None
        raise InputError(f"filter {name}: importing {module} fails: {worded(error)}") from error
    if not isinstance(kind, type):
        found = f"no class {wanted}" if kind is None else f"{wanted}, which is no class,"
        raise InputError(f"filter {name}: found {found} in {module}; expected an estimator")
    if lacking := [part for part in PARTS if not callable(getattr(kind, part, None))]:
        raise InputError(
            f"filter {name}: lacks {', '.join(lacking)}; an estimator has {', '.join(PARTS)}"
        )
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


def built(name: str, kind: Any, config: Config, motion: "Motion") -> "Estimator":
    """Build an estimator from outside: by its ``from_config``, or from the fields that it asks for.

    It raises InputError where it cannot be built.
    """
    try:
        if hasattr(kind, "from_config"):
            return kind.from_config(config, motion)
        return kind(**_arguments(kind, config, motion))
    except Exception as error:
        raise InputError(f"filter {name}: cannot be built: {worded(error)}") from error


def _arguments(kind: Any, config: Config, motion: "Motion") -> dict[str, Any]:
    """Return the values for the fields of a dataclass that have a known name."""
    if not is_dataclass(kind):
        raise InputError("it is no dataclass; make it one, or write from_config(config, motion)")
    known = {"motion": motion, "rays": config.rays, "gate": config.filter.gate, "config": config}
    asked = [field for field in fields(kind) if field.init]
    needed = [f.name for f in asked if f.default is MISSING and f.default_factory is MISSING]
    if unknown := [name for name in needed if name not in known]:
        raise InputError(
            f"found no value for {', '.join(unknown)}, expected fields among {', '.join(known)}; "
            "add defaults, or write from_config(config, motion)"
        )
    return {field.name: known[field.name] for field in asked if field.name in known}


def worded(error: BaseException) -> str:
    r"""Describe an error of an estimator: its kind, and the first line of its text.

    >>> worded(ArithmeticError("\nno solution\nsee the manual"))
    'ArithmeticError: no solution'
    """
    if isinstance(error, InputError):
        return str(error)
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first}".removesuffix(": ")
