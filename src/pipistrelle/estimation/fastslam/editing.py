"""Landmarks of all particles: their moments, taken out, and two that become one."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.estimation.beliefs import JointGaussian, Landmarks
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.geometry import wrap

if TYPE_CHECKING:
    from pipistrelle.estimation.fastslam.filter import FastSlamBelief


class _Placed(NamedTuple):
    """Landmarks that most particles have placed, by p particles and k landmarks."""

    there: Int[np.ndarray, " k"]
    """Their numbers."""
    weight: Float[np.ndarray, " p"]
    """Of each particle."""
    placed: Bool[np.ndarray, "p k"]
    """Whether a particle has placed it."""
    members: Float[np.ndarray, "p k 6"]
    """Its numbers in each particle."""
    share: Float[np.ndarray, "p k"]
    """Weight of each particle among those that have placed it."""
    spots: Float[np.ndarray, "k 2"]
    """Mean position [m]."""


def _placed_by_most(belief: "FastSlamBelief") -> _Placed:
    """Return the landmarks that most particles, by weight, have placed."""
    particles = belief.log_weight.size
    weight = np.exp(belief.log_weight - belief.log_weight.max())
    weight /= weight.sum()
    placed = _lanes(belief.count)[:particles] == 1
    there = np.flatnonzero(np.einsum("p,pn->n", weight, placed) > 0.5)
    members = _numbers(belief.member[:, belief.first[there]], 6)[:particles]
    counting = weight[:, np.newaxis] * placed[:, there]
    share = counting / counting.sum(axis=0)
    spots = np.einsum("pn,pne->ne", share, members[..., :2])
    return _Placed(there, weight, placed[:, there], members, share, spots)


def mixture_map(belief: "FastSlamBelief") -> Landmarks:
    r"""Return the map that all particles have: mean and covariance of each landmark over them.

    .. math:: \bar l = \sum_i w_i l_i, \qquad
              P = \sum_i w_i \left( (l_i - \bar l)(l_i - \bar l)^T + P_i \right)

    A landmark is fully initialised if it is in most particles, by weight. Of any other the rows are
    those of the heaviest particle in which it is a ray.
    """
    of = _placed_by_most(belief)
    off = of.members[..., :2] - of.spots
    spread = np.einsum("pn,pna,pnb->nab", of.share, off, off)
    own = np.einsum("pn,pne->ne", of.share, of.members[..., 2:5])[:, [0, 1, 1, 2]]
    numbers, rows = [of.there], [of.spots]
    spreads, weights = [spread + own.reshape(-1, 2, 2)], [np.ones(of.there.size)]
    count = _lanes(belief.count)[: of.weight.size]
    for n in np.setdiff1d(np.arange(belief.landmark.size), of.there).tolist():
        best = int(np.argmax(np.where(count[:, n] > 1, of.weight, -1.0)))
        first, size = belief.first[n], count[best, n]
        lane = belief.member[best // LANES, first : first + size]
        members = lane.reshape(size, 6, LANES)[..., best % LANES]
        numbers.append(np.full(size, n))
        rows.append(members[:, :2])
        spreads.append(members[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
        weights.append(np.exp(members[:, 5]))
    number = np.concatenate(numbers)
    order = np.argsort(number, kind="stable")
    return Landmarks(
        landmark=belief.landmark[number[order]],
        mean=np.concatenate(rows)[order],
        covariance=np.concatenate(spreads)[order],
        weight=np.concatenate(weights)[order],
    )


def joint_of(belief: "FastSlamBelief") -> JointGaussian:
    r"""Return pose and placed landmarks of all particles as one Gaussian.

    .. math:: \bar x = \sum_i w_i x_i, \qquad
              P = \sum_i w_i \left( (x_i - \bar x)(x_i - \bar x)^T + P_i \right)

    with each particle's own covariances :math:`P_i` of its pose and of its landmarks, of which
    those of one parent share that parent's error. A landmark counts that most particles have
    placed; where one has not, it is at the mean.
    """
    there, weight, placed, members, share, spots = _placed_by_most(belief)
    rows = _numbers(belief.poses, 9)[: weight.size]
    rows[:, 2] = belief.estimate.mean[2] + wrap(rows[:, 2] - belief.estimate.mean[2])
    mean = np.append(np.einsum("p,pe->e", weight, rows[:, :3]), spots.ravel())
    points = np.where(placed[..., np.newaxis], members[..., :2], spots)
    off = np.hstack([rows[:, :3], points.reshape(weight.size, 2 * there.size)]) - mean
    covariance = np.einsum("p,pd,pe->de", weight, off, off, optimize=True)
    covariance[:3, :3] += _packed(np.einsum("p,pe->e", weight, rows[:, 3:9]))
    covariance[3:, 3:] += _by_parents(belief, there, members, weight[:, np.newaxis] * placed)
    own = np.einsum("pn,pne->ne", share, members[..., 2:5])
    for n, (xx, xy, yy) in enumerate(own.tolist()):
        covariance[3 + 2 * n : 5 + 2 * n, 3 + 2 * n : 5 + 2 * n] += [[xx, xy], [xy, yy]]
    return JointGaussian(landmark=belief.landmark[there], mean=mean, covariance=covariance)


def _by_parents(
    belief: "FastSlamBelief",
    there: Int[np.ndarray, " k"],
    members: Float[np.ndarray, "p k 6"],
    weight: Float[np.ndarray, "p k"],
) -> Float[np.ndarray, "d d"]:
    """Return what landmarks have in common by their parents' errors, in the mean over particles.

    ``weight``: of each particle where it has placed a landmark, else 0.
    """
    size, parent = there.size, np.full(belief.landmark.size, -1)
    parent[: belief.parent.size] = belief.parent
    common = np.zeros((size, size, 2, 2))
    for h in np.intersect1d(parent, there).tolist():
        family = np.append(np.flatnonzero(parent[there] == h), np.flatnonzero(there == h))
        A = np.zeros((len(weight), family.size, 4))
        A[:, :-1] = _numbers(belief.slope[:, there[family[:-1]]], 4)[: len(weight)]
        A[:, -1] = 1.0, 0.0, 0.0, 1.0
        A *= np.sqrt(weight[:, family, np.newaxis])
        by_x, by_y = A[..., ::2], A[..., 1::2]
        xx, xy, yy = np.moveaxis(members[:, family[-1:], 2:5, np.newaxis], 2, 0)
        AB = np.stack([by_x * xx + by_y * xy, by_x * xy + by_y * yy])
        flat = 2 * len(weight), 2 * family.size
        both = AB.reshape(flat), np.stack([by_x, by_y]).reshape(flat)
        ABA = np.einsum("kd,ke->de", *both, optimize=True).reshape(family.size, 2, family.size, 2)
        common[np.ix_(family, family)] += np.swapaxes(ABA, 1, 2)
    common[np.arange(size), np.arange(size)] = 0.0
    return np.swapaxes(common, 1, 2).reshape(2 * size, 2 * size)


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
