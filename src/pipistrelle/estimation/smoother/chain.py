"""Solution of the pose chain by elimination and relinearisation.

Linearisation points are kept, for consistency, until the estimate has moved too far from them. Then
the chain is eliminated again from the first changed segment on (`relinearised`), and for the
smoothed result as a whole until convergence (`converged`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.estimation.smoother.history import STRETCH, History, in_hindsight
from pipistrelle.estimation.smoother.observations import nonlinearity
from pipistrelle.estimation.smoother.records import Arrays, Stack
from pipistrelle.estimation.smoother.solution import (
    border_covariance,
    places_left,
    spread_back,
    spread_left,
    spread_with_border,
    trace_back,
)
from pipistrelle.estimation.smoother.sweep import Noise, Points, Solution, Stretch, Sweep
from pipistrelle.jit import optimised_once

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
    history: History, noise: Noise, points: Points, kept: Sequence[Stretch] = (), first: int = 0
) -> Solution:
    """Linearise, eliminate and solve the chain; segments before ``first`` come from ``kept``."""
    sweep = Sweep(history, noise, points)
    if first:
        sweep.take_up(kept, first)
    else:
        sweep.begin()
    sweep.go_to_the_end()
    return sweep.solved()


def stepped(
    solution: Solution, history: History, noise: Noise, guess: Float[np.ndarray, " d"]
) -> Sweep:
    """Return the chain extended by a node linearised at a guess, before the node's measurements."""
    at = solution.points.at.extended(1)
    at.arrays[0][history.nodes - 1] = guess
    sweep = Sweep(history, noise, replace(solution.points, at=at))
    sweep.go_on(solution)
    sweep.step()
    return sweep


def off_line(solution: Solution, history: History) -> float:
    """Return the linearisation error of the last node's measurements [std] (`nonlinearity`)."""
    points, k = (solution.points.at.arrays[0], solution.border), history.nodes - 1
    off = solution.state - points[0][k], solution.beta
    return nonlinearity(history.rows.arrays, history.span, solution.places, points, off)


def relinearised(
    solution: Solution, history: History, noise: Noise, still: float = STILL
) -> Solution:
    """Relinearise the chain at its solution; return it unchanged if that does not lower the cost.

    Levenberg damping is used if the cost would rise. Points that moved by less than ``still`` stay.
    """
    further, damping = _at_solution(solution, history, noise, still), LEAST_DAMPING
    while not further.cost <= solution.cost and damping <= MOST_DAMPING:
        damped = eliminated(history, (*noise[:4], damping), solution.points)
        further, damping = _at_solution(damped, history, noise, 0.0), 10.0 * damping
    return further if further.cost <= solution.cost else solution


def _at_solution(solution: Solution, history: History, noise: Noise, still: float) -> Solution:
    """Linearise, eliminate and solve the chain at its solution."""
    points, first = solved_points(solution, history, still)
    return eliminated(history, noise, points, solution.stretches, first)


def converged(solution: Solution, history: History, noise: Noise) -> Solution:
    """Iterate to the optimum, with landmarks leaving the separator after their last measurement.

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
    """Return the differences between two sets of points as a vector."""
    parts = (points.at.entries(0), points.spots, points.parameters)
    there = (others.at.entries(0), others.spots, others.parameters)
    return np.concatenate([(b - a).ravel() for a, b in zip(parts, there, strict=True)])


def _beyond(points: Points, step: Float[np.ndarray, " u"], times: float) -> Points:
    """Move points by a multiple of a step."""
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
    """Return the ratio of a step to the step before, or 0 if extrapolation would not help."""
    along, size = 0.0, 0.0
    for i in range(step.size):
        along += step[i] * before[i]
        size += before[i] * before[i]
    share = along / size if size > 0.0 else 0.0
    return share if LEAST_SHARE < share < MOST_SHARE else 0.0


def solved_points(solution: Solution, history: History, still: float) -> tuple[Points, int]:
    """Return the solution as linearisation points, and the first segment that they change."""
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
    among: Int[np.ndarray, " g"], still: float, first: int,
) -> int:  # fmt: skip
    """Return the entry segment of the earliest moved landmark, at most ``first``."""
    far = among[np.any(np.abs(moved[among]) > still, axis=1)]
    return min(first, int(entering[far].min(initial=first)))


def _links_of(stretch: Stretch) -> tuple[Arrays, int]:
    """Return the links of a segment and their number; the start has no link."""
    arrays, size = stretch.links.arrays, stretch.links.size
    return (arrays, size) if stretch.first else (tuple(one[1:] for one in arrays), size - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoothed:
    """All states, landmarks and parameters given all measurements."""

    states: Float[np.ndarray, "k d"]
    covariance: Float[np.ndarray, "k d d"]
    cross: Float[np.ndarray, "k d d"]
    """Cross-covariance of each state with the state before."""
    places: Float[np.ndarray, "l 2"]
    place_covariance: Float[np.ndarray, "l 2 2"]
    parameters: Float[np.ndarray, " p"]
    parameter_covariance: Float[np.ndarray, "p p"]


def smoothed(best: Solution, history: History) -> Smoothed:
    """Return means and covariances at the optimum."""
    size, n, w = history.nodes, best.beta.size, len(best.border)
    border, P = np.zeros((w, w)), best.covariance.copy()
    border[:n, :n] = border_covariance(best.factor)
    covariances = P, spread_with_border(best.front[0], border), border
    covariance, cross = np.zeros((2, size, *P.shape))
    covariance[-1], own = P, _known_beforehand(history)
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


def _known_beforehand(history: History) -> Float[np.ndarray, "l 2 2"]:
    """Return the prior covariances of the separator's landmarks."""
    xx, xy, yy = history.known[1].T
    det = xx * yy - xy * xy
    return np.stack([yy, -xy, -xy, xx], axis=1).reshape(-1, 2, 2) / det[:, None, None]
