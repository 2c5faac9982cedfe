"""The file of a `Slam`: the vehicle, the settings and all that was estimated, guarded by a sum.

A file is a head line, the sum of what follows, a line of JSON and the bytes of arrays. The JSON has
a list of nodes: an array, a container or a record each. A node refers to earlier nodes only, so the
file is read in one pass, whatever it holds, and a value that two records share is shared again.

A file may come from anybody. It names records of a closed table (`saved_records.RECORDS`), or
records of the module of an estimator or an association that the caller of `Slam.load` names; it
chooses no other module, class or function. Every value of a record is checked against the
annotation of its field, and arrays claim no more bytes than the file has.
"""

import json
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from hashlib import sha256
from math import prod
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import Float, jaxtyped

from pipistrelle.config import InputError, Section
from pipistrelle.estimation.association import KNOWN
from pipistrelle.estimation.catalogue import CATALOGUE, names_class
from pipistrelle.estimation.data_association.sequential import METHODS
from pipistrelle.estimation.session import SessionState
from pipistrelle.files import printable, read_file, read_named, write_whole
from pipistrelle.refusals import refusal, shown
from pipistrelle.scripting.saved_records import LAWS, RECORDS
from pipistrelle.version import find_version

HEAD = b"# Of Pipistrelle: a drive to go on from\n"
"""First line of the file; the second is the sum of all that follows it."""
FORM = 2
"""Number of the form of the file; 1 was a pickle."""
OWN = ":"
"""Begins the name of a record of a module from outside."""
DEEPEST = 32
"""Most nodes within each other: a belief in a session's memory has about ten."""
MOST_SHARED = 1_000_000
"""Parts that a file may save by sharing: a node that names another several times, and is named so
itself, and so on, has as many parts as could never be walked through."""
_SCALARS = (type(None), bool, int, str)
_CONTAINERS: dict[str, Callable[..., Any]] = {
    one.__name__: one for one in (tuple, list, set, frozenset)
}
_DTYPES = {
    np.dtype(name).name: np.dtype(name).newbyteorder("<")
    for name in ("?", *np.typecodes["AllInteger"], "e", "f", "d", "F", "D")
}
"""Of numbers and truth values, by name; objects have none."""
_OURS = {name: _DTYPES[name] for name in ("float64", "int64", "bool", "uint8")}
"""Of all that an estimator and an association of this package keep."""
_MANY = (Sequence, Collection, list, set, frozenset)


class DriveState(NamedTuple):
    """All that a file holds."""

    name: str
    """Of the log that a `Slam` makes of its vehicle."""
    start: float
    """Time of the start [s]."""
    former: tuple[str, ...]
    """Keys that the vehicle called by former names."""
    vehicle: dict[str, Any]
    """Keys of ``log.toml``."""
    settings: dict[str, Any]
    kept: int
    session: SessionState
    heard: frozenset[tuple[float, ...]]
    """Rows that were heard at the present time."""
    times: Float[np.ndarray, " k"]
    """[s]."""
    means: Float[np.ndarray, "k 3"]
    """Poses of the vehicle as they were believed at their time."""
    covariances: Float[np.ndarray, "k 3 3"]


class Named(NamedTuple):
    """The estimator and the association of a drive."""

    filter: str
    association: str

    @property
    def modules(self) -> set[str]:
        """Names of the modules of those from outside."""
        return {name.partition(":")[0] for name in self if names_class(name)}


def write_state(path: Path, named: Named, state: DriveState) -> None:
    """Write the file, in place of one that was written here before."""
    try:
        nodes = _Nodes(named.modules)
        nodes.add(state)
        line = json.dumps(
            {"form": FORM, "version": find_version(), **named._asdict(), "nodes": nodes.nodes},
            allow_nan=False,
        )
    except (_UnfitError, RecursionError) as error:
        own = f" of {' and '.join(sorted(named.modules))}" if named.modules else ""
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


