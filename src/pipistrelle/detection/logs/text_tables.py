"""Text tables: columns of numbers, parsed with errors that name the line.

A valid file is parsed at once, 60,000 rows in some hundredths of a second; any other, row by row.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import FARTHEST, FASTEST, LARGEST, LEAST_STD, WIDEST
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.files import read_text
from pipistrelle.refusals import refusal

_LABELS = ("landmark", "subject", "barcode")
_LABEL_IT = (
    "number what your sensor tells apart, the same whenever it is seen, and clutter "
    f"{UNLABELLED}; or leave the field empty in every row, for --association.method to decide"
)
_BOUNDS = {
    "range": ("m", 1.0 / LARGEST, FARTHEST),
    "bearing_std": ("rad", LEAST_STD, WIDEST),
    "range_std": ("m", LEAST_STD, FARTHEST),
    "excess_path": ("m", 0.0, FARTHEST),
    "excess_path_std": ("m", LEAST_STD, FARTHEST),
    "bearing_slope": ("rad", -FASTEST, FASTEST),
    "radius": ("m", 1.0 / LARGEST, LARGEST),
    "velocity": ("m/s", -FASTEST, FASTEST),
    "speed": ("m/s", -FASTEST, FASTEST),
    "angular_rate": ("rad/s", -WIDEST, WIDEST),
    "steering": ("rad", -WIDEST, WIDEST),
}
"""Unit, smallest and largest value of a column."""
FORMER_NAMES = MappingProxyType({"detour": "excess_path", "detour_std": "excess_path_std"})
"""Former names of columns and keys of logs, and their present names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The checked rows of a text file: numbers are finite, and times never decrease."""

    path: Path | str
    """The file; for a bag, with the topic."""
    line: Int[np.ndarray, " n"]
    """Line of each row in the file, from 1; for a bag, its message in the topic."""
    unit: str = "line"
    """The noun of `line` in errors."""
    column: dict[str, np.ndarray]
    """Values by column; labels are integers, missing values NaN."""
    former: tuple[str, ...] = ()
    """Former names of columns in the file (`FORMER_NAMES`)."""


def read_table(
    path: Path,
    columns: tuple[str, ...],
    *,
    separator: str | None = ",",
    optional: tuple[str, ...] = (),
    in_order: bool = True,
    words: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> Table:
    r"""Read a text file of columns of numbers; blank lines and lines with ``#`` are skipped.

    Columns are checked by name: ``time`` never decreases, ``range`` and the standard deviations are
    positive, labels are integers.

    `columns` must be in the header; without a `separator` there is none, and fields are separated
    by white space. Fields of `optional` columns may be empty; a column that is not in the header is
    empty in every row. `in_order`: whether further columns must follow in this order. `words`:
    words of a column, replaced by their indices. Raises InputError with the file and the line.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     path = Path(place) / "posts.csv"
    ...     _ = path.write_text("landmark,x\n4,1.5\n7,-2.0\n")
    ...     table = read_table(path, ("landmark", "x"))
    >>> table.column["landmark"], table.column["x"], table.line
    (array([4, 7]), array([ 1.5, -2. ]), array([2, 3]))
    """
    lines = read_text(path).splitlines()
    content = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    former: tuple[str, ...] = ()
    if content and separator:
        line, header = content.pop(0)
        found = [name.strip().strip('"') for name in header.split(separator)]
        former = tuple(name for name in found if name in FORMER_NAMES)
        names = [FORMER_NAMES.get(name, name) for name in found]
        more = tuple(name for name in optional if name not in columns)
        extra, there = names[len(columns) :], [name for name in more if name in names]
        sound = extra == there if in_order else sorted(extra) == sorted(there)
        if names[: len(columns)] != [*columns] or not sound:
            expected = f"the header {separator.join(columns)!r}"
            expected += f", perhaps followed by {', '.join(more)}" * bool(more)
            where, found = f"{path}, line {line}", repr(header[:80])
            missing = "landmark" not in names and "bearing" in {*columns} & {*names}
            raise refusal(where, found, expected, _LABEL_IT if missing else "name the columns so")
        columns = tuple(names)
    if not content:
        expected = f"rows of {', '.join(columns)}"
        raise refusal(path, "no rows", expected, "add them")
    content = [(i, _numbered(f"{path}, line {i}", line, columns, words)) for i, line in content]
    values = _read_at_once([text for _, text in content], len(columns), separator)
    if values is None:
        rows = [_read_row(path, columns, separator, optional, *item) for item in content]
        values = np.array(rows)
    column = dict(zip(columns, values.T.copy(), strict=True))
    column |= {name: np.full(len(values), np.nan) for name in optional if name not in column}
    table = Table(
        path=path, line=np.array([line for line, _ in content]), column=column, former=former
    )
    check_columns(table)
    return table


def table_text(columns: tuple[str, ...], *values: np.ndarray) -> str:
    r"""Format columns as text with a header: floats exactly, NaN as an empty field.

    `values`: numbers, or words without commas.

    >>> table_text(("landmark", "range"), np.array([4, 7]), np.array([0.1, np.nan]))
    'landmark,range\n4,0.1\n7,\n'
    """
    rows = zip(*(column.tolist() for column in values), strict=True)
    lines = [",".join(map(_field, row)) for row in rows]
    return "\n".join([",".join(columns), *lines, ""])


def _field(value: float | str) -> str:
    """Format a field: NaN is empty, words are unchanged."""
    if isinstance(value, str):
        return value
    return "" if value != value else repr(value)


def place_of(table: Table, row: int) -> str:
    """Return the file and line of a row, for an error message."""
    return f"{table.path}, {table.unit} {table.line[row]}"


def rows_kept(table: Table, kept: Bool[np.ndarray, " n"]) -> Table:
    """Select rows of a table by a mask."""
    column = {name: values[kept] for name, values in table.column.items()}
    return replace(table, line=table.line[kept], column=column)


def check_unique(table: Table, *names: str, besides: str | None = None) -> None:
    """Raise if two rows of a table agree in all of these columns.

    `besides`: a further column of whole numbers, which the error does not name.

    >>> column = {"landmark": np.array([4, 7, 4])}
    >>> check_unique(Table(path=Path("x.csv"), line=np.array([2, 3, 4]), column=column), "landmark")
    Traceback (most recent call last):
    pipistrelle.config.InputError: x.csv, line 4: found landmark 4 again, expected it once, as in
    line 2; remove one of the rows
    """
    columns = [table.column[name] for name in (*names, *([besides] if besides else []))]
    key = np.column_stack(columns)
    order = np.lexsort(key.T[::-1])
    same = ~np.diff(key[order], axis=0).any(axis=1)
    if same.any():
        pairs = np.column_stack((order[:-1], order[1:]))[same]
        earlier, later = pairs[np.argmin(pairs[:, 1])]
        values = (f"{name} {table.column[name][later].item()!r}" for name in names)
        found, fix = f"{', '.join(values)} again", "remove one of the rows"
        expected = f"it once, as in {table.unit} {table.line[earlier]}"
        raise refusal(place_of(table, later), found, expected, fix)


def _numbered(
    where: str, line: str, columns: tuple[str, ...], words: Mapping[str, tuple[str, ...]]
) -> str:
    """Replace words by their indices in a row of comma-separated fields."""
    fields = line.split(",") if words else []
    if len(fields) != len(columns):
        return line
    for name in words:
        place = columns.index(name) if name in columns else None
        if place is None or not (word := fields[place].strip()):
            continue
        if word not in words[name]:
            found = f"{name} {word[:80]!r}"
            raise refusal(where, found, " or ".join(words[name]), "correct the field")
        fields[place] = str(words[name].index(word))
    return ",".join(fields)


def _read_at_once(
    lines: list[str], columns: int, separator: str | None
) -> Float[np.ndarray, "n c"] | None:
    """Parse all rows at once; None if any row is not `columns` finite numbers."""
    try:
        values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape[1] == columns and np.isfinite(values).all() else None


def _read_row(
    path: Path,
    columns: tuple[str, ...],
    separator: str | None,
    optional: tuple[str, ...],
    line: int,
    text: str,
) -> list[float]:
    """Parse the numbers of a row; raise at the first invalid field."""
    where, fields = f"{path}, line {line}", text.split(separator)
    if len(fields) != len(columns):
        expected = f"{len(columns)}: {', '.join(columns)}"
        raise refusal(where, f"{len(fields)} fields in {text[:80]!r}", expected, "correct the row")
    row = []
    for name, field in zip(columns, fields, strict=True):
        if not field.strip() and (name in optional or name == "landmark"):
            row.append(math.nan)
            continue
        try:
            row.append(float(field.replace("_", "?")))
        except ValueError:
            row.append(math.nan)
        if not math.isfinite(row[-1]):
            fix = "correct the field" + " or leave it empty" * (name in optional)
            raise refusal(where, f"{name} {field.strip()[:80]!r}", "a finite number", fix)
    return row


def check_columns(table: Table) -> None:
    """Check times, labels and bounded columns; convert labels to integers."""
    for name, values in table.column.items():
        if name == "time":
            wrong = np.diff(values, prepend=-np.inf) < 0
            promise = "a time that does not run backwards"
        elif name in _BOUNDS:
            unit, least, most = _BOUNDS[name]
            wrong = (values < least) | (values > most)
            from_here = "above 0" if least == 1.0 / LARGEST else f"from {least:g}"
            promise = f"a {name} {from_here} {unit}, up to {most:g} {unit}"
        elif name in _LABELS:
            if np.isnan(values).all():
                values[:] = UNLABELLED
            wrong = (values != np.rint(values)) | (values < UNLABELLED) | (values >= 2**53)
            promise = f"an integer from 0 to {2**53 - 1}, or {UNLABELLED} for clutter"
        else:
            wrong = np.abs(values) > LARGEST
            promise = f"a number between -{LARGEST:g} and {LARGEST:g}"
        if wrong.any():
            row = int(np.argmax(wrong))
            where = place_of(table, row)
            found = f"{name} {_written(values[row].item())}"
            if name == "time":
                found += f" after {values[row - 1].item()!r}"
            fix = _LABEL_IT if np.isnan(values[row]) else "correct or remove the row"
            if name == "time" and table.unit == "message":
                fix = "its clock was set back; --bag.stamps received takes the times of reception"
            if name == "range" and not (table.column.get("bearing", values) < 0.0).any():
                fix = "exchange bearing and range, if these are swapped; else correct the row"
            raise refusal(where, found, promise, fix)
        if name in _LABELS:
            table.column[name] = values.astype(np.int64)


def _written(value: float) -> str:
    """Format a number for an error; NaN is an empty field, in quotes."""
    return "''" if math.isnan(value) else repr(value)
