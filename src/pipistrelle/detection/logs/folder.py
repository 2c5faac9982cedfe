"""Log folders, the format of this project: plain text, read and written, the truth unseen.

Whatever is wrong with a file is refused by line or key. `recording` says how rows become steps and
measurements scans.
"""

from dataclasses import asdict
from math import inf, pi
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, field_validator

from pipistrelle.config import (
    LONGEST_STEP,
    MAX_OTHERS,
    STEEPEST,
    AngleStd,
    DistanceStd,
    InputError,
    NonNegative,
    Positive,
    Probability,
    Real,
    Section,
)
from pipistrelle.detection.logs.poses import MOTION_COVARIANCE, POSE, poses_along
from pipistrelle.detection.logs.recording import (
    CALLER,
    MEASUREMENT,
    STATED,
    Log,
    LogCaller,
    assemble,
)
from pipistrelle.detection.logs.text_tables import FORMER_NAMES, Table, read_table, table_text
from pipistrelle.detection.scans import UNLABELLED, Scan
from pipistrelle.files import read_text
from pipistrelle.own_files import LOG, OwnFiles
from pipistrelle.refusals import expectation, meant, refusal, shown, values_expected
from pipistrelle.settings import parse_toml

_Triple = Annotated[tuple[Real, Real, Real], Field(strict=False)]
_Triple_std = Annotated[tuple[NonNegative, NonNegative, NonNegative], Field(strict=False)]
_Bounds = Annotated[tuple[Positive, Positive], Field(strict=False)]
_Turn = Annotated[Positive, Field(le=2.0 * pi)]
_Point = Annotated[tuple[Real, Real], Field(strict=False)]
_Point_std = Annotated[tuple[NonNegative, NonNegative], Field(strict=False)]

_NOISY = {
    "unicycle": ("velocity", "angular_rate"),
    "bicycle": ("speed", "steering"),
    "ackermann": ("speed", "steering"),
    "poses": ("forward", "sideways", "turn"),
}
"""What of a row of odometry has a standard deviation in ``log.toml``."""
_ODOMETRY = _NOISY | {"poses": POSE}
"""Columns of a row of odometry, besides its time."""

_README = """A recorded log of Pipistrelle. Replay it with: pipistrelle slam FOLDER

log.toml          motion model, start and noise; m, s, rad; _std are standard deviations
odometry.csv      {odometry}; {held}
measurements.csv  {measurements}; an empty range is passive
truth.csv         time,x,y,heading; optional, for scoring only
landmarks.csv     landmark,x,y; optional, for scoring only
SHA256SUMS        what was written here: nothing else is ever overwritten

Bearings are relative to the heading, counter-clockwise. Where a measurement has no bearing_std or
range_std of its own, that of log.toml holds.
"""
_EXCESS_PATHS = """
An excess path [m] is how much longer the way of a caller's sound over the landmark is than the
straight one; log.toml says which landmark each caller is. A row without a bearing is one excess
path more.
"""
_HELD = "a row holds until the next one's time, the last only ends the log"
_FOLLOWED = "what counts is the way from row to row, wherever they begin"


class _CallerTable(Section):
    model_config = ConfigDict(strict=True)

    name: Annotated[str, Field(pattern=r"^\w[\w-]*$", max_length=40)]
    landmark: Annotated[int, Field(ge=0, lt=2**53)]
    moves: bool = False
    place: _Point | None = None
    place_std: _Point_std | None = None

    @field_validator("place")
    @classmethod
    def _of_what_stands(cls, place: Any, known: Any) -> Any:
        if place is not None and known.data.get("moves"):
            raise ValueError("no place of a caller that moves")
        return place

    @field_validator("place_std")
    @classmethod
    def _of_a_place(cls, std: Any, known: Any) -> Any:
        if std is not None and known.data.get("place") is None:
            raise ValueError("a place beside it")
        return std


class _AssociationTable(Section):
    """What is known of the sensor; settings of the same names."""

    model_config = ConfigDict(strict=True)

    detection: Probability | None = None
    clutter: Positive | None = None
    max_range: Positive | None = None
    field_of_view: _Turn | None = None


