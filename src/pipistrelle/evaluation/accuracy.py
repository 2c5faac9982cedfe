"""Accuracy: errors of an estimated path and map, and their rigid alignment with the truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.geometry import wrap


@dataclass(frozen=True, slots=True, kw_only=True)
class MapEstimate:
    """An estimated map with a row per landmark, in the order of their first appearance."""

    landmark: Int[np.ndarray, " n"]
    mean: Float[np.ndarray, "n 2"]
    """[m]."""
    covariance: Float[np.ndarray, "n 2 2"]
    """[m^2]."""
    full: Bool[np.ndarray, " n"]
    """Whether the landmark is fully initialised."""


def heaviest(landmarks: Landmarks) -> MapEstimate:
    """Return a map that holds each landmark's hypothesis of largest weight, the first of equals.

    Bradley & Abaid, Sec. V-A, "fully and partially initialize".

    >>> landmarks = Landmarks(
    ...     landmark=np.array([7, 3, 3]),
    ...     mean=np.array([[1.0, 0.0], [2.0, 0.0], [6.0, 0.0]]),
    ...     covariance=np.tile(np.eye(2), (3, 1, 1)),
    ...     weight=np.array([1.0, 0.2, 0.8]),
    ... )
    >>> heaviest(landmarks).mean[:, 0], heaviest(landmarks).full
    (array([1., 6.]), array([ True, False]))
    """
    ordered = np.lexsort((-landmarks.weight, landmarks.landmark))
    _, start = np.unique(landmarks.landmark[ordered], return_index=True)
    _, first = np.unique(landmarks.landmark, return_index=True)
    entered = np.argsort(first)
    row = ordered[start][entered]
    return MapEstimate(
        landmark=landmarks.landmark[row],
        mean=landmarks.mean[row],
        covariance=landmarks.covariance[row],
        full=placed(landmarks)[row],
    )


def scored_landmarks(
    estimate: MapEstimate,
    true_landmark: Int[np.ndarray, " n"],
    true_position: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Pair the fully initialised landmarks with their true positions, if known.

    `true_landmark`: labels, each once; `true_position` [m]. Returns estimated and true positions
    [m].

    Bradley & Abaid, the sums of Eq. (27).

    >>> estimate = MapEstimate(
    ...     landmark=np.array([7, 3, 9]),
    ...     mean=np.array([[1.0, 0.0], [2.0, 0.0], [6.0, 0.0]]),
    ...     covariance=np.tile(np.eye(2), (3, 1, 1)),
    ...     full=np.array([True, False, True]),
    ... )
    >>> scored_landmarks(estimate, np.array([3, 7]), np.array([[5.0, 5.0], [1.5, 0.0]]))
    (array([[1., 0.]]), array([[1.5, 0. ]]))
    """
    row = {int(label): i for i, label in enumerate(true_landmark)}
    pairs = [
        (i, row[label])
        for i, label in enumerate(estimate.landmark.tolist())
        if estimate.full[i] and label in row
    ]
    mapped, true = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return estimate.mean[mapped], true_position[true]


def landmark_error(
    estimate: MapEstimate,
    true_landmark: Int[np.ndarray, " n"],
    true_position: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, " h"]:
    """Return the distance of each estimated landmark from the true landmark of its label.

    `true_landmark`: labels, each once; `true_position` [m]. Returns [m], NaN without a true
    landmark.

    >>> estimate = MapEstimate(
    ...     landmark=np.array([7, 9]),
    ...     mean=np.array([[4.0, 5.0], [6.0, 0.0]]),
    ...     covariance=np.tile(np.eye(2), (2, 1, 1)),
    ...     full=np.array([True, True]),
    ... )
    >>> landmark_error(estimate, np.array([3, 7]), np.array([[5.0, 5.0], [1.0, 1.0]]))
    array([ 5., nan])
    """
    row, unknown = {label: i for i, label in enumerate(true_landmark.tolist())}, -1
    index = np.array([row.get(k, unknown) for k in estimate.landmark.tolist()], dtype=np.intp)
    true = np.full_like(estimate.mean, np.nan)
    true[index != unknown] = true_position[index[index != unknown]]
    return position_error(estimate.mean, true)


