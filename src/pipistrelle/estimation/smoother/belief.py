"""Belief of the smoother: a solution of all measurements, with its trajectory and map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError, RayConfig
from pipistrelle.detection.scans import BEARING, BEARING_STD, RANGE
from pipistrelle.estimation.beliefs import Gaussian, JointGaussian, Landmarks
from pipistrelle.estimation.motion import Pose
from pipistrelle.estimation.rays import ray_members
from pipistrelle.estimation.recovery import Recoverable
from pipistrelle.estimation.smoother.elimination import joint
from pipistrelle.estimation.smoother.history import STRETCH, History
from pipistrelle.estimation.smoother.observations import places_left
from pipistrelle.estimation.smoother.preintegration import Odometry, placed, poses_between
from pipistrelle.estimation.smoother.records import CALLER, POSE, ChainState, NoiseModel, Stack
from pipistrelle.estimation.smoother.sweep import (
    Smoothed,
    Solution,
    converged,
    eliminated,
    smoothed,
)
from pipistrelle.geometry import carrying, wrap
from pipistrelle.jit import kernel


def edited(
    history: History, remove: Sequence[int], merge: Sequence[tuple[int, int]]
) -> tuple[History, Bool[np.ndarray, " l"], int]:
    """Remove and merge landmarks in a history; return it, the kept landmarks and the first change.

    Their measurements are deleted or relabelled; the chain must be eliminated again from this node.
    """
    first = history.nodes - 1
    for label, former in merge:
        gone = _slot(history, former)
        placed = tuple(label if one == former else one for one in history.placed)
        history = replace(history, placed=placed)
        if (label, False) not in history.slots:
            slots = {(label, False) if n == gone else s: n for s, n in history.slots.items()}
            history = replace(history, slots=slots)
            continue
        kept = _slot(history, label)
        first = min(first, *history.heard[[kept, gone], 0].tolist())
        history = _merged(history, kept, gone)
    slots = [_slot(history, label) for label in remove]
    first = min([first, *history.heard[slots, 0].tolist()])
    history = _without(history, history.rows.entries(0), slots)
    index, border = history.index.copy(), np.zeros(len(history.placed), bool)
    border[index[index > 0] - 1] = True
    index[index > 0] = np.cumsum(border)[index[index > 0] - 1]
    placed = tuple(np.array(history.placed, np.int64)[border].tolist())
    known, leaves = tuple(one[border] for one in history.known), history.leaves[border]
    history = replace(history, index=index, placed=placed, known=known, leaves=leaves)
    return history, border, first


def _slot(history: History, label: int) -> int:
    """Return the index of a landmark in the history; raise InputError if moving or unknown."""
    if (label, False) not in history.slots:
        raise InputError(
            f"association: found landmark {label} to change, which is not on the map, or moves"
        )
    return history.slots[label, False]


def _merged(history: History, kept: int, gone: int) -> History:
    """Return the history with all measurements of a landmark assigned to another landmark."""
    if kept == gone:
        raise InputError("association: found a landmark to merge with itself; expected two")
    ends, index, heard = history.rows.entries(0).copy(), history.index.copy(), history.heard.copy()
    ends[:, :2][ends[:, :2] == gone] = kept
    if index[kept] == 0:
        index[kept], index[gone] = index[gone], 0
    heard[kept] = min(heard[kept, 0], heard[gone, 0]), max(heard[kept, 1], heard[gone, 1])
    return _without(replace(history, index=index, heard=heard), ends, [gone])


def _without(history: History, ends: Int[np.ndarray, "r 4"], slots: Sequence[int]) -> History:
    """Return a smoother's history with changed measurements, without some landmarks and theirs."""
    kept = np.append(np.ones(history.latest.size, bool), False)  # the last entry: no caller
    kept[slots] = False
    number, keep, legs = np.where(kept, np.cumsum(kept) - 1, -1), kept[ends[:, 0]], history.legs
    numbers, ends, latest = history.rows.entries(1)[keep], ends[keep], np.full(kept.sum(), -1)
    ends[:, :2] = number[ends[:, :2]]
    _link(ends, numbers, latest)
    before = np.append(0, np.cumsum(keep))
    arrays = [array[: legs.size] for array in legs.arrays]
    arrays[3] = before[arrays[3]]
    names = [name for name, slot in history.slots.items() if kept[slot]]
    return replace(
        history,
        slots={name: slot for slot, name in enumerate(names)},
        index=history.index[kept[:-1]],
        latest=latest,
        heard=history.heard[kept[:-1]],
        moves=history.moves[kept[:-1]],
        rows=Stack((ends, numbers), len(ends), [len(ends)]),
        legs=Stack(tuple(arrays), legs.size, [legs.size]),
    )


