"""The gate: what is outside a share of its predicted distribution is dropped."""

import math
from collections.abc import Collection, Sequence

import gtsam
import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import NO_INNOVATIONS, Innovations
from pipistrelle.estimation.measurement import (
    detour_jacobians,
    detour_of,
    measurement_jacobians,
    observe,
)
from pipistrelle.estimation.rays import gate_bounds
from pipistrelle.estimation.smoother.detours import Detour
from pipistrelle.estimation.smoother.graph import pose_key, pose_of
from pipistrelle.estimation.smoother.legs import turned
from pipistrelle.estimation.smoother.roaming import NO_CHAINS, Chains, known_of, point_key
from pipistrelle.geometry import wrap_angle


def rows_inside(
    isam: gtsam.ISAM2,
    node: int,
    mapped: Collection[int],
    scan: Scan,
    gate: float,
    chains: Chains = NO_CHAINS,
) -> tuple[Bool[np.ndarray, " m"], Innovations]:
    """Tell of which rows bearing and range are inside, or are of what is new.

    Parameters
    ----------
    isam : ISAM2
    node : int
        Number of the pose from which the scan was heard.
    mapped : collection of int
        Landmarks in the graph.
    scan : Scan
    gate : float
    chains : mapping of label to Chain
        Callers that move and are in the graph.

    Returns
    -------
    (m)
        True where a row is but a detour.
    Innovations
        Of the rows that are inside, and of nothing new.
    """
    key = pose_key(node)
    pose = pose_of(isam.calculateEstimatePose2(key))
    known, bounds = known_of(mapped, chains), gate_bounds(gate)
    M, inside, off_by = np.eye(5), np.ones(scan.landmark.size, bool), NO_INNOVATIONS
    M[:3, :3] = turned(pose[2])
    for m, label in enumerate(scan.landmark.tolist()):
        if label not in known or math.isnan(scan.bearing[m]):
            continue
        other = point_key(label, node, chains)
        point = np.array(isam.calculateEstimatePoint2(other))
        joint = _joint(isam, key, other)
        near, expected, _, _, _ = observe(*pose, *point)
        H = np.hstack(measurement_jacobians(pose, point)) @ M
        off = np.array([scan.range[m] - near, wrap_angle(scan.bearing[m] - expected)])
        R = np.square([scan.range_std[m], scan.bearing_std[m]])
        rows = slice(1, 2) if math.isnan(scan.range[m]) else slice(0, 2)
        S = (H @ joint @ H.T + np.diag(R))[rows, rows]
        squared = float(off[rows] @ np.linalg.solve(S, off[rows]))
        inside[m] = squared <= bounds[len(off[rows]) - 1]
        if inside[m]:
            off_by = off_by.plus(squared, float(len(off[rows])))
    return inside, off_by


def detours_inside(
    isam: gtsam.ISAM2,
    mapped: Collection[int],
    heard: Sequence[Detour],
    gate: float,
    chains: Chains = NO_CHAINS,
) -> tuple[Detour, ...]:
    """Return those detours that are inside, or whose landmark or caller is new.

    Each is judged by itself, not with the bearing of its row: what is wrong with one, a direct call
    that was another sound, is nothing to the other.

    Parameters
    ----------
    isam : ISAM2
    mapped : collection of int
        Landmarks in the graph.
    heard : sequence of Detour
        All from one pose.
    gate : float
    chains : mapping of label to Chain
        Callers that move and are in the graph.

    Returns
    -------
    tuple of Detour
    """
    known, bound = known_of(mapped, chains), gate_bounds(gate)[0]
    return tuple(
        one
        for one in heard
        if not (one.landmark in known and one.caller in known)
        or _surprise(isam, one, chains) <= bound
    )


def _surprise(isam: gtsam.ISAM2, one: Detour, chains: Chains) -> float:
    """Return the squared distance of a detour from what is expected, in its variances."""
    ends = [point_key(end, one.node, chains) for end in (one.landmark, one.caller)]
    keys = pose_key(one.node), *ends
    pose = pose_of(isam.calculateEstimatePose2(keys[0]))
    points = [np.array(isam.calculateEstimatePoint2(key)) for key in keys[1:]]
    by_pose, *by_points = detour_jacobians(pose[:2], *points)
    H = np.concatenate([by_pose @ turned(pose[2])[:2, :2], [0.0], *by_points])
    off = one.detour - detour_of(pose[:2], *points)
    return off**2 / float(H @ _joint(isam, *keys) @ H + one.std**2)


def _joint(isam: gtsam.ISAM2, *keys: int) -> Float[np.ndarray, "d d"]:
    """Return the covariance of some variables together, a pose's in its own axes."""
    told = isam.jointMarginalCovariance(list(keys))
    return np.block([[told.at(a, b) for b in keys] for a in keys])
