"""Landmarks that are taken out of a history, and two that become one.

The rows of a landmark that was none are taken out, as if they had never been heard. Of two that are
one, all rows are the first's. The chain is then eliminated anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import BEARING
from pipistrelle.estimation.smoother.history import NEVER, History
from pipistrelle.estimation.smoother.stack import Stack
from pipistrelle.jit import kernel


def edited(
    history: History, remove: Sequence[int], merge: Sequence[tuple[int, int]]
) -> tuple[History, Bool[np.ndarray, " l"]]:
    """Return a history without some landmarks, and with others as one; which of the border stay."""
    for kept, gone in merge:
        history = _merged(history, _slot(history, kept), _slot(history, gone))
    keep, slots = np.ones(history.rows.size, bool), [_slot(history, label) for label in remove]
    ends = history.rows.entries(0).copy()
    keep &= ~np.isin(ends[:, 0], slots)
    ends[np.isin(ends[:, 1], slots), 1] = -1
    history = _forgetting(_with_rows(history, ends, keep), slots)
    border = np.zeros(len(history.placed), bool)
    border[history.index[history.index > 0] - 1] = True
    return _renumbered(history, border), border


def _slot(history: History, label: int) -> int:
    """Return the slot of a landmark; refuse one that moves, or that nobody heard."""
    if (label, False) not in history.slots:
        raise InputError(
            f"association: found landmark {label} to change, which is not on the map, or moves"
        )
    return history.slots[label, False]


def _merged(history: History, kept: int, gone: int) -> History:
    """Return a history in which the rows of one slot are another's."""
    if kept == gone:
        raise InputError("association: found a landmark to merge with itself; expected two")
    ends, index, heard = history.rows.entries(0).copy(), history.index.copy(), history.heard.copy()
    ends[:, :2][ends[:, :2] == gone] = kept
    if index[kept] == 0:
        index[kept], index[gone] = index[gone], 0
    heard[kept] = min(heard[kept, 0], heard[gone, 0]), max(heard[kept, 1], heard[gone, 1])
    history = replace(history, index=index, heard=heard)
    return _forgetting(_with_rows(history, ends, np.ones(len(ends), bool)), [gone])


def _with_rows(
    history: History, ends: Int[np.ndarray, "r 4"], keep: Bool[np.ndarray, " r"]
) -> History:
    """Return a history with other ends of its rows, and only some of them."""
    numbers = history.rows.entries(1)[keep]
    ends, latest = ends[keep], np.full(history.latest.size, -1)
    _link(ends, numbers, latest)
    rows = Stack((ends, numbers), len(ends), [len(ends)])
    before = np.append(0, np.cumsum(keep))
    spans = before[history.legs.entries(3)]
    legs = history.legs
    arrays = tuple(
        spans if number == 3 else array[: legs.size] for number, array in enumerate(legs.arrays)
    )
    moved = Stack(arrays, legs.size, [legs.size])
    return replace(history, rows=rows, legs=moved, latest=latest)


@kernel
def _link(
    ends: Int[np.ndarray, "r 4"], numbers: Float[np.ndarray, "r 8"], latest: Int[np.ndarray, " s"]
) -> None:
    """Write the row of each row's bearing before, and the latest of each slot."""
    for row in range(ends.shape[0]):
        ends[row, 3] = -1
        if not np.isnan(numbers[row, BEARING]):
            ends[row, 3], latest[ends[row, 0]] = latest[ends[row, 0]], row


def _forgetting(history: History, slots: Sequence[int]) -> History:
    """Return a history whose slots are nobody's: they keep their numbers, under no label."""
    named = {slot: key for key, slot in history.slots.items()}
    named |= {slot: (-2 - slot, False) for slot in slots}
    index, heard = history.index.copy(), history.heard.copy()
    index[slots], heard[slots] = 0, (NEVER, -1)
    names = {named[slot]: slot for slot in range(len(named))}
    return replace(history, slots=names, index=index, heard=heard)


def _renumbered(history: History, kept: Bool[np.ndarray, " l"]) -> History:
    """Return a history with some of the border's landmarks, numbered anew."""
    number, index = np.append(0, np.cumsum(kept)), history.index.copy()
    index[index > 0] = number[index[index > 0]]
    mean, information = history.known
    return replace(
        history,
        index=index,
        placed=tuple(np.array(history.placed, np.int64)[kept].tolist()),
        known=(mean[kept], information[kept]),
        leaves=history.leaves[kept],
    )
