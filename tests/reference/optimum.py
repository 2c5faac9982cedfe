"""The smoother's problem solved from the truth: what it should have found from its own poses."""

import numpy as np

from pipistrelle.estimation.smoother.chain import converged, eliminated


def from_the_truth(belief, path, places):
    """Return the best solution as the belief has it, and as it is reached from the true poses.

    `path` (k + 1, 3) holds the true pose at the start and after each step, `places` the true
    place of each landmark by its label.
    """
    history, (_, border) = belief.history, belief.solution.points()
    steps = np.append(0, history.legs.entries(4)[1:, 1])
    there = np.zeros_like(border)
    for number, label in enumerate(history.placed):
        there[1 + 2 * number : 3 + 2 * number] = places[label]
    other = eliminated(history, belief.noise, np.ascontiguousarray(path[steps]), there)
    return belief.best(), converged(other, history, belief.noise)


def poses_of(solution):
    """Return the poses of the nodes at a solution."""
    return solution.trail.entries(0)[:, :3]
