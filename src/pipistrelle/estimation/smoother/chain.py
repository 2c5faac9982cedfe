"""The chain solved: points of linearisation, the front at its last node, and the solution there.

A `Solution` is never changed. Each frame steps to a new node (`stepped`) and hears there
(`heard`). All is linearised at points that stay, so that what is believed is consistent, until
something has moved too far from them: then all is eliminated anew (`relinearised`).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.smoother.elimination import begin, eliminate, step_to
from pipistrelle.estimation.smoother.history import History
from pipistrelle.estimation.smoother.linearity import nonlinearity
from pipistrelle.estimation.smoother.records import CALLER, POSE, Arrays, Points
from pipistrelle.estimation.smoother.solution import retrace, solve
from pipistrelle.estimation.smoother.stack import Stack

Noise = tuple[float, ...]
"""As `records.Noise`."""
COLUMNS = 32
"""The border has room for a multiple of so many columns."""
CONVERGED = 1e-10
"""Change of the cost, absolute and relative, under which the optimum is reached."""
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e9
"""The least and the most information that holds every unknown at its point [1/m^2, 1/rad^2]."""
PASSES = 30
"""How often all is linearised anew, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """A chain that is solved up to its last node."""

    trail: Stack  # points of the chain's states; then E, T, M (`records.Trail`)
    border: Float[np.ndarray, " w"]  # points of the border's columns
    front: Arrays  # `records.Front`
    factor: Float[np.ndarray, "n n"]
    beta: Float[np.ndarray, " n"]
    state: Float[np.ndarray, " d"]
    """State of the last node: pose, then place and velocity of each moving caller."""
    covariance: Float[np.ndarray, "d d"]
    cost: float = np.inf  # twice that at the points, where all was linearised there

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of linearisation of the chain and of the border."""
        return self.trail.arrays[0], self.border

    def places(self) -> Float[np.ndarray, " n"]:
        """Return the border as it is believed; its first number means nothing."""
        return self.border[: self.beta.size] + self.beta


def eliminated(
    history: History, noise: Noise, at: Float[np.ndarray, "k d"], border: Float[np.ndarray, " w"]
) -> Solution:
    """Return the chain linearised at points, eliminated from its start and solved."""
    (k, d), w = at.shape, border.size
    trail = _trail(k, d, w)
    trail.arrays[0][:k] = at
    front = np.empty((d, w)), np.empty((d, d)), np.empty((w, w))
    points = trail.arrays[0], border
    cost = begin(front, history.motion, history.known, points, noise[4])
    cost += _run(history, noise, points, trail, front, 0)
    return _solved(history, trail, border, front, cost)


def _trail(nodes: int, d: int, w: int) -> Stack:
    """Return a trail of so many nodes, to be written."""
    room = max(2 * nodes, 64)
    shapes = (room, d), (room, d, w), (room, d, d), (room, d, d)
    return Stack(tuple(map(np.zeros, shapes)), nodes, [nodes])


def _run(
    history: History, noise: Noise, points: Points, trail: Stack, front: Arrays, first: int
) -> float:
    """Eliminate from a node on, in place; return twice the cost."""
    span = first, history.nodes, history.columns
    return eliminate(
        front, history.motion, history.rows.arrays, history.places(), points,
        trail.arrays[1:], noise, span,
    )  # fmt: skip


def _solved(
    history: History, trail: Stack, border: np.ndarray, front: Arrays, cost: float
) -> Solution:
    """Return the solution at the last node of a chain that is eliminated."""
    n = history.columns
    factor, beta = np.empty((n, n)), np.empty(n)
    off, covariance = solve(front, n, factor, beta)
    beta[0] = 0.0
    return Solution(
        trail=trail,
        border=border,
        front=front,
        factor=factor,
        beta=beta,
        state=trail.arrays[0][history.nodes - 1] + off,
        covariance=covariance,
        cost=cost,
    )


def stepped(solution: Solution, history: History, noise: Noise, guess: np.ndarray) -> Solution:
    """Return the chain with a node more, before anything is heard there, linearised at a guess."""
    solution = _with_room(solution, history)
    trail, k = solution.trail.extended(1), history.nodes - 1
    trail.arrays[0][k] = guess
    front = tuple(map(np.copy, solution.front))
    places, at = history.places(), trail.arrays[0]
    cost = step_to(front, history.motion, places, at, noise, (k, history.columns))
    return Solution(
        trail=trail,
        border=solution.border,
        front=front,
        factor=solution.factor,
        beta=solution.beta,
        state=guess,
        covariance=solution.covariance,
        cost=solution.cost + cost,
    )


def joined(solution: Solution, before: History, history: History, noise: Noise) -> Solution:
    """Return the chain with the places that enter at its last node; its front is used up."""
    solution, k = _with_room(solution, history), history.nodes - 1
    border, (_, P, information) = solution.border.copy(), solution.front
    border[before.columns : history.columns] = history.known[0][len(before.placed) :].ravel()
    for i in range(before.columns, history.columns):
        information[i, i] += noise[1] ** -2
    for v in range(len(before.callers), len(history.callers)):
        i = POSE + CALLER * v
        solution.trail.arrays[0][k, i : i + 2] = history.begun[v]
        P[range(i, i + 4), range(i, i + 4)] = np.square(np.repeat(noise[1:3], 2))
    return replace(solution, border=border)


def waited(before: History, history: History) -> bool:
    """Tell whether measurements from before the last node count now, and did not before."""
    if history is before:
        return False
    new = np.flatnonzero(history.index != before.index)
    earlier = history.rows.arrays[0][: history.span[1], :2]
    return bool(np.isin(earlier, new[history.index[new] > 0]).any())


def off_line(solution: Solution, history: History) -> float:
    """Return how far the lines of the last node's measurements are off (`linearity`)."""
    estimate, places = (solution.state, solution.places()), history.places()
    return nonlinearity(history.rows.arrays, history.span, places, solution.points(), estimate)


