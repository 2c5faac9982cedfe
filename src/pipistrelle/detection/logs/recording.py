"""A recorded drive: rows of odometry become steps, measurements become scans.

A row of odometry holds from its time to the next row's; the last row only ends the log. A row of
poses gives the vehicle's position and heading, and a step is the motion between two (`poses`). Rows
of one time are a scan, perhaps inside a step. Irregular rows that sound logs contain are dropped
and counted. All formats are converted here.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, field_validator

from pipistrelle.config import LONGEST_STEP, NonNegative, Real, Section
from pipistrelle.detection.logs.poses import RESOLUTION, motions_between, turns_in_degrees
from pipistrelle.detection.scans import NO_CALLERS, OWN, UNLABELLED, Scan, columns_of, make_scan
from pipistrelle.geometry import wrap
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import Schema, Table, check_columns, check_unique, place_of, rows_kept

STATED = ("bearing_std", "range_std", "excess_path", "excess_path_std", "bearing_slope", "level_db")
"""Optional columns of a measurement: standard deviations, excess path, slope of the bearing in the
speed of sound, and level. Without labels, an excess path of 0 marks the direct call."""
CALLER = "caller"
"""Column of the caller's number, from 1; absent or NaN for the vehicle's own call."""
MEASUREMENTS = Schema(
    file="measurements.csv",
    row="landmark -1: clutter, empty: unknown; a row without bearing: a range or excess path",
    columns=("time", "landmark", "bearing", "range"),
    optional=(*STATED, CALLER),
    empty=("landmark", "bearing", "range"),
)

MAX_TIME = 1e11
"""Latest time [s]: beyond the year 5000, if counted from 1970."""

_MAX_STEPS = 10_000_000
_MAX_GAP = 10.0  # [s], median gap between rows of odometry or of the truth
_LONG_GAP = 1000.0  # ratio to the median gap: a recording that drops one row in ten, each by
# itself, loses so many in a row with a chance of 1e-1000
_UNITS = (1e-3, 1e-6, 1e-9)  # [s], of other clocks


def _is_name(name: str) -> str:
    """Return a caller's name; raise if it is not a word."""
    if not re.fullmatch(r"\w[\w-]{0,39}", name):
        raise ValueError("letters, digits, _ and -, 40 at most")
    return name


class LogCaller(Section):
    """A caller, other than the vehicle, in a recorded log."""

    model_config = ConfigDict(strict=True)

    name: Annotated[str, AfterValidator(_is_name)]
    """Name in ``log.toml`` and in the column of callers."""
    landmark: Annotated[int, Field(ge=0, lt=2**53)]
    """Its label as a landmark."""
    moves: bool = False
    """Whether it moves: it is then not a landmark of the map, but estimators may track it."""
    place: Annotated[tuple[Real, Real], Field(strict=False)] | None = None
    place_std: Annotated[tuple[NonNegative, NonNegative], Field(strict=False)] | None = None
    """`place` and `place_std`: its position and standard deviation [m], else `landmark_std`."""

    @field_validator("place", "place_std")
    @classmethod
    def _of_a_place(cls, value: Any, known: ValidationInfo) -> Any:
        """Raise if a moving caller has a position, or a std is given without a position."""
        if value is not None and known.data.get("moves"):
            raise ValueError("no place of a caller that moves")
        if value is not None and known.field_name == "place_std" and not known.data.get("place"):
            raise ValueError("a place beside it")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Log:
    """A recorded drive: controls, scans, and the noise of both."""

    name: str
    time: Float[np.ndarray, " t"]
    """The start, then the end of each step [s]."""
    controls: Float[np.ndarray, "t-1 c"]
    """Velocity [m/s] and angular rate [rad/s] (bicycle, car: speed and steering angle [rad]); for
    poses the motion in the step, forward, sideways [m] and turn [rad], perhaps with its
    covariance (`pipistrelle.estimation.motion`)."""
    dt: Float[np.ndarray, " t-1"]
    """Length of each step [s]."""
    scans: tuple[Scan, ...]
    """In order; the ``time`` of each is the entry of `time` at which it is used."""
    motion: Literal["unicycle", "bicycle", "poses", "ackermann"]
    wheelbase: float = 1.0
    """Bicycle and car only [m]."""
    speed_offset: float = 0.0
    """Lateral offset of a car's speed sensor, to the left of the middle of the rear axle [m]."""
    sensor_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose of the sensor on the vehicle: ahead, to the left [m], and turned to the left [rad]."""
    control_std: tuple[float, ...]
    """Noise of the controls, constant over a step, unless the motion states its covariance."""
    noise_at_rest: bool = True
    """Whether a step of zero controls or zero motion has noise; if not, it is exact."""
    initial_pose: tuple[float, float, float]
    initial_pose_std: tuple[float, float, float]
    """`initial_pose` and `initial_pose_std` [m, m, rad]."""
    range_std: float
    """Range std [m]."""
    bearing_std: float
    """Bearing std [rad]."""
    excess_path_std: float | None = None
    """None if the log does not state it [m]."""
    range_bounds: tuple[float, float]
    """Nearest and farthest range of a passive landmark [m]."""
    callers: tuple[LogCaller, ...] = ()
    """The other callers; the first is number 1 of the scans' callers."""
    landmarks: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    """Known positions of landmarks, by label [m]; ``landmark_std``: their standard deviation."""
    landmark_std: float = 1e-3
    association: Mapping[str, float] = field(default_factory=dict)
    """Settings of `association` that the log states for its sensor."""
    gate: float | None = None
    """Probability that a measurement passes the gate; None if the log does not state it."""
    ignored_rows: dict[str, int]
    """Number of dropped rows, by reason."""
    bearings: Float[np.ndarray, " n"] | None = None
    """Bearings of all scans before they were wrapped; None if the scans' are unchanged."""
    notes: tuple[str, ...] = ()
    """Choices and conversions of the reader, for the user, a line each."""
    doubts: tuple[str, ...] = ()
    """Oddities that the reader accepted: warnings for the user, a line each."""

    def recorded_bearings(self) -> Float[np.ndarray, " n"]:
        """Return the recorded bearings of all scans, before wrapping."""
        wrapped = columns_of(self.scans)["bearing"]
        read = wrapped if self.bearings is None else self.bearings
        return read if np.array_equal(wrap(read), wrap(wrapped), equal_nan=True) else wrapped


