"""The file of a `Slam`: vehicle, settings and estimates, with a checksum.

A file is a head line, the SHA-256 of the rest, a line of JSON and the bytes of arrays. The JSON has
a list of nodes: arrays, containers and records. A node refers only to earlier nodes, so any file is
read in one pass, and a value that two records share is shared again.

A file may be forged. It can only name records of the closed table `RECORDS`, or records of the
module of an estimator or association that the caller of `Slam.load` names; it cannot choose another
module, class or function. Every field of a record is checked against its annotation, and arrays
cannot claim more bytes than the file has. Since kernels index arrays by the stored numbers without
checks of bounds, `LAWS` checks the numbers of each record against each other.
"""

import json
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from hashlib import sha256
from math import prod
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float, jaxtyped

from pipistrelle.config import InputError, RayConfig, Section
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import KNOWN, Gaussian, Innovations, JointGaussian, Landmarks
from pipistrelle.estimation.catalogue import CATALOGUE, names_class
from pipistrelle.estimation.data_association.existence import WINDOW, Known
from pipistrelle.estimation.data_association.rows import (
    CallerPlace,
    CallerState,
    Memory,
    ScanRows,
    Tracks,
)
from pipistrelle.estimation.data_association.sequential import METHODS
from pipistrelle.estimation.data_association.watch import BINS, Watched
from pipistrelle.estimation.ekf.filter import EkfBelief
from pipistrelle.estimation.ekf.gaussian import INVARIANT, LINEAR
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.estimation.fastslam.filter import FastSlamBelief
from pipistrelle.estimation.session import MOST_STEPS, SessionState, StoredScan
from pipistrelle.estimation.smoother.belief import SmootherBelief
from pipistrelle.estimation.smoother.history import NEVER, STRETCH, History
from pipistrelle.estimation.smoother.preintegration import Calibration, Odometry
from pipistrelle.estimation.smoother.records import CALLER, POSE, NoiseModel, Stack
from pipistrelle.estimation.smoother.sweep import Points, Solution, Stretch
from pipistrelle.files import printable, read_file, read_named, write_whole
from pipistrelle.refusals import refusal, shown
from pipistrelle.version import find_version

HEAD = b"# Of Pipistrelle: a drive to go on from\n"
"""First line of the file; the second is the checksum of the rest."""
FORM = 5
"""Version of the file format; 1 was a pickle, 2 and 3 had no watch."""
ROLES = ("filter", "association")
"""Keys of the head with the names of estimator and association."""
OWN = ":"
"""Prefix of the name of a record from a module of the user."""
DEEPEST = 32
"""Largest nesting of nodes; a belief in the memory of a session has about ten."""
MOST_SHARED = 1_000_000
"""Largest number of parts that a file may save by sharing. Nodes that repeatedly name each other
could otherwise have exponentially many parts."""
_SCALARS = (type(None), bool, int, str)
_CONTAINERS = {"tuple": tuple, "list": list, "set": set, "frozenset": frozenset}
_DTYPES = {
    np.dtype(name).name: np.dtype(name).newbyteorder("<")
    for name in ("?", *np.typecodes["AllInteger"], "e", "f", "d", "F", "D")
}
"""Little-endian types of arrays by name, without objects."""
_OURS = {name: _DTYPES[name] for name in ("float64", "int64", "bool", "uint8")}
"""Types of the arrays of this package's estimators and associations."""
_MANY = (Sequence, Collection, list, set, frozenset)
LARGEST = np.sqrt(np.finfo(np.float64).max)
"""Largest number with a finite square."""
RECORDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        Calibration, CallerPlace, CallerState, EkfBelief, FastSlamBelief, Gaussian,
        History, Innovations, JointGaussian, Known, Landmarks, Memory, NoiseModel, Odometry, Points,
        RayConfig, Scan, ScanRows, SessionState, SmootherBelief, Solution, Stack, StoredScan,
        Stretch, Tracks, Watched,
    )
}  # fmt: skip
"""The records that a file may name."""


