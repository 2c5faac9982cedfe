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
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numba import config

from pipistrelle import kernel_clock
from pipistrelle.kernel_folder import place_kernels, say

_fault: Exception | None = None
"""Why kernels are compiled by Numba's public functions; None if they are not."""
try:
    from pipistrelle.kernel_linking import Kernel, check, checked

    if not config.DISABLE_JIT:  # pyrefly: ignore[missing-attribute]
        with kernel_clock.judging():
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