def read_state(path: Path, own: Mapping[str, str | None]) -> tuple[Named, DriveState]:
    """Return what the file holds, and of which estimator and association.

    ``own``: the names that the caller gives, by the fields of `Named`; their modules are imported.
    """
    data = read_named(path, "a file of Slam.save")
    found = "a file that Slam.save did not write"
    if data.startswith(HEAD):
        sum_, _, body = data[len(HEAD) :].partition(b"\n")
        if sum_ == sha256(body).hexdigest().encode():
            return _content(path, body, own)
        found = "a file that has changed since Slam.save wrote it"
    raise refusal(path, found, "one of Slam.save, as it was written", "name another")


def not_saved(path: Path, error: Exception) -> InputError:
    """Return the refusal of a file whose sum is right and whose content is not."""
    found = f"what Slam.save did not write ({type(error).__name__})"
    return refusal(path, found, "one of Slam.save, as it was written", "name another")


def _content(path: Path, body: bytes, own: Mapping[str, str | None]) -> tuple[Named, DriveState]:
    """Return what follows the sum; bytes that have a sum may still be anybody's."""
    line, _, data = body.partition(b"\n")
    try:
        header = json.loads(line, parse_constant=_no_number)
        named = _checked_header(path, header, own)
        state = _Read(data, named.modules).all(header["nodes"])
        if type(state) is not DriveState:
            raise TypeError(type(state).__name__)
    except InputError:
        raise
    except Exception as error:
        raise not_saved(path, error) from None
    return named, state


def _checked_header(path: Path, header: Any, own: Mapping[str, str | None]) -> Named:
    """Refuse what another version wrote, and a class from outside that the caller does not name."""
    here, there = find_version(), header["version"]
    if there != here or header.get("form", 1) != FORM:
        found = f"a drive of Pipistrelle {there if isinstance(there, str) else shown(there)}"
        found += " in an earlier form" if there == here else ""
        fix = "load it with the Pipistrelle that wrote it, or drive on from a new start"
        raise refusal(path, shown(found)[1:-1], f"one of {here}", fix)
    named = Named(header["filter"], header["association"])
    ours = (CATALOGUE, (KNOWN, *METHODS))
    for (key, asked), name, word, known in zip(
        own.items(), named, Named._fields, ours, strict=True
    ):
        if not isinstance(name, str) or (name != asked if asked else name not in known):
            expected = f"one by {asked}" if asked else "one of this package"
            fix = f"if you trust the file and that class, load(..., {key}={shown(name)})"
            raise refusal(path, f"a drive by the {word} {shown(name)}", expected, fix)
    return named


def _no_number(word: str) -> None:
    """Refuse NaN and Infinity, which are no JSON."""
    raise ValueError(word)


class _UnfitError(TypeError):
    """A value of a kind that no file holds."""


class _Nodes:
    """The nodes of a file that is written, and the bytes of its arrays."""

    def __init__(self, modules: Collection[str]) -> None:
        self.nodes: list[Any] = []
        self.data: list[bytes] = []
        self._modules, self._dtypes = modules, _DTYPES if modules else _OURS
        self._known: dict[int, tuple[Any, int]] = {}
        """By identity: the value, which stays alive, and the number of its node."""

    def add(self, value: Any) -> Any:
        """Return what stands for a value: itself, or the number of its node in a list."""
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
        """Return the node of a value; add those that it refers to."""
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
        """Return the node of an array or of one of NumPy's scalars."""
        if array.dtype.name not in self._dtypes:
            raise _UnfitError(f"an array of {array.dtype}")
        columns = array.flags.f_contiguous and not array.flags.c_contiguous
        order = "F" if columns and self._modules else "C"  # of whole numbers, in ours
        self.data.append(array.astype(self._dtypes[array.dtype.name], copy=False).tobytes(order))
        return ["array", array.dtype.name, list(array.shape), order, scalar]