def assemble(
    odometry: Table,
    measurements: Table,
    *,
    step: float | None = None,
    time_offset: float = 0.0,
    span: tuple[float, float] = (-math.inf, math.inf),
    ignored_rows: dict[str, int] | None = None,
    **settings: Any,
) -> Log:
    """Make a log of a table of odometry and a table of measurements.

    `odometry` has ``time`` and two controls or, for ``motion = "poses"``, the columns of
    `motions_between`. `measurements` has the required columns of `MEASUREMENTS`, and any of the
    optional ones (NaN if unknown); a row without a bearing has a range, or a further excess path.
    `step` [s]: length of the steps into which rows are merged (None: each row is a step);
    `time_offset` [s]: delay of the measurements' times relative to the odometry's clock; `span`
    [s]: times to which the log is cut; `ignored_rows`: rows dropped so far, by reason; `settings`:
    the other fields of `Log`.

    Raises InputError if no odometry or no measurement remains, a landmark is measured twice at one
    time with the same call, an excess path has no caller, or times cannot be seconds.
    """
    check_seconds(odometry)
    check_seconds(measurements, math.inf)
    stamp = odometry.column["time"]
    last = np.append(np.diff(stamp) > 0, True)
    rows = _cut(odometry.path, stamp[last], span)
    time = _step_times(odometry, rows, step)
    doubts = [*settings.pop("doubts", ()), *_silence(rows, step)]
    if settings["motion"] == "poses":
        controls = motions_between(odometry, time)
        if turns_in_degrees(odometry):
            doubts.append("headings seem to be in degrees; multiply them by pi / 180")
    else:
        _, *columns = odometry.column.values()
        controls = _mean_controls(stamp[last], np.column_stack(columns)[last], rows, time)
    stamps = {"time": measurements.column["time"] - time_offset}
    measurements = replace(measurements, column=measurements.column | stamps)
    callers = settings.get("callers", ())
    clutter = measurements.column["landmark"] == UNLABELLED
    labelled = not clutter.all()
    if labelled:
        measurements = rows_kept(measurements, ~clutter)
    measurements = _of_callers(measurements, callers)
    told = measurements.column["landmark"] > UNLABELLED
    check_unique(rows_kept(measurements, told), "time", "landmark", besides=CALLER)
    stamp = measurements.column["time"]
    inside = (stamp >= time[0]) & (stamp <= time[-1])
    ignored = Counter(ignored_rows or {})
    ignored["same_time_odometry"] += int(np.sum(~last))
    ignored["clutter"] += int(np.sum(clutter)) * labelled
    ignored["outside_odometry"] += int(np.sum(~inside))
    if not inside.any():
        reasons = ", ".join(f"{n} {why.replace('_', ' ')}" for why, n in ignored.items() if n)
        found = f"no row to use (left out: {reasons})"
        expected = f"some of landmarks, between {time[0].item()!r} s and {time[-1].item()!r} s"
        raise refusal(measurements.path, found, expected, "use the odometry's clock")
    said = (
        *MEASUREMENTS.columns,
        CALLER,
        *(name for name in STATED if name in measurements.column),
    )
    measured = _in_order({name: measurements.column[name][inside] for name in said})
    return Log(
        time=time,
        controls=controls,
        dt=np.diff(time),
        scans=_scans(
            time, measured, 0.0 if step is None else RESOLUTION, callers, bool(told.all())
        ),
        ignored_rows={reason: count for reason, count in ignored.items() if count},
        doubts=tuple(doubts),
        bearings=measured["bearing"],
        **settings,
    )


