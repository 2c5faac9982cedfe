"""Compilation of kernels, loops over arrays, by Numba: serial, cached, with IEEE arithmetic.

Division by zero gives infinity, as in NumPy, without an exception. Nothing is reordered or fused
(no ``fastmath``), so results do not depend on the processor's vector length. No kernel is called
from C, so none has a C wrapper, which saves a sixth of the compile time.

A kernel takes eight arguments at most; related ones are a record, a NamedTuple. As an argument from
Python a record costs a microsecond and a plain tuple nothing, so a kernel that is called for every
frame takes the columns as a tuple and makes the record itself, which is free. Recursion is not
possible, as called kernels are linked (`kernel_linking`).

Linking and checked files use private parts of Numba. If these are missing, kernels are compiled and
cached by Numba's public functions, with the same results, and a message is printed.

Clocks stop while kernels are compiled or loaded, so that estimators' times exclude it. The first
compilation in a process is announced, as it takes long; loading is not. The announcement is
suppressed while input is checked, so that an error message is not preceded by it.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import numba
import numpy as np
from numba import config

from pipistrelle.kernel_folder import place_kernels, say

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

_fault: Exception | None = None
"""Why kernels are compiled by Numba's public functions; None if they are not."""
try:
    from pipistrelle.kernel_linking import Kernel, check, checked

    if not config.DISABLE_JIT:  # pyrefly: ignore[missing-attribute]
        with judging():
            check()
except Exception as error:
    _fault = error
if not place_kernels(plain=_fault is not None) and _fault is not None:
    say(
        f"Numba {numba.__version__} is not as those that were tested ({type(_fault).__name__}): "
        "compiling kernels takes longer; install numba<0.69"
    )

Whole = int | np.integer
"""An integer in a kernel: Python's or NumPy's."""
Flag = bool | np.bool_
"""A truth value in a kernel: Python's or NumPy's."""


_Function = TypeVar("_Function", bound=Callable[..., Any])


def _compiler(*, twice: bool = True, **options: bool | str) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles functions by Numba, and caches them in checked files."""
    public: dict[str, Any] = {name: value for name, value in options.items() if name == "inline"}
    public |= {"nopython": True, "error_model": "numpy"}
    options |= public | {"no_cfunc_wrapper": True}

    def compiled(function: Any) -> Any:
        if config.DISABLE_JIT:  # pyrefly: ignore[missing-attribute]
            return function
        if _fault is not None:
            return numba.jit(cache=True, **public)(function)
        dispatcher = Kernel(function, options, twice=twice)
        dispatcher.enable_caching()
        return checked(dispatcher)

    return compiled


kernel = _compiler()
"""Compile a kernel."""

optimised_once = _compiler(twice=False)
"""Compile a large kernel of small matrices, with little to vectorise: a fifth faster."""

no_alloc = _compiler(_nrt=False)
"""Compile a kernel that makes no array, calls none that does, and returns none to one that does.

It borrows its arrays without counting references. Counting is atomic, some 5 ns for every array of
a record at every call: a fifth of a filter's time.
"""

substituted = _compiler(inline="always")
"""Compile a formula that is substituted for its call before the caller is compiled."""

inlined = _compiler(forceinline=True)
"""Compile a part of a loop's body that must be inlined for the loop to be vectorised."""

no_alloc_inlined = _compiler(_nrt=False, forceinline=True)
"""Compile a function with wide records as arguments, inlined: copying them to the stack at every
call would cost a twentieth of the filter's time. Its callers are all compiled with it, so keep
it low in the call tree."""
