"""All estimators by name, one entry each: the only list of them.

Verbs, plans, memory checks, figures and reports read here what they need to know of an estimator.
To add one, write it (`pipistrelle.estimation.beliefs.Estimator`) and give it an entry. Its module
is imported when it is built, so the command line lists all names at once. An estimator that is not
listed is named ``module:Class`` (`entry`).

Classes from outside, estimators and associations: found, checked and built by their names.

The module is an installed one, or one in the current folder, which goes first, as with
``python -m``. Everything that can be wrong with it is refused in one line.
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

    It is None where the class is not imported or has no title that can be printed.

    >>> title_met("never.imported:Here") is None
    True
    """
    module, _, wanted = name.partition(":")
    title = getattr(getattr(sys.modules.get(module), wanted, None), "title", None)
    return title if isinstance(title, str) and title.isprintable() else None


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


if TYPE_CHECKING:
    from pipistrelle.estimation.beliefs import Estimator
    from pipistrelle.estimation.motion import Motion

READ = ("listening", "association", "filter", "rays")
"""Sections of the settings that every estimator reads."""
DOUBLE = 8
"""Bytes of a number."""
COPIES = 3.0
"""How many times arrays that are worked on are held: before, during and after, as measured."""
GATE = 0.999
"""Default share of a measurement's predicted distribution that is accepted from a recorded log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """What the rest of the package knows of an estimator."""

    name: str
    """As settings, tables and files have it."""
    title: str
    """As a reader knows it."""
    build: "Callable[[Config, Motion], Estimator]"
    """Makes the estimator from the settings, for a vehicle with this motion model."""
    sections: tuple[str, ...]
    """The sections of the settings that it reads; none of them changes what is heard."""
    nees_limit: float
    """A NEES above it means that the estimator has diverged."""
    memory: Callable[[int, int, Config], float]
    """The most bytes that it holds at once, by the number of landmarks, that of each one's members,
    and a Config."""
    calibrates: bool = False
    """Whether it estimates what ``filter.calibrate`` names."""
    follows: bool = False
    """Whether scans give it moving callers (`beliefs.Belief.moving`), or rows of what stands
    alone."""
    gate: float = GATE
    """What ``filter.gate = "auto"`` means to it: the share of a measurement's predicted
    distribution that it accepts of a log; 1 drops nothing."""
    robust_gate: float = GATE
    """The same with ``filter.robust = "huber"``."""


def gate_of(name: str, config: Config) -> float:
    """Return the share of a predicted distribution that an estimator accepts: ``filter.gate``.

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
    return known.robust_gate if settings.robust == "huber" else known.gate


def entry(name: str) -> Entry:
    """Look an estimator up, by its name here, or as a class from outside, ``module:Class``.

    The module is one that is installed, or one in the current folder, which goes first, as it
    does for ``python -m``. The class is an `Estimator`. Its classmethod
    ``from_config(config, motion)`` builds it, where it has one; else it is a dataclass and is
    given, by keyword, those of its fields that are called

    - ``motion``: the `Motion` of the vehicle,
    - ``rays``, ``gate``: these settings,
    - ``config``: all settings.

    Its other fields need defaults. It may have the attributes ``title``, as a reader is to know
    it (else its name), ``nees_limit`` (else infinity: only a NEES that is not finite means
    that it diverged) and ``follows`` (else False: True gives it what is heard of callers that
    move, whose labels are in the scan's ``moving``). What memory it needs is not known, and not
    checked.

    Parameters
    ----------
    name : str

    Returns
    -------
    Entry

    Raises
    ------
    InputError
        For an unknown name, a module that is not there or cannot be imported, a class that is
        not there or is no estimator.

    Examples
    --------
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
    return Entry(
        name=name,
        title=title,
        build=lambda config, motion: _built(name, kind, _with_gate(name, config), motion),
        sections=READ,
        nees_limit=float(limit),
        memory=lambda landmarks, members, config: 0.0,
        follows=bool(getattr(kind, "follows", False)),
    )


def check_name(name: str, *groups: str, where: str = "filter") -> str:
    """Return an estimator's name; refuse one neither listed nor of the form ``module:Class``.

    ``groups`` are names of several estimators that were allowed, too, and ``where`` is where it is
    named, for the refusal.

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
    """Return an estimator's name as files bear it: of one from outside, the class.

    >>> short_name("ekf"), short_name("mine.filters:DeadReckoning")
    ('ekf', 'DeadReckoning')
    """
    return name.rpartition(":")[2]


def title_of(name: str) -> str:
    """Return an estimator's name as a reader knows it, without loading it.

    One from outside has its own title once it has been looked up in this process (`entry`); before
    that, the name of its class.

    >>> title_of("ekf"), title_of("not.installed:Here")
    ('EKF', 'Here')
    """
    if name in CATALOGUE:
        return CATALOGUE[name].title
    return title_met(name) or short_name(name)


