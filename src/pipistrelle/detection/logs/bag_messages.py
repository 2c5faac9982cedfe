"""ROS message types: convert poses, velocities and echoes, and check definitions in a bag.

Definitions: `marine_acoustic_msgs` (github.com/apl-ocean-engineering/marine_msgs, BSD 3-Clause) and
`mrpt_msgs` (github.com/mrpt-ros-pkg/mrpt_msgs, BSD); all others are ROS's common interfaces. Echoes
are points in the frame of their sensor, x ahead, y to the left.

rosbags generates Python source from a definition: 30 bytes of text, ``string[20000000] x``, become
gigabytes of source, and its parsers evaluate arithmetic of any size. The text in a bag is therefore
parsed here, in time linear in its length, and compared with the known definition. If both describe
the same bytes, the known types decode the messages. If the text has further fields, its types do,
within limits. A text that lacks a known field, or changes its type, is an error.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.files import shipped_text
from pipistrelle.refusals import refusal, shown

ODOMETRY = "nav_msgs/msg/Odometry"
_PINGS = "marine_acoustic_msgs/msg/"
_PART = re.compile(r"^=+[ \t]*\n", re.MULTILINE)
"""Line between the definitions in a text."""
DEFINITIONS = {
    head.removeprefix("MSG: "): fields
    for part in _PART.split(shipped_text("detection/logs/definitions.msg"))
    for head, _, fields in (part.partition("\n"),)
}
"""Types that rosbags does not know, for bags that do not define them."""

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]
"""Rotation and translation [m] from one frame to another."""
_ROUNDING = 0.01
"""Largest deviation of a quaternion's length from 1: components of 8 bits, the coarsest of
drivers, are each off by half of 1/127 and the length by up to 1/127."""
_UNIFORM = 12.0**-0.5
"""Standard deviation of a uniform distribution of width 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Echoes:
    """Positions, delays and standard deviations of the echoes in a message."""

    point: Float[np.ndarray, "n 3"]
    """Position relative to the sensor [m]."""
    delay: Float[np.ndarray, " n"]
    """Delay of each echo's emission after the header's time [s]."""
    range_std: Float[np.ndarray, " n"]
    """[m]; NaN if not stated."""
    bearing_std: Float[np.ndarray, " n"]
    """[rad]; NaN if not stated."""
    landmark: Int[np.ndarray, " n"]
    mount: Pose | None = None
    """Pose of the sensor on the vehicle, if the message states it."""
    ignored: Counter[str] = field(default_factory=Counter)
    """Echoes left out, by reason."""


class TurnError(InputError):
    """Invalid orientation in a message: not a unit quaternion, or a vehicle upside down."""


def yaw_of(q: Any) -> float:
    """Return the heading of a quaternion [rad]; raise if its length is not 1 up to rounding."""
    x, y, z, w = q.x, q.y, q.z, q.w
    if not abs((length := math.hypot(x, y, z, w)) - 1.0) <= _ROUNDING:
        raise TurnError(
            f"found the quaternion ({x:g}, {y:g}, {z:g}, {w:g}) of length {length:.3g}, expected "
            "the length 1; fill in x, y, z and w"
        )
    return float(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))


