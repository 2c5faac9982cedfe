"""Text tables: the columns of this project's files, read, checked, written and described.

`TEXT_COLUMNS` holds unit, bounds and meaning of each column, a `Schema` the columns of one file.
Errors name the file, the line, the column, the value found and the values expected.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import FARTHEST, FASTEST, LARGEST, LEAST_STD, WIDEST
from pipistrelle.files import read_text
from pipistrelle.refusals import refusal


class Column(NamedTuple):
    """Unit, meaning and bounds of a column in text tables."""

    unit: str
    meaning: str
    low: float = -LARGEST
    high: float = LARGEST
    whole: bool = False
    """Whether all values are integers."""


_LABEL = (-1.0, 2.0**53 - 1.0, True)
_TINY = 1.0 / LARGEST
TEXT_COLUMNS: Mapping[str, Column] = MappingProxyType(
    {
        "time": Column("s", "by one clock for all files; never decreases"),
        "landmark": Column("", "label, the same in all rows of it", *_LABEL),
        "subject": Column("", "number of a landmark or robot", *_LABEL),
        "barcode": Column("", "number on a landmark or robot", *_LABEL),
        "bearing": Column("rad", "from the heading, counter-clockwise"),
        "range": Column("m", "to the landmark; empty: passive", _TINY, FARTHEST),
        "bearing_std": Column("rad", "std; empty: that of log.toml", LEAST_STD, WIDEST),
        "range_std": Column("m", "std; empty: that of log.toml", LEAST_STD, FARTHEST),
        "excess_path": Column(
            "m", "path from the caller over the landmark less the direct one", 0.0, FARTHEST
        ),
        "excess_path_std": Column("m", "std; empty: that of log.toml", LEAST_STD, FARTHEST),
        "bearing_slope": Column(
            "rad", "change with the logarithm of the speed of sound", -FASTEST, FASTEST
        ),
        "level_db": Column("dB", "level of the echo above the noise"),
        "caller": Column("", "name of the emitter in log.toml; empty: the vehicle"),
        "x": Column("m", "position"),
        "y": Column("m", "position"),
        "z": Column("m", "position, up"),
        "heading": Column("rad", "counter-clockwise from +x"),
        "velocity": Column("m/s", "ahead", -FASTEST, FASTEST),
        "angular_rate": Column("rad/s", "counter-clockwise", -WIDEST, WIDEST),
        "speed": Column("m/s", "of the front wheel; a car's ahead", -FASTEST, FASTEST),
        "steering": Column("rad", "angle of the front wheel, counter-clockwise", -WIDEST, WIDEST),
        "motion_xx": Column("m²", "variance of the motion forward since the row before"),
        "motion_xy": Column("m²", "covariance, forward and to the left"),
        "motion_xh": Column("m rad", "covariance, forward and turn"),
        "motion_yy": Column("m²", "variance, to the left"),
        "motion_yh": Column("m rad", "covariance, to the left and turn"),
        "motion_hh": Column("rad²", "variance of the turn"),
        "radius": Column("m", "of the landmark's body; empty: target.radius", _TINY, LARGEST),
        "shape": Column("", "cylinder or sphere; empty: target.shape"),
        "channel": Column("", "of a recording, without gaps, from 0 or 1", 0.0, LARGEST, True),
        "face": Column("", "name of its face; empty: none"),
        "gain_db": Column("dB", "relative to the others; empty: 0", -100.0, 100.0),
    }
)
"""The known columns, by name; others are numbers without a unit."""
_LABEL_IT = (
    "number your landmarks, the same number in all rows of one, and clutter -1; or leave the field "
    "empty, for --association.method to decide"
)


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
    """Values by column; labels are integers, words text, missing numbers NaN."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Schema:
    """Name, row meaning, and required and optional columns of a kind of text file."""

    file: str
    row: str
    """What a row is, for README files."""
    columns: tuple[str, ...]
    """The first columns, in this order."""
    optional: tuple[str, ...] = ()
    """Columns that may follow, in any order, and whose fields may be empty."""
    empty: tuple[str, ...] = ()
    """Columns of `columns` whose fields may be empty."""

    def read(self, path: Path, words: Mapping[str, Sequence[str]] = MappingProxyType({})) -> Table:
        """Read a text file with the columns of this schema (`read_table`)."""
        return read_table(path, self.columns, optional=(*self.empty, *self.optional), words=words)

    def readme(self, names: Sequence[str] = ()) -> str:
        """Return a README's description of this file; `names`: its columns, by default all."""
        names = names or (*self.columns, *self.optional)
        lines = [f"{self.file}: {','.join(names)}", f"  {self.row}"]
        for name in names:
            unit = f"[{TEXT_COLUMNS[name].unit}]" if TEXT_COLUMNS[name].unit else ""
            lines.append(f"  {name:<15} {unit:<7} {TEXT_COLUMNS[name].meaning}")
        return "\n".join([*lines, ""])


