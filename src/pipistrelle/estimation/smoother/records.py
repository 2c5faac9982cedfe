"""Records of arrays that the smoother's kernels take, and where each number stands."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.jit import Whole, kernel

POSE = 3
"""Numbers of the chain's state that are the pose."""
CALLER = 4
"""Numbers of each moving caller: its place and its velocity."""


class Front(NamedTuple):
    """The last state of the chain, given the border, and the evidence about the border."""

    C: Float[np.ndarray, "d n"]
    P: Float[np.ndarray, "d d"]
    information: Float[np.ndarray, "n n"]  # lower triangle


class Legs(NamedTuple):
    """How the vehicle came to each node of the chain; the first is the start."""

    mean: Float[np.ndarray, "k 3"]  # motion since the node before, in its axes
    noise: Float[np.ndarray, "k 3 3"]
    seconds: Float[np.ndarray, " k"]
    rows: Int[np.ndarray, "k 2"]  # what was heard from it: first row, and the one after the last
    slopes: Float[np.ndarray, "k 3 q"]
    """Of the motion, by the parameters of odometry, which stand first in the border."""
    scale: Int[np.ndarray, "1"]
    """Column of the speed's scale where nothing else tells how large the world is, or 0."""


class Rows(NamedTuple):
    """Measurements in the order of their nodes."""

    ends: Int[np.ndarray, "m 4"]
    """Slots of the landmark, and of the excess path's caller or -1; the node; the row of the
    landmark's bearing before, or -1."""
    numbers: Float[np.ndarray, "m 8"]  # as those of a scan


class Places(NamedTuple):
    """Where each slot, a landmark or a caller, stands among the unknowns, and the parameters."""

    index: Int[np.ndarray, " s"]  # column of the border; minus the index in the chain; 0: nowhere
    first: Int[np.ndarray, " v"]  # node at which each moving caller joins the chain
    begun: Float[np.ndarray, "v 2"]  # where it was placed then
    sensor: Int[np.ndarray, "4"]
    """Columns of the speed of sound, of the sensor's heading, of its place and of how late its
    clock is; 0: not estimated."""
    way: Float[np.ndarray, "k 3"]  # as `Legs.mean`
    seconds: Float[np.ndarray, " k"]


class Noise(NamedTuple):
    """Assumptions about measurements and moving callers."""

    believed: float  # Huber's bound in standard deviations, or infinity
    place_std: float  # of a moving caller when it joins the chain [m]
    speed_std: float  # of its velocity then, along an axis [m/s]
    walk_std: float  # of its velocity after 1 s [m/s]
    damping: float = 0.0  # information that holds every unknown at its point (Levenberg)


class Links(NamedTuple):
    """What elimination leaves of each node's predecessor: D beta + G x, with the covariance S."""

    D: Float[np.ndarray, "k d n"]
    G: Float[np.ndarray, "k d d"]
    S: Float[np.ndarray, "k d d"]


class Work(NamedTuple):
    """Arrays to work in."""

    F: Float[np.ndarray, "d d"]
    u: Float[np.ndarray, " d"]
    Q: Float[np.ndarray, "d d"]
    by: Float[np.ndarray, "d q"]  # slopes of a transition by the parameters of odometry
    T: Float[np.ndarray, "d d"]
    G: Float[np.ndarray, "d n"]
    C: Float[np.ndarray, "d n"]
    E: Float[np.ndarray, "d n"]
    M: Float[np.ndarray, "d d"]
    A: Float[np.ndarray, "d d"]
    B: Float[np.ndarray, "d d"]
    at: Int[np.ndarray, " e"]  # entries of one row: where they stand in the chain, then the border
    slope: Float[np.ndarray, " e"]
    alone: Bool[np.ndarray, "1"]  # whether each row corrects alone
    w: Float[np.ndarray, " n"]


Arrays = tuple[np.ndarray, ...]
"""A record as kernels are handed it: a plain tuple costs nothing at their door."""
Points = tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " n"]]
"""Points of linearisation: states of the chain, and the border (the first number is not used)."""


@kernel
def work_of(d: Whole, n: Whole, q: Whole) -> Work:
    """Return arrays to work in: a state of d numbers, a border of n, q parameters of odometry."""
    return Work(
        np.zeros((d, d)),
        np.zeros(d),
        np.zeros((d, d)),
        np.zeros((d, q)),
        np.zeros((d, d)),
        np.zeros((d, n)),
        np.zeros((d, n)),
        np.zeros((d, n)),
        np.zeros((d, d)),
        np.zeros((d, d)),
        np.zeros((d, d)),
        np.zeros(24, np.int64),
        np.zeros(24),
        np.zeros(1, np.bool_),
        np.zeros(n),
    )