def rotation_of(q: Any) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion."""
    yaw_of(q)
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / np.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pose_of(place: Any, q: Any) -> Pose:
    """Return the rigid transform (rotation, translation) of a position and a quaternion."""
    return rotation_of(q), np.array([place.x, place.y, place.z], dtype=float)


def _planar(place: Any, q: Any) -> tuple[float, float, float]:
    """Return x, y and heading of a position and a quaternion; raise for a vehicle upside down."""
    heading = yaw_of(q)
    if q.x * q.x + q.y * q.y > q.z * q.z + q.w * q.w:
        raise TurnError(
            f"found the quaternion ({q.x:g}, {q.y:g}, {q.z:g}, {q.w:g}), a vehicle upside down, "
            "expected its z upwards; is the order x, y, z, w, and the frame's z up?"
        )
    return place.x, place.y, heading


POSES: dict[str, Callable[[Any], tuple[float, float, float]]] = {
    ODOMETRY: lambda m: _planar(m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/PoseStamped": lambda m: _planar(m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _planar(
        m.pose.pose.position, m.pose.pose.orientation
    ),
    "geometry_msgs/msg/TransformStamped": lambda m: _planar(
        m.transform.translation, m.transform.rotation
    ),
}
"""Message types of poses; each function returns x, y [m] and heading [rad]."""


def _sonar_detections(message: Any, speed_of_sound: float | None) -> Echoes:
    """Convert the travel times and beam angles of a sonar message to echoes."""
    time = np.asarray(message.two_way_travel_times, dtype=float)
    speed = message.ping_info.sound_speed or speed_of_sound
    if not speed:
        raise InputError("found no speed of sound, expected one; add --bag.speed-of-sound")
    across = _per_beam("rx_angles", message.rx_angles, time.size)
    along = _per_beam("tx_angles", message.tx_angles, time.size, 0.0)
    level, up = np.cos(along), np.sin(along)
    ways = np.column_stack([level * np.cos(across), -level * np.sin(across), up])
    distance = 0.5 * speed * time
    return _beams(message, ways, distance, message.tx_delays)


def _sonar_ranges(message: Any, _: float | None) -> Echoes:
    """Convert the ranges along unit vectors of a sonar message to echoes."""
    distance = np.asarray(message.ranges, dtype=float)
    vectors = [(v.x, v.y, v.z) for v in message.beam_unit_vec]
    if len(vectors) != distance.size:
        raise InputError(f"found {len(vectors)} unit vectors, expected one for each range")
    ways = np.array(vectors, dtype=float).reshape(-1, 3)
    return _beams(message, ways, distance, message.transmit_delays)


def _beams(
    message: Any, ways: Float[np.ndarray, "n 3"], distance: Float[np.ndarray, " n"], delays: Any
) -> Echoes:
    """Return the echoes of beams with a valid range and no flag, with std by the beam's width."""
    size = distance.size
    flags = np.array([flag.flag for flag in message.flags])
    flagged = _per_beam("flags", flags, size, 0.0) != 0.0
    heard = np.isfinite(distance) & (distance > 0.0)
    width = _per_beam("rx_beamwidths", message.ping_info.rx_beamwidths, size)
    ignored = Counter(flagged=int(flagged.sum()), nothing_heard=int((~heard & ~flagged).sum()))
    kept = heard & ~flagged
    return _echoes(
        (ways * np.where(kept, distance, 0.0)[:, None])[kept],
        delay=_per_beam("delays", delays, size, 0.0)[kept],
        bearing_std=np.where(width > 0.0, _UNIFORM * width, np.nan)[kept],
        ignored=ignored,
    )


def _range(message: Any, _: float | None) -> Echoes:
    """Convert a range in a cone to an echo straight ahead, its bearing uniform over the width.

    There is no echo at infinity, below the minimum range, or, as Gazebo and many drivers write it,
    at the maximum range, which single precision may round down by a last place.
    """
    distance, near, far = float(message.range), float(message.min_range), float(message.max_range)
    below = float(np.nextafter(np.float32(far), np.float32(0.0)))
    heard = int(math.isfinite(distance) and max(near, 0.0) <= distance < below and distance > 0.0)
    width, variance = float(message.field_of_view), float(getattr(message, "variance", 0.0))
    return _echoes(
        np.array([[distance, 0.0, 0.0]])[:heard],
        bearing_std=np.array([_UNIFORM * width if width > 0.0 else np.nan])[:heard],
        range_std=np.array([variance**0.5 if variance > 0.0 else np.nan])[:heard],
        ignored=Counter(nothing_heard=1 - heard),
    )


def _range_bearing(message: Any, _: float | None) -> Echoes:
    """Convert a message of labelled ranges and angles, with the sensor's pose, to echoes."""
    rows = [(one.range, one.yaw, one.pitch, one.id) for one in message.sensed_data]
    distance, yaw, pitch, label = np.array(rows, dtype=float).reshape(-1, 4).T
    if not (distance > 0.0).all():
        raise InputError(f"found the range {distance[~(distance > 0.0)][0]:g}, expected above 0")
    level = distance * np.cos(pitch)
    points = [level * np.cos(yaw), level * np.sin(yaw), -distance * np.sin(pitch)]
    stated = message.sensor_std_range, message.sensor_std_yaw
    range_std, bearing_std = (np.full(len(rows), s if s > 0.0 else np.nan) for s in stated)
    pose = message.sensor_pose_on_robot
    q = pose.orientation
    turned = rotation_of(q) if any((q.x, q.y, q.z, q.w)) else np.eye(3)
    place = np.array([pose.position.x, pose.position.y, pose.position.z], dtype=float)
    return _echoes(
        np.column_stack(points),
        range_std=range_std,
        bearing_std=bearing_std,
        landmark=label.astype(np.int64),
        mount=(turned, place),
    )


