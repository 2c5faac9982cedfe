"""Landmarks of all particles: as one Gaussian, taken out, and two that become one."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.config import InputError
from pipistrelle.estimation.beliefs import JointGaussian
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.geometry import wrap

if TYPE_CHECKING:
    from pipistrelle.estimation.fastslam.filter import FastSlamBelief


def joint_of(belief: "FastSlamBelief") -> JointGaussian:
    r"""Return pose and placed landmarks of all particles as one Gaussian.

    .. math:: \bar x = \sum_i w_i x_i, \qquad
              P = \sum_i w_i \left( (x_i - \bar x)(x_i - \bar x)^T + P_i \right)

    with each particle's own covariances :math:`P_i` of its pose and of its landmarks. A landmark
    counts that most particles have placed; where one has not, it is at the mean.
    """
    particles = belief.log_weight.size
    weight = np.exp(belief.log_weight - belief.log_weight.max())
    weight /= weight.sum()
    placed = _lanes(belief.count)[:particles] == 1
    there = np.flatnonzero(np.einsum("p,pn->n", weight, placed) > 0.5)
    rows = _numbers(belief.poses, 9)[:particles]
    members = _numbers(belief.member[:, belief.first[there]], 6)[:particles]
    share = weight[:, np.newaxis] * placed[:, there]
    share /= share.sum(axis=0)
    spots = np.einsum("pn,pne->ne", share, members[..., :2])
    rows[:, 2] = belief.estimate.mean[2] + wrap(rows[:, 2] - belief.estimate.mean[2])
    mean = np.append(np.einsum("p,pe->e", weight, rows[:, :3]), spots.ravel())
    points = np.where(placed[:, there, np.newaxis], members[..., :2], spots)
    off = np.hstack([rows[:, :3], points.reshape(particles, 2 * there.size)]) - mean
    covariance = np.einsum("p,pd,pe->de", weight, off, off, optimize=True)
    covariance[:3, :3] += _packed(np.einsum("p,pe->e", weight, rows[:, 3:9]))
    own = np.einsum("pn,pne->ne", share, members[..., 2:5])
    for n, (xx, xy, yy) in enumerate(own.tolist()):
        covariance[3 + 2 * n : 5 + 2 * n, 3 + 2 * n : 5 + 2 * n] += [[xx, xy], [xy, yy]]
    return JointGaussian(landmark=belief.landmark[there], mean=mean, covariance=covariance)


def _numbers(blocks: np.ndarray, count: int) -> np.ndarray:
    """Return numbers by block and lane as numbers of particles, the numbers of one last."""
    middle = blocks.shape[1:-1]
    lanes = blocks.reshape(len(blocks), *middle, count, LANES)
    return np.moveaxis(lanes, -1, 1).reshape(len(blocks) * LANES, *middle, count)


def _lanes(count: np.ndarray) -> np.ndarray:
    """Return counts by block, landmark and lane as counts by particle and landmark."""
    return np.swapaxes(count, 1, 2).reshape(len(count) * LANES, count.shape[1])


def _packed(numbers: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3 3"]:
    """Return the covariance that xx, xy, yy, xh, yh and hh are."""
    xx, xy, yy, xh, yh, hh = numbers
    return np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])


def edits(
    belief: "FastSlamBelief", remove: Sequence[int], merge: Sequence[tuple[int, int]]
) -> dict[str, Any]:
    """Return the changed arrays of a belief without some landmarks, and with others as one.

    Of two that are one, that stays which most particles have placed, the first if both are.
    """
    landmark, gone = belief.landmark.copy(), [*remove]
    for kept, other in merge:
        first, second = (_number(belief, label) for label in (kept, other))
        if kept == other:
            raise InputError("association: found a landmark to merge with itself; expected two")
        if np.mean(belief.count[:, first] == 1) <= 0.5 < np.mean(belief.count[:, second] == 1):
            landmark[first], landmark[second] = other, kept
        gone.append(other)
    for label in gone:
        _number(belief, label)
    return _without(belief, landmark, ~np.isin(landmark, gone))


def _number(belief: "FastSlamBelief", label: int) -> int:
    """Return the number of a landmark; refuse one that is not on the map."""
    found = np.flatnonzero(belief.landmark == label)
    if not found.size:
        raise InputError(f"association: found landmark {label} to change, which is not on the map")
    return int(found[0])


def _without(
    belief: "FastSlamBelief", landmark: np.ndarray, kept: Bool[np.ndarray, " n"]
) -> dict[str, Any]:
    """Return the arrays of a belief of which some landmarks are left, by their new labels."""
    rows = np.diff(belief.first)
    members = np.repeat(kept, rows)
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    parents, slopes = belief.parent.size, belief.slope.shape[1]
    parent = belief.parent[kept[:parents]]
    return {
        "landmark": landmark[kept],
        "first": np.append(0, np.cumsum(rows[kept])),
        "count": np.ascontiguousarray(belief.count[:, kept]),
        "member": np.ascontiguousarray(belief.member[:, members]),
        "best_count": belief.best_count[kept],
        "best_member": belief.best_member[members],
        "parent": np.where(parent >= 0, number[parent], -1),
        "slope": np.ascontiguousarray(belief.slope[:, kept[:slopes]]),
    }
