"""Ways to spoil a file: each takes its bytes, and returns in words what was done, and the rest."""

import re
from collections.abc import Callable, Sequence
from typing import TypeVar

from numpy.random import Generator

Spoiled = tuple[str, bytes]
Mutation = Callable[[Generator, bytes], Spoiled]
Rows = list[list[str]]
Choice = TypeVar("Choice")

HUGE = "9" * 5000
"""More digits than Python turns into a number unasked."""
FACTORS = (1e3, 1e6, 1e9, 1e-3, 1e-9, 57.3, 1 / 57.3, 0.0, 2.0, -1.0, 1e160, 1e300)
"""Other units, the other sign, and what no double can square."""
NUMBERS = (
    *("nan", "inf", "-inf", "0", "-0", "-0.0", "-1", "1", "0.5", "1e308", "-1e308", "1e400"),
    *("1.7976931348623157e308", "1e155", "-1e155", "1e154", "5e-324", "1e-308", "1e-155", "1e-30"),
    *("1e-12", "1e12", "1e30", "9007199254740993", "9223372036854775807", "9223372036854775808"),
    *("-9223372036854775809", "3.141592653589793", HUGE, f"-{HUGE}", f"0.{HUGE}", f"1e{HUGE}"),
)
WORDS = (
    *("", " ", '"', "'", '""', "#", "x", "True", "null", "1_000", "0x10", "1,5", "1;5", "1+2j"),
    *("++1", "1e", ".", "1.5.2", "∞", "١٢", "é", "\x00", "\x1b[31m", "\ufeff1", "\u2028", "NaN(1)"),
    *("-", "--", "1d3", "%s", "{0}", "x" * 10_000),
)
VALUES = (
    *NUMBERS,
    *("true", "false", '""', '"text"', "[]", "{}", "[[]]", "[1]", "[0, 0]", "[0.0, 0.0, 0.0]"),
    *("[1, 2]", "[2.0, 1.0]", "[1.0, 2.0, 3.0, 4.0]", "[nan, nan, nan]", "[inf, inf, inf]"),
    *("[1e308, 1e308, 1e308]", "[1e155, 1e155, 1e155]", "[5e-324, 5e-324, 5e-324]", "[1, 'a']"),
    *("[true, true, true]", "1979-05-27T07:32:00Z", "07:32:00", "1_0", "0b1", "'''\n'''", "=", ""),
    *("{a = 1}", "{a.b.c = {d = 1}}", "[" * 5000 + "]" * 5000, "{a = " * 2000 + "1" + "}" * 2000),
)
"""What may stand behind the = of a TOML file, and what may not."""


def one_of(rng: Generator, choices: Sequence[Choice]) -> Choice:
    """Draw one of some things as it is."""
    return choices[int(rng.integers(len(choices)))]


def short(text: str) -> str:
    """Word a text, a long one by its beginning."""
    return repr(text) if len(text) <= 60 else f"{text[:24]!r}... of {len(text)} characters"


def _text(data: bytes) -> str:
    """Take bytes for characters, one each, so that any can be put back."""
    return data.decode("latin-1")


def _odd(rng: Generator, choices: Sequence[str]) -> tuple[str, str]:
    """Draw an odd value: in words, and as `_text` would have read it."""
    value = one_of(rng, choices)
    return short(value), _text(value.encode())


# Bytes