ECHOES: dict[str, Callable[[Any, float | None], Echoes]] = {
    f"{_PINGS}SonarDetections": _sonar_detections,
    f"{_PINGS}SonarRanges": _sonar_ranges,
    "sensor_msgs/msg/Range": _range,
    "mrpt_msgs/msg/ObservationRangeBearing": _range_bearing,
}
"""Message types of echoes; a function takes the speed of sound for a ping without one."""
ANGLES = f"{_PINGS}SonarDetections"
"""Type with angles about its sensor's axis, positive to starboard."""
CONES = "sensor_msgs/msg/Range"


def _per_beam(
    name: str, values: Any, size: int, default: float = np.nan
) -> Float[np.ndarray, " n"]:
    """Return a number per beam: its value, the only value, or the default if there is none."""
    numbers = np.asarray(values, dtype=float)
    if numbers.size not in (0, 1, size):
        raise InputError(f"found {numbers.size} {name}, expected one for each of {size} beams")
    if numbers.size == size:
        return numbers
    return np.full(size, numbers[0] if numbers.size else default)


def _echoes(point: Float[np.ndarray, "n 3"], **said: Any) -> Echoes:
    """Build echoes at points, with defaults for missing fields; raise if not finite."""
    nothing = np.full(len(point), np.nan)
    given: dict[str, Any] = {
        "delay": np.zeros(len(point)),
        "range_std": nothing,
        "bearing_std": nothing,
    }
    given |= {"landmark": np.full(len(point), UNLABELLED)} | said
    wrong: Bool[np.ndarray, " n"] = ~np.isfinite(np.column_stack([point, given["delay"]]))
    if wrong.any():
        raise InputError("found an angle or a delay that is no number, expected finite ones")
    return Echoes(point=point, **given)


LONGEST = 200_000
"""Longest text of a definition [characters]; ROS's longest have some 20,000, mostly comments."""
MOST_PARTS = 300
"""Most fields of a message type, with elements of arrays of records and texts. An `Odometry` has
29, and rosbags compiles 300 within a second."""
DEEPEST = 20
"""Deepest nesting of records; ROS's types have 5."""

Fields = list[tuple[str, Any]]
"""Names and types of fields, a type as in rosbags: kind, and name or element."""
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of types: a number or text, a record, an array of fixed length, a list."""
_NUMBERS = r"bool|byte|char|float(?:32|64)|u?int(?:8|16|32|64)"
_SHORT = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_FIELD = re.compile(
    r"\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d{1,9})?(?:\[(?:(?P<size>\d{1,9})|(?:<=\d{1,9})?)(?P<many>\])"
    r")?[ \t]+(?P<name>[A-Za-z]\w*)[ \t]*(?P<constant>=)?",
    re.ASCII,
)
_TYPE = re.compile(r"[A-Za-z]\w*/(?:msg/|action/|srv/)?[A-Za-z]\w*", re.ASCII)
_TOKEN = re.compile(
    r"(?P<skip>\s+|//[^\n]*|\#[^\n]*|/\*.*?(?:\*/|\Z))"
    r'|@\s*[\w:]+(?:\s*\((?:[^()"]|"(?:\\.|[^"\\])*")*\))?'
    r'|"(?:\\.?|[^"\\])*(?:"|\Z)|(?:::)?[A-Za-z]\w*(?:::[A-Za-z]\w*)*|[\w.]+|[^\s\w]',
    re.ASCII | re.DOTALL,
)
_IDL_NUMBERS = {
    "float": "float32",
    "double": "float64",
    "boolean": "bool",
    "octet": "byte",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
}


def types_of(name: str, text: str, *, idl: bool, first: bool) -> Any:
    """Return the rosbags type store that decodes messages of a type.

    `text`: the definition in the bag, or empty; `idl`: whether it is IDL; `first`: whether of ROS
    1.
    """
    known = _known(first)
    if name not in known.fielddefs:
        raise InputError(f"found the type {shown(name)}, expected one that ROS or we define")
    if not text.strip():
        return known
    told = read_definition(name, text, idl=idl)
    there = {one: fields for one, (_, fields) in known.fielddefs.items()} | told
    same, fault = _compared(name, there, known.fielddefs)
    if fault:
        raise refusal(f"the definition of {name}", *fault, "write ROS's own definition")
    return known if same else _registered(name, there)


@cache
def _known(first: bool) -> Any:
    """Return a type store of all types that rosbags and this package define, for ROS 1 or 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    for known, fields in DEFINITIONS.items():
        store.register(get_types_from_msg(fields, known))
    return store


