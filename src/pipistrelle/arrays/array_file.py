"""Files of microphone arrays: the position, gain and face of each channel's microphone.

A file is ``array.csv``, a row per channel, in metres, in the vehicle's frame, x ahead and y to the
left:

.. code-block:: text

    channel,x,y,z,face,gain_db
    1,0.03,-0.02,0,front,0
    2,0.03,0.02,0,front,0

where ``z``, ``face`` and ``gain_db`` may be left out; or the XML of Acoular, ``<MicArray
name="..."><pos Name="..." x="..." y="..." z="..."/></MicArray>``, in its declared encoding, with
microphones numbered from 1 in the order of the file.
"""

import codecs
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import SQUARE, InputError, MicrophoneRow
from pipistrelle.files import check_ordinary, read_named, read_text, write_whole
from pipistrelle.refusals import refusal, shown
from pipistrelle.settings import ARRAY_KEY, Layer

MAX_MICROPHONES = 256
"""Most microphones of an array."""
MAX_BYTES = 1_000_000
"""Largest size of an array's file [byte]."""
MAX_EXTENT = 10.0
"""Largest width of an array [m]: a wider one is probably in millimetres."""
SAME_PLACE = 1e-4
"""Least distance of two microphones [m]."""
MAX_GAIN_DB = 100.0
"""Largest gain of a microphone, and its negative the smallest [dB]."""
REQUIRED = ("channel", "x", "y")
OPTIONAL = ("z", "face", "gain_db")
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
    b"<\0?\0": "utf-16-le",
    b"\0<\0?": "utf-16-be",
}
"""First bytes of XML in some encodings (XML 1.0, appendix F)."""
_DECLARED = re.compile(rb"""<\?xml\s[^>]*?\bencoding\s*=\s*(["'])(?P<name>[^"']*)\1""")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,40}")
"""Valid name of an encoding in XML."""
_ON_WINDOWS = {
    "shift_jis": "cp932",
    "gb2312": "gb18030",
    "gbk": "gb18030",
    "big5": "cp950",
    "euc_kr": "cp949",
}
"""Encodings to which Windows adds characters under the same name."""
_OF_PYTHON = ("idna", "punycode", "undefined", "unicode-escape", "unicode_escape",
              "raw-unicode-escape", "raw_unicode_escape")  # fmt: skip
"""Python codecs that are not encodings of files."""
_FACE = re.compile(r"[\w-]{0,40}")
_LIMITS = {"x": 1e6, "y": 1e6, "z": 1e6, "gain_db": MAX_GAIN_DB}


@dataclass(frozen=True, slots=True, kw_only=True)
class Microphones:
    """The microphones of an array, a row per channel."""

    channel: Int[np.ndarray, " m"]
    """Channel number: without gaps, from 0 or 1, in the order of a recording's channels."""
    position: Float[np.ndarray, "m 3"]
    """Position in the vehicle's frame: x ahead, y to the left, z up [m]."""
    gain_db: Float[np.ndarray, " m"]
    """Gain relative to the others, at equal noise [dB]."""
    face: tuple[str, ...]
    """Name of its face on the vehicle; empty without a face."""


class _Row(NamedTuple):
    """One microphone of a file or setting."""

    place: str
    """Line of the file, or row of the setting."""
    channel: int
    x: float
    y: float
    z: float = 0.0
    face: str = ""
    gain_db: float = 0.0


def read_array(path: Path, *, some: bool = False) -> Microphones:
    r"""Read the microphones of a file, CSV or Acoular's XML, sorted by channel.

    `some`: whether the channels are a subset of a recording's, counted from 1. Raises InputError
    with file, line and column if the file is not an array, or has fewer than two microphones, two
    in one position, a channel twice or missing, numbers that are not finite, or coordinates in
    millimetres.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     path = Path(place) / "array.csv"
    ...     _ = path.write_text("channel,x,y\n1,0.0,-0.02\n2,0.0,0.02\n")
    ...     read_array(path).position[:, 1]
    array([-0.02,  0.02])
    """
    check_ordinary(path)
    if path.exists() and (size := path.stat().st_size) > MAX_BYTES:
        expected = f"an array of at most {MAX_MICROPHONES} microphones"
        raise refusal(path, f"{size / 1e6:.1f} MB", expected, "name the file of an array")
    text = _text_of_xml(path, read_named(path, "a readable text file"))
    rows = list(_rows_of_csv(path, read_text(path)) if text is None else _rows_of_xml(path, text))
    rows.sort(key=lambda row: row.channel)
    return _checked(str(path), rows, some=some)


def microphones_of(rows: Sequence[MicrophoneRow], where: str = "receiver.array") -> Microphones:
    """Return the microphones of a setting's rows: x, y, z [m], gain [dB] and face of each.

    >>> microphones_of([(0.0, 0.1, 0.0, 0.0, ""), (0.0, -0.1, 0.0, 0.0, "")]).channel
    array([1, 2])
    """
    numbered = enumerate(rows, start=1)
    return _checked(
        where,
        [
            _Row(f"row {n}", n, x=x, y=y, z=z, gain_db=gain_db, face=face)
            for n, (x, y, z, gain_db, face) in numbered
        ],
    )