class _Settings(Section):
    model_config = ConfigDict(strict=True)

    format: Literal[1]
    motion: Literal["unicycle", "bicycle", "ackermann", "poses"]
    initial_pose: _Triple
    initial_pose_std: _Triple_std
    range_std: DistanceStd
    bearing_std: AngleStd
    excess_path_std: DistanceStd | None = None
    range_bounds: _Bounds
    step: Annotated[Positive, Field(le=LONGEST_STEP)] | None = None
    gate: Probability | None = None
    noise_at_rest: bool = True
    sensor_pose: _Triple = (0.0, 0.0, 0.0)
    association: _AssociationTable = _AssociationTable()
    callers: Annotated[tuple[_CallerTable, ...], Field(strict=False, max_length=MAX_OTHERS)] = ()

    @field_validator("callers")
    @classmethod
    def _apart(cls, callers: tuple[_CallerTable, ...]) -> tuple[_CallerTable, ...]:
        names = {"vehicle", *(caller.name.casefold() for caller in callers)}
        if len(names) <= len(callers):
            raise ValueError('a name of its own for each caller, not "vehicle", a or A alike')
        if len({caller.landmark for caller in callers}) < len(callers):
            raise ValueError("a landmark of its own for each caller")
        return callers

    @field_validator("range_bounds")
    @classmethod
    def _rising(cls, bounds: tuple[float, float]) -> tuple[float, float]:
        if bounds[0] >= bounds[1]:
            raise ValueError("a near range below a far one")
        return bounds


class _UnicycleSettings(_Settings):
    velocity_std: NonNegative
    angular_rate_std: NonNegative


class _BicycleSettings(_Settings):
    speed_std: NonNegative
    steering_std: NonNegative
    wheelbase: Positive


class _AckermannSettings(_BicycleSettings):
    speed_offset: Real = 0.0

    @field_validator("speed_offset")
    @classmethod
    def _within_the_car(cls, offset: float, known: Any) -> float:
        if abs(offset) > 0.5 * known.data.get("wheelbase", inf):
            raise ValueError("at most half the wheelbase")
        return offset


class _PosesSettings(_Settings):
    forward_std: NonNegative
    sideways_std: NonNegative
    turn_std: NonNegative


_SETTINGS: dict[str, type[_Settings]] = {
    "unicycle": _UnicycleSettings,
    "bicycle": _BicycleSettings,
    "ackermann": _AckermannSettings,
    "poses": _PosesSettings,
}
_SHARED = tuple(name for name in _Settings.model_fields if name not in ("format", "step"))


def read_log(folder: Path) -> Log:
    r"""Read a log folder: ``log.toml``, ``odometry.csv`` and ``measurements.csv``.

    With a ``step``, the rows of odometry are merged into steps of that length (the last may be
    shorter), each with the time-weighted mean of its controls, of poses with the motion from its
    start to its end. Times are compared to 1e-6 s then, and exactly otherwise.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    Log

    Raises
    ------
    InputError
        With the file and the line or key, what was found, what was expected and the fix.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> settings = '''
    ... format = 1
    ... motion = "unicycle"
    ... initial_pose = [0.0, 0.0, 0.0]
    ... initial_pose_std = [0.05, 0.05, 0.0436]
    ... velocity_std = 0.1
    ... angular_rate_std = 0.15
    ... range_std = 0.2
    ... bearing_std = 0.06
    ... range_bounds = [0.5, 20.0]
    ... step = 0.5
    ... '''
    >>> odometry = "time,velocity,angular_rate\n0,1,0\n0.2,2,0\n0.6,0,0"
    >>> with TemporaryDirectory() as place:
    ...     folder = Path(place)
    ...     _ = (folder / "log.toml").write_text(settings)
    ...     _ = (folder / "odometry.csv").write_text(odometry)
    ...     _ = (folder / "measurements.csv").write_text("time,landmark,bearing,range\n0.3,7,1,")
    ...     log = read_log(folder)
    >>> log.time, log.controls[:, 0].round(12)
    (array([0. , 0.5, 0.6]), array([1.6, 2. ]))
    >>> log.scans[0].time, log.scans[0].landmark, log.scans[0].range
    (0.5, array([7]), array([nan]))
    """
    settings, former = _read_settings(folder / "log.toml")
    names = tuple(caller.name for caller in settings.callers)
    measured = read_table(
        folder / "measurements.csv",
        MEASUREMENT,
        optional=("bearing", "range", *STATED, CALLER),
        in_order=False,
        words={CALLER: names or ("a name that [[callers]] of log.toml have",)},
    )
    measured.column[CALLER] += 1.0  # the vehicle is number 0
    odometry = read_odometry(folder, settings.motion)
    return _assembled(folder, settings, odometry, measured, (*measured.former, *former))


