"""The smoother's problem solved from the true poses, for comparison with its solution."""

from dataclasses import replace

import numpy as np

from pipistrelle.estimation.smoother.records import Stack
from pipistrelle.estimation.smoother.sweep import converged, eliminated


def from_the_truth(belief, path, places):
    """Return a smoother's best solution, and the optimum reached from the true poses.

    `path` (k + 1, 3) holds the true pose at the start and after each step, `places` the true
    position of each landmark by its label.
    """
    history = belief.history
    steps = np.append(0, history.legs.entries(4)[1:, 1])
    there = np.array([places[label] for label in history.placed]).reshape(-1, 2)
    at = Stack((np.ascontiguousarray(path[steps]),), len(steps), [len(steps)])
    other = eliminated(history, belief.noise, replace(belief.solution.points, at=at, spots=there))
    return belief.best(), converged(other, history, belief.noise)


def poses_of(solution):
    """Return the poses of the nodes at a solution."""
    return solution.points.at.entries(0)[:, :3]
