r"""Excess paths in the graph: one factor for all those of a frame, and those that wait.

An excess path :math:`e = |b - l| + |l - p| - |b - p|` is a factor between the pose from which it
was heard, the landmark l and the caller b, which is a landmark of the graph, too. GTSAM has no such
factor, so it calls Python back. It does so once for a frame: a factor holds all its excess paths,
and a kernel computes their errors and slopes together. A factor for each excess path gives the same
and calls back twenty times as often. The graph gets no denser: what was heard from one pose is
connected anyway once the solver has eliminated the pose.

Huber's loss is taken of each excess path alone, within the factor. As in GTSAM, an error is
:math:`\sqrt{2 \rho(z)}` where the total error is asked, and :math:`\sqrt{w} z` with
:math:`\sqrt{w} J` where slopes are asked, with

.. math:: z = \frac{e - \hat e}{\sigma}, \quad w = \min(1, k / |z|), \quad
          \rho = \tfrac12 z^2 \text{ or } k |z| - \tfrac12 k^2 .

An excess path waits until its landmark and its caller are in the graph (`ExcessPath`). At most
`MAX_WAITING` wait; the oldest are dropped. Where landmark or caller moves, the factor is of its
place at that pose (`caller_motion`), and an excess path from before it was placed is dropped.
"""

import math
from collections.abc import Collection, Iterable
from itertools import groupby
from typing import NamedTuple

import gtsam
import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.measurement import (
    HUBER_K,
    columns_of,
    excess_path_slopes,
    excess_paths,
    timings_of,
)
from pipistrelle.estimation.smoother.caller_motion import (
    NO_CHAINS,
    Chains,
    is_there,
    labels_in_graph,
    point_key,
)
from pipistrelle.estimation.smoother.graph import pose_key
from pipistrelle.jit import kernel

MAX_WAITING = 1000
"""How many excess paths may wait: those of some fifty frames."""


class ExcessPath(NamedTuple):
    """An excess path [m]: the pose that heard it, its landmark and caller, and its deviation."""

    node: int
    landmark: int
    caller: int
    excess_path: float
    std: float


def excess_paths_of(scan: Scan, node: int) -> tuple[ExcessPath, ...]:
    """Return the excess paths of a scan that was heard from pose number ``node``.

    >>> from dataclasses import replace
    >>> from pipistrelle.detection.scans import make_scan
    >>> timed = {"caller": 1, "excess_path": 3.0, "excess_path_std": 0.5}
    >>> scan = make_scan(0.0, np.array([4]), np.zeros(1), **timed)
    >>> excess_paths_of(replace(scan, callers=np.array([-1, 9])), 7)
    (ExcessPath(node=7, landmark=4, caller=9, excess_path=3.0, std=0.5),)
    """
    timings = timings_of(scan)
    if timings is None:
        return ()
    found = excess_paths(columns_of(scan), timings)
    columns = found.landmark, found.caller, found.excess_path, np.sqrt(found.variance)
    return tuple(
        ExcessPath(node, *row) for row in zip(*map(np.ndarray.tolist, columns), strict=True)
    )


def split_ready(
    heard: Iterable[ExcessPath],
    mapped: Collection[int],
    chains: Chains = NO_CHAINS,
    moving: Collection[int] = (),
) -> tuple[tuple[ExcessPath, ...], tuple[ExcessPath, ...]]:
    """Separate excess paths that may enter the graph from those that wait (the newest are kept).

    The newest is the last. An excess path of a caller in ``moving`` from before it was placed is
    dropped.

    >>> heard = [ExcessPath(0, 4, 9, 3.0, 0.5), ExcessPath(1, 5, 9, 2.0, 0.5)]
    >>> [[one.landmark for one in part] for part in split_ready(heard, {4, 9})]
    [[4], [5]]
    """
    entering, waiting, known = [], [], labels_in_graph(mapped, chains)
    for one in heard:
        ends = one.landmark, one.caller
        if moving and any(end in moving and not is_there(end, one.node, chains) for end in ends):
            continue
        ready = one.landmark in known and one.caller in known
        (entering if ready else waiting).append(one)
    return tuple(entering), tuple(waiting[-MAX_WAITING:])