@kernel
def _link(
    ends: Int[np.ndarray, "r 4"], numbers: Float[np.ndarray, "r 8"], latest: Int[np.ndarray, " s"]
) -> None:
    """Write into each measurement the index of its landmark's previous bearing or range."""
    for row in range(ends.shape[0]):
        ends[row, 3] = -1
        if not (np.isnan(numbers[row, BEARING]) and np.isnan(numbers[row, RANGE])):
            ends[row, 3], latest[ends[row, 0]] = latest[ends[row, 0]], row


MapRow = tuple[int, Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float]
"""Label, position, covariance and weight of a hypothesis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherBelief(Recoverable):
    """The smoother's belief: the solution up to the last scan, and the control steps since."""

    at: Gaussian
    """Pose at the last node of the chain, (3) and (3, 3)."""
    ahead: Gaussian
    """Current pose, after the control steps since the last node."""
    odometry: Odometry
    """Control steps since the last node, with assumed parameters."""
    history: History
    solution: Solution
    noise: NoiseModel
    rays: RayConfig
    found: dict[str, Any] = field(init=False, repr=False, default_factory=dict)
    """Cache of the optimum and its covariances."""

    def best(self) -> Solution:
        """Return the converged solution of all measurements so far, cached."""
        if "best" not in self.found:
            self.found["best"] = converged(self.solution, self.history, self.noise)
        return self.found["best"]

    def smoothed(self) -> Smoothed:
        """Return all states and landmarks at the optimum, with covariances."""
        if "smoothed" not in self.found:
            self.found["smoothed"] = smoothed(self.best(), self.history)
        return self.found["smoothed"]

    def guess(self) -> ChainState:
        """Predict the current state: the vehicle's pose, and callers at constant velocity."""
        state = self.solution.state.copy()
        state[:POSE] = self.ahead.mean
        for i in range(POSE, len(state), CALLER):
            state[i : i + 2] += self.odometry.seconds * state[i + 2 : i + 4]
        return state

    def pose(self) -> Gaussian:
        """Return the current vehicle pose: mean [m, m, rad] and 3 x 3 covariance."""
        return self.ahead

    def placed(self, odometry: Odometry, first: int) -> Gaussian:
        """Return the world poses after the control steps of odometry, from step ``first`` on."""
        parameters = self.history.calibration.odometry.size
        return _placed(self.solution, self.at, odometry, first, parameters)

    def path(self) -> Gaussian:
        """Return the smoothed trajectory at each control step, given all measurements so far."""
        known, legs, steps = self.smoothed(), self.history.legs, self.history.steps
        mean = np.ascontiguousarray(known.states[:, :3])
        mean[:, 2] = wrap(mean[:, 2])
        nodes = mean, np.ascontiguousarray(known.covariance[:, :3, :3])
        cross, ends = np.ascontiguousarray(known.cross[:, :3, :3]), legs.entries(4)
        motion, led = self.history.motion, (steps.arrays[0], steps.arrays[1])
        parameters = self.history.calibration.odometry.size
        if parameters:
            known_now = known.parameters[:parameters]
            motion = motion[0] + (motion[4] * known_now).sum(axis=-1), *motion[1:]
            led = led[0] + (steps.arrays[2] * known_now).sum(axis=-1), led[1]
        poses, spread = poses_between(motion, ends, led, nodes, cross)
        last = Gaussian(mean=nodes[0][-1], covariance=nodes[1][-1])
        since = _placed(self.best(), last, self.odometry, 0, parameters)
        return Gaussian(
            mean=np.concatenate([poses, since.mean]),
            covariance=np.concatenate([spread, since.covariance]),
        )

    def landmarks(self) -> Landmarks:
        """Return the map: a Gaussian per located landmark, else a mixture along its bearing."""
        known, placed = self.smoothed(), self.history.placed
        points = zip(placed, known.places, known.place_covariance, [1.0] * len(placed), strict=True)
        return _map_of([*points, *self._rays(moving=False)])

    def calibration(self) -> dict[str, tuple[float, float]]:
        """Return each calibration parameter's estimate and standard deviation, by name."""
        known, made = self.smoothed(), self.history.calibration
        values = made.assumed + made.unit * known.parameters
        stds = made.unit * np.sqrt(known.parameter_covariance.diagonal())
        both = zip(values.tolist(), stds.tolist(), strict=True)
        return dict(zip(made.names, both, strict=True))

    def labels(self) -> list[int]:
        """Return the labels of all landmarks and callers, initialised or not."""
        return [label for label, _ in self.history.slots]

    def joint(self, among: Int[np.ndarray, " n"] | None = None) -> JointGaussian:
        """Return the joint Gaussian of pose, initialised landmarks and moving callers."""
        solution, steps = self.solution, self.ahead.mean[:2] - self.at.mean[:2]
        d, n, callers = len(solution.state), solution.beta.size, self._callers()
        there = np.flatnonzero(solution.columns)
        if among is not None:
            there = there[np.isin(np.array(self.history.placed, np.int64)[there], among)]
        at, rows = solution.columns[there], 3 + 2 * np.arange(there.size)
        first, seconds = 3 + 2 * there.size, self.odometry.seconds
        size, guess = first + 2 * len(callers), self.guess()
        by_chain, by_border = np.zeros((size, d)), np.zeros((size, n))
        by_chain[:3, :3] = np.eye(3)
        by_chain[0, 2], by_chain[1, 2] = -steps[1], steps[0]
        by_border[rows, at] = by_border[rows + 1, at + 1] = 1.0
        for i, (_, state) in zip(range(first, size, 2), callers, strict=True):
            by_chain[i, state] = by_chain[i + 1, state + 1] = 1.0
            by_chain[i, state + 2] = by_chain[i + 1, state + 3] = seconds
        points = (solution.border[:n] + solution.beta)[at[:, np.newaxis] + np.arange(2)].ravel()
        roving = [guess[state : state + 2] for _, state in callers]
        covariance = joint(solution.front, solution.factor, n, by_chain, by_border)
        covariance[:3, :3] = self.ahead.covariance
        strayed = self.noise.walk_std**2 * seconds**3 / 3.0
        covariance[first:, first:] += strayed * np.eye(size - first)
        labels = [self.history.placed[number] for number in there.tolist()]
        labels += [label for label, _ in callers]
        return JointGaussian(
            landmark=np.array(labels, np.int64),
            mean=np.concatenate((self.ahead.mean, points, *roving)),
            covariance=covariance,
        )

    def edited(self, remove: Sequence[int], merge: Sequence[tuple[int, int]]) -> "SmootherBelief":
        """Return the belief with some landmarks removed and some pairs of landmarks merged."""
        history, kept, node = edited(self.history, remove, merge)
        points = replace(self.solution.points, spots=self.solution.points.spots[kept])
        first, number = node // STRETCH, np.cumsum(kept) - 1
        stretches = [
            replace(one, columns=one.columns[kept[: one.columns.size]], gone=number[one.gone])
            for one in self.solution.stretches[: first + 1]
        ]
        solution = eliminated(history, self.noise, points, stretches, first)
        at = Gaussian(mean=solution.state[:3], covariance=solution.covariance[:3, :3])
        belief = replace(self, at=at, ahead=at, history=history, solution=solution)
        if not len(self.odometry.mean):
            return belief
        poses = belief.placed(self.odometry, len(self.odometry.mean) - 1)
        ahead = Gaussian(mean=poses.mean[-1], covariance=poses.covariance[-1])
        return replace(belief, ahead=ahead)

    def freed(self, pose: Pose, stds: Pose) -> "SmootherBelief":
        """Shift the pose and widen its covariance, gradually over the steps since the last scan."""
        if not len(self.odometry.mean):
            return self
        x, y, turned = pose - self.at.mean
        c, s = np.cos(self.at.mean[2]), np.sin(self.at.mean[2])
        end = np.array([c * x + s * y, c * y - s * x, turned]) - self.odometry.mean[-1]
        end[2] = wrap(end[2])
        share = np.linspace(0.0, 1.0, len(self.odometry.mean) + 1)[1:, np.newaxis]
        odometry = replace(
            self.odometry,
            mean=self.odometry.mean + share * end,
            covariance=self.odometry.covariance + share[:, np.newaxis] * np.diag(stds * stds),
        )
        ahead = self.placed(odometry, len(share) - 1)
        ahead = Gaussian(mean=ahead.mean[-1], covariance=ahead.covariance[-1])
        return replace(self, odometry=odometry, ahead=ahead)

    def moving(self) -> Landmarks:
        """Return the moving callers: Gaussians if tracked, else mixtures along a bearing."""
        state, C = self.solution.state, self.solution.covariance
        seconds, points = self.odometry.seconds, []
        strayed = self.noise.walk_std**2 * seconds**3 / 3.0 * np.eye(2)
        for label, i in self._callers():
            b, v = slice(i, i + 2), slice(i + 2, i + 4)
            spread = C[b, b] + seconds * (C[b, v] + C[v, b]) + seconds**2 * C[v, v] + strayed
            points.append((label, state[b] + seconds * state[v], spread, 1.0))
        return _map_of([*points, *self._rays(moving=True)])

    def tracks(self) -> dict[int, Gaussian]:
        """Return the past positions of moving callers by label, with a covariance for each step."""
        history = self.history
        if not history.callers:
            return {}
        mean, covariance = self.smoothed().states, self.smoothed().covariance
        rows = np.append(0, history.legs.entries(4)[1:, 1])
        size, found = history.steps.size + len(self.odometry.mean) + 1, {}
        for (label, i), first in zip(self._callers(), history.first.tolist(), strict=True):
            place, about = np.full((size, 2), np.nan), np.full((size, 2, 2), np.nan)
            place[rows[first:]] = mean[first:, i : i + 2]
            about[rows[first:]] = covariance[first:, i : i + 2, i : i + 2]
            found[label] = Gaussian(mean=place, covariance=about)
        return found

    def _callers(self) -> list[tuple[int, int]]:
        """Return the label and the state index of each moving caller."""
        return [(label, POSE + CALLER * v) for v, label in enumerate(self.history.callers)]

    def _rays(self, *, moving: bool) -> list[MapRow]:
        """Return map rows of unlocated landmarks or callers: hypotheses along their last bearing.

        The hypotheses of a ray, at least two, have equal weights. Ranges without bearings give
        two mirrored places, or none.
        """
        history, rays = self.history, []
        waits = (history.index == 0) & (history.latest >= 0) & (history.moves == moving)
        labels = list(history.slots)
        for slot in np.flatnonzero(waits).tolist():
            row = history.latest[slot]
            node, numbers = history.rows.arrays[0][row, 2], history.rows.arrays[1][row]
            if moving and node != history.nodes - 1:
                continue
            if np.isnan(numbers[BEARING]):
                rays += self._mirrored(labels[slot][0], row)
                continue
            (x, y, heading), C = self.at.mean, self.at.covariance
            if not moving:
                known = self.smoothed()
                (x, y, heading), C = known.states[node, :3], known.covariance[node, :3, :3]
            ranges, stds = ray_members(self.rays)
            if len(ranges) == 1:
                ranges, stds = np.repeat(ranges, 2), np.repeat(stds, 2)
            angle = heading + numbers[BEARING]
            along = np.array([np.cos(angle), np.sin(angle)])
            ahead, across = np.outer(along, along), np.eye(2) - np.outer(along, along)
            for far, spread in zip(ranges, stds, strict=True):
                noise = spread**2 * ahead + (far * numbers[BEARING_STD]) ** 2 * across
                mean = np.array([x, y]) + far * along
                rays.append((labels[slot][0], mean, noise + C[:2, :2], 1.0 / len(ranges)))
        return rays

    def _mirrored(self, label: int, row: int) -> list[MapRow]:
        """Return map rows of the two places that a landmark's ranges up to a row leave, if two."""
        best, history = self.best(), self.history
        border, poses = best.border.copy(), np.ascontiguousarray(self.smoothed().states)
        border[: best.beta.size] += best.beta
        places, noise = history.places(best.columns), (history.legs.arrays[1], self.noise.loss)
        count, *both = places_left(history.rows.arrays, row, (poses, border), places, *noise)
        if count < 2:
            return []
        share = 1.0 / (1.0 + math.exp(0.5 * (both[1][2] - both[0][2])))
        return [
            (label, np.array([x, y]), np.array([[xx, xy], [xy, yy]]), weight)
            for (x, y, _, xx, xy, yy), weight in zip(both, (1.0 - share, share), strict=True)
        ]