def with_array(layer: Layer) -> Layer:
    """Replace the name of an array's file in a layer of settings by its microphones."""
    given = layer.get(ARRAY_KEY)
    if given is None or not isinstance(given.value, str) or given.value in ("", SQUARE):
        return layer
    try:
        found = read_array(Path(given.value))
    except InputError as error:
        raise InputError(f"{given.where}: {error}") from None
    columns = found.position.tolist(), found.gain_db.tolist(), found.face
    rows = [[*place, gain_db, face] for place, gain_db, face in zip(*columns, strict=True)]
    return layer | {ARRAY_KEY: given._replace(value=rows)}


def _checked(where: str, rows: list[_Row], *, some: bool = False) -> Microphones:
    """Make microphones of rows sorted by channel; raise if they are not an array."""
    _check_channels(where, rows, some=some)
    _check_places(where, rows)
    return Microphones(
        channel=np.array([row.channel for row in rows]),
        position=np.array([(row.x, row.y, row.z) for row in rows]),
        gain_db=np.array([row.gain_db for row in rows]),
        face=tuple(row.face for row in rows),
    )


def array_text(microphones: Microphones) -> str:
    r"""Format microphones as a CSV file, without columns of zeros or empty names.

    >>> pair = Microphones(channel=np.arange(2), position=np.array([[0, 0, 0], [0, 0.1, 0]]),
    ...                    gain_db=np.zeros(2), face=("", ""))
    >>> array_text(pair)
    'channel,x,y\n0,0.0,0.0\n1,0.0,0.1\n'
    """
    x, y, z = microphones.position.T.astype(float).tolist()
    columns = {"channel": microphones.channel.tolist(), "x": x, "y": y}
    if any(z):
        columns["z"] = z
    if any(microphones.face):
        columns["face"] = list(microphones.face)
    if microphones.gain_db.any():
        columns["gain_db"] = microphones.gain_db.tolist()
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(v if isinstance(v, str) else repr(v) for v in row) for row in rows]
    return "\n".join([",".join(columns), *lines, ""])


def write_array(path: Path, microphones: Microphones) -> None:
    """Write microphones as a new CSV file for `read_array`; raise if the file exists."""
    try:
        write_whole(path, array_text(microphones).encode(), replace=False)
    except FileExistsError:
        raise refusal(path, "a file", "a new name", "name another, or move it away") from None


def _rows_of_csv(path: Path, text: str) -> Iterator[_Row]:
    """Yield the microphones of a CSV file; blank lines and lines with # are skipped."""
    numbered = enumerate(text.splitlines(), start=1)
    content = [(line, row) for line, row in numbered if row.strip() and row[0] != "#"]
    expected = f"the header {','.join(REQUIRED)!r}, perhaps followed by {', '.join(OPTIONAL)}"
    if not content:
        raise refusal(path, "no rows", expected, "add a row for each microphone")
    line, header = content.pop(0)
    names = [name.strip().strip('"') for name in header.split(",")]
    more = names[len(REQUIRED) :]
    known = len(set(more)) == len(more) and set(more) <= set(OPTIONAL)
    if tuple(names[: len(REQUIRED)]) != REQUIRED or not known:
        fix = "part the columns by commas" if ";" in header or "\t" in header else "name them so"
        raise refusal(f"{path}, line {line}", shown(header), expected, fix)
    for line, row in content:
        fields = [field.strip().strip('"') for field in row.split(",")]
        where = f"{path}, line {line}"
        if len(fields) != len(names):
            found = f"{len(fields)} fields in {shown(row)}"
            raise refusal(where, found, f"{len(names)}: {', '.join(names)}", "correct the row")
        yield _row(path, line, dict(zip(names, fields, strict=True)))


def _text_of_xml(path: Path, data: bytes) -> str | None:
    """Decode XML by its byte order mark, declaration or UTF-8; return None for other files."""
    marked = next((name for mark, name in _MARKS.items() if data.startswith(mark)), None)
    if marked is None and not data.lstrip().startswith(b"<"):
        return None
    declared = _DECLARED.match(data.lstrip()) if marked is None else None
    name = declared["name"].decode("ascii", "replace") if declared else marked or "utf-8-sig"
    found, text = f"XML in the encoding {shown(name)}", ""
    try:
        codec = codecs.lookup(name).name if _NAME.fullmatch(name) else _OF_PYTHON[0]
        if codec not in _OF_PYTHON:
            text = data.decode(_ON_WINDOWS.get(codec, codec)).lstrip("\ufeff").lstrip()
            text.encode()  # for the parser, which rejects lone surrogates
    except LookupError:
        pass
    except ValueError:
        found, text = f"XML whose bytes are no {name}", ""
    if text.startswith("<"):
        return text
    if marked is not None:
        return None
    expected = "XML in the encoding that it declares, UTF-8 or another that is known"
    raise refusal(path, found, expected, "save it as UTF-8, and declare that")