def excess_path_factors(
    heard: Iterable[ExcessPath], *, robust: bool, chains: Chains = NO_CHAINS
) -> list[gtsam.CustomFactor]:
    """Return a factor for all excess paths of each pose; those of one pose follow one another.

    >>> rows = (0, 4, 3.0), (0, 5, 2.0), (3, 4, 2.0)
    >>> heard = [ExcessPath(node, label, 9, d, 0.5) for node, label, d in rows]
    >>> [len(factor.keys()) for factor in excess_path_factors(heard, robust=False)]
    [4, 3]
    """
    return [
        _factor(node, list(rows), HUBER_K if robust else math.inf, chains)
        for node, rows in groupby(heard, key=lambda one: one.node)
    ]


def _factor(
    node: int, rows: list[ExcessPath], believed: float, chains: Chains
) -> gtsam.CustomFactor:
    """Return the factor of the excess paths that were heard from one pose."""
    points = sorted({one.landmark for one in rows} | {one.caller for one in rows})
    place = {label: k for k, label in enumerate(points)}
    ends = np.array([[place[one.landmark], place[one.caller]] for one in rows], dtype=np.int64)
    measured = np.array([[one.excess_path, one.std] for one in rows])
    vehicle, others = pose_key(node), [point_key(label, node, chains) for label in points]

    def misfit(
        _: gtsam.CustomFactor, values: gtsam.Values, slopes: gtsam.JacobianVector | None
    ) -> Float[np.ndarray, " d"]:
        pose = values.atPose2(vehicle)
        places = np.concatenate(list(map(values.atPoint2, others))).reshape(-1, 2)
        at = pose.x(), pose.y(), pose.theta()
        if slopes is None:
            return huber_errors(at, places, ends, measured, believed)
        r, by_pose, by_place = misfits(at, places, ends, measured, believed)
        slopes[:] = gtsam.JacobianVector([by_pose, *by_place])  # one by one takes twice as long
        return r

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(rows)), [vehicle, *others], misfit)


@kernel
def huber_errors(
    at: tuple[float, float, float],
    places: Float[np.ndarray, "n 2"],
    ends: Int[np.ndarray, "d 2"],
    measured: Float[np.ndarray, "d 2"],
    believed: float,
) -> Float[np.ndarray, " d"]:
    """Return the roots of twice Huber's loss of each excess path, with the sign of its error.

    ``at`` is the pose; the rows of ``ends`` number landmark and caller among the places, those of
    ``measured`` are the excess path and its standard deviation.
    """
    r = np.empty(len(ends))
    for i in range(len(ends)):
        (px, py), (bx, by) = places[ends[i, 0]], places[ends[i, 1]]
        expected, _, _, _, _ = excess_path_slopes(at[0], at[1], px, py, bx, by)
        z = (expected - measured[i, 0]) / measured[i, 1]
        far = abs(z)
        r[i] = z if far <= believed else z / far * math.sqrt(believed * (2.0 * far - believed))
    return r


@kernel
def misfits(
    at: tuple[float, float, float],
    places: Float[np.ndarray, "n 2"],
    ends: Int[np.ndarray, "d 2"],
    measured: Float[np.ndarray, "d 2"],
    believed: float,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d 3"], Float[np.ndarray, "n d 2"]]:
    """Return the errors of excess paths and their slopes, weighted by Huber's rule.

    The slopes are by the pose, in its own axes, and by each place.
    """
    c, s, count = math.cos(at[2]), math.sin(at[2]), len(ends)
    r, by_pose, by_place = np.empty(count), np.zeros((count, 3)), np.zeros((len(places), count, 2))
    for i in range(count):
        landmark, caller = ends[i]
        (px, py), (bx, by) = places[landmark], places[caller]
        expected, u, v, p, q = excess_path_slopes(at[0], at[1], px, py, bx, by)
        z = (expected - measured[i, 0]) / measured[i, 1]
        less = math.sqrt(believed / abs(z)) if abs(z) > believed else 1.0
        r[i], scale = less * z, less / measured[i, 1]
        u, v, p, q = scale * u, scale * v, scale * p, scale * q
        by_place[landmark, i], by_place[caller, i] = (u, v), (p, q)
        by_pose[i, 0] = -c * (u + p) - s * (v + q)
        by_pose[i, 1] = s * (u + p) - c * (v + q)
    return r, by_pose, by_place