def _assembled(
    folder: Path, settings: _Settings, odometry: Table, measured: Table, former: tuple[str, ...]
) -> Log:
    """Return the log of settings and tables."""
    stds = _NOISY[settings.motion]
    values = {name: getattr(settings, name) for name in _SHARED}
    values["association"] = settings.association.model_dump(exclude_none=True)
    values["callers"] = tuple(LogCaller(**caller.model_dump()) for caller in settings.callers)
    return assemble(
        odometry,
        measured,
        step=settings.step,
        name=folder.resolve().name,
        former_names=former,
        wheelbase=getattr(settings, "wheelbase", 1.0),
        speed_offset=getattr(settings, "speed_offset", 0.0),
        control_std=tuple(getattr(settings, f"{name}_std") for name in stds),
        **values,
    )


def read_odometry(folder: Path, motion: str) -> Table:
    """Read ``odometry.csv`` of a log of a motion model."""
    optional = MOTION_COVARIANCE if motion == "poses" else ()
    columns = ("time", *_ODOMETRY[motion])
    odometry = read_table(folder / "odometry.csv", columns, optional=optional)
    if motion == "ackermann":
        _check_steering(odometry)
    return odometry


def _check_steering(odometry: Table) -> None:
    """Refuse what no car's front wheels do."""
    steering = odometry.column["steering"]
    wrong = np.abs(steering) > STEEPEST
    if wrong.any():
        row = int(np.argmax(wrong))
        where = f"{odometry.path}, line {odometry.line[row]}"
        expected = f"an angle from -{STEEPEST:g} to {STEEPEST:g} rad"
        raise refusal(where, f"steering {steering[row].item()!r}", expected, "is it in radians?")


def write_log(folder: Path, log: Log) -> None:
    """Write a log folder that `read_log` reads back exactly, motions of poses up to rounding.

    Steps become rows, at the precision of the numbers; poses begin at the origin. Scans that share
    a step are spread over it in their order; empty scans leave no row. How surely it was measured
    is written row by row, if any row states it. An earlier log that we wrote is replaced, its truth
    removed (`pipistrelle.files`); ``log.toml`` comes last.

    Parameters
    ----------
    folder : Path
        Made if need be.
    log : Log

    Raises
    ------
    InputError
        Where a file cannot be written, or one in its place is not as we wrote it.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> log = Log(
    ...     name="short", time=np.array([0.0, 0.1]), controls=np.array([[1.0, 0.2]]),
    ...     dt=np.array([0.1]), scans=(), motion="unicycle", control_std=(0.1, 0.15),
    ...     initial_pose=(0.0, 0.0, 0.0), initial_pose_std=(0.05, 0.05, 0.04), range_std=0.2,
    ...     bearing_std=0.06, range_bounds=(0.5, 20.0), ignored_rows={},
    ... )
    >>> with TemporaryDirectory() as place:
    ...     write_log(Path(place), log)
    ...     print((Path(place) / "odometry.csv").read_text())
    time,velocity,angular_rate
    0.0,1.0,0.2
    0.1,0.0,0.0
    """
    OwnFiles(folder, LOG).replace(log_files(log))


def log_files(log: Log) -> dict[str, str]:
    """Return the files of a log's folder; ``log.toml`` is the last."""
    settings: dict[str, Any] = {"format": 1} | {name: getattr(log, name) for name in _SHARED}
    settings["callers"] = [asdict(caller) for caller in log.callers]
    stds = zip(_NOISY[log.motion], log.control_std, strict=True)
    settings |= {f"{name}_std": std for name, std in stds}
    if log.motion in ("bicycle", "ackermann"):
        settings["wheelbase"] = log.wheelbase
    if log.motion == "ackermann":
        settings["speed_offset"] = log.speed_offset
    settings["association"] = dict(log.association)
    model = _SETTINGS[log.motion].model_validate(settings)
    driven = _odometry_columns(log)
    measured = _measurement_columns(log)
    columns = {"odometry": ",".join(driven), "measurements": ",".join(measured)}
    held = _FOLLOWED if log.motion == "poses" else _HELD
    more = _EXCESS_PATHS if "excess_path" in measured else ""
    return {
        "odometry.csv": table_text(tuple(driven), *driven.values()),
        "measurements.csv": table_text(tuple(measured), *measured.values()),
        "README.md": _README.format(**columns, held=held) + more,
        "log.toml": _settings_text(model),
    }


