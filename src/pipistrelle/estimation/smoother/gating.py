"""The gate: measurements outside a share of their predicted distribution are dropped."""

import math
from collections.abc import Collection, Sequence

import gtsam
import numpy as np
from jaxtyping import Bool

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import NO_INNOVATIONS, Innovations
from pipistrelle.estimation.measurement import (
    excess_path_jacobians,
    excess_path_of,
    measurement_jacobians,
    observe,
)
from pipistrelle.estimation.rays import gate_bounds
from pipistrelle.estimation.smoother.caller_motion import (
    NO_CHAINS,
    Chains,
    labels_in_graph,
    point_key,
)
from pipistrelle.estimation.smoother.graph import joint_covariance, pose_key, pose_of
from pipistrelle.estimation.smoother.preintegration import turned
from pipistrelle.estimation.smoother.tdoa import ExcessPath
from pipistrelle.geometry import wrap_angle


def rows_inside(
    isam: gtsam.ISAM2,
    node: int,
    mapped: Collection[int],
    scan: Scan,
    gate: float,
    chains: Chains = NO_CHAINS,
) -> tuple[Bool[np.ndarray, " m"], Innovations]:
    """Find rows that pass the gate or whose landmark is new, and return their innovations, too.

    ``node`` is the number of the pose from which the scan was heard. A row without a bearing
    passes.
    """
    key = pose_key(node)
    pose = pose_of(isam.calculateEstimatePose2(key))
    known, bounds = labels_in_graph(mapped, chains), gate_bounds(gate)
    M, inside, off_by = np.eye(5), np.ones(scan.landmark.size, bool), NO_INNOVATIONS
    M[:3, :3] = turned(pose[2])
    for m, label in enumerate(scan.landmark.tolist()):
        if label not in known or math.isnan(scan.bearing[m]):
            continue
        other = point_key(label, node, chains)
        point = np.array(isam.calculateEstimatePoint2(other))
        joint = joint_covariance(isam, key, other)
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


def excess_paths_inside(
    isam: gtsam.ISAM2,
    mapped: Collection[int],
    heard: Sequence[ExcessPath],
    gate: float,
    chains: Chains = NO_CHAINS,
) -> tuple[ExcessPath, ...]:
    """Return the excess paths that pass the gate, or whose landmark or caller is not in the graph.

    Each is judged alone, not with the bearing of its row: an error of one, such as a wrong direct
    call, says nothing about the other. All are heard from one pose.
    """
    known, bound = labels_in_graph(mapped, chains), gate_bounds(gate)[0]
    return tuple(
        one
        for one in heard
        if not (one.landmark in known and one.caller in known)
        or _surprise(isam, one, chains) <= bound
    )


def _surprise(isam: gtsam.ISAM2, one: ExcessPath, chains: Chains) -> float:
    """Return the squared innovation of an excess path divided by its variance."""
    ends = [point_key(end, one.node, chains) for end in (one.landmark, one.caller)]
    keys = pose_key(one.node), *ends
    pose = pose_of(isam.calculateEstimatePose2(keys[0]))
    points = [np.array(isam.calculateEstimatePoint2(key)) for key in keys[1:]]
    by_pose, *by_points = excess_path_jacobians(pose[:2], *points)
    H = np.concatenate([by_pose @ turned(pose[2])[:2, :2], [0.0], *by_points])
    off = one.excess_path - excess_path_of(pose[:2], *points)
    return off**2 / float(H @ joint_covariance(isam, *keys) @ H + one.std**2)