def heard(solution: Solution, history: History, noise: Noise) -> Solution:
    """Return the chain solved with what is heard from the last node; its front is used up."""
    trail, border, front = solution.trail, solution.border, solution.front
    cost = _run(history, noise, solution.points(), trail, front, history.nodes - 1)
    return _solved(history, trail, border, front, solution.cost + cost)


def relinearised(solution: Solution, history: History, noise: Noise) -> Solution:
    """Return the chain linearised at its solution, or on the way there, where that costs less.

    Where the solution costs more than its points, steps are damped as Levenberg's are. Where no
    step leads to less, the chain stays as it is.
    """
    further, damping = _at_solution(solution, history, noise), LEAST_DAMPING
    while not further.cost <= solution.cost and damping <= MOST_DAMPING:
        damped = eliminated(
            history, (*noise[:4], damping), solution.trail.entries(0), solution.border
        )
        further, damping = _at_solution(damped, history, noise), 10.0 * damping
    return further if further.cost <= solution.cost else solution


def _at_solution(solution: Solution, history: History, noise: Noise) -> Solution:
    """Return the chain linearised at its solution, eliminated and solved anew."""
    beta, n = solution.beta.copy(), history.columns
    beta[0] = 1.0
    states = retrace(
        history.motion, history.places(), solution.points(), solution.trail.arrays[1:],
        noise, beta, history.nodes,
    )  # fmt: skip
    border = solution.border.copy()
    border[1:n] += beta[1:]
    return eliminated(history, noise, states, border)


def converged(solution: Solution, history: History, noise: Noise) -> Solution:
    """Return the chain at its optimum."""
    for _ in range(PASSES):
        before, solution = solution.cost, relinearised(solution, history, noise)
        if before - solution.cost <= CONVERGED * (1.0 + solution.cost):
            break
    return solution


def _with_room(solution: Solution, history: History) -> Solution:
    """Return a solution whose arrays have room for all columns and callers."""
    d, w = history.dimension, solution.border.size
    if d == len(solution.state) and history.columns <= w:
        return solution
    w = -(-history.columns // COLUMNS) * COLUMNS
    k, size = len(solution.trail.arrays[0]), solution.trail.size
    arrays = tuple(
        _padded(array, shape)
        for array, shape in zip(
            solution.trail.arrays, ((k, d), (k, d, w), (k, d, d), (k, d, d)), strict=True
        )
    )
    front = tuple(map(_padded, solution.front, ((d, w), (d, d), (w, w))))
    return replace(
        solution,
        trail=Stack(arrays, size, [size]),
        border=_padded(solution.border, (w,)),
        front=front,
    )


def _padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array in the corner of a larger one of zeros."""
    padded = np.zeros(shape)
    padded[tuple(map(slice, array.shape))] = array
    return padded
