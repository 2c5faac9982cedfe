"""Tables as text: with lines on a terminal, in plain columns elsewhere."""

import io
import shutil
import sys
from collections.abc import Sequence


def text_table(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a table as text, its first column to the left and all others to the right.

    >>> print(text_table("", [["", "A", "B"]], [["NEES", "2.1", "10.0"]]))
            A     B
    NEES  2.1  10.0
    """
    return _drawn(title, heads, rows) if sys.stdout.isatty() else _plain(title, heads, rows)


def _plain(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Lay out columns with two spaces between them."""
    lines = [*heads, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    laid = (
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
    return "\n".join([*filter(None, [title]), *laid])


def _drawn(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Draw a table for a terminal, as wide as it needs to be and no wider than there is room."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title) if title else None, title_justify="left", box=box.SIMPLE_HEAD)
    for i, column in enumerate(zip(*heads, strict=True)):
        head = Text("\n".join(column).strip("\n") if i else "\n".join(column))
        table.add_column(head, justify="right" if i else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    out = io.StringIO()
    width = shutil.get_terminal_size().columns
    Console(file=out, force_terminal=True, width=width).print(table)
    return "\n".join(line.rstrip() for line in out.getvalue().rstrip("\n").splitlines())