def check_distinct(names: Iterable[str], where: str = "filter") -> None:
    """Refuse estimators whose files would have the same name; ``where`` says where they are named.

    >>> check_distinct(["ekf", "a:Own", "b:Own"])
    Traceback (most recent call last):
    pipistrelle.config.InputError: filter: a:Own and b:Own would write the same files; rename one
    """
    seen: dict[str, str] = {}
    for name in names:
        first = seen.setdefault(short_name(name), name)
        if first != name:
            raise InputError(f"{where}: {first} and {name} would write the same files; rename one")


def _builder(name: str, where: str) -> "Callable[[Config, Motion], Estimator]":
    """Return what builds an EKF or the smoother, a class ``module:Class`` of this room."""

    def build(config: Config, motion: "Motion") -> "Estimator":
        module, _, kind = where.partition(":")
        made = getattr(import_module(f"pipistrelle.estimation.{module}"), kind)
        return made(**_settings(name, config, motion))

    return build


def _settings(name: str, config: Config, motion: "Motion") -> dict[str, Any]:
    """Return what an EKF or the smoother is made with."""
    settings = config.filter
    return {
        "motion": motion,
        "rays": config.rays,
        "gate": gate_of(name, config),
        "robust": settings.robust == "huber",
        "speed_std": settings.caller_speed_std,
        "walk_std": settings.caller_walk_std,
    }


def _smoother(config: Config, motion: "Motion") -> "Estimator":
    """Build the smoother."""
    from pipistrelle.estimation.smoother.filter import Smoother
    from pipistrelle.estimation.smoother.preintegration import calibration_of

    return Smoother(
        **_settings("smoother", config, motion),
        calibration=calibration_of(config, motion),
        window=config.filter.window or math.inf,
    )


def _built(name: str, kind: Any, config: Config, motion: "Motion") -> "Estimator":
    """Build an estimator from outside."""
    values = {"motion": motion, "rays": config.rays, "gate": config.filter.gate, "config": config}
    return build(ESTIMATOR, name, kind, (config, motion), values)


def _with_gate(name: str, config: Config) -> Config:
    """Return the settings with a number for the gate, as estimators from outside get them."""
    settings = config.filter.model_copy(update={"gate": gate_of(name, config)})
    return config.model_copy(update={"filter": settings})


def _smoother_bytes(landmarks: int, _: int, config: Config) -> float:
    """Estimate the memory of what the elimination leaves at each pose, and of all measurements.

    Three rows of the border at each pose, held twice where all is linearised anew; every landmark
    heard from every pose.
    """
    poses = config.scenario.steps / config.scenario.steps_per_frame
    each = 2.0 * COPIES * 3 * (1 + 2 * landmarks) + 12 * landmarks
    return DOUBLE * (poses * each + COPIES * (1 + 2 * landmarks) ** 2)


def _ekf_bytes(landmarks: int, members: int, _: Config) -> float:
    """Estimate the memory of three covariances: before, during and after a correction."""
    return COPIES * DOUBLE * (3 + 2 * landmarks * members) ** 2


def _fastslam(config: Config, motion: "Motion") -> "Estimator":
    """Build FastSLAM 2.0."""
    from pipistrelle.estimation.fastslam.filter import FastSlam

    gate = gate_of("fastslam", config)
    return FastSlam(motion=motion, rays=config.rays, gate=gate, settings=config.fastslam)


def _fastslam_bytes(landmarks: int, members: int, config: Config) -> float:
    """Estimate the memory of three sets of particles: before, corrected and resampled."""
    slopes = 4 if config.listening.timing else 0
    each = 6 * landmarks * members + landmarks + slopes * landmarks
    return COPIES * DOUBLE * config.fastslam.particles * each


CATALOGUE = {
    known.name: known
    for known in (
        Entry(
            name="ekf",
            title="EKF",
            build=_builder("ekf", "ekf.filter:EkfSlam"),
            sections=READ,
            nees_limit=50.0,
            memory=_ekf_bytes,
            follows=True,
        ),
        Entry(
            name="fastslam",
            title="FastSLAM 2.0",
            build=_fastslam,
            sections=(*READ, "fastslam"),
            nees_limit=2750.0,
            memory=_fastslam_bytes,
        ),
        Entry(
            name="iekf",
            title="invariant EKF",
            build=_builder("iekf", "ekf.filter:InvariantEkfSlam"),
            sections=READ,
            nees_limit=50.0,
            memory=_ekf_bytes,
            follows=True,
        ),
        Entry(
            name="smoother",
            title="smoother",
            build=_smoother,
            sections=(*READ, "prior"),
            nees_limit=50.0,
            memory=_smoother_bytes,
            calibrates=True,
            follows=True,
            robust_gate=1.0,
        ),
    )
}
"""All estimators; the limits are those of Bradley & Abaid, Sec. V-A."""
PAPERS = ("ekf", "fastslam")
"""The two estimators of Bradley & Abaid."""
SECTIONS = tuple(dict.fromkeys(name for known in CATALOGUE.values() for name in known.sections))
"""All sections of the settings that estimators read; none of them changes what is heard."""