def fields_in(path: Path, separator: str | None = ",") -> list[tuple[int, list[str]]]:
    """Return the line, from 1, and the fields of each row of a file, its header included.

    Blank lines and lines that begin with ``#`` are skipped, blanks and quotes around fields
    removed. Without a separator, fields are separated by white space.
    """
    text = read_text(path)
    padded = any(mark in text for mark in ' \t"')
    lines = enumerate(text.splitlines(), start=1)
    rows = ((n, line.split(separator)) for n, line in lines if line.strip() and line[0] != "#")
    return [(n, [f.strip(' \t"') for f in fields] if padded else fields) for n, fields in rows]


def read_table(
    path: Path,
    columns: tuple[str, ...],
    *,
    separator: str | None = ",",
    optional: tuple[str, ...] = (),
    words: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Table:
    r"""Read a text file of columns of numbers; blank lines and lines with ``#`` are skipped.

    Columns are checked by name (`TEXT_COLUMNS`): ``time`` never decreases, ``range`` and the
    standard deviations are positive, labels are integers.

    `columns` must be in the header, first and in this order; without a `separator` there is none,
    and fields are separated by white space. Fields of `optional` columns may be empty; others of
    these may follow in any order, and are empty in every row if the header lacks them. `words`: the
    columns of text, each with its allowed words, or none for any text. Raises InputError with the
    file and the line.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     path = Path(place) / "posts.csv"
    ...     _ = path.write_text("landmark,x\n4,1.5\n7,-2.0\n")
    ...     table = read_table(path, ("landmark", "x"))
    >>> table.column["landmark"], table.column["x"], table.line
    (array([4, 7]), array([ 1.5, -2. ]), array([2, 3]))
    """
    rows = fields_in(path, separator)
    names = columns
    if rows and separator:
        line, found = rows.pop(0)
        names = tuple(found)
        more, extra = [n for n in optional if n not in columns], names[len(columns) :]
        if names[: len(columns)] != columns or {*extra} - {*more} or len({*extra}) < len(extra):
            expected = f"the header {','.join(columns)!r}"
            expected += f", perhaps followed by {', '.join(more)}" * bool(more)
            fix, header = "name the columns so", ",".join(found)
            if "landmark" not in names and "bearing" in {*columns} & {*names}:
                fix = _LABEL_IT
            elif ";" in header or "\t" in header:
                fix = "separate the columns by commas"
            raise refusal(f"{path}, line {line}", repr(header[:80]), expected, fix)
    if not rows:
        raise refusal(path, "no rows", f"rows of {','.join(columns)}", "add them")
    return table_of(path, names, rows, optional, words)


def table_of(
    path: Path,
    names: tuple[str, ...],
    rows: Sequence[tuple[int, Sequence[str]]],
    optional: tuple[str, ...] = (),
    words: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Table:
    """Check and convert rows of text fields, each with its line, to a table (`read_table`)."""
    for line, fields in rows:
        if len(fields) != len(names):
            found = f"{len(fields)} fields in {','.join(fields)[:80]!r}"
            expected = f"{len(names)}: {', '.join(names)}"
            raise refusal(f"{path}, line {line}", found, expected, "correct the row")
    column = dict(zip(names, zip(*(fields for _, fields in rows), strict=True), strict=True))
    lines = np.array([line for line, _ in rows])
    table = Table(path=path, line=lines, column={})
    table.column.update(_values(table, column, optional, words))
    for name in optional:
        table.column.setdefault(name, np.full(len(rows), "" if name in words else np.nan))
    check_columns(table)
    return table


def _values(
    table: Table,
    fields: Mapping[str, Sequence[str]],
    optional: tuple[str, ...],
    words: Mapping[str, Sequence[str]],
) -> dict[str, np.ndarray]:
    """Convert the fields of each column to numbers; raise at the first line with an invalid one."""
    import polars as pl

    values, wrong = {}, {}
    for name, column in fields.items():
        filled = np.array(column, dtype=bool)
        if name in words:
            values[name] = np.array(column)
            wrong[name] = filled & bool(words[name]) & ~np.isin(values[name], words[name])
        else:
            numbers = pl.Series(column).cast(pl.Float64, strict=False).to_numpy()
            values[name] = np.where(filled, numbers, np.nan)
            wrong[name] = filled & ~np.isfinite(numbers)
        if name not in optional:
            wrong[name] |= ~filled
    if (rows := np.any([*wrong.values()], axis=0)).any():
        row = int(np.argmax(rows))
        name = next(name for name in fields if wrong[name][row])
        found = f"{name} {fields[name][row][:80]!r}"
        expected = " or ".join(words[name]) if name in words else "a finite number"
        fix = "correct the field" + " or leave it empty" * (name in optional)
        fix = _LABEL_IT if name == "landmark" and name in optional else fix
        raise refusal(place_of(table, row), found, expected, fix)
    return values


def check_columns(table: Table) -> None:
    """Raise if a time, label or bounded value of a table is invalid; make labels integers."""
    for name, values in table.column.items():
        if values.dtype.kind == "U":
            continue
        column = TEXT_COLUMNS.get(name, Column("", ""))
        unknown = np.isnan(values) & (name == "landmark")
        if name == "time":
            wrong = np.diff(values, prepend=-np.inf) < 0
        else:
            wrong = (values < column.low) | (values > column.high)
            wrong |= column.whole & (values != np.rint(values))
        if (wrong := wrong & ~unknown).any():
            raise _out_of_bounds(table, name, int(np.argmax(wrong)))
        if column.whole:  # beside labels, -1 is clutter, and unknown landmarks are -2
            empty = column.low - (not unknown.all())
            table.column[name] = np.where(unknown, empty, values).astype(np.int64)


def _out_of_bounds(table: Table, name: str, row: int) -> Exception:
    """Return the error of a number beyond the bounds of its column."""
    values, column = table.column[name], TEXT_COLUMNS.get(name, Column("", ""))
    number, fix = values[row].item(), "correct or remove the row"
    whole = column.whole and float(number).is_integer()
    found = f"{name} " + (repr(int(number) if whole else number) if number == number else "''")
    if name == "time":
        found += f" after {values[row - 1].item()!r}"
        expected = "a time that does not run backwards"
        if table.unit == "message":
            fix = "its clock was set back; --bag.stamps received takes the times of reception"
    elif column.whole:
        expected = f"an integer from 0 to {column.high:.0f}"
        expected += ", or -1 for clutter" * (column.low < 0.0)
        fix = fix if number == number else _LABEL_IT
    elif column.high == -column.low == LARGEST:
        expected = f"a number between -{LARGEST:g} and {LARGEST:g} {column.unit}".rstrip()
    else:
        low = "above 0" if column.low == _TINY else f"from {column.low:g}"
        expected = f"a {name} {low} {column.unit}, up to {column.high:g} {column.unit}"
    if name == "range" and not (table.column.get("bearing", values) < 0.0).any():
        fix = "exchange bearing and range, if these are swapped; else correct the row"
    return refusal(place_of(table, row), found, expected, fix)


def table_text(column: Mapping[str, np.ndarray]) -> str:
    r"""Format columns as text with a header: floats exactly, NaN as an empty field.

    `column`: numbers, or words without commas, by name.

    >>> table_text({"landmark": np.array([4, 7]), "range": np.array([0.1, np.nan])})
    'landmark,range\n4,0.1\n7,\n'
    """
    rows = zip(*(values.tolist() for values in column.values()), strict=True)
    lines = [
        ",".join(v if isinstance(v, str) else repr(v) if v == v else "" for v in row)
        for row in rows
    ]
    return "\n".join([",".join(column), *lines, ""])


def place_of(table: Table, row: int) -> str:
    """Return the file and line of a table's row, for an error message."""
    return f"{table.path}, {table.unit} {table.line[row]}"


def rows_kept(table: Table, kept: Bool[np.ndarray, " n"] | Int[np.ndarray, " k"]) -> Table:
    """Select rows of a table by a mask, or by their indices in an order."""
    column = {name: values[kept] for name, values in table.column.items()}
    return replace(table, line=table.line[kept], column=column)


def points_of(table: Table) -> Float[np.ndarray, "n 2"]:
    """Return the positions in the columns ``x`` and ``y`` of a table."""
    return np.column_stack((table.column["x"], table.column["y"]))


def check_unique(table: Table, *names: str, besides: str | None = None) -> None:
    """Raise if two rows of a table have equal values in all given columns.

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
