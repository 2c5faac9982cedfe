"""Landmarks conditional on a caller, their parent: kernels on all particles.

A landmark has the same parent in all particles: ``parent[n]`` is the number of that landmark, or
-1. ``slope[b, n]`` says how it depends on its parent in each lane (`block_conditional`); it is zero
until an excess path is used, and has no rows as long as no landmark has a parent.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.fastslam.block import LANES, Lanes, Member
from pipistrelle.estimation.fastslam.block_conditional import (
    SLOPES,
    Pairs,
    excess_path_beyond,
    lanes_with_parent,
    lanes_with_sure_parent,
    shift_by_parent,
)
from pipistrelle.estimation.measurement import ExcessPaths
from pipistrelle.jit import Whole, kernel, no_alloc

Parents = tuple[Int[np.ndarray, " parents"], Float[np.ndarray, "b n slopes"]]
"""Number of each landmark's parent, and the slopes."""
ParentsAfter = tuple[Int[np.ndarray, " reached"], Float[np.ndarray, "b more slopes"]]
"""The same, with the landmarks of a scan that are new."""


@no_alloc
def slot_of(landmark: Int[np.ndarray, " n"], label: Whole) -> Whole:
    """Return the number of a landmark; -1 for one that is not in the map."""
    for n in range(landmark.size):
        if landmark[n] == label:
            return n
    return -1


@kernel
def assign_parents(
    parents: Parents,
    landmark: Int[np.ndarray, " n"],
    count: Int[np.ndarray, "b k lanes"],
    particles: Whole,
    heard: ExcessPaths,
    callers: Int[np.ndarray, " c"],
) -> ParentsAfter:
    """Give landmarks of a scan a parent, new landmarks included.

    It is the first caller that they have an excess path by and that most particles have placed. A
    caller has no parent: its landmarks would depend on that, too.
    """
    parent, before = np.full(landmark.size, -1, dtype=np.int64), parents[1].shape[1]
    parent[: parents[0].size] = parents[0]
    for d in range(heard.landmark.size):
        n, h = slot_of(landmark, heard.landmark[d]), slot_of(landmark, heard.caller[d])
        new = n >= 0 and parent[n] < 0 and slot_of(callers, heard.landmark[d]) < 0
        known = 0
        for p in range(particles if new and 0 <= h < count.shape[1] else 0):
            known += count[p // LANES, h, p % LANES] == 1
        if 2 * known > particles:
            parent[n] = h
    slope = np.zeros((count.shape[0], parent.size if np.any(parent >= 0) else 0, SLOPES))
    slope[:, :before] = parents[1]
    return parent, slope


@kernel
def excess_paths_of_parents(
    parent: Int[np.ndarray, " n"],
    landmark: Int[np.ndarray, " n"],
    labels: Int[np.ndarray, " m"],
    heard: ExcessPaths,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return each measurement's excess path by its landmark's parent, with variance; or NaN."""
    excess_path, variance = np.full(labels.size, np.nan), np.full(labels.size, np.nan)
    for d in range(heard.landmark.size):
        n, m = slot_of(landmark, heard.landmark[d]), slot_of(labels, heard.landmark[d])
        if n >= 0 and m >= 0 and parent[n] >= 0 and landmark[parent[n]] == heard.caller[d]:
            excess_path[m], variance[m] = heard.excess_path[d], heard.variance[d]
    return excess_path, variance


@no_alloc
def shift_all(
    pairs: Pairs,
    first: Int[np.ndarray, " ends"],
    member: Float[np.ndarray, "c numbers"],
    sign: float,
) -> None:
    """Add the parents' parts to all landmarks that have one; with a sign of -1, subtract them."""
    for n in range(pairs.slope.shape[0]):
        h = pairs.parent[n]
        if h >= 0:
            shift_by_parent(member[first[h]], member[first[n]], pairs.slope[n], sign)


@no_alloc
def copy_row(source: Member, target: Member) -> None:
    """Copy a row."""
    for k in range(source.size):
        target[k] = source[k]


@no_alloc
def copy_lanes(source: Member, target: Member, turn: Lanes) -> None:
    """Copy a row in lanes that have a turn."""
    for k in range(0, source.size, LANES):
        for i in range(LANES):
            target[k + i] = source[k + i] if turn[i] > 0.0 else target[k + i]


@kernel
def gated_excess_paths(
    pose: Float[np.ndarray, "b rows"],
    first: Int[np.ndarray, " ends"],
    count: Int[np.ndarray, "b n lanes"],
    member: Float[np.ndarray, "b c numbers"],
    landmark: Int[np.ndarray, " n"],
    parents: Parents,
    heard: ExcessPaths,
    bound: float,
) -> Bool[np.ndarray, " d"]:
    """Tell which excess paths are beyond the bound for every particle that could use them."""
    (parent, slope), turn, usable = parents, np.empty(LANES), np.empty(LANES)
    gated = np.zeros(heard.landmark.size, dtype=np.bool_)
    for d in range(gated.size):
        n, h = slot_of(landmark, heard.landmark[d]), slot_of(landmark, heard.caller[d])
        gated[d] = 0 <= n < parent.size and h >= 0 and parent[n] == h
        for b in range(pose.shape[0] if gated[d] else 0):
            caller = member[b, first[h]]
            lanes_with_parent(count[b, n], count[b, h], turn)
            lanes_with_sure_parent(pose[b], caller, count[b, h], usable)
            gated[d] = gated[d] and excess_path_beyond(
                pose[b], caller, member[b, first[n]], slope[b, n], heard.excess_path[d],
                heard.variance[d], turn * usable, bound,
            )  # fmt: skip
    return gated


@kernel
def resample_slopes(
    slope: Float[np.ndarray, "b n slopes"], ancestor: Int[np.ndarray, " p"]
) -> Float[np.ndarray, "b n slopes"]:
    """Put the slopes of the ancestors in the particles' places; spare lanes follow the last."""
    copies = np.empty_like(slope)
    for b in range(slope.shape[0]):
        for i in range(LANES):
            source = ancestor[min(b * LANES + i, ancestor.size - 1)]
            copies[b, :, i::LANES] = slope[source // LANES, :, source % LANES :: LANES]
    return copies
