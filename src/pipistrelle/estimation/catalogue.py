"""Catalogue of all estimators by name, and loading of external estimators and associations.

To add an estimator, implement `pipistrelle.estimation.beliefs.Estimator` and add an `Entry`.
Modules are imported only when an estimator is built. External classes are named ``module:Class``;
the module is installed or in the current folder, which has priority, as with ``python -m``. All
their errors become an InputError of one line.
"""

import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pipistrelle.config import Config, InputError
from pipistrelle.refusals import meant


class Role(NamedTuple):
    """Kind of a user's class, such as an estimator: its name in messages, and required methods."""

    key: str
    """Option or setting that names the class, the prefix of error messages."""
    title: str
    methods: tuple[str, ...]
    """Required methods."""
    from_config: str
    """Signature of the class method that builds a class that is no dataclass."""


ESTIMATOR = Role(
    "filter", "an estimator", ("init", "predict", "update"), "from_config(config, motion)"
)
ASSOCIATION = Role(
    "association.method", "an association", ("start", "associate"), "from_config(config)"
)


def look_in(folder: Path) -> None:
    """Put a folder first in the module search path, as ``python -m`` does."""
    if sys.path[:1] != [str(folder)]:
        sys.path[:] = [str(folder), *(place for place in sys.path if place != str(folder))]
    invalidate_caches()  # a module may be newer than the last search


def names_class(name: str) -> bool:
    """Return whether a name has the form ``module:Class``.

    >>> names_class("mine.filters:Own"), names_class("ekf")
    (True, False)
    """
    module, colon, kind = name.partition(":")
    return all(part.isidentifier() for part in (*module.split("."), kind)) and colon == ":"


def class_of(role: Role, name: str) -> type:
    """Import the class ``module:Class`` and check that it has the methods of its role.

    Raises InputError if module or class is missing, the import fails, or methods are missing.
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


def build(role: Role, name: str, kind: Any, given: tuple[Any, ...], values: dict[str, Any]) -> Any:
    """Build an object of a user's class; raise InputError if that fails.

    `given`: arguments of its ``from_config``, if any; `values`: for a dataclass, by field.
    """
    try:
        if hasattr(kind, "from_config"):
            return kind.from_config(*given)
        return kind(**_arguments(role, kind, values))
    except Exception as error:
        raise InputError(f"{role.key} {name}: cannot be built: {worded(error)}") from error


def _arguments(role: Role, kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a dataclass' fields; raise InputError if a required value is missing."""
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
    r"""Format an error of a user's class: its type, and the first line of its message.

    >>> worded(ArithmeticError("\nno solution\nsee the manual"))
    'ArithmeticError: no solution'
    """
    if isinstance(error, InputError):
        return str(error)
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first}".removesuffix(": ")


if TYPE_CHECKING:
    from pipistrelle.estimation.beliefs import Estimator
    from pipistrelle.estimation.motion import Motion

