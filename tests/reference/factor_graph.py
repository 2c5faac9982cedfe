"""The smoother's problem as a factor graph of GTSAM, and its optimum by a general solver."""

import math

import gtsam
import numpy as np

from pipistrelle.estimation.observations.excess_path import excess_path_of
from reference.everything import turned
from reference.timing import excess_path_jacobians

CALLER = 4
LEAST_STD = 1e-4


def pose_key(node):
    return gtsam.symbol("x", node)


def graph_of(belief):
    """Return the factors of all measurements of a belief, and its linearisation point."""
    history, (loss, place_std, speed_std, walk_std, _) = belief.history, belief.noise
    at, spots = belief.solution.points.at.entries(0), belief.solution.points.spots
    mean, noise, seconds, rows = map(history.legs.entries, range(4))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(history.nodes):
        values.insert(pose_key(k), gtsam.Pose2(*at[k, :3]))
        C = turned(mean[k, 2]).T @ noise[k] @ turned(mean[k, 2])
        if not noise[k].any():
            C = 1e-16 * np.eye(3)  # the vehicle has not moved
        model = gtsam.noiseModel.Gaussian.Covariance(C, False)
        if k:
            keys = pose_key(k - 1), pose_key(k)
            graph.add(gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*mean[k]), model))
        else:
            graph.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*mean[0]), model))
    for number, (label, place, (xx, xy, yy)) in enumerate(
        zip(history.placed, *history.known, strict=True)
    ):
        values.insert(gtsam.symbol("l", label), spots[number])
        model = gtsam.noiseModel.Gaussian.Information(np.array([[xx, xy], [xy, yy]]), False)
        graph.add(gtsam.PriorFactorPoint2(gtsam.symbol("l", label), place, model))
    for v, first in enumerate(history.first.tolist()):
        add_walk(graph, values, at, (v, first), (place_std, speed_std, walk_std), history, seconds)
    labels = list(history.slots)
    for k, (begin, end) in enumerate(rows):
        for ends, numbers in zip(
            history.rows.entries(0)[begin:end], history.rows.entries(1)[begin:end], strict=True
        ):
            point = key_of(history, labels, ends[0], k)
            if point is None:
                continue
            if not (math.isnan(numbers[0]) and math.isnan(numbers[1])):
                graph.add(direction(k, point, numbers, loss))
            caller = None if ends[1] < 0 else key_of(history, labels, ends[1], k)
            if caller is not None:
                graph.add(excess_path(k, point, caller, numbers, loss))
    return graph, values


def key_of(history, labels, slot, node):
    """Return the graph's key of a slot's position, as seen from a node; None if not initialised."""
    index, (label, _) = history.index[slot], labels[slot]
    if index > 0:
        return gtsam.symbol("l", label)
    v = (-index - 3) // CALLER
    return caller_key(v, node) if index < 0 and history.first[v] <= node else None


def caller_key(v, node):
    return gtsam.symbol("c", (v << 32) + node)


def velocity_key(v, node):
    return gtsam.symbol("v", (v << 32) + node)


def robust(noise, loss):
    """Add a robust loss to a noise model, by its place among the losses."""
    if loss == 0:
        return noise
    kinds = gtsam.noiseModel.mEstimator
    kind = kinds.Huber.Create(2.0) if loss == 1 else kinds.Cauchy.Create(2.385)
    return gtsam.noiseModel.Robust.Create(kind, noise)


def direction(node, point, numbers, loss):
    """Return the factor of a bearing, with its range if measured."""
    bearing, distance, _, across, along = numbers[:5]
    if math.isnan(bearing):
        noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, along), loss)
        return gtsam.RangeFactor2D(pose_key(node), point, distance, noise)
    if math.isnan(distance):
        noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, across), loss)
        return gtsam.BearingFactor2D(pose_key(node), point, gtsam.Rot2(bearing), noise)
    noise = robust(gtsam.noiseModel.Diagonal.Sigmas(np.array([across, along])), loss)
    return gtsam.BearingRangeFactor2D(pose_key(node), point, gtsam.Rot2(bearing), distance, noise)


def excess_path(node, point, caller, numbers, loss):
    """Return the factor of an excess path."""

    def misfit(_, values, slopes):
        pose = values.atPose2(pose_key(node))
        places = [values.atPoint2(key) for key in (point, caller)]
        here = np.array([pose.x(), pose.y()])
        if slopes is not None:
            by_pose, *by_places = excess_path_jacobians(here, *places)
            by_pose = np.append(by_pose @ turned(pose.theta())[:2, :2], 0.0)
            for k, by in enumerate((by_pose, *by_places)):
                slopes[k] = by[None]
        return np.array([excess_path_of(here, *places) - numbers[2]])

    noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, numbers[5]), loss)
    return gtsam.CustomFactor(noise, [pose_key(node), point, caller], misfit)


def add_walk(graph, values, at, caller, stds, history, seconds):
    """Add the states of a moving caller, and the factors between them."""
    (v, first), (place_std, speed_std, walk_std) = caller, stds
    i, two = 3 + CALLER * v, gtsam.noiseModel.Isotropic.Sigma
    for k in range(first, history.nodes):
        values.insert(caller_key(v, k), at[k, i : i + 2])
        values.insert(velocity_key(v, k), at[k, i + 2 : i + 4])
    graph.add(gtsam.PriorFactorPoint2(caller_key(v, first), history.begun[v], two(2, place_std)))
    graph.add(gtsam.PriorFactorPoint2(velocity_key(v, first), np.zeros(2), two(2, speed_std)))
    for k in range(first + 1, history.nodes):
        graph.add(walk(v, k, seconds[k], walk_std))


def walk(v, k, T, walk_std):
    """Return the motion factor of a caller's position and velocity between successive nodes."""
    stray, sway = walk_std**2 * T + LEAST_STD**2, walk_std**2 * T**3 / 12.0 + LEAST_STD**2
    keys = caller_key(v, k - 1), velocity_key(v, k - 1), caller_key(v, k), velocity_key(v, k)
    eye, by = np.eye(2), []
    for place, velocity in ((-1.0, -0.5 * T), (1.0, -0.5 * T)):
        by.append(np.vstack([place * eye, 0.0 * eye]))
        by.append(np.vstack([velocity * eye, np.sign(place) * eye]))

    def misfit(_, states, slopes):
        if slopes is not None:
            for number, slope in enumerate(by):
                slopes[number] = slope
        return sum(J @ states.atPoint2(key) for J, key in zip(by, keys, strict=True))

    noise = gtsam.noiseModel.Diagonal.Variances(np.repeat([sway, stray], 2))
    return gtsam.CustomFactor(noise, list(keys), misfit)


def optimum(graph, values, passes=40):
    """Return the optimum near given values, by Gauss-Newton steps.

    GTSAM's own optimisers stop as soon as the cost no longer decreases within rounding.
    """
    for _ in range(passes):
        values = values.retract(graph.linearize(values).optimize())
    return values
