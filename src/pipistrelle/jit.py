"""How kernels, loops over arrays, are compiled: serially, kept in the cache, IEEE arithmetic.

A division by zero makes infinity, as in NumPy, and no exception. Nothing is reordered or fused
(no ``fastmath``): a result does not depend on how many numbers the processor takes at a time.

A kernel takes eight arguments at most; what belongs together is a record, a NamedTuple. At its door
a record costs a microsecond and a plain tuple nothing, so a kernel that is called for every frame
is handed the columns as a tuple and makes the record of them itself, which is free.
"""

import numpy as np
from numba import njit

Whole = int | np.integer
"""A whole number in a kernel: Numba's are Python's, those of arrays NumPy's."""
kernel = njit(cache=True, error_model="numpy")
"""Compile a kernel."""

no_alloc = njit(cache=True, error_model="numpy", _nrt=False)  # pyrefly: ignore[no-matching-overload]
"""Compile a kernel that makes no array, calls none that does, and returns none to one that does.

It borrows the arrays that it is given, and does not count references to them and to parts of them.
Counting is atomic, some 5 ns each time, for every array of a record at every call: a fifth of a
filter's time.
"""

inlined = njit(cache=True, error_model="numpy", forceinline=True)
"""Compile a piece of a loop's body, without which the loop would not be vectorised."""

no_alloc_inlined = njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)  # pyrefly: ignore[no-matching-overload]
"""Compile a piece that is handed wide records: laid on the stack at every call, they would cost a
twentieth of the filter's time. Every kernel above it is compiled with it, so it stands low down.
"""
