"""Standard streams that may be closed, full or without a reader, and signals to end.

A message that cannot be written is dropped: it never stops the work, and the exit status remains.
"""

import codecs
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EPIPE
from types import FrameType
from typing import TextIO

ENDING = (signal.SIGINT, signal.SIGTERM)


def hold_streams() -> None:
    """Open the null device for closed standard streams; print undecodable names as bytes.

    Otherwise the next opened file would get the number of a closed stream, and messages would be
    written into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, this one
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
    if sys.stdout.errors in ("strict", "surrogateescape") and hasattr(sys.stdout, "reconfigure"):
        codecs.register_error("pipistrelle.bytes", _as_bytes)
        sys.stdout.reconfigure(errors="pipistrelle.bytes")


def _as_bytes(error: UnicodeError) -> tuple[str | bytes, int]:
    """Encode a name as its bytes, and a character outside the encoding as its number."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def say(message: str) -> None:
    """Write a line to standard error if it is open; escape control characters."""
    text = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    with suppress(OSError):
        try:
            print(text, file=sys.stderr, flush=True)
        except OSError:
            _silence(sys.stderr)


def warn(*messages: str) -> None:
    """Write warnings to standard error."""
    for message in messages:
        say(f"pipistrelle: warning: {message}")


def flush_results() -> None:
    """Flush standard output, unless its reader has left."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _silence(sys.stdout)
        if error.errno != EPIPE:
            raise


def put(*values: object, end: str = "\n") -> None:
    """Write a result to standard output, unless its reader has left."""
    try:
        print(*values, end=end)
    except BrokenPipeError:
        _silence(sys.stdout)


def _silence(stream: TextIO) -> None:
    """Redirect a stream to the null device, with its unwritten text."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class Interrupted(KeyboardInterrupt):
    """A keyboard interrupt that is caught.

    If a plain one passes through ``exec``, as in the import of some libraries, Python ends by the
    signal even if the interrupt is caught later.
    """


@contextmanager
def heard_signals(*, last: bool = False) -> Iterator[list[int]]:
    """Raise `Interrupted` on signals to end; yield the list of received signals.

    A library may replace the interruption by its own error, so check the list. If this is the
    `last` work of the process, signals are ignored afterwards.

    >>> from contextlib import suppress
    >>> with suppress(KeyboardInterrupt), heard_signals() as heard:
    ...     signal.raise_signal(signal.SIGTERM)
    >>> heard
    [15]
    """
    heard: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        heard.append(number)
        raise Interrupted

    try:
        before = {ending: signal.signal(ending, interrupt) for ending in ENDING}
    except ValueError:  # only the main thread receives signals
        yield heard
        return
    try:
        yield heard
    finally:
        for ending, handler in before.items():
            signal.signal(ending, signal.SIG_IGN if last else handler)
