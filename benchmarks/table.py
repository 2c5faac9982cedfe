"""Rows of the benchmarks with their targets: as a table, as a file, and against another run.

Only the standard library is imported here, so that the process that starts the measured processes
stays small (a child is charged with its parent's memory) and the documentation can use the file.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal

HEADINGS = ("row", "value", "unit", "target", "met", "ratio", "floor")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A line of the table.

    Attributes
    ----------
    name : str
    value : float
    unit : str
    target : float or None
        None: measured without a target.
    relation : "<=" or ">="
        Required relation of value to target; without a target, the better direction.
    ratio : float or None
        A time in units of the calibration kernel's, measured around it; a row that compares two
        times of a run is its own ratio; sizes have none.
    floor : float or None
        Best value that the arithmetic, or the row's nature, allows.
    command : str
        Command that measures this row again.
    note : str
        Explanation.
    """

    name: str
    value: float
    unit: str
    target: float | None
    relation: Literal["<=", ">="]
    ratio: float | None
    floor: float | None
    command: str
    note: str = ""


def met(row: Row) -> bool | None:
    """Return whether a row meets its target; None without a target.

    >>> row = Row(name="help_ratio", value=1.2, unit="1", target=1.4, relation="<=", ratio=1.2,
    ...           floor=1.0, command="")
    >>> met(row)
    True
    """
    if row.target is None:
        return None
    return row.value <= row.target if row.relation == "<=" else row.value >= row.target


def cells(row: Row) -> tuple[str, ...]:
    """Format a row, with a cell for each of the headings."""
    target = "" if row.target is None else f"{row.relation} {number(row.target)}"
    kept = {True: "yes", False: "NO", None: ""}[met(row)]
    quantities = number(row.ratio), number(row.floor)
    return (row.name, number(row.value), row.unit, target, kept, *quantities)


def number(value: float | None) -> str:
    """Format a number with three digits, from 1000 on as an integer; None gives an empty string.

    >>> number(0.12345), number(4321.0), number(None)
    ('0.123', '4321', '')
    """
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def plain(rows: Sequence[Row]) -> str:
    """Format rows as lines of text, for a file or a pipe."""
    lines = [HEADINGS, *(cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADINGS))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i in (0, 2) else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown(report: dict[str, Any]) -> str:
    """Format the rows, notes and machine of a file as Markdown."""
    rows = rows_of(report)
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---|--:|---|--:|---|--:|--:|"]
    lines += ["| " + " | ".join((f"`{name}`", *rest)) + " |" for name, *rest in map(cells, rows)]
    lines += ["", *(f"- `{row.name}`: {row.note}" for row in rows if row.note)]
    machine = ", ".join(f"{key} {value}" for key, value in report["machine"].items())
    return "\n".join([*lines, "", f"Measured on: {machine}."])


def show(rows: Sequence[Row]) -> None:
    """Print the rows and their notes: as a table on a terminal, else as plain lines."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if console.is_terminal:
        table = Table(*HEADINGS)
        for row in rows:
            style = {True: "green", False: "red", None: None}[met(row)]
            table.add_row(*cells(row), style=style)
        console.print(table)
    else:
        print(plain(rows))
    for row in rows:
        if row.note:
            print(f"{row.name}: {row.note}")


def write(path: Path, machine: dict[str, Any], rows: Sequence[Row]) -> None:
    """Write the machine and rows of a run as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    report = {"machine": machine, "rows": [asdict(row) for row in rows]}
    path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read(path: Path) -> dict[str, Any]:
    """Read a file from `write`."""
    return json.loads(path.read_text(encoding="utf-8"))


def rows_of(report: dict[str, Any]) -> list[Row]:
    """Return the rows of a file."""
    return [Row(**row) for row in report["rows"]]


def grown(now: Sequence[Row], before: Sequence[Row], factor: float) -> list[tuple[str, float]]:
    """Return the rows that became worse by more than a factor, and by how much.

    Ratios are compared if both runs have them, so that a slower or busier machine is no regression;
    else the values. For ">=" the factor is inverted. A row whose earlier value is not positive is
    infinitely worse if it no longer meets its target.
    """
    known = {row.name: row for row in before}
    worse = []
    for row in now:
        old = known.get(row.name)
        if old is None:
            continue
        calibrated = row.ratio is not None and old.ratio is not None
        new, past = (row.ratio, old.ratio) if calibrated else (row.value, old.value)
        if row.relation == ">=":
            new, past = past, new
        if past > 0.0 and new / past > factor:
            worse.append((row.name, new / past))
        elif past <= 0.0 and met(old) and not met(row):
            worse.append((row.name, inf))
    return worse
