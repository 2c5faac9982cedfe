"""Signals that ask for an end: Ctrl-C, and those that a job scheduler sends before it kills."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """An interruption that is caught.

    Of a plain one that reaches a text run by ``exec``, as libraries do when they are imported,
    Python remembers that it was not caught, and ends by that signal even if it was.
    """


@contextmanager
def heard_signals(*, last: bool = False) -> Iterator[list[int]]:
    """Let signals that ask for an end interrupt the work, so that it ends in order.

    Yields the signals so far: a library may hide the interruption behind an error of its own. If
    this is the last work, signals are ignored afterwards.

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
    except ValueError:  # not in the main thread, which hears them
        yield heard
        return
    try:
        yield heard
    finally:
        for ending, handler in before.items():
            signal.signal(ending, signal.SIG_IGN if last else handler)
