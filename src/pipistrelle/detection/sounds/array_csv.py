"""``array.csv``: where the microphone of each channel is; of a square of equal line arrays."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arrays.layout import Layout
from pipistrelle.detection.logs.text_tables import check_unique, place_of, read_table, table_text
from pipistrelle.refusals import refusal

FILE = "array.csv"
_COLUMNS = ("channel", "x", "y", "face")
_EXACT = 1e-5
"""How far a microphone may be off its place in the square [m]."""


class Microphones(NamedTuple):
    """A layout, and which channel each of its elements is."""

    layout: Layout
    channel: Int[np.ndarray, "f e"]
    """Numbers of the channels in a sound file, from 0 on."""


def array_text(layout: Layout) -> str:
    """Return ``array.csv`` of a layout whose channels go face by face, from the right to the left.

    The faces are the sides of a square: half a side's length before the vehicle's point.

    >>> layout = Layout(normal=np.array([0.0, np.pi]), position=np.array([-0.002, 0.002]))
    >>> print(array_text(layout))
    channel,x,y,face
    1,0.004,-0.002,1
    2,0.004,0.002,1
    3,-0.004,0.002,2
    4,-0.004,-0.002,2
    <BLANKLINE>
    """
    elements = layout.position.size
    side = 0.5 * float(np.ptp(layout.position)) * elements / (elements - 1)
    c, s = np.cos(layout.normal)[:, None], np.sin(layout.normal)[:, None]
    x, y = side * c - layout.position * s, side * s + layout.position * c
    face = np.repeat(np.arange(1, layout.normal.size + 1), elements)
    places = (np.round(column.ravel(), 9) + 0.0 for column in (x, y))
    return table_text(_COLUMNS, np.arange(1, face.size + 1), *places, face)


def read_array(path: Path) -> Microphones:
    r"""Read ``array.csv``: faces of equal line arrays that look away from their middle.

    >>> from tempfile import TemporaryDirectory
    >>> rows = "1,0.004,-0.002,1\n2,0.004,0.002,1\n3,-0.004,0.002,2\n4,-0.004,-0.002,2\n"
    >>> with TemporaryDirectory() as place:
    ...     _ = (Path(place) / "array.csv").write_text("channel,x,y,face\n" + rows)
    ...     layout, channel = read_array(Path(place) / "array.csv")
    >>> layout.normal.round(3), layout.position, channel.tolist()
    (array([ 0.   , -3.142]), array([-0.002,  0.002]), [[0, 1], [2, 3]])
    """
    table = read_table(path, _COLUMNS)
    check_unique(table, "channel")
    channel, face = table.column["channel"], table.column["face"]
    for name, column in (("channel", channel), ("face", face)):
        wrong = (column != np.rint(column)) | (column < 1) | (column > 1024)
        if wrong.any():
            where, value = place_of(table, int(np.argmax(wrong))), column[np.argmax(wrong)]
            raise refusal(
                where, f"{name} {value.item()!r}", "a whole number from 1 on", "number it"
            )
    place = np.column_stack((table.column["x"], table.column["y"]))
    middle, rows = place.mean(axis=0), [np.flatnonzero(face == f) for f in np.unique(face)]
    normal, position, order = [], [], []
    for row in rows:
        angle, along = _line(path, int(face[row[0]]), place[row] - middle)
        order.append(row[np.argsort(along)])
        normal.append(angle)
        position.append(np.sort(along))
    if len({len(row) for row in rows}) > 1 or np.ptp(np.array(position), axis=0).max() > _EXACT:
        raise refusal(path, "faces that are not alike", "equal line arrays", "correct the places")
    layout = Layout(normal=np.array(normal), position=np.mean(position, axis=0))
    return Microphones(layout, channel[np.array(order)].astype(np.int64) - 1)


def _line(
    path: Path, face: int, place: Float[np.ndarray, "e 2"]
) -> tuple[float, Float[np.ndarray, " e"]]:
    """Return the direction in which a face looks [rad], and its elements' places along it [m]."""
    centre = place.mean(axis=0)
    away = float(np.hypot(*centre))
    if len(place) < 2 or away < _EXACT:
        found = "one microphone" if len(place) < 2 else "a face through the middle of all"
        raise refusal(f"{path}, face {face}", found, "a line beside it", "correct the places")
    ahead = centre / away
    deep, along = (place - centre) @ ahead, (place - centre) @ np.array([-ahead[1], ahead[0]])
    if np.abs(deep).max() > _EXACT or np.diff(np.sort(along)).min() < _EXACT:
        expected = "a line across the direction in which it looks, away from the middle of all"
        raise refusal(f"{path}, face {face}", "no such line", expected, "correct the places")
    angle = np.arctan2(ahead[1], ahead[0])
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi), along