def pose_error(
    path: Float[np.ndarray, "k 3"], true_path: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3"]:
    r"""Return the estimated minus true poses, the heading wrapped.

    .. math:: e_k = \hat x_k - x_k

    `path`, `true_path` [m, m, rad]. Returns [m, m, rad].

    Bradley & Abaid, the differences of Eqs. (23) and (26).

    >>> pose_error(np.array([[1.0, 2.0, 3.1]]), np.array([[0.0, 2.0, 3.1 - 2 * np.pi]])).round(9)
    array([[1., 0., 0.]])
    """
    error = path - true_path
    error[:, 2] = wrap(error[:, 2])
    return error


def position_error(
    points: Float[np.ndarray, "n _"], true_points: Float[np.ndarray, "n _"]
) -> Float[np.ndarray, " n"]:
    r"""Return the distances between estimated and true positions.

    .. math:: d_i = \sqrt{(\hat x_i - x_i)^2 + (\hat y_i - y_i)^2}

    `points`, `true_points`: x, y [m]; further columns (a heading) are ignored. Returns [m].

    Bradley & Abaid, the terms of Eqs. (26) and (27).

    >>> position_error(np.array([[3.0, 4.0, 0.1]]), np.zeros((1, 3)))
    array([5.])
    """
    offset = points[:, :2] - true_points[:, :2]
    return np.hypot(offset[:, 0], offset[:, 1])


def rmse(error: Float[np.ndarray, " n"]) -> float:
    r"""Return the root mean square of errors, in their unit.

    .. math:: \mathrm{RMSE} = \sqrt{\frac{1}{N} \sum_{i=1}^{N} e_i^2}
       :label: eq-26-27

    `error`: position errors of a path or of a map [m], or heading errors [rad]. Not finite if an
    error is not finite. Raises ValueError without errors.

    Bradley & Abaid, Eqs. (26) and (27).

    >>> rmse(np.array([1.0, -7.0]))
    5.0
    """
    if len(error) == 0:
        raise ValueError("rmse needs at least one error, found none")
    return float(np.sqrt(np.mean(np.square(error))))


def alignment(
    points: Float[np.ndarray, "n 2"], reference: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3"]:
    r"""Return the rigid motion, without scale, that moves points closest to a reference.

    .. math:: \min_{\theta, t} \sum_i \lVert R(\theta) p_i + t - q_i \rVert^2: \quad
              \theta = \operatorname{atan2}\Bigl(\sum_i p'_i \times q'_i,
              \sum_i p'_i \cdot q'_i\Bigr), \quad t = \bar q - R(\theta) \bar p

    with p' and q' the offsets from the means.

    `points`, `reference` [m]: at least one; the rotation is 0 if they do not determine it. Returns
    t and theta [m, m, rad]: the pose of the points' origin in the reference.

    The planar case of Umeyama (1991). In the plane a reflection cannot occur.

    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    >>> (alignment(square, np.array([[5.0, 0.0], [5.0, 1.0], [4.0, 1.0]])) / [1, 1, np.pi]).round(9)
    array([5. , 0. , 0.5])
    """
    mean, target = points.mean(axis=0), reference.mean(axis=0)
    p, q = points - mean, reference - target
    theta = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    return np.append(target - moved(mean[None], np.array([0.0, 0.0, theta]))[0], theta)


def moved(
    points: Float[np.ndarray, "n 2"], motion: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 2"]:
    r"""Rotate and translate points by a rigid motion.

    .. math:: q_i = R(\theta) p_i + t

    `points` [m]; `motion`: t and theta [m, m, rad], as from `alignment`. The action of SE(2) on the
    plane.

    >>> moved(np.array([[1.0, 0.0]]), np.array([0.0, 2.0, np.pi / 2])).round(9)
    array([[0., 3.]])
    """
    x, y, theta = motion
    cos, sin = np.cos(theta), np.sin(theta)
    return np.column_stack(
        [cos * points[:, 0] - sin * points[:, 1] + x, sin * points[:, 0] + cos * points[:, 1] + y]
    )
