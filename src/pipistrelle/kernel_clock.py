"""Clocks that stop while kernels are compiled or loaded, so that estimators' times exclude it.

The first compilation in a process is announced, as it takes long; loading is not. The announcement
is suppressed while input is checked, so that an error message is not preceded by it.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

try:
    from numba.core import event as _events
except ImportError:  # another Numba than tested: no announcement
    _events: Any = None

COMPILING = (
    "Compiling the kernels of this kind of task, kept for the next time (a minute or two) ..."
)
_COMPILE, _LOCK = "numba:compile", "numba:compiler_lock"
"""Numba's events of compilation, and of compilation or loading."""


class _Clock(_events.Listener if _events else object):  # pyrefly: ignore[invalid-inheritance]
    """Numba's listener that sums the time of compiling and loading, and announces the first."""

    def __init__(self) -> None:
        self.tell: Callable[[str], object] | None = _say
        self.said, self.judging = False, 0
        self.lost = (0.0, 0.0)
        self._began, self._depth = (0.0, 0.0), 0

    def on_start(self, event: Any) -> None:
        """Stop the clocks as Numba begins to compile or load; announce the first compilation."""
        held = self.said or self.judging
        if event.kind == _COMPILE and self.tell is not None and not held:
            self.said = True
            self.tell(COMPILING)
        if not self._depth:
            self._began = _now()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Restart the clocks as Numba's outermost compilation or loading ends."""
        self._depth -= 1
        if not self._depth:
            (wall, cpu), began = _now(), self._began
            self.lost = (self.lost[0] + wall - began[0], self.lost[1] + cpu - began[1])


def wall_s() -> float:
    """Return the wall-clock time [s], without compilation and loading of kernels."""
    return time.perf_counter() - _CLOCK.lost[0]


def cpu_s() -> float:
    """Return this thread's processor time [s], without compilation and loading of kernels."""
    return time.thread_time() - _CLOCK.lost[1]


def _say(line: str) -> None:
    """Write a line to standard error, if it is open."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def announce(tell: Callable[[str], object] | None = _say) -> None:
    """Set the function that announces the first compilation of kernels; None for silence."""
    _CLOCK.tell = tell


@contextmanager
def judging() -> Iterator[None]:
    """Suppress the announcement of compilation while input is checked, as that is quick."""
    _CLOCK.judging += 1
    try:
        yield
    finally:
        _CLOCK.judging -= 1


def _now() -> tuple[float, float]:
    """Return the wall-clock time and this thread's processor time [s]."""
    return time.perf_counter(), time.thread_time()


_CLOCK = _Clock()
for _kind in (_COMPILE, _LOCK) if _events else ():
    _events.register(_kind, _CLOCK)
