"""How kernels, loops over arrays, are compiled: serially, kept in the cache, IEEE arithmetic.

A division by zero makes infinity, as in NumPy, and no exception. Nothing is reordered or fused
(no ``fastmath``): a result does not depend on how many numbers the processor takes at a time.
No kernel is called from C, so none has a wrapper for it: a sixth of the time to compile them.

A kernel takes eight arguments at most; what belongs together is a record, a NamedTuple. At its door
a record costs a microsecond and a plain tuple nothing, so a kernel that is called for every frame
is handed the columns as a tuple and makes the record of them itself, which is free. None calls
itself: those that are called are linked (`kernel_linking`), which recursion prevents.

Linking and checked files need private parts of Numba. Where a Numba has them no more, kernels are
compiled and kept by its public functions, with the same numbers, and a line says so.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import numba
import numpy as np
from numba import config

from pipistrelle import kernel_clock
from pipistrelle.kernel_folder import place_kernels

_fault: Exception | None = None
"""Why kernels are compiled by Numba's public functions."""
try:
    from pipistrelle.kernel_linking import Kernel, check, checked

    if not config.DISABLE_JIT:  # pyrefly: ignore[missing-attribute]
        with kernel_clock.judging():
            check()
except Exception as error:
    _fault = error
if not place_kernels(plain=_fault is not None) and _fault is not None:
    with suppress(OSError, AttributeError):  # there is no reader
        print(
            f"pipistrelle: Numba {numba.__version__} is not as those that were tested "
            f"({type(_fault).__name__}): compiling kernels takes longer; install numba<0.69",
            file=sys.stderr,
        )

Whole = int | np.integer
"""A whole number in a kernel: Numba's are Python's, those of arrays NumPy's."""
Flag = bool | np.bool_
"""The same of a truth value."""


_Function = TypeVar("_Function", bound=Callable[..., Any])


def _compiler(*, twice: bool = True, **options: bool | str) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles, and keeps what it compiled in checked files."""
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
"""Compile a large kernel of small matrices, in which little can be vectorised: a fifth faster."""

no_alloc = _compiler(_nrt=False)
"""Compile a kernel that makes no array, calls none that does, and returns none to one that does.

It borrows the arrays that it is given, and does not count references to them and to parts of them.
Counting is atomic, some 5 ns each time, for every array of a record at every call: a fifth of a
filter's time.
"""

substituted = _compiler(inline="always")
"""Compile a formula: it is put in place of its call before the caller is compiled."""

inlined = _compiler(forceinline=True)
"""Compile a piece of a loop's body, without which the loop would not be vectorised."""

no_alloc_inlined = _compiler(_nrt=False, forceinline=True)
"""Compile a piece that is handed wide records: laid on the stack at every call, they would cost a
twentieth of the filter's time. Every kernel above it is compiled with it, so it stands low down.
"""
