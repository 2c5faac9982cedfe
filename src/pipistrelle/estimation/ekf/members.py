"""The members of a landmark: where they stand in the state, and room to work on them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.jit import Whole, kernel, no_alloc


class Scratch(NamedTuple):
    """Room to work on the members of one landmark, and on the order of the state's numbers.

    ``innovations`` (2) adds up what `beliefs.Innovations` holds.
    """

    likelihood: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    keep: Bool[np.ndarray, " m"]
    source: Int[np.ndarray, " n"]
    innovations: Float[np.ndarray, "2"]


@kernel
def scratch_for(members: Whole) -> Scratch:
    """Make room for so many members."""
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
    """Index of a landmark's first member and how many it has (0: not mapped)."""
    for first in range(members):
        if landmark[first] == label:
            last = first + 1
            while last < members and landmark[last] == label:
                last += 1
            return first, last - first
    return members, 0
