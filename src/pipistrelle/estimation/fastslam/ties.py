"""Who is tied to whom, and what detours say: kernels on all particles.

A landmark is tied to one caller, in all particles: ``hub[n]`` is the number of that landmark, or
-1. ``tie[b, n]`` says how in each lane (`block_ties`), and nothing until a detour has told
something of it. As long as no landmark is tied there are no rows of it.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.fastslam.block import LANES, Counts, Lanes, Member, Poses
from pipistrelle.estimation.fastslam.block_ties import (
    TIE,
    detour_beyond,
    joined,
    known_surely,
    shift,
    take_bearing,
    take_detour,
    take_range,
)
from pipistrelle.estimation.measurement import Detours, Measurements
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined

Tied = tuple[Int[np.ndarray, " hubs"], Float[np.ndarray, "b tied slopes"]]
"""Who is tied to whom, and how."""
TiedAfter = tuple[Int[np.ndarray, " reached"], Float[np.ndarray, "b longer slopes"]]
"""The same, with those that are new."""


class Ties(NamedTuple):
    """Of one block: who is tied to whom and how, and what detours there are.

    Attributes
    ----------
    hub : (n)
    tie : (n, 4 L)
    detour, variance : (m)
        Of each measurement, by its landmark's caller; NaN where there is none.
    turn, timed, row : (L), (L), (6 L)
        Room to work.
    """

    hub: Int[np.ndarray, " n"]
    tie: Float[np.ndarray, "tied slopes"]
    detour: Float[np.ndarray, " m"]
    variance: Float[np.ndarray, " m"]
    turn: Lanes
    timed: Lanes
    row: Member


@no_alloc
def slot_of(landmark: Int[np.ndarray, " n"], label: Whole) -> Whole:
    """Number of a landmark; -1 for one that is not there."""
    for n in range(landmark.size):
        if landmark[n] == label:
            return n
    return -1


@kernel
def tie_landmarks(
    tied: Tied,
    landmark: Int[np.ndarray, " n"],
    count: Int[np.ndarray, "b k lanes"],
    particles: Whole,
    told: Detours,
    callers: Int[np.ndarray, " c"],
) -> TiedAfter:
    """Return the ties of a scan's landmarks, too, those among them that are new and not counted.

    A landmark is tied to the first of whom it has a detour and whose place most particles know. A
    caller is tied to none: it would take its own along.
    """
    hub, before = np.full(landmark.size, -1, dtype=np.int64), tied[1].shape[1]
    hub[: tied[0].size] = tied[0]
    for d in range(told.landmark.size):
        n, h = slot_of(landmark, told.landmark[d]), slot_of(landmark, told.caller[d])
        new = n >= 0 and hub[n] < 0 and slot_of(callers, told.landmark[d]) < 0
        known = 0
        for p in range(particles if new and 0 <= h < count.shape[1] else 0):
            known += count[p // LANES, h, p % LANES] == 1
        if 2 * known > particles:
            hub[n] = h
    tie = np.zeros((count.shape[0], hub.size if np.any(hub >= 0) else 0, TIE))
    tie[:, :before] = tied[1]
    return hub, tie


@kernel
def heard_of(
    hub: Int[np.ndarray, " n"],
    landmark: Int[np.ndarray, " n"],
    labels: Int[np.ndarray, " m"],
    told: Detours,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Detour of each measurement by its landmark's caller, and its variance; or NaN."""
    detour, variance = np.full(labels.size, np.nan), np.full(labels.size, np.nan)
    for d in range(told.landmark.size):
        n, m = slot_of(landmark, told.landmark[d]), slot_of(labels, told.landmark[d])
        if n >= 0 and m >= 0 and hub[n] >= 0 and landmark[hub[n]] == told.caller[d]:
            detour[m], variance[m] = told.detour[d], told.variance[d]
    return detour, variance


@no_alloc
def shift_all(
    ties: Ties, first: Int[np.ndarray, " ends"], member: Float[np.ndarray, "c numbers"], sign: float
) -> None:
    """Take from all tied landmarks what their callers add, the sign being -1; or add it."""
    for n in range(ties.tie.shape[0]):
        h = ties.hub[n]
        if h >= 0:
            shift(member[first[h]], member[first[n]], ties.tie[n], sign)


@no_alloc_inlined
def take_tied(
    pose: Poses,
    caller: Member,
    callers: Counts,
    n: Whole,
    ties: Ties,
    heard: Measurements,
    m: Whole,
) -> None:
    """Correct landmark n, in the row of the ties, and its caller by all that measurement m says."""
    row, tie, turn = ties.row, ties.tie[n], ties.turn
    take_bearing(pose, caller, row, tie, heard.bearing[m], heard.bearing_variance[m], turn)
    if not math.isnan(heard.range[m]):
        take_range(pose, caller, row, tie, heard.range[m], heard.range_variance[m], turn)
    if not math.isnan(ties.detour[m]):
        known_surely(pose, caller, callers, ties.timed)
        take_detour(pose, caller, row, tie, ties.detour[m], ties.variance[m], turn, ties.timed)


@no_alloc
def copy_row(source: Member, target: Member) -> None:
    """Copy a row."""
    for k in range(source.size):
        target[k] = source[k]


@no_alloc
def put_row(source: Member, target: Member, turn: Lanes) -> None:
    """Copy a row in lanes that have a turn."""
    for k in range(0, source.size, LANES):
        for i in range(LANES):
            target[k + i] = source[k + i] if turn[i] > 0.0 else target[k + i]


@kernel
def gated_detours(
    pose: Float[np.ndarray, "b rows"],
    first: Int[np.ndarray, " ends"],
    count: Int[np.ndarray, "b n lanes"],
    member: Float[np.ndarray, "b c numbers"],
    landmark: Int[np.ndarray, " n"],
    tied: Tied,
    told: Detours,
    bound: float,
) -> Bool[np.ndarray, " d"]:
    """Whether each detour is beyond the bound for every particle that could use it."""
    (hub, tie), turn, timed = tied, np.empty(LANES), np.empty(LANES)
    gated = np.zeros(told.landmark.size, dtype=np.bool_)
    for d in range(gated.size):
        n, h = slot_of(landmark, told.landmark[d]), slot_of(landmark, told.caller[d])
        gated[d] = 0 <= n < hub.size and h >= 0 and hub[n] == h
        for b in range(pose.shape[0] if gated[d] else 0):
            caller = member[b, first[h]]
            joined(count[b, n], count[b, h], turn)
            known_surely(pose[b], caller, count[b, h], timed)
            gated[d] = gated[d] and detour_beyond(
                pose[b], caller, member[b, first[n]], tie[b, n], told.detour[d], told.variance[d],
                turn * timed, bound,
            )  # fmt: skip
    return gated


@kernel
def resample_ties(
    tie: Float[np.ndarray, "b tied slopes"], ancestor: Int[np.ndarray, " p"]
) -> Float[np.ndarray, "b tied slopes"]:
    """Put the ties of the ancestors in the particles' places; spare lanes follow the last."""
    copies = np.empty_like(tie)
    for b in range(tie.shape[0]):
        for i in range(LANES):
            source = ancestor[min(b * LANES + i, ancestor.size - 1)]
            copies[b, :, i::LANES] = tie[source // LANES, :, source % LANES :: LANES]
    return copies
