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
    """Replace closed standard streams by the null device; print undecodable names as bytes.

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
    """Handle encoding errors: return a name's bytes, or a character's escaped number."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def say(message: str) -> None:
    """Write a message to standard error if it is open, with control characters escaped."""
    text = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    with suppress(OSError):
        try:
            print(text, file=sys.stderr, flush=True)
        except OSError:
            _silence(sys.stderr)


def warn(*messages: str) -> None:
    """Write messages to standard error, each marked as a warning."""
    for message in messages:
        say(f"pipistrelle: warning: {message}")


def flush_results() -> None:
    """Flush standard output; do nothing if its reader has closed the pipe."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _silence(sys.stdout)
        if error.errno != EPIPE:
            raise


def put(*values: object, end: str = "\n") -> None:
    """Print values to standard output; do nothing if its reader has closed the pipe."""
    try:
        print(*values, end=end)
    except BrokenPipeError:
        _silence(sys.stdout)


def _silence(stream: TextIO) -> None:
    """Redirect a stream, with its unwritten text, to the null device."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


class Interrupted(KeyboardInterrupt):
    """Keyboard interrupt that a signal raises and this package catches.

    If a plain one passes through ``exec``, as in the import of some libraries, Python ends by the
    signal even if the interrupt is caught later.
    """


@contextmanager
def heard_signals(*, last: bool = False) -> Iterator[list[int]]:
    """Raise `Interrupted` on SIGINT or SIGTERM in this context; yield the signals received.

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
