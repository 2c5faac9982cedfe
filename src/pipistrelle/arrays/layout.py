"""Array geometry: line arrays on the faces of a vehicle, or microphones of a file.

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
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.parsers import expat

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import SQUARE, Config, InputError, MicrophoneRow, ReceiverConfig
from pipistrelle.files import check_ordinary, read_named, write_whole
from pipistrelle.geometry import wrap
from pipistrelle.refusals import refusal, shown
from pipistrelle.settings import ARRAY_KEY, Layer
from pipistrelle.text_tables import Schema, place_of, rows_kept, table_of, table_text

MAX_MICROPHONES = 256
"""Most microphones of an array."""
MAX_BYTES = 1_000_000
"""Largest size of an array's file [byte]."""
MAX_EXTENT = 10.0
"""Largest width of an array [m]: a wider one is probably in millimetres."""
SAME_PLACE = 1e-4
"""Least distance of two microphones [m]."""
ARRAY = Schema(
    file="array.csv",
    row="a row is a microphone, in the vehicle's frame: x ahead, y to the left",
    columns=("channel", "x", "y"),
    optional=("z", "face", "gain_db"),
)
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
"""Encodings that Windows extends under the same name."""
_OF_PYTHON = ("idna", "punycode", "undefined", "unicode-escape", "unicode_escape",
              "raw-unicode-escape", "raw_unicode_escape")  # fmt: skip