class _Read:
    """The nodes of a file that is read."""

    def __init__(self, data: bytes, modules: Collection[str]) -> None:
        self._data, self._at, self._modules = data, 0, modules
        self._dtypes = _DTYPES if modules else _OURS
        self._values: list[Any] = []
        self._depths: list[int] = []
        self._sizes: list[int] = []
        """Parts of each value, and of all within it."""
        self._parts = self._walked = 0

    def all(self, nodes: list[Any]) -> Any:
        """Return the value of the last node."""
        for kind, *rest in nodes:
            self._depth, before = 0, self._walked
            self._parts += 1 + len(rest)
            self._walked += 1 + len(rest)
            self._values.append(self._value(kind, rest))
            if self._depth >= DEEPEST:
                raise ValueError("too deep")
            self._depths.append(1 + self._depth)
            self._sizes.append(self._walked - before)
        if self._at != len(self._data):
            raise ValueError("bytes of no array")
        return self._values[-1]

    def _value(self, kind: str, rest: list[Any]) -> Any:
        """Return the value of a node."""
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
        """Return the value that a part of a node stands for."""
        if type(part) is not list:
            if type(part) not in (*_SCALARS, float):
                raise TypeError(type(part).__name__)
            return part
        (number,) = part
        if type(number) is not int or not 0 <= number < len(self._values):
            raise IndexError(number)
        self._depth = max(self._depth, self._depths[number])
        self._walked += self._sizes[number]
        if self._walked > DEEPEST * (self._parts + MOST_SHARED):
            raise ValueError("too many parts")
        return self._values[number]

    def _record(self, name: str, *parts: Any) -> Any:
        """Return a record, by its constructor."""
        kind, values = _kind_named(name, self._modules), [self._part(part) for part in parts]
        if kind is None:
            raise TypeError(name)
        if issubclass(kind, Section):
            return kind.model_validate(*values)
        record = kind(**dict(zip(_fields_of(kind), values, strict=True)))
        _check(record, name)
        return record

    def _array(self, name: str, shape: list[int], order: Any, scalar: bool) -> Any:
        """Return the next array, or one of NumPy's scalars."""
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
        found = np.frombuffer(self._data[begin : self._at], dtype)
        if dtype.kind == "b" and found.view(np.uint8).max(initial=0) > 1:
            raise ValueError("no truth value")
        array = found.astype(dtype.newbyteorder("=")).reshape(shape, order=order)
        if scalar and shape:
            raise ValueError("scalar")
        return array[()] if scalar else array


def _kind_named(name: str, modules: Collection[str]) -> Any:
    """Return the record of a name: of the closed table, or of a module from outside; or None.

    Of a module count the records that it defines at its top and whose constructor takes all fields.
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
    """Return the names of a record's fields, as its constructor takes them."""
    if is_dataclass(kind):
        return tuple(field.name for field in fields(kind) if field.init)
    return kind._fields


@cache
def _hints_of(kind: Any) -> dict[str, Any]:
    """Return the annotations of a record's fields."""
    return get_type_hints(kind)


def _check(record: Any, name: str) -> None:
    """Refuse a record of the table that is not as its annotations and its law have it."""
    kind = type(record)
    hints = _hints_of(kind) if not name.startswith(OWN) else {}
    with jaxtyped("context"):
        for field, hint in hints.items():
            if field in _fields_of(kind) and not _fits(value := getattr(record, field), hint):
                raise _UnfitError(f"a {name} whose {field} is {shown(value)}")
    if hints and kind in LAWS and not LAWS[kind](record):
        raise _UnfitError(f"a {name} that contradicts itself")


def _fits(value: Any, hint: Any) -> bool:
    """Tell whether a value is as an annotation has it; shapes are those of the context."""
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
    """Tell the same of a part of a container, whose shapes are its own."""
    with jaxtyped("context"):
        return _fits(value, hint)