class DriveState(NamedTuple):
    """State of a drive as a file stores it: vehicle, settings, estimator and last poses."""

    name: str
    """Name of the vehicle in messages."""
    start: float
    """Time of the start [s]."""
    vehicle: dict[str, Any]
    """Keys of ``log.toml``."""
    settings: dict[str, Any]
    kept: int
    session: SessionState
    heard: frozenset[tuple[float, ...]]
    """Identities of the rows at the present time."""
    times: Float[np.ndarray, " k"]
    """Kept times [s]."""
    means: Float[np.ndarray, "k 3"]
    """Pose estimates of the vehicle at these times."""
    covariances: Float[np.ndarray, "k 3 3"]


def _modules(names: Sequence[str]) -> set[str]:
    """Return the modules that define the user's estimator and association."""
    return {name.partition(":")[0] for name in names if names_class(name)}


def write_state(path: Path, names: tuple[str, str], state: DriveState) -> None:
    """Write a drive's state into a new file, or over a file that this function wrote."""
    modules = _modules(names)
    try:
        nodes = _Nodes(modules)
        nodes.add(state)
        header = {"form": FORM, "version": find_version(), **dict(zip(ROLES, names, strict=True))}
        line = json.dumps(header | {"nodes": nodes.nodes}, allow_nan=False)
    except (_UnfitError, RecursionError) as error:
        own = f" of {' and '.join(sorted(modules))}" if modules else ""
        expected = f"arrays, numbers, text, containers of them and records{own}"
        fix = "hold it in a dataclass or NamedTuple of that module, or leave it out"
        found = f"a belief or memory with {error}"
        raise refusal(printable(path), found, expected, fix) from None
    body = line.encode() + b"\n" + b"".join(nodes.data)
    try:
        if path.exists() and not read_file(path).startswith(HEAD):
            found, expected = "a file that Slam.save did not write", "a new file, or one to replace"
            raise refusal(path, found, expected, "name another")
        write_whole(path, HEAD + sha256(body).hexdigest().encode() + b"\n" + body)
    except InputError:
        raise
    except (OSError, ValueError) as error:  # a ValueError is of a name that no file can have
        found = f"that it cannot be written ({getattr(error, 'strerror', error)})"
        fix = "name a file in a folder that is there and can be written"
        raise refusal(printable(path), found, "a file", fix) from None


@contextmanager
def refused_if_forged(path: Path) -> Iterator[None]:
    """Raise an InputError for any error in this context, which reads a forged or damaged file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = f"what Slam.save did not write ({type(error).__name__})"
        raise refusal(path, found, "one of Slam.save, as it was written", "name another") from None


def read_state(path: Path, own: Mapping[str, str | None]) -> tuple[tuple[str, str], DriveState]:
    """Read a drive's state from a file that may be forged; return class names and state.

    ``own``: estimator and association that the caller trusts, by the names of the options. Call it
    within `refused_if_forged`.
    """
    data = read_named(path, "a file of Slam.save")
    sum_, _, body = data[len(HEAD) :].partition(b"\n")
    if not data.startswith(HEAD) or sum_ != sha256(body).hexdigest().encode():
        found = "a file that Slam.save did not write"
        if data.startswith(HEAD):
            found = "a file that has changed since Slam.save wrote it"
        raise refusal(path, found, "one of Slam.save, as it was written", "name another")
    line, _, arrays = body.partition(b"\n")
    header = json.loads(line, parse_constant=_no_number)
    names = _checked_names(path, header, own)
    state = _Read(arrays, _modules(names)).all(header["nodes"])
    if type(state) is not DriveState:
        raise TypeError(type(state).__name__)
    return names, state


def _checked_names(path: Path, header: Any, own: Mapping[str, str | None]) -> tuple[str, str]:
    """Check a file's version and classes; return the names of estimator and association."""
    here, written = find_version(), header["version"]
    if written != here or header.get("form", 1) != FORM:
        found = f"a drive of Pipistrelle {written if isinstance(written, str) else shown(written)}"
        found += " in an earlier form" if written == here else ""
        fix = "load it with the Pipistrelle that wrote it, or drive on from a new start"
        raise refusal(path, shown(found)[1:-1], f"one of {here}", fix)
    ours = (CATALOGUE, (KNOWN, *METHODS))
    for (key, asked), role, known in zip(own.items(), ROLES, ours, strict=True):
        name = header[role]
        if not isinstance(name, str) or (name != asked if asked else name not in known):
            expected = f"one by {asked}" if asked else "one of this package"
            fix = f"if you trust the file and that class, load(..., {key}={shown(name)})"
            raise refusal(path, f"a drive by the {role} {shown(name)}", expected, fix)
    return header["filter"], header["association"]


