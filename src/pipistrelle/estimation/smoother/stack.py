"""Arrays that grow: what a drive has heard is kept once, and shared by all beliefs about it.

A belief is never changed, and each frame makes a new one. Were its history copied, a mission would
cost the square of its length. A `Stack` is the first so many entries of arrays that have room for
more. What one belief adds stands behind the entries of all earlier ones, in the same arrays, unless
another belief has written there before: then it gets copies.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

ROOM = 64
"""How many entries a first array holds."""


@dataclass(frozen=True, slots=True)
class Stack:
    """The first entries of arrays that grow together along their first axes.

    >>> stack = Stack((np.zeros((4, 2)),))
    >>> one, other = stack.extended(1), stack.extended(1)
    >>> one.arrays[0][0], other.arrays[0][0] = 1.0, 2.0
    >>> one.arrays[0][0], one.size
    (array([1., 1.]), 1)
    """

    arrays: tuple[np.ndarray, ...]
    size: int = 0
    written: list[int] = field(default_factory=lambda: [0])
    """How many entries of the arrays some stack has; stacks of the same arrays share it."""

    def extended(self, count: int) -> Self:
        """Return a stack with so many entries more, which are yet to be written."""
        arrays, written, size = self.arrays, self.written, self.size + count
        if written[0] != self.size or size > len(arrays[0]):
            room = max(ROOM, len(arrays[0]), 2 * size if size > len(arrays[0]) else 0)
            arrays = tuple(_copied(array, self.size, room) for array in arrays)
            written = [0]
        written[0] = size
        return type(self)(arrays, size, written)

    def entries(self, number: int) -> np.ndarray:
        """Return the entries of an array."""
        return self.arrays[number][: self.size]


def _copied(array: np.ndarray, size: int, room: int) -> np.ndarray:
    """Return the first entries of an array, in one with more room."""
    copied = np.zeros((room, *array.shape[1:]), array.dtype)
    copied[:size] = array[:size]
    return copied
