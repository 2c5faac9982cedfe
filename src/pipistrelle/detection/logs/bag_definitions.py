"""Definitions of ROS messages, as the text in a bag gives them, and the types that decode messages.

rosbags makes Python source of a definition: a text of 30 bytes, ``string[20000000] x``, becomes
gigabytes of it, and its parsers evaluate arithmetic of any size. The text in a bag is therefore
read here, in a time that grows with its length, and compared with the known definition. Where
both describe the same bytes, the known types decode the messages. Where the text has further
fields, its types do, if they are few. A text that lacks a known field, or gives it another type,
is refused.
"""

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from pipistrelle.config import InputError
from pipistrelle.detection.logs.bag_messages import DEFINITIONS
from pipistrelle.refusals import refusal, shown

LONGEST = 200_000
"""Longest text of a definition [characters]; ROS's longest have some 20,000, mostly comments."""
MOST_PARTS = 300
"""Most fields that a message may have, elements of its arrays of records and texts included. An
`Odometry` has 29, and rosbags compiles 300 within a second."""
DEEPEST = 20
"""Most records within one another; ROS's own have 5."""

Fields = list[tuple[str, Any]]
"""Names and types of fields; a type is described as rosbags does: kind, and name or element."""
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of types: a number or text, a record, an array of fixed length, a list."""
_NUMBERS = r"bool|byte|char|float(?:32|64)|u?int(?:8|16|32|64)"
_SHORT = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_PART = re.compile(r"^=+[ \t]*\n", re.MULTILINE)
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
    """Return the types (rosbags' store) that decode messages of one type.

    `text`: the definition in the bag, perhaps empty; `idl`: in which language; `first`: of ROS 1.
    """
    known = _known(first, latest=False)
    if name not in known.fielddefs:
        raise InputError(f"found the type {shown(name)}, expected one that ROS or we define")
    if not text.strip():
        return known
    told = read_definition(name, text, idl=idl)
    there = {one: fields for one, (_, fields) in known.fielddefs.items()} | told
    same, fault = _compared(name, there, known.fielddefs)
    if not same and not first:
        latest = _known(first, latest=True)
        if _compared(name, there, latest.fielddefs)[0]:
            return latest
    if fault:
        raise refusal(f"the definition of {name}", *fault, "write ROS's own definition")
    return known if same else _registered(name, there)


@cache
def _known(first: bool, *, latest: bool) -> Any:
    """Return the types that rosbags and we know, of ROS 1 or of one of the versions of ROS 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    second = Stores.LATEST if latest else Stores.ROS2_HUMBLE
    store = get_typestore(Stores.ROS1_NOETIC if first else second)
    for known, fields in DEFINITIONS.items():
        store.register(get_types_from_msg(fields, known))
    return store


def _compared(
    name: str, told: Mapping[str, Fields], known: Mapping[str, Any]
) -> tuple[bool, tuple[str, str] | None]:
    """Return whether two types are the same bytes, and what is there in place of a known field."""
    there, fields = dict(told[name]), known[name][1]
    same, fault = [one for one, _ in told[name]] == [one for one, _ in fields], None
    for field, kind in fields:
        found, expected = _bytes_of(there.get(field)), _bytes_of(kind)
        if found != expected:
            fault = fault or (f"{name}: {field} as {_words(found)}", _words(expected))
        elif (inner := _record(kind)) is not None:
            alike, within = _compared(inner, told, known)
            same, fault = same and alike, fault or within
    return same and fault is None, fault


def _bytes_of(kind: Any) -> Any:
    """Return a type without what its bytes do not depend on, the bounds of texts and lists."""
    if kind is None or kind[0] == NAME:
        return kind if kind is None else (NAME, kind[1])
    if kind[0] == BASE:
        return BASE, kind[1][0]
    return kind[0], _bytes_of(kind[1][0]), kind[1][1] if kind[0] == ARRAY else 0


def _words(kind: Any) -> str:
    """Write a type."""
    if kind is None:
        return "nothing"
    if kind[0] in (BASE, NAME):
        return kind[1]
    return f"{_words(kind[1])}[{kind[2] if kind[0] == ARRAY else ''}]"


def _record(kind: Any) -> str | None:
    """Return the name of the record that a field is, or is made of."""
    one = kind if kind[0] in (BASE, NAME) else kind[1][0]
    return one[1] if one[0] == NAME else None


def _registered(name: str, types: Mapping[str, Fields]) -> Any:
    """Return a store of a type and of all that it is made of; refuse a large one."""
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
    """Return how many fields a type has, those of its fields included."""
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
    r"""Read the definitions of a type and of the records in it, by the names of types.

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
        made = _of_idl(rest) if language == "IDL" else {owner: _of_msg(rest, owner)}
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
    """Return the name of a type with its package and ``/msg/``."""
    name = _SHORT.get(name, name)
    if "/" not in name and owner:
        name = f"{owner.rpartition('/')[0]}/{name}"
    if not _TYPE.fullmatch(name):
        raise InputError(f"found {shown(name)}, expected the name of a type")
    package, *_, last = name.split("/")
    return name if name.count("/") == 2 else f"{package}/msg/{last}"


def _of_msg(text: str, owner: str) -> Fields:
    """Read the fields of a type in ROS's own language, one on a line."""
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


def _of_idl(text: str) -> dict[str, Fields]:
    """Read the records of IDL, as far as ROS writes it: modules, constants, typedefs, structs."""
    tokens = [
        found[0]
        for found in _TOKEN.finditer(text)
        if found["skip"] is None and not found[0].startswith("@")
    ]
    return _Idl(tokens).records


class _Idl:
    """The records of a list of tokens."""

    def __init__(self, tokens: list[str]) -> None:
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
                self._struct("/".join([*self._scope, self._next()]))
            else:
                raise InputError(f"found {shown(word)} in IDL, expected a module or a struct")

    def _next(self) -> str:
        if not self._left:
            raise InputError("found IDL that ends early, expected all of it")
        return self._left.pop()

    def _expect(self, word: str) -> None:
        if (found := self._next()) != word:
            raise InputError(f"found {shown(found)} in IDL, expected {word!r}")

    def _struct(self, name: str) -> None:
        self._expect("{")
        fields = self.records[_full(name)] = []
        while self._left and self._left[-1] != "}":
            fields.append(self._declared())
        self._expect("}")
        self._expect(";")

    def _declared(self) -> tuple[str, Any]:
        """Read a type and a name, perhaps with the length of an array."""
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
        """Read a type."""
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