def _no_number(word: str) -> None:
    """Raise ValueError for NaN and Infinity, which JSON does not allow."""
    raise ValueError(word)


class _UnfitError(TypeError):
    """Error for a value of a type that a state file cannot hold."""


class _Nodes:
    """Writer of a state: values become JSON nodes, and arrays become bytes."""

    def __init__(self, modules: Collection[str]) -> None:
        self.nodes: list[Any] = []
        self.data: list[bytes] = []
        self._modules, self._dtypes = modules, _DTYPES if modules else _OURS
        self._known: dict[int, tuple[Any, int]] = {}
        """The value (kept alive) and the number of its node, by identity."""

    def add(self, value: Any) -> Any:
        """Store a value as a node and return its number in a list; return a scalar as such."""
        if type(value) in _SCALARS:
            return value
        if type(value) is float and np.isfinite(value):
            return value
        if id(value) not in self._known:
            node = self._node(value)
            self._known[id(value)] = value, len(self.nodes)
            self.nodes.append(node)
        return [self._known[id(value)][1]]

    def _node(self, value: Any) -> list[Any]:
        """Return the JSON node of a value; store the nodes of its parts."""
        kind = type(value)
        if kind is float:
            return ["float", repr(value)]
        if kind is np.ndarray or isinstance(value, np.generic):
            return self._array(np.asarray(value), scalar=kind is not np.ndarray)
        if kind.__name__ in _CONTAINERS and kind is _CONTAINERS[kind.__name__]:
            return [kind.__name__, *map(self.add, value)]
        if kind is dict:
            return ["dict", *(self.add(part) for pair in value.items() for part in pair)]
        names = [kind.__name__, f"{OWN}{kind.__name__}"]
        name = next((name for name in names if kind is _kind_named(name, self._modules)), None)
        if name is None:
            raise _UnfitError(f"a {kind.__module__}.{kind.__qualname__}")
        if issubclass(kind, Section):
            return ["record", name, self.add(value.model_dump(mode="json"))]
        _check(value, name)
        return ["record", name, *(self.add(getattr(value, part)) for part in _fields_of(kind))]

    def _array(self, array: np.ndarray, *, scalar: bool) -> list[Any]:
        """Return the JSON node of an array or NumPy scalar; store its bytes."""
        if array.dtype.name not in self._dtypes:
            raise _UnfitError(f"an array of {array.dtype}")
        columns = array.flags.f_contiguous and not array.flags.c_contiguous
        order = "F" if columns and self._modules else "C"  # the package has only C order
        self.data.append(array.astype(self._dtypes[array.dtype.name], copy=False).tobytes(order))
        return ["array", array.dtype.name, list(array.shape), order, scalar]