def _placed(
    solution: Solution, at: Gaussian, odometry: Odometry, first: int, parameters: int
) -> Gaussian:
    """Predict poses from a solution's last pose by odometry with the estimated calibration."""
    if not parameters:
        return placed(at, odometry, first)
    estimate = solution.border[1 : 1 + parameters] + solution.beta[1 : 1 + parameters]
    led = replace(odometry, mean=odometry.mean + (odometry.slopes * estimate).sum(axis=-1))
    poses, slopes = placed(at, led, first), odometry.slopes[first:]
    d, n = len(solution.state), solution.beta.size
    by_chain, by_border = np.zeros((3 + parameters, d)), np.zeros((3 + parameters, n))
    by_chain[:3, :3], by_border[3:, 1 : 1 + parameters] = np.eye(3), np.eye(parameters)
    about = joint(solution.front, solution.factor, n, by_chain, by_border)
    # The poses' covariance due to the parameters, and to their correlation with the start.
    c, s = np.cos(at.mean[2]), np.sin(at.mean[2])
    by_start, by = carrying(poses.mean[:, :2] - at.mean[:2]), slopes.copy()
    by[:, 0], by[:, 1] = c * slopes[:, 0] - s * slopes[:, 1], s * slopes[:, 0] + c * slopes[:, 1]
    mixed = np.einsum("mae,ef,mbf->mab", by, about[3:, :3], by_start)
    own = np.einsum("mae,ef,mbf->mab", by, about[3:, 3:], by)
    more = mixed + np.swapaxes(mixed, 1, 2) + own
    return replace(poses, covariance=poses.covariance + more)


def _map_of(rows: Sequence[MapRow]) -> Landmarks:
    """Convert map rows (label, position, covariance, weight) to a `Landmarks` record."""
    return Landmarks(
        landmark=np.array([row[0] for row in rows], dtype=np.int64),
        mean=np.array([row[1] for row in rows]).reshape(-1, 2),
        covariance=np.array([row[2] for row in rows]).reshape(-1, 2, 2),
        weight=np.array([row[3] for row in rows], dtype=float),
    )
