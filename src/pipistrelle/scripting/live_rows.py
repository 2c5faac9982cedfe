"""What a robot hands over at one time, checked: numbers, times, and the rows of a scan."""

from collections.abc import Mapping, Sequence
from math import inf, nan
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.logs.recording import CALLER, MAX_TIME, STATED, LogCaller
from pipistrelle.detection.logs.text_tables import Table
from pipistrelle.detection.scans import OWN
from pipistrelle.experiments.runs.replay import LABELS
from pipistrelle.refusals import meant, refusal, shown

SAME_TIME = 1e-6
"""A scan so near the end of the last step is heard there [s]."""
COLUMNS = ("landmark", "bearing", "range", CALLER, *STATED)
"""What may be said of a row that is heard."""
_NO_NUMBERS = (str, bytes, bool, np.bool_, complex, np.complexfloating)
"""What Python would make a number of, or has half of."""
Times = tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]
"""When steps end, and how long they take [s]."""


def numbers(values: object, where: str) -> Float[np.ndarray, "*n"]:
    """Return an array of numbers, NaN for None and what is masked; refuse anything else.

    >>> numbers([1, None], "range")
    array([ 1., nan])
    """
    try:
        given = np.asarray(values)
        if isinstance(values, np.ma.MaskedArray):
            given = given.astype(object)
            given[np.ma.getmaskarray(values)] = None
        if given.dtype.kind not in "iuf":
            if given.dtype.kind != "O" or any(isinstance(v, _NO_NUMBERS) for v in given.flat):
                raise TypeError
            given = np.array(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise refusal(where, shown(values), "numbers", "correct it") from None
    return given.astype(float)


def finite(value: object, where: str) -> float:
    """Return a finite number; refuse anything else."""
    found = numbers(value, where)
    if found.shape != () or not np.isfinite(found):
        raise refusal(where, shown(value), "a finite number", "correct it")
    return float(found)


def times_of(dt: object, time: object, now: float) -> Times:
    """Return the times of steps, by how long they took or by when they ended."""
    if (dt is None) == (time is None):
        found = "neither dt nor time" if dt is None else "both dt and time"
        fix = "say how long the step took, or when it ended"
        raise refusal("move", found, "one of them", fix)
    if time is None:
        lengths = np.atleast_1d(numbers(dt, "dt"))
        return now + np.cumsum(lengths), lengths
    ends = np.atleast_1d(numbers(time, "time"))
    if ends.ndim > 1:
        raise refusal("move", f"times of the shape {ends.shape}", "one for each step", "correct it")
    lengths = np.diff(ends, prepend=now)
    late = np.flatnonzero(~(lengths > 0.0))
    if late.size:
        k = int(late[0])
        before = f"{ends[k - 1].item()} s" if k else f"{now} s, where the vehicle is"
        found = f"the time {ends[k].item()} s"
        raise refusal("move", found, f"one after {before}", "leave out steps that come late")
    return ends, lengths


def check_clock(ends: Float[np.ndarray, " k"], now: float = -inf) -> None:
    """Refuse times that can be no seconds, or that a clock at `now` [s] cannot tell apart."""
    if (far := np.abs(ends) > MAX_TIME).any():
        found = f"the time {ends[far][0].item()} s"
        raise refusal("time", found, f"seconds, up to {MAX_TIME:g}", "take another zero or unit")
    if not (np.diff(ends, prepend=now) > 0.0).all():
        found, expected = f"a step too short for a clock at {now} s", "a later time at its end"
        raise refusal("move", found, expected, "join it with the next, or take another zero")


def check_now(time: object, now: float) -> None:
    """Refuse a scan of another time than that of the vehicle."""
    if time is None or abs((stamp := finite(time, "time")) - now) <= SAME_TIME:
        return
    late = "the vehicle has moved on: leave out scans that come late"
    fix = "move to it first, by a part of a step if need be" if stamp > now else late
    raise refusal("hear", f"the time {stamp} s", f"{now} s, where the vehicle is", fix)


def table_of(columns: Mapping[str, Any], callers: Sequence[LogCaller], *, labelled: bool) -> Table:
    """Lay out the columns of a scan as the rows of a log.

    `labelled`: whether rows need labels.
    """
    if unknown := sorted(columns.keys() - {*COLUMNS}):
        near = meant(unknown[0], COLUMNS)
        fix = f"did you mean {near!r}?" if near else "leave it out"
        raise refusal("hear", repr(unknown[0]), f"some of {', '.join(COLUMNS)}", fix)
    given = {name: values for name, values in columns.items() if values is not None}
    if labelled and "landmark" not in given:
        raise refusal("hear", "no landmark", LABELS, 'give association__method="marginal"')
    if CALLER in given:
        given[CALLER] = _numbers_of(given[CALLER], [caller.name for caller in callers])
    column = {name: np.atleast_1d(numbers(values, name)) for name, values in given.items()}
    shapes = {name: values.shape for name, values in column.items()}
    if len({*shapes.values()}) > 1 or any(len(shape) > 1 for shape in shapes.values()):
        raise refusal("hear", f"columns of the shapes {shapes}", "one row each", "correct them")
    (size,) = next(iter(shapes.values()), (0,))
    column = {name: column.get(name, np.full(size, nan)) for name in COLUMNS}
    return Table(path="hear", line=np.arange(1, size + 1), unit="row", column=column)


def keys_of(table: Table) -> set[tuple[float, ...]]:
    """Return what tells rows of one time apart: their label and caller, or all that is measured."""
    names = ("landmark", CALLER, "bearing", "range", "excess_path")
    columns = (np.nan_to_num(table.column[name], nan=-1.0).tolist() for name in names)
    return {row[:2] if row[0] >= 0 else row for row in zip(*columns, strict=True)}


def _numbers_of(names: Any, known: Sequence[str]) -> list[float]:
    """Return the numbers of callers by their names; None is the vehicle itself."""
    whole = [names] if names is None or isinstance(names, str) else names
    places = {None: nan, "": nan} | {name: float(n) for n, name in enumerate(known, start=OWN + 1)}
    try:
        return [places[name] for name in whole]
    except (KeyError, TypeError):
        found = shown(names)
        expected = " or ".join([*map(repr, known), "None, the vehicle itself"])
        raise refusal("hear, caller", found, expected, "say the vehicle's callers") from None