class _Read:
    """Reader of a state: builds values from JSON nodes and from the bytes of arrays."""

    def __init__(self, data: bytes, modules: Collection[str]) -> None:
        self._data, self._at, self._modules = data, 0, modules
        self._dtypes = _DTYPES if modules else _OURS
        self._nodes: list[tuple[Any, int, int]] = []
        """Value, depth and number of parts of each node, including nested ones."""
        self._depth = self._walked = self._most = 0

    def all(self, nodes: list[Any]) -> Any:
        """Read all nodes of a file in order; return the value of the last."""
        self._most = DEEPEST * (sum(map(len, nodes)) + MOST_SHARED)
        for kind, *rest in nodes:
            self._depth, before = 0, self._walked
            self._walked += 1 + len(rest)
            value = self._value(kind, rest)
            if self._depth >= DEEPEST:
                raise ValueError("too deep")
            self._nodes.append((value, 1 + self._depth, self._walked - before))
        if self._at != len(self._data):
            raise ValueError("bytes of no array")
        return self._nodes[-1][0]

    def _value(self, kind: str, rest: list[Any]) -> Any:
        """Return the value that a JSON node describes."""
        if kind == "array":
            return self._array(*rest)
        if kind == "float":
            return {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}[rest[0]]
        if kind == "record":
            return self._record(*rest)
        parts = [self._part(part) for part in rest]
        if kind == "dict":
            return dict(zip(parts[::2], parts[1::2], strict=True))
        return _CONTAINERS[kind](parts)

    def _part(self, part: Any) -> Any:
        """Return the value of a node's part: a scalar, or the value of an earlier node."""
        if type(part) is not list:
            if type(part) not in (*_SCALARS, float):
                raise TypeError(type(part).__name__)
            return part
        (number,) = part
        if type(number) is not int or number < 0:
            raise IndexError(number)
        value, depth, size = self._nodes[number]
        self._depth, self._walked = max(self._depth, depth), self._walked + size
        if self._walked > self._most:
            raise ValueError("too many parts")
        return value

    def _record(self, name: str, *parts: Any) -> Any:
        """Construct a record from the parts of a node, and check it."""
        kind, values = _kind_named(name, self._modules), [self._part(part) for part in parts]
        if kind is None:
            raise TypeError(name)
        if issubclass(kind, Section):
            return kind.model_validate(*values)
        record = kind(**dict(zip(_fields_of(kind), values, strict=True)))
        _check(record, name)
        return record

    def _array(self, name: str, shape: list[int], order: Any, scalar: bool) -> Any:
        """Read the next array or NumPy scalar from the file's bytes."""
        dtype, begin = self._dtypes[name], self._at
        if any(type(n) is not int or not 0 <= n <= len(self._data) for n in shape):
            raise ValueError("shape")
        self._at += prod(shape) * dtype.itemsize
        if (
            len(shape) > DEEPEST
            or self._at > len(self._data)
            or order not in ("CF" if self._modules else "C")
        ):
            raise ValueError("an array larger than the file")
        stored = np.frombuffer(self._data[begin : self._at], dtype)
        if dtype.kind == "b" and stored.view(np.uint8).max(initial=0) > 1:
            raise ValueError("no truth value")
        array = stored.astype(dtype.newbyteorder("=")).reshape(shape, order=order)
        if scalar and shape:
            raise ValueError("scalar")
        return array[()] if scalar else array


def _kind_named(name: str, modules: Collection[str]) -> Any:
    """Return the record class that a file names, if a state may contain it; else None.

    In a user's module it must be defined at the top, with a constructor that takes all fields.
    """
    if not name.startswith(OWN):
        return DriveState if name == DriveState.__name__ else RECORDS.get(name)
    name = name.removeprefix(OWN)
    for module in modules:
        kind = vars(sys.modules[module]).get(name)
        if isinstance(kind, type) and (kind.__module__, kind.__qualname__) == (module, name):
            plain = is_dataclass(kind) and all(field.init for field in fields(kind))
            if plain or (issubclass(kind, tuple) and hasattr(kind, "_fields")):
                return kind
    return None