READ = ("listening", "association", "filter", "rays")
"""Sections of the settings that every estimator reads."""
DOUBLE = 8
"""Bytes of a number."""
COPIES = 3.0
"""Measured number of simultaneous copies of an estimator's arrays."""
GATE = 0.999
"""Default gate for recorded logs, as a share of a measurement's predicted distribution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """Properties of an estimator: names, builder, settings, limits and features."""

    name: str
    """Name in settings, tables and files."""
    title: str
    """Title for readers."""
    build: "Callable[[Config, Motion], Estimator]"
    """Function that builds the estimator from the settings for a motion model."""
    sections: tuple[str, ...]
    """Sections of the settings that it reads; none changes the measurements."""
    nees_limit: float
    """NEES above which the estimator counts as diverged."""
    memory: Callable[[int, int, Config], float]
    """Memory estimate [bytes] from the number of landmarks, hypotheses per landmark, and the
    settings."""
    calibrates: bool = False
    """Whether it estimates the parameters in ``filter.calibrate``."""
    follows: bool = False
    """Whether it estimates moving callers (`beliefs.Belief.moving`); else it gets only fixed
    landmarks."""
    gate: float = GATE
    """Gate that ``filter.gate = "auto"`` selects for a log: accepted share of a measurement's
    predicted distribution; 1 keeps all."""
    robust_gate: float = GATE
    """Gate that ``filter.gate = "auto"`` selects with a robust loss."""


def gate_of(name: str, config: Config) -> float:
    """Return an estimator's gate from the settings, as a share of the predicted distribution.

    >>> from pipistrelle.config import FilterConfig
    >>> gate_of("ekf", Config()), gate_of("ekf", Config(filter=FilterConfig(gate="auto")))
    (1.0, 0.999)
    """
    settings = config.filter
    if settings.gate != "auto":
        return settings.gate
    known = CATALOGUE.get(name)
    if known is None:
        return GATE
    return known.gate if settings.robust == "none" else known.robust_gate


def entry(name: str) -> Entry:
    """Return an estimator's properties by its name in the catalogue or as ``module:Class``.

    The module is installed or in the current folder, which has priority. The class is an
    `Estimator`. Its classmethod ``from_config(config, motion)`` builds it, or it is a dataclass
    with any of the fields

    - ``motion``: the `Motion` of the vehicle,
    - ``rays``, ``gate``: these settings,
    - ``config``: all settings;

    other fields need defaults. Optional attributes are ``title`` (default: its name),
    ``nees_limit`` (default: infinity) and ``follows`` (default False; True: scans include moving
    callers, with their labels in ``moving``). Its memory is not checked. Raises InputError for an
    unknown name, a module that cannot be imported, or a class that is missing or no estimator.

    >>> entry("fastslam").title
    'FastSLAM 2.0'
    >>> entry("pipistrelle.estimation.ekf.filter:EkfSlam").title
    'EkfSlam'
    """
    if name in CATALOGUE:
        return CATALOGUE[name]
    kind: Any = class_of(ESTIMATOR, check_name(name))
    title, limit = getattr(kind, "title", kind.__name__), getattr(kind, "nees_limit", math.inf)
    if not (isinstance(title, str) and title.isprintable()):
        expected = "text in one line that can be printed"
        raise InputError(f"filter {name}: title: found {title!r}, expected {expected}")
    if not isinstance(limit, (int, float)) or not limit > 0.0:
        raise InputError(f"filter {name}: nees_limit: found {limit!r}, expected a number above 0")

    def built(config: Config, motion: "Motion") -> "Estimator":
        settings = config.filter.model_copy(update={"gate": gate_of(name, config)})
        config = config.model_copy(update={"filter": settings})
        values = {"motion": motion, "rays": config.rays, "gate": settings.gate, "config": config}
        return build(ESTIMATOR, name, kind, (config, motion), values)

    return Entry(
        name=name,
        title=title,
        build=built,
        sections=READ,
        nees_limit=float(limit),
        memory=lambda landmarks, members, config: 0.0,
        follows=bool(getattr(kind, "follows", False)),
    )


def check_name(name: str, *groups: str, where: str = "filter") -> str:
    """Return an estimator's name; raise InputError if it is unknown and not ``module:Class``.

    ``groups``: further accepted names; ``where``: its origin, for the message.

    >>> check_name("ikef")
    Traceback (most recent call last):
    pipistrelle.config.InputError: filter: found 'ikef', expected one of ekf, fastslam, iekf,
    smoother, module:Class; did you mean 'iekf'?
    """
    if name not in CATALOGUE and not names_class(name):
        known, near = (*CATALOGUE, *groups), meant(name, (*CATALOGUE, *groups))
        fix = f"; did you mean {near!r}?" if near else ""
        expected = f"one of {', '.join(known)}, module:Class"
        raise InputError(f"{where}: found {name!r}, expected {expected}{fix}")
    return name


def short_name(name: str) -> str:
    """Return an estimator's name for files: for ``module:Class`` only the class.

    >>> short_name("ekf"), short_name("mine.filters:DeadReckoning")
    ('ekf', 'DeadReckoning')
    """
    return name.rpartition(":")[2]


def title_of(name: str) -> str:
    """Return an estimator's title for readers, without importing an external module.

    External estimators have the name of their class until they are imported (`entry`).

    >>> title_of("ekf"), title_of("not.installed:Here")
    ('EKF', 'Here')
    """
    if name in CATALOGUE:
        return CATALOGUE[name].title
    module, _, wanted = name.partition(":")
    title = getattr(getattr(sys.modules.get(module), wanted, None), "title", None)
    return title if isinstance(title, str) and title.isprintable() else short_name(name)


def check_distinct(names: Iterable[str], where: str = "filter") -> None:
    """Raise InputError if two estimators would write the same files; ``where``: their origin.

    >>> check_distinct(["ekf", "a:Own", "b:Own"])
    Traceback (most recent call last):
    pipistrelle.config.InputError: filter: a:Own and b:Own would write the same files; rename one
    """
    seen: dict[str, str] = {}
    for name in names:
        first = seen.setdefault(short_name(name), name)
        if first != name:
            raise InputError(f"{where}: {first} and {name} would write the same files; rename one")


Options = Callable[[Config, "Motion"], dict[str, Any]]
"""Function that returns an estimator's special arguments from the settings."""