def _settings_text(settings: _Settings) -> str:
    """Return ``log.toml``."""
    import tomli_w

    return tomli_w.dumps(settings.model_dump(mode="json", exclude_defaults=True, exclude_none=True))


class RowsHeard:
    """A log of scans without labels, written as they are heard, beside odometry that is there.

    Parameters
    ----------
    folder : Path
        Holds ``odometry.csv``, and a ``recording.toml`` that was read.
    about : dict
        Its table ``log``: keys of ``log.toml``.
    callers : list of dict
        As ``log.toml`` lists them.

    Raises
    ------
    InputError
        Where the table or the odometry are not as those of a log.
    """

    columns = ("time", *MEASUREMENT[1:], *STATED, CALLER)
    """Of ``measurements.csv``."""

    def __init__(self, folder: Path, about: dict[str, Any], callers: list[dict[str, Any]]) -> None:
        raw = about | {"format": 1, "callers": callers}
        self._settings = _checked_settings(raw, f"{folder / 'recording.toml'}, table 'log'")
        self._names = np.array(["", *(caller.name for caller in self._settings.callers)])
        self._odometry = folder / "odometry.csv"
        odometry = read_odometry(folder, self._settings.motion)
        begin = {"time": odometry.column["time"][:1], "landmark": np.array([UNLABELLED])}
        nothing = dict.fromkeys(("range", *STATED, CALLER), np.full(1, np.nan))
        column = begin | {"bearing": np.zeros(1)} | nothing
        one = Table(path=self._odometry, line=np.ones(1, dtype=np.int64), column=column)
        log = _assembled(folder, self._settings, odometry, one, ())  # refuses odd odometry
        self.time = log.time
        self.rows = self.inside = 0
        """Rows that were heard, and those of them that the odometry's times hold."""

    def text(self, scan: Scan) -> str:
        """Return the rows of a scan, as ``measurements.csv`` has them, without the header."""
        time = np.full(len(scan.bearing), scan.time)
        column = [_said(scan, name) for name in self.columns[1:-1]]
        self.rows += time.size
        self.inside += time.size * bool(self.time[0] <= scan.time <= self.time[-1])
        text = table_text(self.columns, time, *column, self._names[scan.caller])
        return text.split("\n", 1)[1]

    def files(self) -> dict[str, str]:
        """Return the log's other files; refuse a log of which no row can be used."""
        if not self.inside:
            begin, end = self.time[[0, -1]].tolist()
            found = f"{self.rows} echoes, none between {begin!r} s and {end!r} s"
            fix = "use the odometry's clock ('start' of recording.toml), or a lower threshold"
            raise refusal(self._odometry, found, "echoes while it drives", fix)
        columns = {
            "odometry": ",".join(("time", *_ODOMETRY[self._settings.motion])),
            "measurements": ",".join(self.columns),
        }
        held = _FOLLOWED if self._settings.motion == "poses" else _HELD
        return {
            "odometry.csv": read_text(self._odometry),
            "README.md": _README.format(**columns, held=held) + _EXCESS_PATHS,
            "log.toml": _settings_text(self._settings),
        }


def _said(scan: Scan, name: str) -> np.ndarray:
    """Return a column of a scan as a log's rows say it."""
    values = getattr(scan, name)
    if name == "excess_path" and scan.direct.size:
        values = values.copy()
        values[scan.direct[scan.direct >= 0]] = 0.0
    return values


def _read_settings(path: Path) -> tuple[_Settings, tuple[str, ...]]:
    """Return the settings of ``log.toml``, and which keys it calls by former names.

    Of several errors the first is named, unknown keys before missing ones.
    """
    raw = parse_toml(read_text(path), path)
    former = tuple(key for key in raw if FORMER_NAMES.get(key, key) not in raw)
    raw |= {FORMER_NAMES[key]: raw.pop(key) for key in former}
    return _checked_settings(raw, path), former


def _checked_settings(raw: dict[str, Any], path: Path | str) -> _Settings:
    """Return settings that are what they should be; `path`: where they stand."""
    model = _SETTINGS.get(str(raw.get("motion")), _UnicycleSettings)
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        faults = error.errors(include_url=False)
    rank = {"format": 0, "motion": 1}
    other = {"extra_forbidden": 2}
    fault = min(faults, key=lambda f: rank.get(str(f["loc"][0]), other.get(f["type"], 3)))
    raise _key_refusal(path, fault, model)


