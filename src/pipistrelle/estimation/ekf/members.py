"""The members of one landmark: their place in the state, and arrays to work on them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.jit import Whole, kernel, no_alloc


class Scratch(NamedTuple):
    """Arrays to work on the members of one landmark, and on the order of the state's numbers."""

    likelihood: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    keep: Bool[np.ndarray, " m"]
    source: Int[np.ndarray, " n"]
    innovations: Float[np.ndarray, "2"]  # adds up the two numbers of `beliefs.Innovations`


@kernel
def scratch_for(members: Whole) -> Scratch:
    """Allocate arrays for so many members."""
    return Scratch(
        np.empty(members),
        np.empty(members),
        np.empty(members, np.bool_),
        np.empty(3 + 2 * members, np.int64),
        np.zeros(2),
    )


@no_alloc
def members_of(
    landmark: Int[np.ndarray, " h"], members: Whole, label: Whole
) -> tuple[Whole, Whole]:
    """Return the index of a landmark's first member, and how many it has (0: not in the map)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0
