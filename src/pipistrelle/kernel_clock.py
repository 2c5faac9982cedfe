"""Clocks that stand still while kernels are compiled or loaded: that is no filter's time.

The first kernel of a process that is compiled, and not merely loaded, is announced before: it takes
long. It is announced once, and never while input is judged, for a refusal should stand alone.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

try:
    from numba.core import event as _events
except ImportError:  # of another Numba than those that were tested: nothing is announced
    _events: Any = None

COMPILING = (
    "Compiling the kernels of this kind of task, kept for the next time (a minute or two) ..."
)
_COMPILE, _LOCK = "numba:compile", "numba:compiler_lock"
"""Numba tells when it compiles, and when it compiles or loads."""


class _Clock(_events.Listener if _events else object):  # pyrefly: ignore[invalid-inheritance]
    """Sum up the time in which kernels are compiled or loaded, and announce the first."""

    def __init__(self) -> None:
        self.tell: Callable[[str], object] | None = _say
        self.said, self.judging = False, 0
        self.lost = (0.0, 0.0)
        self._began, self._depth = (0.0, 0.0), 0

    def on_start(self, event: Any) -> None:
        """Stop the clocks."""
        held = self.said or self.judging
        if event.kind == _COMPILE and self.tell is not None and not held:
            self.said = True
            self.tell(COMPILING)
        if not self._depth:
            self._began = _now()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Let the clocks go on, when the outermost of nested events is at its end."""
        self._depth -= 1
        if not self._depth:
            (wall, cpu), began = _now(), self._began
            self.lost = (self.lost[0] + wall - began[0], self.lost[1] + cpu - began[1])


def wall_s() -> float:
    """Return the time by the clock [s], without that of compiling and loading kernels."""
    return time.perf_counter() - _CLOCK.lost[0]


def cpu_s() -> float:
    """Return this thread's processor time [s], without that of compiling and loading kernels."""
    return time.thread_time() - _CLOCK.lost[1]


def _say(line: str) -> None:
    """Write a line to standard error, if anybody can read it."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def announce(tell: Callable[[str], object] | None = _say) -> None:
    """Set the function that is called when the first kernel of this process is compiled.

    `tell`: called at most once in a process; None: there is no message.
    """
    _CLOCK.tell = tell


@contextmanager
def judging() -> Iterator[None]:
    """Suppress the announcement while input is checked; its few kernels compile quickly."""
    _CLOCK.judging += 1
    try:
        yield
    finally:
        _CLOCK.judging -= 1


def _now() -> tuple[float, float]:
    """Return the time by the clock and this thread's processor time [s]."""
    return time.perf_counter(), time.thread_time()


_CLOCK = _Clock()
for _kind in (_COMPILE, _LOCK) if _events else ():
    _events.register(_kind, _CLOCK)