def _rows_of_xml(path: Path, text: str) -> Iterator[_Row]:
    """Return the microphones of Acoular's XML; raise at a document type (entities)."""
    rows: list[_Row] = []
    parser = expat.ParserCreate("utf-8")  # overrides the declared encoding, as the text is decoded
    expected = "Acoular's <MicArray><pos x=... y=... z=.../></MicArray>"

    def refuse_type(*_: object) -> None:
        where = f"{path}, line {parser.CurrentLineNumber}"
        raise refusal(where, "a document type", "plain XML", "take the line <!DOCTYPE ...> out")

    def begin(tag: str, fields: dict[str, str]) -> None:
        line = parser.CurrentLineNumber
        where = f"{path}, line {line}"
        if tag == "pos" and not all(axis in fields for axis in "xyz"):
            found = f"pos with {', '.join(fields) or 'nothing'}"
            raise refusal(where, found, "pos with x, y and z", "add the coordinates")
        if tag == "pos":
            number = {"channel": str(len(rows) + 1)}
            rows.append(_row(path, line, number | {axis: fields[axis] for axis in "xyz"}))

    parser.StartDoctypeDeclHandler, parser.StartElementHandler = refuse_type, begin
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        where = f"{path}, line {error.lineno}"
        raise refusal(where, expat.ErrorString(error.code), expected, "correct the file") from None
    if not rows:
        raise refusal(path, "XML without microphones", expected, "name the file of an array")
    return iter(rows)


def _row(path: Path, line: int, fields: dict[str, str]) -> _Row:
    """Return the microphone of a line's fields; raise at the first invalid field."""
    where, channel = f"{path}, line {line}", fields["channel"]
    if not (channel.isdecimal() and channel.isascii() and len(channel) < 10):
        found, expected = f"channel {shown(channel)}", "a whole number, from 0 or 1 on"
        raise refusal(where, found, expected, "number the channels of the recording")
    if not _FACE.fullmatch(face := fields.get("face", "")):
        expected = "up to 40 letters, digits, _ and -, or nothing for one that hangs free"
        raise refusal(where, f"face {shown(face)}", expected, "name it so")
    numbers = {}
    for name, limit in _LIMITS.items():
        field = fields.get(name, "") or ("0" if name in OPTIONAL else "")
        try:
            numbers[name] = float(field.replace("_", "?"))
        except ValueError:
            numbers[name] = math.nan
        if not abs(numbers[name]) <= limit:
            unit = "dB" if name == "gain_db" else "m"
            expected = f"a number between -{limit:g} and {limit:g} {unit}"
            raise refusal(where, f"{name} {shown(field)}", expected, "correct the field")
    return _Row(f"line {line}", channel=int(channel), face=face, **numbers)


def _check_channels(path: str, rows: list[_Row], *, some: bool) -> None:
    """Raise if sorted rows have wrong channel numbers, or gaps unless `some`."""
    if not 2 <= len(rows) <= MAX_MICROPHONES:
        found = f"{len(rows)} microphone" + "s" * (len(rows) != 1)
        expected = f"2 to {MAX_MICROPHONES}"
        raise refusal(path, found, expected, "one alone hears no direction; add the others")
    for before, row in pairwise(rows):
        where = f"{path}, {row.place}"
        if row.channel == before.channel:
            expected = f"it once, as in {before.place}"
            raise refusal(where, f"channel {row.channel} again", expected, "renumber one")
        if row.channel != before.channel + 1 and not some:
            found = f"channel {row.channel} after {before.channel}"
            fix = "add the row, or number the channels without gaps"
            raise refusal(where, found, f"channel {before.channel + 1}", fix)
    if some and rows[0].channel == 0:
        where = f"{path}, {rows[0].place}"
        fix = "number the recording's channels from 1"
        raise refusal(where, "channel 0", "1 or more", fix)
    if rows[0].channel > 1 and not some:
        where = f"{path}, {rows[0].place}"
        found = f"{rows[0].channel} as the first channel"
        raise refusal(where, found, "0 or 1", "add the rows, or number the channels from 1")


def _check_places(path: str, rows: list[_Row]) -> None:
    """Raise if microphones coincide, or are implausibly far from each other."""
    place = np.array([(row.x, row.y, row.z) for row in rows])
    extent = float(np.ptp(place, axis=0).max())
    if extent > MAX_EXTENT:
        expected, fix = f"at most {MAX_EXTENT:g} m", "if x, y, z are millimetres, divide by 1000"
        raise refusal(path, f"an array {extent:g} m wide", expected, fix)
    for m, row in enumerate(rows):
        near = np.flatnonzero(np.linalg.norm(place[:m] - place[m], axis=1) < SAME_PLACE)
        if near.size:
            other = rows[near[0]]
            found = f"channel {row.channel} where channel {other.channel} is ({other.place})"
            expected = "each microphone in a place of its own"
            raise refusal(f"{path}, {row.place}, x, y, z", found, expected, "correct one")