def _builder(name: str, where: str, options: Options) -> "Callable[[Config, Motion], Estimator]":
    """Return a function that builds an estimator from settings, importing its class when called."""

    def build(config: Config, motion: "Motion") -> "Estimator":
        module, _, kind = where.partition(":")
        made = getattr(import_module(f"pipistrelle.estimation.{module}"), kind)
        gate = gate_of(name, config)
        return made(motion=motion, rays=config.rays, gate=gate, **options(config, motion))

    return build


def _ekf_options(config: Config, _: "Motion") -> dict[str, Any]:
    """Return the keyword arguments common to EKFs and smoother, from the settings."""
    settings = config.filter
    return {
        "robust": settings.robust,
        "speed_std": settings.caller_speed_std,
        "walk_std": settings.caller_walk_std,
    }


def _smoother_options(config: Config, motion: "Motion") -> dict[str, Any]:
    """Return the smoother's keyword arguments from the settings and the motion model."""
    from pipistrelle.estimation.smoother.preintegration import calibration_of

    own = {
        "calibration": calibration_of(config, motion),
        "window": config.filter.window or math.inf,
    }
    return _ekf_options(config, motion) | own


def _smoother_bytes(landmarks: int, _: int, config: Config) -> float:
    """Estimate the smoother's memory [bytes] from the numbers of landmarks and poses."""
    poses = config.scenario.steps / config.scenario.steps_per_frame
    each = 2.0 * COPIES * 3 * (1 + 2 * landmarks) + 12 * landmarks
    return DOUBLE * (poses * each + COPIES * (1 + 2 * landmarks) ** 2)


def _ekf_bytes(landmarks: int, members: int, _: Config) -> float:
    """Estimate the EKF's memory [bytes]: three covariances, before, during and after an update."""
    return COPIES * DOUBLE * (3 + 2 * landmarks * members) ** 2


def _fastslam_bytes(landmarks: int, members: int, config: Config) -> float:
    """Estimate FastSLAM's memory [bytes]: particles before and after an update, and resampled."""
    slopes = 4 if config.listening.excess_paths else 0
    each = 6 * landmarks * members + landmarks + slopes * landmarks
    return COPIES * DOUBLE * config.fastslam.particles * each


CATALOGUE = {
    known.name: known
    for known in (
        Entry(
            name="ekf",
            title="EKF",
            build=_builder("ekf", "ekf.filter:EkfSlam", _ekf_options),
            sections=READ,
            nees_limit=50.0,
            memory=_ekf_bytes,
            follows=True,
        ),
        Entry(
            name="fastslam",
            title="FastSLAM 2.0",
            build=_builder(
                "fastslam",
                "fastslam.filter:FastSlam",
                lambda config, _: {"settings": config.fastslam},
            ),
            sections=(*READ, "fastslam"),
            nees_limit=2750.0,
            memory=_fastslam_bytes,
        ),
        Entry(
            name="iekf",
            title="invariant EKF",
            build=_builder("iekf", "ekf.filter:InvariantEkfSlam", _ekf_options),
            sections=READ,
            nees_limit=50.0,
            memory=_ekf_bytes,
            follows=True,
        ),
        Entry(
            name="smoother",
            title="smoother",
            build=_builder("smoother", "smoother.filter:Smoother", _smoother_options),
            sections=(*READ, "prior"),
            nees_limit=50.0,
            memory=_smoother_bytes,
            calibrates=True,
            follows=True,
            robust_gate=1.0,
        ),
    )
}
"""All estimators by name; NEES limits from Bradley & Abaid, Sec. V-A."""
PAPERS = ("ekf", "fastslam")
"""Names of the two estimators of Bradley & Abaid."""
SECTIONS = tuple(dict.fromkeys(name for known in CATALOGUE.values() for name in known.sections))
"""All sections of the settings that estimators read; none changes the measurements."""