def _compared(
    name: str, told: Mapping[str, Fields], known: Mapping[str, Any]
) -> tuple[bool, tuple[str, str] | None]:
    """Return whether two definitions of a type share their byte layout, and the first mismatch."""
    there, fields = dict(told[name]), known[name][1]
    same, fault = [one for one, _ in told[name]] == [one for one, _ in fields], None
    for part, kind in fields:
        found, expected = _bytes_of(there.get(part)), _bytes_of(kind)
        if found != expected:
            fault = fault or (f"{name}: {part} as {_words(found)}", _words(expected))
        elif (inner := _record(kind)) is not None:
            alike, within = _compared(inner, told, known)
            same, fault = same and alike, fault or within
    return same and fault is None, fault


def _bytes_of(kind: Any) -> Any:
    """Return a field's type without length bounds, which do not affect its byte layout."""
    if kind is None or kind[0] == NAME:
        return kind if kind is None else (NAME, kind[1])
    if kind[0] == BASE:
        return BASE, kind[1][0]
    return kind[0], _bytes_of(kind[1][0]), kind[1][1] if kind[0] == ARRAY else 0


def _words(kind: Any) -> str:
    """Format the type of a message field, for an error."""
    if kind is None:
        return "nothing"
    if kind[0] in (BASE, NAME):
        return kind[1]
    return f"{_words(kind[1])}[{kind[2] if kind[0] == ARRAY else ''}]"


def _record(kind: Any) -> str | None:
    """Return the nested message type of a field or of its elements; None for plain types."""
    one = kind if kind[0] in (BASE, NAME) else kind[1][0]
    return one[1] if one[0] == NAME else None


def _registered(name: str, types: Mapping[str, Fields]) -> Any:
    """Build a rosbags type store of a message type and its nested types; raise if too large."""
    from rosbags.typesys import Stores, get_typestore

    sizes: dict[str, int] = {}
    if (parts := _parts(name, types, sizes, ())) > MOST_PARTS:
        found = f"{parts:.3g} fields and elements"
        raise refusal(f"the definition of {name}", found, f"at most {MOST_PARTS}", "shorten it")
    store = get_typestore(Stores.EMPTY)
    store.register({one: ([], types[one]) for one in sizes})
    return store


def _parts(
    name: str, types: Mapping[str, Fields], sizes: dict[str, int], within: tuple[str, ...]
) -> int:
    """Count the fields of a message type and its nested types; raise if nested too deep."""
    where = f"the definition of {(*within, name)[0]}"
    if name in within or len(within) == DEEPEST:
        found = f"{name} within itself" if name in within else f"more than {DEEPEST} records"
        raise refusal(where, found, "records that end within one another", "shorten it")
    if name not in types:
        raise refusal(where, f"no definition of {name}", "one", "add it to the bag's text")
    if name not in sizes:
        total = 0
        for _, kind in types[name]:
            inner = _record(kind)
            text = kind[0] == ARRAY and kind[1][0] == (BASE, ("string", 0))
            many = kind[1][1] if kind[0] == ARRAY and (inner is not None or text) else 1
            size = 1 if inner is None else 1 + _parts(inner, types, sizes, (*within, name))
            total += many * size
        sizes[name] = total
    return sizes[name]


def read_definition(name: str, text: str, *, idl: bool = False) -> dict[str, Fields]:
    r"""Parse the definition of a message type and its nested types; return fields by type name.

    >>> read_definition("a_msgs/msg/Pair", "float64 x  # ahead\nfloat64[2] y\n")
    {'a_msgs/msg/Pair': [('x', (1, ('float64', 0))), ('y', (3, ((1, ('float64', 0)), 2)))]}
    """
    if len(text) > LONGEST:
        raise InputError(
            f"found a definition of {len(text)} characters, expected {LONGEST} at most"
        )
    told: dict[str, Fields] = {}
    for number, part in enumerate(_PART.split(text)):
        if not part.strip():
            continue
        head, _, rest = part.partition("\n")
        language, _, title = head.partition(": ")
        if language not in ("MSG", "IDL"):
            if number:
                raise InputError(f"found {shown(head[:80])}, expected MSG: and the name of a type")
            language, title, rest = "IDL" if idl else "MSG", name, part
        owner = _full(title.strip())
        made = _Idl(rest).records if language == "IDL" else {owner: _of_msg(rest, owner)}
        for one, fields in made.items():
            names = [field for field, _ in fields]
            if len({*names}) < len(names) or told.get(one, fields) != fields:
                found = "a field twice" if len({*names}) < len(names) else "two definitions"
                raise InputError(f"found {found} in {one}, expected it once")
            told[one] = fields
    if name not in told:
        found = shown(", ".join(told)) if told else "nothing"
        raise InputError(f"found a definition of {found}, expected {name}")
    return told