def scan_at(time: float, rows: Table, callers: tuple[LogCaller, ...], *, known: bool) -> Scan:
    """Build a scan from measurements with the same time; ``known``: all labels are stated.

    `rows` have ``landmark``, ``bearing``, ``range``, ``caller``, perhaps other columns of a log.
    Raises InputError if a row is not valid in a log.
    """
    check_columns(rows)
    rows = _of_callers(rows, callers)
    labelled = rows_kept(rows, rows.column["landmark"] > UNLABELLED)
    check_unique(labelled, "landmark", besides=CALLER)
    measured = rows.column | {"time": np.full(len(rows.line), time)}
    (scan,) = _scans(np.array([time]), _in_order(measured), 0.0, callers, known)
    return scan


def check_seconds(table: Table, longest_gap: float = _MAX_GAP) -> None:
    """Raise if a table's times or gaps cannot be seconds, and name the likely unit."""
    time = table.column["time"]
    gaps = np.diff(time)
    typical = float(np.median(gaps[gaps > 0.0])) if np.any(gaps > 0.0) else 0.0
    latest = float(np.max(np.abs(time), initial=0.0))
    if typical <= longest_gap and latest <= MAX_TIME:
        return
    if latest > MAX_TIME:
        factor = next((unit for unit in _UNITS if latest * unit <= MAX_TIME / 10.0), _UNITS[-1])
    else:  # the unit of 1 ms, 1 us and 1 ns that makes the median gap closest to 0.1 s
        factor = min(_UNITS, key=lambda unit: abs(math.log10(typical * unit / 0.1)))
    found = f"times from {time[0].item():g} to {time[-1].item():g}, typically {typical:g} apart"
    raise refusal(table.path, found, "seconds", f"multiply them by {factor:g}")