"""Python codecs that are not encodings of files."""
_FACE = re.compile(r"[\w-]{0,40}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Microphones:
    """Channels, positions, gains and faces of the microphones of an array."""

    channel: Int[np.ndarray, " m"]
    """Channel number: without gaps, from 0 or 1, in the order of a recording's channels."""
    position: Float[np.ndarray, "m 3"]
    """Position in the vehicle's frame: x ahead, y to the left, z up [m]."""
    gain_db: Float[np.ndarray, " m"]
    """Gain relative to the others, at equal noise [dB]."""
    face: tuple[str, ...]
    """Name of its face on the vehicle; empty without a face."""


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
    if text is None:
        table = ARRAY.read(path, words={"face": ()})
    else:
        table = table_of(path, (*ARRAY.columns, "z"), _rows_of_xml(path, text), ARRAY.optional)
    order = np.argsort(table.column["channel"], kind="stable")
    table = rows_kept(table, order)
    faces = tuple(name if isinstance(name, str) else "" for name in table.column["face"].tolist())
    for row, name in enumerate(faces):
        if not _FACE.fullmatch(name):
            expected = "up to 40 letters, digits, _ and -, or nothing for one that hangs free"
            raise refusal(place_of(table, row), f"face {shown(name)}", expected, "name it so")
    column = {name: np.nan_to_num(table.column[name]) for name in ("x", "y", "z", "gain_db")}
    gain_db = column.pop("gain_db")
    microphones = Microphones(
        channel=table.column["channel"],
        position=np.column_stack([*column.values()]),
        gain_db=gain_db,
        face=faces,
    )
    return _checked(str(path), [f"line {line}" for line in table.line], microphones, some=some)


def microphones_of(rows: Sequence[MicrophoneRow], where: str = "receiver.array") -> Microphones:
    """Build the microphones from rows of the settings: x, y, z [m], gain [dB] and face of each.

    >>> microphones_of([(0.0, 0.1, 0.0, 0.0, ""), (0.0, -0.1, 0.0, 0.0, "")]).channel
    array([1, 2])
    """
    microphones = Microphones(
        channel=np.arange(1, len(rows) + 1),
        position=np.array([row[:3] for row in rows]),
        gain_db=np.array([row[3] for row in rows]),
        face=tuple(row[4] for row in rows),
    )
    return _checked(where, [f"row {n}" for n in microphones.channel], microphones)


def with_array(layer: Layer) -> Layer:
    """Replace an array's file name in a layer of settings by the rows of its microphones."""
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


def _checked(
    where: str, places: Sequence[str], microphones: Microphones, *, some: bool = False
) -> Microphones:
    """Return sorted microphones unchanged; raise if number, channels or positions are invalid.

    `places`: their lines or rows, for errors; `some`: as in `read_array`.
    """
    channels = microphones.channel.tolist()
    if not 2 <= len(channels) <= MAX_MICROPHONES:
        found = f"{len(channels)} microphone" + "s" * (len(channels) != 1)
        expected = f"2 to {MAX_MICROPHONES}"
        raise refusal(where, found, expected, "one alone hears no direction; add the others")
    for row, (earlier, channel) in enumerate(pairwise(channels), start=1):
        place = f"{where}, {places[row]}"
        if channel == earlier:
            found, expected = f"channel {channel} again", f"it once, as in {places[row - 1]}"
            raise refusal(place, found, expected, "renumber one")
        if channel != earlier + 1 and not some:
            fix = "add the row, or number the channels without gaps"
            raise refusal(
                place, f"channel {channel} after {earlier}", f"channel {earlier + 1}", fix
            )
    first = f"{where}, {places[0]}"
    if some and channels[0] == 0:
        raise refusal(first, "channel 0", "1 or more", "number the recording's channels from 1")
    if channels[0] > 1 and not some:
        found, fix = f"{channels[0]} as the first channel", "add the rows, or number them from 1"
        raise refusal(first, found, "0 or 1", fix)
    position = microphones.position
    extent = float(np.ptp(position, axis=0).max())
    if extent > MAX_EXTENT:
        expected, fix = f"at most {MAX_EXTENT:g} m", "if x, y, z are millimetres, divide by 1000"
        raise refusal(where, f"an array {extent:g} m wide", expected, fix)
    for m, place in enumerate(places):
        near = np.flatnonzero(np.linalg.norm(position[:m] - position[m], axis=1) < SAME_PLACE)
        if near.size:
            other = f"channel {channels[near[0]]} is ({places[near[0]]})"
            found, expected = f"channel {channels[m]} where {other}", "microphones apart"
            raise refusal(f"{where}, {place}, x, y, z", found, expected, "correct one")
    return microphones


def array_text(microphones: Microphones) -> str:
    r"""Format microphones as a CSV file, without columns of zeros or empty names.

    >>> pair = Microphones(channel=np.arange(2), position=np.array([[0, 0, 0], [0, 0.1, 0]]),
    ...                    gain_db=np.zeros(2), face=("", ""))
    >>> array_text(pair)
    'channel,x,y\n0,0.0,0.0\n1,0.0,0.1\n'
    """
    x, y, z = microphones.position.T.astype(float)
    column = {"channel": microphones.channel, "x": x, "y": y}
    if z.any():
        column["z"] = z
    if any(microphones.face):
        column["face"] = np.array(microphones.face)
    if microphones.gain_db.any():
        column["gain_db"] = microphones.gain_db
    return table_text(column)


def write_array(path: Path, microphones: Microphones) -> None:
    """Write microphones as a new CSV file for `read_array`; raise if the file exists."""
    try:
        write_whole(path, array_text(microphones).encode(), replace=False)
    except FileExistsError:
        raise refusal(path, "a file", "a new name", "name another, or move it away") from None


def _text_of_xml(path: Path, data: bytes) -> str | None:
    """Decode a file's bytes if they are XML, as declared or in UTF-8; return None otherwise."""
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


def _rows_of_xml(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """Return line number and fields of each microphone in Acoular's XML; raise if it is invalid."""
    rows: list[tuple[int, list[str]]] = []
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
            rows.append((line, [str(len(rows) + 1), *(fields[axis].strip() for axis in "xyz")]))

    parser.StartDoctypeDeclHandler, parser.StartElementHandler = refuse_type, begin
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        where = f"{path}, line {error.lineno}"
        raise refusal(where, expat.ErrorString(error.code), expected, "correct the file") from None
    if not rows:
        raise refusal(path, "XML without microphones", expected, "name the file of an array")
    return rows


LINE_TOLERANCE = 1e-5
"""Largest deviation of a microphone from its position on a line [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Equal, back-baffled line arrays on faces, with the vehicle's position as phase centre.

    An element receives within 90 degrees of its face's normal. The faces' offsets from the centre
    (some 25 mm) are neglected: they would shift delays by less than 0.1 ms.
    """

    normal: Float[np.ndarray, " f"]
    """Direction of each face's normal, relative to the heading [rad]."""
    position: Float[np.ndarray, " e"]
    """Elements along a face, positive to the left of its normal, centred on 0 [m]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of faces, and number of microphones per face."""
        return self.normal.size, self.position.size

    def members(self, g: int) -> tuple[int, Int[np.ndarray, " k"]]:
        """Return a face's index in a recording, and its microphones' indices within the face."""
        return g, np.arange(self.position.size)

    def places(self, g: int) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return positions of a face's microphones in the vehicle's frame [m], and their gains."""
        left = np.array([-np.sin(self.normal[g]), np.cos(self.normal[g])])
        return np.outer(self.position, left), np.ones(self.position.size)

    def phases(
        self, angle: Float[np.ndarray, "*n"] | float, frequency: float, speed_of_sound: float
    ) -> Float[np.ndarray, "*n e"]:
        r"""Return a plane wave's phases [rad] at a face's elements, by angle off the face's normal.

        .. math:: \varphi_e(\theta) = 2\pi f \, y_e \sin\theta / c

        `angle` [rad]; `frequency` [Hz]; `speed_of_sound` [m/s].

        >>> pair = Layout(normal=np.zeros(1), position=np.array([0.0, 0.0049]))
        >>> pair.phases(np.pi / 2, 35e3, 343.0).round(9)
        array([0.        , 3.14159265])
        """
        lead = np.multiply.outer(np.sin(angle), self.position) / speed_of_sound
        return 2.0 * np.pi * frequency * lead


@dataclass(frozen=True, slots=True, kw_only=True)
class Scattered:
    """Microphones at any positions on the vehicle, in groups that form separate beams.

    A plane wave reaches a microphone at p earlier than the vehicle's centre by p . u / c, with u
    the unit vector to the source. Sound travels horizontally: heights are ignored.
    """

    position: Float[np.ndarray, "e 2"]
    """In the vehicle's frame, x ahead and y to the left [m]."""
    amplitude: Float[np.ndarray, " e"]
    """Gain of each microphone; the noise of all is the same."""
    group: Int[np.ndarray, " e"]
    """Number of each microphone's group."""
    normal: Float[np.ndarray, " f"]
    """Normal of each group [rad]: a line on a face receives within 90 degrees of it; NaN for a
    group that receives from all directions."""
    name: tuple[str, ...]
    """Name of the face of each group; empty for microphones without a face."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a recording's face and microphone axes: 1, and the number of microphones."""
        return 1, len(self.position)

    def members(self, g: int) -> tuple[int, Int[np.ndarray, " k"]]:
        """Return 0, the only face index of a recording, and a group's microphone indices there."""
        return 0, np.flatnonzero(self.group == g)

    def places(self, g: int) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Return positions of a group's microphones in the vehicle's frame [m], and their gains."""
        _, members = self.members(g)
        return self.position[members], self.amplitude[members]

    def lead(self, bearing: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n e"]:
        """Return each microphone's distance ahead of the centre, towards bearings [rad], in metres.

        >>> pair = scattered(microphones_of([(0.1, 0, 0, 0, ""), (0, 0.2, 0, 0, "")]))
        >>> pair.lead(np.pi / 2).round(9)
        array([0. , 0.2])
        """
        toward = np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
        return toward @ self.position.T


def layout_of(config: Config) -> Layout | Scattered:
    """Build the array of the settings: line arrays on a square, or microphones at any positions."""
    if config.receiver.array == SQUARE:
        return square_of_four(config.receiver)
    return scattered(microphones_in(config))


def microphones_in(config: Config) -> Microphones:
    """Return the microphones of the settings: of the square, of a file, or listed."""
    array = config.receiver.array
    if array == SQUARE:
        return square_microphones(config.receiver)
    return read_array(Path(array)) if isinstance(array, str) else microphones_of(array)


def scattered(microphones: Microphones, where: str = "receiver.array") -> Scattered:
    """Group the microphones of an array by face; microphones without a face form a group.

    A face whose microphones have equal gains and form an equally spaced line receives on one side,
    away from the middle of the array; for a line through the middle, the side with its last channel
    on the left. `where`: origin of the microphones, for errors.

    >>> front = [(0.03, -0.02, 0, 0, "front"), (0.03, 0.02, 0, 0, "front")]
    >>> stern = [(-0.05, 0.0, 0, 0, ""), (-0.05, 0.01, 0, 0, "")]
    >>> array = scattered(microphones_of([*front, *stern]))
    >>> array.name, abs(array.normal.round(9)), array.group
    (('', 'front'), array([nan,  0.]), array([1, 1, 0, 0]))
    """
    place, names = microphones.position[:, :2], tuple(sorted(set(microphones.face)))
    group = np.array([names.index(face) for face in microphones.face])
    for name, count in zip(names, np.bincount(group), strict=True):
        if count < 2:
            found = "on face " + name if name else "that hangs free"
            expected = "two or more, as one alone hears no direction; add one, or leave it out"
            raise InputError(f"{where}: found one microphone {found}, expected {expected}")
    middle, gain = place.mean(axis=0), microphones.gain_db
    normal = [
        _normal(place[group == g], middle) if name and np.ptp(gain[group == g]) == 0.0 else np.nan
        for g, name in enumerate(names)
    ]
    return Scattered(
        position=place,
        amplitude=10.0 ** (gain / 20.0),
        group=group,
        normal=np.array(normal),
        name=names,
    )


def at_one_centre(microphones: Microphones, where: str) -> tuple[Layout, Int[np.ndarray, "f e"]]:
    """Build equal line arrays at the vehicle's position; also return each element's microphone.

    Faces are sorted by their first channels; `where`: their origin, for errors.

    >>> layout, microphone = at_one_centre(square_microphones(ReceiverConfig(elements=2)), "")
    >>> layout.shape, microphone.tolist()
    ((4, 2), [[0, 1], [2, 3], [4, 5], [6, 7]])
    """
    array = scattered(microphones, where)
    if np.isnan(array.normal).any():
        odd = array.name[int(np.argmax(np.isnan(array.normal)))]
        found = f"{odd!r}, which is no evenly spaced line of them" if odd else "microphones alone"
        raise InputError(f"{where}: found {found}, expected lines on faces where one_centre is set")
    lines = [along_line(array, g) for g in range(array.normal.size)]
    lines.sort(key=lambda line: int(line[0].min()))  # by their first microphones
    positions = [line.position for _, line in lines]
    alike = len({place.size for place in positions}) == 1
    if not alike or np.ptp(positions, axis=0).max() > LINE_TOLERANCE:
        expected = "lines of one length and spacing where one_centre is set"
        raise InputError(f"{where}: found faces that are not alike, expected {expected}")
    normal = np.array([line.normal[0] for _, line in lines])
    members = np.array([numbers for numbers, _ in lines])
    return Layout(normal=normal, position=np.mean(positions, axis=0)), members


def square_microphones(receiver: ReceiverConfig) -> Microphones:
    """Return the microphones of the square array, on four faces around the vehicle's centre.

    >>> square_microphones(ReceiverConfig()).position.shape
    (40, 3)
    """
    square, rows = square_of_four(receiver), []
    reach = 0.5 * (np.ptp(square.position) + receiver.spacing)
    for name, normal in zip(("front", "left", "back", "right"), square.normal, strict=True):
        ahead, left = np.array([np.cos(normal), np.sin(normal)]), (-np.sin(normal), np.cos(normal))
        for along in square.position:
            x, y = reach * ahead + along * np.array(left)
            rows.append((float(x), float(y), 0.0, 0.0, name))
    return microphones_of(rows)


def along_line(layout: Scattered, g: int) -> tuple[Int[np.ndarray, " k"], Layout]:
    """Return the indices of a line array's microphones from right to left, and its layout."""
    _, members = layout.members(g)
    left = np.array([-np.sin(layout.normal[g]), np.cos(layout.normal[g])])
    along = layout.position[members] @ left
    order = np.argsort(along)
    return members[order], Layout(
        normal=layout.normal[g : g + 1],
        position=(np.arange(along.size) - 0.5 * (along.size - 1))
        * np.ptp(along)
        / (along.size - 1),
    )


def _normal(place: Float[np.ndarray, "k 2"], middle: Float[np.ndarray, "2"]) -> float:
    """Return the direction of a line's outward normal; NaN if microphones are not on a line."""
    centre = place.mean(axis=0)
    far = place[np.argmax(np.linalg.norm(place - place[0], axis=1))] - place[0]
    along = far / max(np.linalg.norm(far), LINE_TOLERANCE)
    order = np.argsort(place @ along)
    regular = np.linspace(place[order[0]], place[order[-1]], len(place))
    if np.abs(place[order] - regular).max() > LINE_TOLERANCE:
        return np.nan
    along *= np.sign((place[-1] - place[0]) @ along)
    normal = np.array([along[1], -along[0]])
    outward = (centre - middle) @ normal
    if outward < -LINE_TOLERANCE:
        normal = -normal
    return float(wrap(np.arctan2(normal[1], normal[0])))


def square_of_four(receiver: ReceiverConfig) -> Layout:
    """Return the layout of four equal line arrays, facing front, left, back and right.

    `receiver` has the number of elements and their spacing [m]. Bradley & Abaid, Sec. II-C.

    >>> layout = square_of_four(ReceiverConfig())
    >>> np.degrees(layout.normal).tolist()
    [0.0, 90.0, -180.0, -90.0]
    >>> round(float(np.ptp(layout.position)), 4)
    0.0441
    """
    index = np.arange(receiver.elements)
    return Layout(
        normal=np.array([0.0, 0.5, -1.0, -0.5]) * np.pi,
        position=(index - 0.5 * (receiver.elements - 1)) * receiver.spacing,
    )