@cache
def _fields_of(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields that a record's constructor takes."""
    if is_dataclass(kind):
        return tuple(field.name for field in fields(kind) if field.init)
    return kind._fields


_hints_of = cache(get_type_hints)
"""Returns the annotations of the fields of a record."""


def _check(record: Any, name: str) -> None:
    """Raise if a record violates its type annotations or its consistency check in `LAWS`."""
    kind = type(record)
    hints = _hints_of(kind) if not name.startswith(OWN) else {}
    with jaxtyped("context"):
        for field, hint in hints.items():
            if field in _fields_of(kind) and not _fits(value := getattr(record, field), hint):
                raise _UnfitError(f"a {name} whose {field} is {shown(value)}")
    if hints and kind in LAWS and not LAWS[kind](record):
        raise _UnfitError(f"a {name} that contradicts itself")


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value fits a type annotation, including the shapes of arrays."""
    if hint is Any or isinstance(hint, TypeVar):
        return True
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in args)
    if origin is Literal:
        return value in args
    if origin is tuple and args[-1:] != (Ellipsis,):
        if not isinstance(value, tuple) or len(value) != len(args):
            return False
        return all(_fits(part, one) for part, one in zip(value, args, strict=True))
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(
            _fits_alone(part, one)
            for pair in value.items()
            for part, one in zip(pair, args, strict=True)
        )
    if origin is tuple or origin in _MANY:
        many = (tuple,) if origin is tuple else (tuple, list, set, frozenset)
        return isinstance(value, many) and all(_fits_alone(part, args[0]) for part in value)
    if hint in (int, float):
        number = (int, np.integer) if hint is int else (int, float, np.integer, np.floating)
        return isinstance(value, number) and not isinstance(value, bool)
    return isinstance(value, hint)


def _fits_alone(value: Any, hint: Any) -> bool:
    """Return whether an item of a container fits an annotation, with independent shapes."""
    with jaxtyped("context"):
        return _fits(value, hint)


def check_going_on(start: SessionState, state: SessionState, *, own: bool) -> None:
    """Raise if a loaded state does not fit the estimator and association of a new session.

    ``own``: whether the estimator is a user's, which may have several types of beliefs.
    """
    beliefs = [state.belief, *(heard.belief for heard in state.past)]
    beliefs += [state.open[0]] if state.open else []
    first = start.belief
    for belief in () if own else beliefs:
        same = type(belief) is type(first)
        same = same and getattr(first, "error", 0) == getattr(belief, "error", 0)
        if isinstance(first, SmootherBelief) and same:
            old, new = first.history.calibration, belief.history.calibration
            same = (first.noise, first.rays, old.names) == (belief.noise, belief.rays, new.names)
            for name in ("assumed", "unit", "stds", "odometry", "sensor"):
                same = same and np.array_equal(getattr(old, name), getattr(new, name))
        if not same:
            raise ValueError("another estimator")
    kinds = {type(memory) for memory in (state.memory, *(heard.memory for heard in state.past))}
    if isinstance(start.memory, Memory | None) and kinds != {type(start.memory)}:
        raise ValueError("another association")


def within(values: Any, low: Any, high: Any) -> bool:
    """Return whether all values are at least `low` and below `high`."""
    array = np.asarray(values)
    return bool(np.all((array >= low) & (array < high)))


def _finite(*arrays: Any) -> bool:
    """Return whether all numbers and their squares are finite."""
    return all(bool(np.all(np.abs(array) <= LARGEST)) for array in arrays)


def _sessions(state: SessionState) -> bool:
    """Return whether a session's scan numbers, random states and open motion are consistent."""
    numbers = [heard.number for heard in state.past]
    end = state.first + len(state.labels)
    if state.first < 0 or numbers != [*range(end - len(numbers), end)]:
        return False
    try:
        states: list[Any] = [state.draws, *([state.open[1]] if state.open else [])]
        for draws in states:
            np.random.PCG64(0).state = draws
    except (ValueError, TypeError, KeyError, OverflowError, IndexError):
        return False
    legs = [*state.legs, *(leg for heard in state.past for leg in heard.legs)]
    going = (
        len(state.open) == 2 and 0 < len(legs[len(state.legs) - 1][1]) < MOST_STEPS
        if (state.open is not None and state.legs)
        else state.open is None
    )
    return going and all(_finite(dt) for _, dt in legs)


def _is_pose(gaussian: Gaussian) -> bool:
    """Return whether a Gaussian has the shape of a pose and only finite numbers."""
    return gaussian.mean.shape == (POSE,) and _finite(gaussian.mean, gaussian.covariance)


def _ekf(belief: EkfBelief) -> bool:
    """Return whether an EKF belief has consistent sizes and only finite numbers."""
    size, members = belief.mean.size, belief.landmark.size
    numbers = belief.mean, belief.covariance, belief.weight, belief.origin
    return (
        size == POSE + 2 * members == belief.covariance.shape[0]
        and belief.error in (LINEAR, INVARIANT)
        and belief.covariance.diagonal().min() >= 0.0
        and _finite(*numbers)
    )


def _fastslam(belief: FastSlamBelief) -> Any:
    """Return whether a FastSLAM belief has consistent sizes and counts, and only numbers."""
    blocks, landmarks, lanes = belief.count.shape
    room = np.diff(belief.first)
    if {room.size, belief.landmark.size, belief.best_count.size} != {landmarks}:
        return False
    rows = belief.member.shape[1], len(belief.best_member)
    sound = (
        lanes == LANES
        and blocks == -(-belief.log_weight.size // LANES) > 0
        and (belief.poses.shape, belief.member.shape[2]) == ((blocks, 9 * LANES), 6 * LANES)
        and belief.first[0] == 0
        and within(room, 0, 1 + min(rows))
        and belief.first[-1] <= min(rows)
        and within(belief.count, 0, 1 + room[:, None])
        and within(belief.best_count, 0, 1 + room)
        and np.unique(belief.landmark).size == landmarks
        and _is_pose(belief.estimate)
        and _finite(belief.poses)
        and not np.isnan(belief.log_weight).any()
    )
    if not sound:
        return False
    c = int(belief.first[-1])  # the rows of members that are not in use are unwritten
    place = np.arange(c) - np.repeat(belief.first[:-1], room)
    best = belief.best_member[:c][place < np.repeat(belief.best_count, room)]
    used = place[:, None] < np.repeat(belief.count, room, axis=1)
    numbers = belief.member[:, :c].reshape(blocks, c, 6, LANES)
    return not (np.isnan(best).any() or np.any(np.isnan(numbers) & used[:, :, None]))


def _shapes(stack: Stack, *rest: tuple[int, ...], whole: Sequence[int] = ()) -> bool:
    """Return whether the entries of a stack of arrays have given shapes and number types."""
    kinds = [np.int64 if n in whole else np.float64 for n in range(len(rest))]
    shapes = tuple(array.shape[1:] for array in stack.arrays)
    return shapes == rest and [array.dtype for array in stack.arrays] == kinds


def _has_shapes(arrays: Sequence[Any], *shapes: tuple[int, ...]) -> bool:
    """Return whether arrays are finite float64 arrays with given shapes."""
    return tuple(array.shape for array in arrays) == shapes and all(
        array.dtype == np.float64 and _finite(array) for array in arrays
    )


def _history(history: History) -> Any:
    """Return whether all indices in a smoother's history are in range and consistent."""
    q, p = history.calibration.odometry.size, history.calibration.stds.size
    legs = _shapes(history.legs, (3,), (3, 3), (), (2,), (2,), (3, q), whole=(3, 4))
    if not (legs and _shapes(history.steps, (3,), (3, 3), (3, q)) and p >= q):
        return False
    if not (_shapes(history.rows, (4,), (8,), whole=(0,)) and history.legs.size):
        return False
    slots, nodes, placed = len(history.slots), history.nodes, len(history.placed)
    callers, ends = len(history.callers), history.rows.entries(0)
    heard, led = history.legs.entries(3), history.legs.entries(4)
    of_border, in_chain = history.index[history.index > 0], -history.index[history.index < 0]
    lengths = {history.index.size, history.latest.size, len(history.heard), history.moves.size}
    return (
        lengths == {slots}
        and [*history.slots.values()] == [*range(slots)]
        and within(heard, 0, 1 + history.rows.size)
        and within(led, 0, 1 + history.steps.size)
        and not any(np.any(span[:, 0] > span[:, 1]) for span in (heard, led))
        and within(ends[:, :3], (0, -1, 0), (slots, slots, nodes))
        and within(ends[:, 3], -1, np.arange(len(ends)))
        and np.all((ends[:, 3] < 0) | (ends[ends[:, 3], 0] == ends[:, 0]))
        and np.array_equal(np.sort(of_border), 1 + np.arange(placed))
        and np.array_equal(np.sort(in_chain), POSE + CALLER * np.arange(callers))
        and within(history.latest, -1, history.rows.size)
        and within(history.heard[:, 1], -1, nodes)
        and within(history.heard[history.heard[:, 0] != NEVER, 0], 0, nodes)
        and within(history.moves, 0, 2)
        and _has_shapes(history.known, (placed, 2), (placed, 3))
        and (history.leaves.size, history.first.size) == (placed, callers)
        and within(history.first, 0, nodes)
        and _finite(history.way, *map(history.legs.entries, (0, 1, 2, 5)))
        and _finite(*map(history.steps.entries, range(3)))
    )


def _columns(columns: Any, first: int, width: int) -> bool:
    """Return whether landmarks have distinct pairs of columns in range, or column 0 for none."""
    used = columns[columns != 0]
    return (
        within(used, first, width - 1)
        and np.unique(used).size == used.size
        and not np.any((used - first) % 2)
    )


def _smoother(belief: SmootherBelief) -> Any:
    """Return whether a smoother's solution has sizes and columns that fit its history."""
    history, solution = belief.history, belief.solution
    points, odometry = solution.points, belief.odometry
    p, q = history.calibration.stds.size, history.calibration.odometry.size
    nodes, d, w, n = history.nodes, history.dimension, len(solution.border), solution.beta.size
    if solution.columns.size != len(history.placed) or len(solution.places) != 6:
        return False
    places = history.places(solution.columns)
    return (
        all(map(np.array_equal, places[:4], solution.places[:4]))
        and all(a.dtype == b.dtype for a, b in zip(places, solution.places, strict=True))
        and all(a.shape[1:] == b.shape[1:] for a, b in zip(places, solution.places, strict=True))
        and all(len(array) >= nodes for array in solution.places[4:])
        and n == max(1 + p, 2 + int(solution.columns.max(initial=-2))) <= w
        and _has_shapes(solution.front, (d, w), (d, d), (w, w))
        and (solution.factor.shape, solution.covariance.shape) == ((n, n), (d, d))
        and (points.at.size, points.parameters.size) == (nodes, p)
        and len(points.spots) == len(history.placed)
        and _shapes(points.at, (d,))
        and odometry.slopes.shape[1:] == (3, q)
        and _is_pose(belief.at)
        and _is_pose(belief.ahead)
        and _stretches(solution.stretches, nodes, (d, w), (1 + p, len(history.placed)))
        and _finite(solution.border, solution.factor, solution.beta)
        and _finite(points.at.entries(0), points.spots, solution.covariance, odometry.mean)
    )  # fmt: skip


def _stretches(
    stretches: Sequence[Stretch], nodes: int, size: tuple[int, int], border: tuple[int, int]
) -> bool:
    """Return whether a smoother's segments cover all poses, with arrays of fitting shapes.

    ``size``: of the state and of the border; ``border``: its first column of landmarks, and their
    number.
    """
    (d, most), (first, placed), least = size, border, 0
    if len(stretches) != 1 + (nodes - 1) // STRETCH:
        return False
    for number, one in enumerate(stretches):
        w, (g, a), left = one.front[0].shape[-1], (one.gone.size, one.freed.size), one.left
        wide = one.links.arrays[0].shape[-1]
        fits = (
            one.first == number * STRETCH
            and one.links.size == min(STRETCH, nodes - one.first)
            and least <= w <= wide <= most
            and _has_shapes(one.front, (d, w), (d, d), (w, w))
            and _shapes(one.links, (d, wide), (d, d), (d, d))
            and one.columns.size <= placed
            and _columns(one.columns, first, w)
            and g == a
            and within(one.gone, 0, placed)
            and _columns(one.freed, first, left[0].shape[2])
            and one.freed.all()
            and left[0].shape[2] <= most
            and _has_shapes(left, (g, 2, left[0].shape[2]), (g, 2, d), (g, 2, 2))
        )
        if not fits:
            return False
        least = w
    return True


LAWS: dict[Any, Callable[[Any], Any]] = {
    Calibration: lambda it: within(it.odometry, 0, POSE) and it.sensor.min() >= 0,
    EkfBelief: _ekf,
    FastSlamBelief: _fastslam,
    History: _history,
    Known: lambda it: (
        np.unique(it.label).size == it.label.size and it.past.shape == (*it.source.shape, WINDOW)
    ),
    Memory: lambda it: (
        it.scan >= 0
        and within(it.known.label, 0, it.labels + 1)
        and min((caller.label for caller in it.callers.values()), default=0) >= 0
    ),
    Scan: lambda it: it.caller.min(initial=0) >= 0 and within(it.direct, -1, it.landmark.size),
    SessionState: _sessions,
    SmootherBelief: _smoother,
    Stack: lambda it: (
        len(room := {len(array) for array in it.arrays if array.ndim}) == len(it.written) == 1
        and 0 <= it.size <= it.written[0] <= min(room)
    ),
    Watched: lambda it: (
        it.hits.shape[1:] == (BINS,)
        and bool(np.all((it.hits >= 0.0) & (it.hits <= it.asked)))
        and it.times.shape == (WINDOW,)
        and 0 <= it.lost <= it.lost * len(it.alarms)
    ),
    Tracks: lambda it: (
        len(it.rows) == len(it.poses) == len(it.times) == len(it.direct)
        and all(within(rows[:, 0], 0, len(it.last)) for rows in it.rows)
    ),
    StoredScan: lambda it: (
        it.label.size == it.original.landmark.size == it.scan.landmark.size and it.number >= 0
    ),
}
"""Checks of the numbers of a record against each other."""
