"""Standard output and error, which may be closed, be full, or have no reader any more.

What a person reads never decides what becomes of the work: a word that cannot be said is not said,
and the exit status tells what was done.
"""

import codecs
import os
import sys
from contextlib import suppress
from errno import EPIPE
from typing import TextIO


def hold_streams() -> None:
    """Open something in place of standard streams that are closed; print odd names by their bytes.

    Otherwise the next file that is opened would get the number of a closed stream, and what is
    meant for the stream would be written into it.

    >>> hold_streams()
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # it gets the lowest number that is free: this one
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
    if sys.stdout.errors in ("strict", "surrogateescape") and hasattr(sys.stdout, "reconfigure"):
        codecs.register_error("pipistrelle.bytes", _as_bytes)
        sys.stdout.reconfigure(errors="pipistrelle.bytes")


def _as_bytes(error: UnicodeError) -> tuple[str | bytes, int]:
    """Encode a name as its bytes, and a character that the stream lacks as its number."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def say(message: str) -> None:
    """Write a line to standard error at once, if it is open, without control characters.

    >>> say("Drawing mission.gif ...")
    """
    text = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    with suppress(OSError):
        try:
            print(text, file=sys.stderr, flush=True)
        except OSError:
            _silence(sys.stderr)


def warn(*messages: str) -> None:
    """Print warnings about a result that was written nevertheless.

    >>> warn("the beam is wider than the world")
    """
    for message in messages:
        say(f"pipistrelle: warning: {message}")


def flush_results() -> None:
    """Write out what standard output still holds, unless its reader has left."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _silence(sys.stdout)
        if error.errno != EPIPE:
            raise


def put(*values: object, end: str = "\n") -> None:
    """Write a result to standard output, unless its reader has left.

    >>> put("runs/one")
    runs/one
    """
    try:
        print(*values, end=end)
    except BrokenPipeError:
        _silence(sys.stdout)


def _silence(stream: TextIO) -> None:
    """Discard what a stream still holds, and all that follows."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