def _full(name: str, owner: str = "") -> str:
    """Return the full name of a message type, with its package and ``/msg/``."""
    name = _SHORT.get(name, name)
    if "/" not in name and owner:
        name = f"{owner.rpartition('/')[0]}/{name}"
    if not _TYPE.fullmatch(name):
        raise InputError(f"found {shown(name)}, expected the name of a type")
    package, *_, last = name.split("/")
    return name if name.count("/") == 2 else f"{package}/msg/{last}"


def _of_msg(text: str, owner: str) -> Fields:
    """Parse the fields of a message type from text in ROS's message language, a field per line."""
    fields = []
    for line in text.split("\n"):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if (found := _FIELD.match(line)) is None:
            raise InputError(f"found {shown(line[:80])} in {owner}, expected a type and a name")
        if found["constant"]:
            continue
        plain = found["type"] == "string" or re.fullmatch(_NUMBERS, found["type"])
        kind: Any = (BASE, (found["type"], 0)) if plain else (NAME, _full(found["type"], owner))
        if found["many"]:
            size = int(found["size"] or 0)
            kind = (ARRAY if found["size"] else SEQUENCE, (kind, size))
        fields.append((found["name"], kind))
    return fields


class _Idl:
    """Parser of message types in ROS's IDL text: modules, constants, typedefs and structs."""

    def __init__(self, text: str) -> None:
        found = _TOKEN.finditer(text)
        tokens = [one[0] for one in found if one["skip"] is None and not one[0].startswith("@")]
        self.records: dict[str, Fields] = {}
        self._left, self._scope, self._named = tokens[::-1], list[str](), dict[str, Any]()
        while self._left:
            word = self._next()
            if word == "module" and len(self._scope) < DEEPEST:
                self._scope.append(self._next())
                self._expect("{")
            elif word == "}" and self._scope:
                self._scope.pop()
                self._expect(";")
            elif word == "const":
                while self._next() != ";":
                    pass
            elif word == "typedef":
                name, kind = self._declared()
                self._named["/".join([*self._scope, name])] = kind
            elif word == "struct":
                fields = self.records[_full("/".join([*self._scope, self._next()]))] = []
                self._expect("{")
                while self._left and self._left[-1] != "}":
                    fields.append(self._declared())
                self._expect("}")
                self._expect(";")
            else:
                raise InputError(f"found {shown(word)} in IDL, expected a module or a struct")

    def _next(self) -> str:
        if not self._left:
            raise InputError("found IDL that ends early, expected all of it")
        return self._left.pop()

    def _expect(self, word: str) -> None:
        if (found := self._next()) != word:
            raise InputError(f"found {shown(found)} in IDL, expected {word!r}")

    def _declared(self) -> tuple[str, Any]:
        """Parse a field's declaration in IDL; return its name and type."""
        kind, name = self._kind(), self._next()
        if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise InputError(f"found {shown(name)} in IDL, expected a name")
        if self._left and self._left[-1] == "[":
            self._next()
            kind = (ARRAY, (self._one(kind), self._number()))
            self._expect("]")
        self._expect(";")
        return name, kind

    def _number(self) -> int:
        if not re.fullmatch(r"\d{1,9}", word := self._next(), re.ASCII):
            raise InputError(f"found {shown(word)} in IDL, expected a number below 1e9")
        return int(word)

    def _one(self, kind: Any) -> Any:
        if kind[0] not in (BASE, NAME):
            raise InputError("found arrays of arrays in IDL, expected arrays of one dimension")
        return kind

    def _kind(self) -> Any:
        """Parse the type of a field in IDL."""
        word = self._next()
        while self._left and f"{word} {self._left[-1]}" in (*_IDL_NUMBERS, "unsigned long"):
            word = f"{word} {self._next()}"
        if word in ("sequence", "string"):
            kind: Any = (BASE, ("string", 0))
            if word == "sequence":
                self._expect("<")
                self._one((SEQUENCE,) if self._left[-1:] == ["sequence"] else kind)
                kind = (SEQUENCE, (self._one(self._kind()), 0))
            bound = self._left and self._left[-1] == ("," if word == "sequence" else "<")
            if bound:
                self._next()
                self._number()
            if bound or word == "sequence":
                self._expect(">")
            return kind
        number = _IDL_NUMBERS.get(word, word)
        if re.fullmatch(_NUMBERS, number):
            return BASE, (number, 0)
        name = word.removeprefix("::").replace("::", "/")
        here = name if "::" in word else "/".join([*self._scope, name])
        return self._named.get(here) or (NAME, _full(here))