def flipped(rng: Generator, data: bytes) -> Spoiled:
    """Flip bits here and there."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5)) if data else 0):
        changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return "bits are flipped", bytes(changed)


def cut_off(rng: Generator, data: bytes) -> Spoiled:
    """Leave out the end, or the beginning."""
    at = int(rng.integers(len(data) + 1))
    return one_of(rng, [(f"ends at byte {at}", data[:at]), (f"begins at byte {at}", data[at:])])


def inserted(rng: Generator, data: bytes) -> Spoiled:
    """Put strange bytes in."""
    at, strange = int(rng.integers(len(data) + 1)), rng.bytes(int(rng.integers(1, 9)))
    strange = one_of(rng, [strange, b"\0", b"\0" * 4096, b"\n" * 4096, b"\xef\xbb\xbf", b"\x1a"])
    return f"{strange[:8]!r} stands at byte {at}", data[:at] + strange + data[at:]


def encoded(rng: Generator, data: bytes) -> Spoiled:
    """Write the same in another encoding."""
    name = one_of(rng, ["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp500", "utf-7"])
    return f"is encoded as {name}", _text(data).encode(name)


def ended(rng: Generator, data: bytes) -> Spoiled:
    """End the lines otherwise."""
    end = one_of(rng, [b"\r\n", b"\r", b"\n\r", b"\n\n", b"\x0b", b"\x0c", b" \n", b"\n \t\n", b""])
    return f"lines end in {end!r}", data.replace(b"\n", end)


def emptied(rng: Generator, data: bytes) -> Spoiled:
    """Leave nothing, or nothing to read."""
    rest = one_of(rng, [b"", b"\n", b" ", b"\0" * len(data), b"#\n" * 9, b"\xff" * 100])
    return f"holds {rest[:8]!r} alone", rest


# Lines


def line_gone(rng: Generator, data: bytes) -> Spoiled:
    """Take lines out."""
    lines = data.splitlines(keepends=True)
    first = int(rng.integers(len(lines) + 1))
    last = min(len(lines), first + one_of(rng, [1, 1, 2, 10, len(lines)]))
    return f"lines {first + 1} to {last} are gone", b"".join(lines[:first] + lines[last:])


def line_again(rng: Generator, data: bytes) -> Spoiled:
    """Repeat a line, there or elsewhere."""
    lines = data.splitlines(keepends=True) or [b"\n"]
    which, at = int(rng.integers(len(lines))), int(rng.integers(len(lines) + 1))
    at = one_of(rng, [at, which])
    return f"line {which + 1} is repeated as {at + 1}", b"".join(
        [*lines[:at], lines[which], *lines[at:]]
    )


def lines_moved(rng: Generator, data: bytes) -> Spoiled:
    """Put lines in another order."""
    lines = data.splitlines(keepends=True) or [b"\n"]
    one, other = rng.integers(len(lines), size=2).tolist()
    swapped = list(lines)
    swapped[one], swapped[other] = lines[other], lines[one]
    told, lines = one_of(
        rng,
        [
            (f"lines {one + 1} and {other + 1} are swapped", swapped),
            ("lines are reversed", lines[::-1]),
            ("lines are shuffled", [lines[i] for i in rng.permutation(len(lines))]),
            ("all lines are repeated", lines + lines),
        ],
    )
    return told, b"".join(lines)


def line_added(rng: Generator, data: bytes) -> Spoiled:
    """Put a strange line in."""
    lines, (told, line) = data.splitlines(keepends=True), _odd(rng, (*WORDS, *NUMBERS))
    at = int(rng.integers(len(lines) + 1))
    added = line.encode("latin-1") + b"\n"
    return f"line {at + 1} is {told}", b"".join([*lines[:at], added, *lines[at:]])


# Cells


def _rows(data: bytes) -> tuple[Rows, str, list[int]]:
    """Part lines into cells; tell what parts them, and which rows are no comment."""
    text = _text(data)
    separator = "," if "," in text else " "
    lines = text.split("\n")
    rows = [line.split(",") if separator == "," else line.split() for line in lines]
    there = [i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    return rows, separator, there


def _joined(rows: Rows, separator: str) -> bytes:
    """Put cells together again."""
    return "\n".join(separator.join(row) for row in rows).encode("latin-1")


def _multiplied(cell: str, factor: float) -> str:
    """Take a number times a factor; leave what is none."""
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


def cell_odd(rng: Generator, data: bytes) -> Spoiled:
    """Put something odd into a cell, or into one cell of some rows."""
    rows, separator, there = _rows(data)
    if not there:
        return "is left as it is", data
    told, value = _odd(rng, one_of(rng, [NUMBERS, NUMBERS, NUMBERS, WORDS]))
    row = one_of(rng, there)
    column = int(rng.integers(len(rows[row])))
    rows[row][column] = value
    return f"line {row + 1}, cell {column + 1}: {told}", _joined(rows, separator)


def cell_scaled(rng: Generator, data: bytes) -> Spoiled:
    """Give a cell another unit."""
    rows, separator, there = _rows(data)
    if not there:
        return "is left as it is", data
    row, factor = one_of(rng, there), one_of(rng, FACTORS)
    column = int(rng.integers(len(rows[row])))
    rows[row][column] = _multiplied(rows[row][column], factor)
    return f"line {row + 1}, cell {column + 1} times {factor:g}", _joined(rows, separator)


def column_changed(rng: Generator, data: bytes) -> Spoiled:
    """Give a column another unit, one value, or another label in every row."""
    rows, separator, there = _rows(data)
    if not there:
        return "is left as it is", data
    column, factor = int(rng.integers(len(rows[there[-1]]))), one_of(rng, FACTORS)
    told, value = _odd(rng, one_of(rng, [NUMBERS, WORDS]))
    changes: list[tuple[str, Callable[[str], str]]] = [
        (f"times {factor:g}", lambda cell: _multiplied(cell, factor)),
        (f"times {factor:g}", lambda cell: _multiplied(cell, factor)),
        (f"all {told}", lambda _: value),
        ("as whole numbers", lambda cell: cell.split(".")[0]),
        ("in quotes", lambda cell: f'"{cell}"'),
    ]
    told, change = one_of(rng, changes)
    for row in there[1:]:
        rows[row][column : column + 1] = map(change, rows[row][column : column + 1])
    return f"column {column + 1}: {told}", _joined(rows, separator)


def columns_moved(rng: Generator, data: bytes) -> Spoiled:
    """Take a column out, repeat it, add one, or swap two."""
    rows, separator, there = _rows(data)
    if not there:
        return "is left as it is", data
    width = len(rows[there[-1]])
    one, other = rng.integers(width, size=2).tolist()
    order = list(range(width))
    order[one], order[other] = other, one
    told, order = one_of(
        rng,
        [
            (f"column {one + 1} is gone", [i for i in range(width) if i != one]),
            (f"column {one + 1} is repeated", [*range(width), one]),
            (f"columns {one + 1} and {other + 1} are swapped", order),
            (f"column {one + 1} alone is left", [one]),
        ],
    )
    first = there[0] + (separator == "," and bool(rng.integers(2)))  # with its header or without
    moved = [
        [row[j] for j in order if j < len(row)] if i in there and i >= first else row
        for i, row in enumerate(rows)
    ]
    return told, _joined(moved, separator)


def reparted(rng: Generator, data: bytes) -> Spoiled:
    """Part the cells by something else."""
    rows, _, _ = _rows(data)
    separator = one_of(rng, [";", "\t", ", ", " ", ",,", "|", " , "])
    return f"cells are parted by {separator!r}", _joined(rows, separator)


# TOML

_ASSIGNED = re.compile(r"^(\s*)([^#=\[\n]+?)(\s*=\s*)(.*)$")


def _assignments(data: bytes) -> tuple[list[str], list[int]]:
    """Part a TOML file into lines; tell which assign something."""
    lines = _text(data).split("\n")
    return lines, [i for i, line in enumerate(lines) if _ASSIGNED.match(line)]


def value_odd(rng: Generator, data: bytes) -> Spoiled:
    """Assign something odd."""
    lines, there = _assignments(data)
    if not there:
        return "is left as it is", data
    at, (told, value) = one_of(rng, there), _odd(rng, VALUES)
    lines[at] = _ASSIGNED.sub(lambda match: "".join(match.groups()[:3]) + value, lines[at])
    return f"{lines[at].split('=')[0].strip()} = {told}", "\n".join(lines).encode("latin-1")


def number_odd(rng: Generator, data: bytes) -> Spoiled:
    """Put something odd for a number, alone or within a list."""
    numbers = list(re.finditer(r"(?<![\w.])-?\d[\d.e+-]*", _text(data)))
    if not numbers:
        return "is left as it is", data
    found, factor = one_of(rng, numbers), one_of(rng, FACTORS)
    told, value = one_of(
        rng,
        [
            _odd(rng, NUMBERS),
            (f"{found.group()} times {factor:g}", _multiplied(found.group(), factor)),
        ],
    )
    text = _text(data)
    line = text.count("\n", 0, found.start()) + 1
    spoiled = text[: found.start()] + value + text[found.end() :]
    return f"line {line}: {told} for {found.group()}", spoiled.encode("latin-1")


def key_odd(rng: Generator, data: bytes) -> Spoiled:
    """Take a key out, repeat it, misspell it, or add a strange one."""
    lines, there = _assignments(data)
    if not there:
        return "is left as it is", data
    at = one_of(rng, there)
    name, _, value = lines[at].partition("=")
    name = name.strip()
    told, lines[at] = one_of(
        rng,
        [
            (f"no {name}", ""),
            (f"{name} twice", f"{lines[at]}\n{lines[at]}"),
            (f"{name} misspelt", f"{name[:-1]} ={value}"),
            (f"{name} in quotes with a line's end", f'"{name}\\n" ={value}'),
            (f"{name} in capitals", f"{name.upper()} ={value}"),
            (f"{name} in a table of its own", f"[{name}]\n{lines[at]}"),
            (f"{name} as a table", f"{name}.deep ={value}"),
            ("a strange key", f"{lines[at]}\nstrange = 1"),
            ("an empty key", f'{lines[at]}\n"" = 1'),
            ("a key of two thousand parts", f"{lines[at]}\n{'.'.join(['a'] * 2000)} = 1"),
            ("a strange table", f"{lines[at]}\n[strange]"),
            ("a strange key with a control character", f'{lines[at]}\n"\\u001b[31m" = 1'),
        ],
    )
    return told, "\n".join(lines).encode("latin-1")


BYTES: tuple[Mutation, ...] = (flipped, cut_off, inserted, encoded, ended, emptied)
LINES: tuple[Mutation, ...] = (line_gone, line_again, lines_moved, line_added)
CELLS: tuple[Mutation, ...] = (
    *(cell_odd, cell_odd, cell_scaled, cell_scaled),
    *(column_changed, column_changed, columns_moved, reparted),
)
TOML: tuple[Mutation, ...] = (value_odd, value_odd, number_odd, number_odd, number_odd, key_odd)


def spoiled(rng: Generator, name: str, data: bytes) -> Spoiled:
    """Spoil a file in a way that suits it."""
    suits = TOML if name.endswith(".toml") else CELLS
    ways = one_of(rng, [suits, suits, suits, suits, LINES, BYTES])
    told, rest = one_of(rng, ways)(rng, data)
    return f"{name}: {told}", rest