def _key_refusal(path: Path | str, fault: Any, model: type[_Settings]) -> InputError:
    known, name = model.model_fields, fault["loc"][0]
    if name == "callers" and len(fault["loc"]) > 2:
        return _caller_refusal(path, fault)
    if name == "callers" and fault["type"] == "too_long":
        found = f"{len(fault['input'])} callers"
        return refusal(f"{path}, key 'callers'", found, f"at most {MAX_OTHERS}", "leave some out")
    if name in known and (count := values_expected(fault, known[name])) is not None:
        found = f"{len(fault['input'])} values"
        return refusal(f"{path}, key {name!r}", found, f"{count}", "mend the list")
    if name == "association" and len(fault["loc"]) > 1:
        known = _AssociationTable.model_fields
    parts = (f"[{p}]" if isinstance(p, int) else f".{p}" for p in fault["loc"])
    key = "".join(parts).removeprefix(".")
    if fault["type"] == "missing":
        return refusal(path, f"no key {key!r}", f"the keys {', '.join(known)}", f"add {key!r}")
    if fault["type"] == "extra_forbidden":
        near = meant(str(fault["loc"][-1]), known)
        fix = f"did you mean {near!r}?" if near else "remove it"
        return refusal(path, f"the unknown key {key!r}", f"one of {', '.join(known)}", fix)
    found = shown(fault["input"])
    return refusal(f"{path}, key {key!r}", found, expectation(fault), "correct the value")


def _caller_refusal(path: Path | str, fault: Any) -> InputError:
    """Refuse a caller by its number, from 1 on, and key."""
    _, number, name, *_ = fault["loc"]
    key, known = f"callers.{number + 1}.{name}", _CallerTable.model_fields
    if fault["type"] == "missing":
        return refusal(path, f"no key {key!r}", "a name and a landmark", f"add {key!r}")
    if fault["type"] == "extra_forbidden":
        near = meant(name, known)
        fix = f"did you mean {near!r}?" if near else "remove it"
        return refusal(path, f"the unknown key {key!r}", f"one of {', '.join(known)}", fix)
    expected = expectation(fault)
    if name == "name" and fault["type"] in ("string_pattern_mismatch", "string_too_long"):
        expected = "letters, digits, _ and -, 40 at most"
    return refusal(f"{path}, key {key!r}", shown(fault["input"]), expected, "correct the value")


def _odometry_columns(log: Log) -> dict[str, np.ndarray]:
    """Return the columns of ``odometry.csv``: controls, or poses with their covariance."""
    if log.motion != "poses":
        rows = np.vstack((log.controls, np.zeros(2)))
        return {"time": log.time} | dict(zip(_ODOMETRY[log.motion], rows.T, strict=True))
    column = dict(zip(POSE, poses_along(log.controls).T, strict=True))
    stated = log.controls[:, len(POSE) :]
    rows = np.vstack((np.full(stated.shape[1], np.nan), stated))
    return {"time": log.time} | column | dict(zip(MOTION_COVARIANCE, rows.T, strict=False))


def _measurement_columns(log: Log) -> dict[str, np.ndarray]:
    """Return the columns of ``measurements.csv``; scans lie spread over their step, in order.

    Of how surely it was measured there are those of which any row says something; how loud it was
    stands in logs without labels.
    """
    used = np.array([scan.time for scan in log.scans])
    index = np.searchsorted(log.time, used)
    start = log.time[np.maximum(index - 1, 0)]
    rank = np.arange(len(used)) - np.searchsorted(used, used)
    count = np.searchsorted(used, used, side="right") - np.searchsorted(used, used)
    stamp = np.where(rank + 1 == count, used, start + (used - start) * (rank + 1) / count)
    sizes = [len(scan.landmark) for scan in log.scans]
    column = {"time": np.repeat(stamp, sizes)}
    for name in (*MEASUREMENT[1:], *STATED):
        fields = [_said(scan, name) for scan in log.scans]
        values = np.concatenate(fields) if fields else np.empty(0)
        labelled = name == "level_db" and (column["landmark"] != UNLABELLED).any()
        if name in MEASUREMENT or not (labelled or np.isnan(values).all()):
            column[name] = values
    whose = np.concatenate([np.empty(0, dtype=np.int64), *(scan.caller for scan in log.scans)])
    if log.callers and whose.any():
        column[CALLER] = np.array(["", *(caller.name for caller in log.callers)])[whose]
    return column