def _cut(path: Path | str, time: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """Return the odometry's times within a span, including both ends of the span."""
    start, end = max(time[0], span[0]), min(time[-1], span[1])
    if start >= end:
        found = f"times from {time[0].item()!r} to {time[-1].item()!r}"
        if time[0] == time[-1]:
            raise refusal(path, found, "two times or more", "add the row that ends the log")
        expected = f"some between {span[0]!r} and {span[1]!r}"
        raise refusal(path, found, expected, "use odometry and truth of one drive")
    return np.concatenate(([start], time[(time > start) & (time < end)], [end]))


def _step_times(odometry: Table, time: np.ndarray, step: float | None) -> np.ndarray:
    """Return the boundaries of the control steps [s]: the rows' times, or every `step` [s]."""
    if step is None:
        long = np.flatnonzero(np.diff(time) > LONGEST_STEP)
        if long.size:
            row = int(np.searchsorted(odometry.column["time"], time[long[0] + 1]))
            found = f"time {time[long[0] + 1].item()!r} after {time[long[0]].item()!r}"
            expected = f"rows at most {LONGEST_STEP:g} s apart"
            fix = "part the log there, or merge rows into steps by `step` in log.toml"
            raise refusal(place_of(odometry, row), found, expected, fix)
        return time
    count = max(1.0, np.ceil((time[-1] - time[0] - RESOLUTION) / step))
    if count > _MAX_STEPS:
        gap, start, end, _ = _widest_gap(time)
        found = (
            f"{time[-1] - time[0]:g} s in steps of {step:g} s, {gap:g} s of them without a row, "
            f"from {start!r} s to {end!r} s"
        )
        fix = "correct the times there, if the clock was set, or the step"
        raise refusal(odometry.path, found, f"at most {_MAX_STEPS} steps", fix)
    return np.append(time[0] + step * np.arange(count), time[-1])


def _widest_gap(time: np.ndarray) -> tuple[float, float, float, float]:
    """Return the widest gap between times, its start and end, and the median gap [s]."""
    gaps = np.diff(time)
    row = int(np.argmax(gaps))
    start, end = time[row : row + 2].tolist()
    return end - start, start, end, float(np.median(gaps))


def _silence(time: np.ndarray, step: float | None) -> list[str]:
    """Return a warning if one gap in the odometry is far longer than the others."""
    gap, start, end, typical = _widest_gap(time)
    if not gap > max(_LONG_GAP * typical, _MAX_GAP):
        return []
    steps = "" if step is None else f", which is {math.ceil(gap / step)} steps"
    return [
        f"the odometry is silent for {gap:.6g} s, from {start!r} s to {end!r} s{steps}, and its "
        f"rows are typically {typical:.3g} s apart; was its clock set, or the recording paused?"
    ]


def _mean_controls(
    stamp: np.ndarray, controls: np.ndarray, rows: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """Average the controls of the rows that each step spans, weighted by time."""
    held = controls[np.searchsorted(stamp, rows[:-1], side="right") - 1]
    if time is rows:
        return held
    edges = np.union1d(rows, time)
    row = np.searchsorted(rows, edges[:-1], side="right") - 1
    driven = np.diff(edges)[:, None] * held[row]
    total = np.add.reduceat(driven, np.searchsorted(edges, time[:-1]))
    return total / np.diff(time)[:, None]


def _of_callers(measurements: Table, callers: tuple[LogCaller, ...]) -> Table:
    """Add caller numbers to measurements; raise at invalid excess paths or empty rows."""
    column, nothing = measurements.column, np.full(len(measurements.line), np.nan)
    caller, excess_path = column.get(CALLER, nothing), column.get("excess_path", nothing)
    own = np.array([UNLABELLED, *(one.landmark for one in callers)])
    whose = own[np.where(np.isnan(caller), OWN, caller).astype(np.int64)]
    unheard = np.isnan(column["bearing"]) & np.isnan(excess_path) & np.isnan(column["range"])
    for wrong, found, expected, fix in (
        (
            unheard,
            "bearing ''",
            "a finite number, or a range or a further excess path without it",
            "correct the field",
        ),
        (
            ~np.isnan(excess_path) & np.isnan(caller),
            "an excess path without a caller",
            "the name of a caller beside it",
            "add it in the column 'caller', and to [[callers]] of log.toml",
        ),
        (
            ~np.isnan(excess_path) & ~np.isnan(caller) & (whose == column["landmark"]),
            "an excess path of a call over the caller itself",
            "excess paths over other landmarks",
            "leave the field of one that came straight empty",
        ),
    ):
        if wrong.any():
            where = place_of(measurements, int(np.argmax(wrong)))
            raise refusal(where, found, expected, fix)
    number = np.where(np.isnan(caller), OWN, caller).astype(np.int64)
    return replace(measurements, column=column | {CALLER: number})


def _in_order(measured: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Sort measurements by time; at equal times, rows without a bearing are last."""
    order = np.lexsort((np.isnan(measured["bearing"]), measured["time"]))
    return {name: column[order] for name, column in measured.items()}


def _scans(
    time: np.ndarray,
    measured: dict[str, np.ndarray],
    resolution: float,
    callers: tuple[LogCaller, ...],
    known: bool,
) -> tuple[Scan, ...]:
    """Return a scan per time of the sorted measurements; just before a step's end, at that end."""
    labels = np.array([UNLABELLED, *(caller.landmark for caller in callers)])
    stamp, bearing, landmark = measured["time"], measured["bearing"], measured["landmark"]
    end = time[np.searchsorted(time, stamp - resolution)]
    said: dict[str, Any] = measured | {
        "landmark": np.maximum(landmark, UNLABELLED),
        "time": np.where(end - stamp > resolution, stamp, end),
        "bearing": np.where(~(np.abs(bearing) >= np.pi), bearing, wrap(bearing)),
    }
    edges = np.unique([0, *np.flatnonzero(np.diff(stamp)) + 1, stamp.size]).tolist()
    named = labels if callers and (landmark > UNLABELLED).any() else NO_CALLERS
    straight = np.equal(said.get("excess_path", math.nan), 0.0) & (not known)
    if straight.any():
        said["excess_path"] = np.where(straight, np.nan, said["excess_path"])
    rows = make_scan(**said | {"time": math.nan})
    whose = (rows.landmark > UNLABELLED) & (rows.landmark == labels[rows.caller])
    direct = (straight | whose) & (not known)

    def scan(begin: int, end: int) -> Scan:
        caller, at = rows.caller[begin:end], np.flatnonzero(direct[begin:end])[::-1]
        marked = NO_CALLERS if known else np.full(labels.size, UNLABELLED)
        marked[caller[at]] = at  # of several, the first
        return Scan(
            time=float(said["time"][begin]),
            landmark=rows.landmark[begin:end],
            caller=caller,
            numbers=np.ascontiguousarray(rows.numbers[:, begin:end]),
            callers=named,
            direct=marked,
        )

    return tuple(map(scan, edges[:-1], edges[1:]))
