"""Forward elimination along the pose chain, and its relinearisation until convergence.

Landmarks enter and leave the separator. A `Sweep` is mutable, used for a single frame or
elimination, and ends as an immutable `Solution`. Linearisation points are kept, for consistency,
until the estimate has moved too far from them. Then the chain is eliminated again from the first
changed segment on (`relinearised`), and for the smoothed result as a whole until convergence
(`converged`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.smoother.elimination import (
    Left,
    begin,
    border_covariance,
    eliminate,
    enter,
    leave,
    places_left,
    solve,
    spread_back,
    spread_left,
    step_to,
    trace_back,
)
from pipistrelle.estimation.smoother.history import STRETCH, History, in_hindsight
from pipistrelle.estimation.smoother.observations import nonlinearity
from pipistrelle.estimation.smoother.records import (
    CALLER,
    POSE,
    Arrays,
    Border,
    ChainState,
    Factor,
    NoiseModel,
    Square,
    Stack,
    multiply,
)
from pipistrelle.jit import optimised_once

COLUMNS = 32
"""Increment of the separator's capacity [columns]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """Linearisation points of all states, landmarks and calibration parameters."""

    at: Stack
    """States of the chain."""
    spots: Float[np.ndarray, "l 2"]
    """Positions of the separator's landmarks, by their numbers [m]."""
    parameters: Float[np.ndarray, " p"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Trajectory segment with the results of its elimination: each state given the next."""

    first: int
    """First node."""
    front: Arrays
    """`records.Front` before the segment, after landmarks left it; zeros at the start."""
    columns: Int[np.ndarray, " l"]
    """Columns of the landmarks at its start; 0 if not in the separator."""
    cost: float
    """Twice the cost of all before."""
    links: Stack
    """`records.Links` between its nodes, and from the node before."""
    gone: Int[np.ndarray, " g"]
    """Numbers of the landmarks that left the separator after its last node, in order."""
    freed: Int[np.ndarray, " g"]
    """Columns of these landmarks."""
    left: Left
    """Conditionals of these landmarks."""

    @property
    def last(self) -> int:
        """Index of the segment's last scan."""
        return self.first + self.links.size - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """The smoother's solution of all scans so far: last state, landmarks, factor and cost."""

    points: Points
    columns: Int[np.ndarray, " l"]
    """Columns of the landmarks now in the separator; 0: not in it."""
    border: Float[np.ndarray, " w"]
    """Linearisation points of the separator's columns."""
    stretches: tuple[Stretch, ...]
    front: Arrays
    """`records.Front` of the last node."""
    factor: Factor
    beta: Border
    state: ChainState
    """State of the last node: pose, then position and velocity of each moving caller."""
    covariance: Square
    cost: float
    """Twice the cost at the linearisation points, if all are current."""
    places: Arrays
    """Variable of each slot (`records.Places`)."""


class Sweep:
    """Mutable state of the smoother's forward pass, which eliminates pose after pose."""

    def __init__(self, history: History, noise: NoiseModel, points: Points) -> None:
        """Prepare a forward pass with all calibration parameters and no landmarks."""
        self.history, self.noise, self.points = history, noise, points
        self.columns = np.zeros(len(history.placed), np.int64)
        self.stretches: list[Stretch] = []
        self.cost = 0.0

    def begin(self) -> None:
        """Begin the forward pass at the start pose, with the priors of the parameters."""
        w, d = _room(1 + self.points.parameters.size), self.history.dimension
        self.front: Arrays = np.zeros((d, w)), np.zeros((d, d)), np.zeros((w, w))
        self.border = _padded(np.append(0.0, self.points.parameters), (w,))
        self._settle()
        self.cost = begin(
            self.front, self.history.motion, self.points.at.arrays[0], self.border,
            self.history.calibration.stds, self.noise.damping,
        )  # fmt: skip

    def resume(
        self,
        stretches: Sequence[Stretch],
        columns: Int[np.ndarray, " l"],
        front: Arrays,
        cost: float,
    ) -> None:
        """Resume the forward pass after already eliminated segments, from their results."""
        self.stretches, self.cost = list(stretches), cost
        self.columns[: columns.size], self.front = columns, tuple(map(np.copy, front))
        self.border = np.zeros(len(self.front[2]))
        self.border[1 : 1 + self.points.parameters.size] = self.points.parameters
        self._settle()
        self._write_spots(np.flatnonzero(self.columns))

    def go_to_the_end(self) -> None:
        """Continue the forward pass through all remaining segments of the trajectory."""
        entering = self.history.entering
        for number in range(len(self.stretches), 1 + (self.history.nodes - 1) // STRETCH):
            self._open()
            self.join(np.flatnonzero((entering == number) & (self.columns == 0)))
            first = self.stretches[-1].first
            last = min(first + STRETCH, self.history.nodes)
            self._extend(last - first)
            self._eliminate(max(first - 1, 0), first, last)
            if last < self.history.nodes:
                self.part()

    def step(self) -> None:
        """Predict the newest state to the last scan, before its measurements."""
        k = self.history.nodes - 1
        if k % STRETCH == 0:
            self.part()
            self._open()
        self._extend(1)
        span = k, self.size, self.stretches[-1].first
        links = self.stretches[-1].links.arrays
        self.cost += step_to(
            self.front, self.history.motion, self.places, self._linearised(), links,
            self.noise, span,
        )  # fmt: skip

    def hear(self) -> None:
        """Update the newest state with the measurements of the last scan."""
        k = self.history.nodes - 1
        self._eliminate(k, k, k + 1)

    def join(self, numbers: Int[np.ndarray, " l"]) -> None:
        """Add landmarks with their priors to the unknowns of the forward pass."""
        if not numbers.size:
            return
        taken, column = {*self.columns.tolist()}, 1 + self.points.parameters.size
        for number in numbers.tolist():
            while column in taken:
                column += 2
            self.columns[number], column = column, column + 2
        self._settle()
        self._write_spots(numbers)
        known = self.history.known[0][numbers], self.history.known[1][numbers]
        at = self.columns[numbers]
        self.cost += enter(self.front[2], at, known, self.border, self.noise.damping)

    def admit(self, history: History) -> None:
        """Adopt a history with new moving callers, and new landmarks that are added later."""
        before, self.history = self.history, history
        more = len(history.placed) - len(before.placed)
        self.columns = np.append(self.columns, np.zeros(more, np.int64))
        self._settle()
        spots = np.concatenate([self.points.spots, history.known[0][len(before.placed) :]])
        self.points = replace(self.points, spots=spots)
        self._widen(history.dimension, len(self.border))
        k, (_, P, _) = history.nodes - 1, self.front
        for v in range(len(before.callers), len(history.callers)):
            i = POSE + CALLER * v
            self.points.at.arrays[0][k, i : i + 2] = history.begun[v]
            P[range(i, i + 4), range(i, i + 4)] = np.square(
                np.repeat((self.noise.place_std, self.noise.speed_std), 2)
            )

    def part(self) -> None:
        """Eliminate the landmarks scheduled to leave the unknowns after the last segment."""
        stretch = self.history.leaves == len(self.stretches) - 1
        gone = np.flatnonzero(stretch & (self.columns > 0))
        if not gone.size:
            return
        freed, (d, w) = self.columns[gone], self.front[0].shape
        left = np.empty((gone.size, 2, w)), np.empty((gone.size, 2, d)), np.empty((gone.size, 2, 2))
        leave(self.front, freed, left)
        self.columns[gone] = 0
        self._settle()
        self.stretches[-1] = replace(self.stretches[-1], gone=gone, freed=freed, left=left)

    def solved(self) -> Solution:
        """Return the solution of all measurements up to the last scan."""
        n = self.size
        factor, beta = np.zeros((n, n)), np.empty(n)
        off, covariance = solve(self.front, n, factor, beta)
        beta[0] = 0.0
        return Solution(
            points=self.points,
            columns=self.columns,
            border=self.border,
            stretches=tuple(self.stretches),
            front=self.front,
            factor=factor,
            beta=beta,
            state=self.points.at.arrays[0][self.history.nodes - 1] + off,
            covariance=covariance,
            cost=self.cost,
            places=self.places,
        )

    def _open(self) -> None:
        """Begin a new trajectory segment at the newest state."""
        d, w = self.front[0].shape
        none = np.empty(0, np.int64)
        self.stretches.append(
            Stretch(
                first=STRETCH * len(self.stretches),
                front=tuple(map(np.copy, self.front)),
                columns=self.columns.copy(),
                cost=self.cost,
                links=Stack(tuple(np.zeros((STRETCH, d, size)) for size in (w, d, d))),
                gone=none,
                freed=none,
                left=(np.empty((0, 2, w)), np.empty((0, 2, d)), np.empty((0, 2, 2))),
            )
        )

    def _extend(self, count: int) -> None:
        """Extend the last trajectory segment by a number of scans."""
        last = self.stretches[-1]
        self.stretches[-1] = replace(last, links=last.links.extended(count))

    def _eliminate(self, stands: int, first: int, last: int) -> None:
        """Run the forward pass over some scans of the last segment, and add their cost."""
        stretch = self.stretches[-1]
        span = stands, first, last, self.size, stretch.first
        self.cost += eliminate(
            self.front, self.history.motion, self.history.rows.arrays, self.places,
            self._linearised(), stretch.links.arrays, self.noise, span,
        )  # fmt: skip

    def _settle(self) -> None:
        """Update the index of each landmark's and caller's unknowns, and the number of columns."""
        self.places = self.history.places(self.columns)
        last = int(self.columns.max()) + 2 if self.columns.size else 0
        self.size = max(1 + self.points.parameters.size, last)

    def _linearised(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the linearisation points of the states, and of landmarks and parameters."""
        return self.points.at.arrays[0], self.border

    def _write_spots(self, numbers: Int[np.ndarray, " l"]) -> None:
        """Write landmarks' linearisation points to their columns; enlarge arrays if necessary."""
        if self.size > len(self.border):
            self._widen(self.history.dimension, _room(self.size))
        for e in range(2):
            self.border[self.columns[numbers] + e] = self.points.spots[numbers, e]

    def _widen(self, d: int, w: int) -> None:
        """Enlarge all arrays to states of size d and to w columns for landmarks and parameters."""
        if self.front[0].shape == (d, w):
            return
        if d > len(self.front[0]):
            self.stretches = [_wider(stretch, d) for stretch in self.stretches]
        self.front = tuple(map(_padded, self.front, ((d, w), (d, d), (w, w))))
        self.border = _padded(self.border, (w,))
        if self.stretches:
            last = self.stretches[-1]
            shapes = (STRETCH, d, w), (STRETCH, d, d), (STRETCH, d, d)
            links = tuple(map(_padded, last.links.arrays, shapes))
            size = last.links.size
            self.stretches[-1] = replace(last, links=Stack(links, size, [size]))
        at = self.points.at
        if d > at.arrays[0].shape[1]:
            wider = _padded(at.arrays[0], (len(at.arrays[0]), d))
            self.points = replace(self.points, at=Stack((wider,), at.size, [at.size]))


def _wider(stretch: Stretch, d: int) -> Stretch:
    """Return a trajectory segment with arrays enlarged to states of size d."""
    D, G, S = stretch.links.arrays
    by_border, by_state, own = stretch.left
    (k, _, w), size = D.shape, stretch.links.size
    links = _padded(D, (k, d, w)), _padded(G, (k, d, d)), _padded(S, (k, d, d))
    C, P, information = stretch.front
    return replace(
        stretch,
        links=Stack(links, size, [size]),
        front=(_padded(C, (d, C.shape[1])), _padded(P, (d, d)), information),
        left=(by_border, _padded(by_state, (*by_state.shape[:2], d)), own),
    )


def _room(columns: int) -> int:
    """Round a number of matrix columns up to a multiple of `COLUMNS`, as spare capacity."""
    return -(-columns // COLUMNS) * COLUMNS


def _padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array enlarged to a shape, with zeros for the new entries."""
    padded = np.zeros(shape)
    padded[tuple(map(slice, array.shape))] = array
    return padded


CONVERGED = 1e-10
"""Change of the cost, absolute and relative, at convergence."""
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e9
"""Range of Levenberg damping [1/m^2, 1/rad^2]."""
PASSES = 30
"""Most relinearisations of the whole chain."""
LEAST_SHARE, MOST_SHARE = 0.2, 0.95
"""Range of ratios of consecutive steps within which the next step is extrapolated."""
STILL = 1e-4
"""Smallest change [m, rad] that moves a linearisation point."""


def eliminated(
    history: History,
    noise: NoiseModel,
    points: Points,
    kept: Sequence[Stretch] = (),
    first: int = 0,
) -> Solution:
    """Linearise and solve for all states and the map; keep the segments before ``first``."""
    sweep = Sweep(history, noise, points)
    if first:
        begun = kept[first]
        sweep.resume(kept[:first], begun.columns, begun.front, begun.cost)
    else:
        sweep.begin()
    sweep.go_to_the_end()
    return sweep.solved()


def stepped(solution: Solution, history: History, noise: NoiseModel, guess: ChainState) -> Sweep:
    """Extend a solution's forward pass by a new scan's state, linearised at a guess; return it."""
    at = solution.points.at.extended(1)
    at.arrays[0][history.nodes - 1] = guess
    sweep = Sweep(history, noise, replace(solution.points, at=at))
    sweep.resume(solution.stretches, solution.columns, solution.front, solution.cost)
    sweep.step()
    return sweep


def off_line(solution: Solution, history: History) -> float:
    """Return the largest linearisation error of the last scan's measurements [std]."""
    points, k = (solution.points.at.arrays[0], solution.border), history.nodes - 1
    off = solution.state - points[0][k], solution.beta
    return nonlinearity(history.rows.arrays, history.span, solution.places, points, off)


def relinearised(
    solution: Solution, history: History, noise: NoiseModel, still: float = STILL
) -> Solution:
    """Linearise at a solution and solve again; return the old solution if the cost would rise.

    Levenberg damping is used if the cost would rise. Points that moved by less than ``still`` stay.
    """
    further, damping = _at_solution(solution, history, noise, still), LEAST_DAMPING
    while not further.cost <= solution.cost and damping <= MOST_DAMPING:
        damped = eliminated(history, noise._replace(damping=damping), solution.points)
        further, damping = _at_solution(damped, history, noise, 0.0), 10.0 * damping
    return further if further.cost <= solution.cost else solution


def _at_solution(solution: Solution, history: History, noise: NoiseModel, still: float) -> Solution:
    """Linearise all equations at a given solution, and return the new solution."""
    points, first = solved_points(solution, history, still)
    return eliminated(history, noise, points, solution.stretches, first)


def converged(solution: Solution, history: History, noise: NoiseModel) -> Solution:
    """Iterate a solution to the least-squares optimum of all measurements, and return it.

    Huber weights converge linearly: the ratio of two steps extrapolates all further steps (Aitken).
    """
    history = in_hindsight(history)
    solution, before = eliminated(history, noise, solution.points), None
    for _ in range(PASSES):
        points, _ = solved_points(solution, history, 0.0)
        step, share = _between(solution.points, points), 0.0
        if before is not None and before.size == step.size:
            share = share_of(step, before)
        before = step if share == 0.0 else None
        further = eliminated(history, noise, _beyond(points, step, share / (1.0 - share)))
        if not further.cost <= solution.cost:
            further, before = relinearised(solution, history, noise, 0.0), None
        gain, solution = solution.cost - further.cost, further
        if gain <= CONVERGED * (1.0 + solution.cost):
            break
    return solution


def _between(points: Points, others: Points) -> Float[np.ndarray, " u"]:
    """Return the differences between two sets of linearisation points as a single vector."""
    parts = (points.at.entries(0), points.spots, points.parameters)
    there = (others.at.entries(0), others.spots, others.parameters)
    return np.concatenate([(b - a).ravel() for a, b in zip(parts, there, strict=True)])


def _beyond(points: Points, step: Float[np.ndarray, " u"], times: float) -> Points:
    """Return linearisation points moved by ``times`` an optimisation step."""
    if times == 0.0:
        return points
    states, size = points.at.entries(0), points.spots.size
    first = step[: states.size].reshape(states.shape)
    spots = step[states.size : states.size + size].reshape(points.spots.shape)
    at = Stack((states + times * first,), len(states), [len(states)])
    parameters = points.parameters + times * step[states.size + size :]
    return Points(at=at, spots=points.spots + times * spots, parameters=parameters)


@optimised_once
def share_of(step: Float[np.ndarray, " u"], before: Float[np.ndarray, " u"]) -> float:
    """Return the ratio of an optimisation step to the step before, or 0 if unfit to extrapolate."""
    along, size = 0.0, 0.0
    for i in range(step.size):
        along += step[i] * before[i]
        size += before[i] * before[i]
    share = along / size if size > 0.0 else 0.0
    return share if LEAST_SHARE < share < MOST_SHARE else 0.0


def solved_points(solution: Solution, history: History, still: float) -> tuple[Points, int]:
    """Return a solution as linearisation points, and the first trajectory segment that changes."""
    spots, parameters = solution.points.spots.copy(), solution.points.parameters.size
    beta = np.zeros(len(solution.border))
    beta[: solution.beta.size] = solution.beta
    beta[0] = 1.0
    states = solution.points.at.entries(0).copy()
    state, moved = solution.state - states[-1], spots - solution.points.spots
    there = np.flatnonzero(solution.columns)
    for e in range(2):
        moved[there, e] = beta[solution.columns[there] + e]
    first = 0 if np.any(np.abs(beta[1 : 1 + parameters]) > still) else len(solution.stretches) - 1
    entering = history.entering
    first = _earliest(entering, moved, there, still, first)
    off = np.zeros_like(states)
    for number in range(len(solution.stretches) - 1, -1, -1):
        stretch = solution.stretches[number]
        if stretch.gone.size:
            width = stretch.left[0].shape[2]
            places_left(stretch.left, stretch.freed, beta[:width], state)
            for e in range(2):
                moved[stretch.gone, e] = beta[stretch.freed + e]
            first = _earliest(entering, moved, stretch.gone, still, first)
        a, links, count = stretch.first, *_links_of(stretch)
        back = trace_back(links, beta[: links[0].shape[2]], state, count)
        off[stretch.last - count : stretch.last + 1], state = back, back[0]
        if np.any(np.abs(off[a : stretch.last + 1]) > still):
            first = min(first, number)
        if number <= first and not np.any(np.abs(state) > still):
            break
    changed = STRETCH * first
    states[changed:] += off[changed:]
    again = entering >= first
    spots[again] += moved[again]
    at, parameters = Stack((states,), len(states), [len(states)]), solution.points.parameters
    if first == 0:
        parameters = parameters + beta[1 : 1 + parameters.size]
    return Points(at=at, spots=spots, parameters=parameters), first


def _earliest(
    entering: Int[np.ndarray, " l"], moved: Float[np.ndarray, "l 2"],
    among: Int[np.ndarray, " g"], still: float, first: int
) -> int:  # fmt: skip
    """Return the first segment with a measurement of a moved landmark, at most ``first``."""
    far = among[np.any(np.abs(moved[among]) > still, axis=1)]
    return min(first, int(entering[far].min(initial=first)))


def _links_of(stretch: Stretch) -> tuple[Arrays, int]:
    """Return a segment's distributions of each state given the next, and their number."""
    arrays, size = stretch.links.arrays, stretch.links.size
    return (arrays, size) if stretch.first else (tuple(one[1:] for one in arrays), size - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothed:
    """Smoothed states, landmarks and calibration parameters, with covariances."""

    states: Float[np.ndarray, "k d"]
    covariance: Float[np.ndarray, "k d d"]
    cross: Float[np.ndarray, "k d d"]
    """Cross-covariance of each state with the state before."""
    places: Float[np.ndarray, "l 2"]
    place_covariance: Float[np.ndarray, "l 2 2"]
    parameters: Float[np.ndarray, " p"]
    parameter_covariance: Float[np.ndarray, "p p"]


def smoothed(best: Solution, history: History) -> Smoothed:
    """Return all states, landmarks and parameters with covariances, from the optimal solution."""
    size, n, w = history.nodes, best.beta.size, len(best.border)
    border, P = np.zeros((w, w)), best.covariance.copy()
    border[:n, :n] = border_covariance(best.factor)
    X = np.zeros(best.front[0].shape)
    multiply(best.front[0], border, X)
    covariances = P, X, border
    covariance, cross = np.zeros((2, size, *P.shape))
    covariance[-1], (xx, xy, yy) = P, history.known[1].T
    own = np.stack([yy, -xy, -xy, xx], axis=1).reshape(-1, 2, 2)  # the priors
    own /= (xx * yy - xy * xy)[:, None, None]
    there, parameters = np.flatnonzero(best.columns), slice(1, 1 + best.points.parameters.size)
    for number in there.tolist():
        at = slice(best.columns[number], best.columns[number] + 2)
        own[number] = border[at, at]
    about = border[parameters, parameters].copy()
    for stretch in reversed(best.stretches):
        if stretch.gone.size:
            own[stretch.gone] = spread_left(stretch.left, stretch.freed, covariances)
        links, count = _links_of(stretch)
        before = stretch.last - count
        covariance[before : stretch.last], cross[before + 1 : stretch.last + 1] = spread_back(
            links, covariances, count
        )
    return Smoothed(
        states=best.points.at.entries(0),
        covariance=covariance,
        cross=cross,
        places=best.points.spots,
        place_covariance=own,
        parameters=best.points.parameters,
        parameter_covariance=about,
    )
