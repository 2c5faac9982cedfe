"""Accuracy: how far an estimated path and map are from the true ones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.geometry import wrap


@dataclass(frozen=True, slots=True, kw_only=True)
class MapEstimate:
    """A map with one row per landmark, in the order in which the landmarks entered it."""

    landmark: Int[np.ndarray, " n"]
    mean: Float[np.ndarray, "n 2"]
    """Mean [m]."""
    covariance: Float[np.ndarray, "n 2 2"]
    """Covariance [m^2]."""
    full: Bool[np.ndarray, " n"]
    """Whether the landmark is fully initialised."""


def heaviest(landmarks: Landmarks) -> MapEstimate:
    """Represent each landmark by its heaviest hypothesis, the first of equals.

    Parameters
    ----------
    landmarks : Landmarks of h hypotheses

    Returns
    -------
    MapEstimate of n landmarks

    Notes
    -----
    Bradley & Abaid, Sec. V-A, "fully and partially initialize".

    Examples
    --------
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
    """Pair the fully initialised landmarks with their true positions.

    A landmark whose true position is not known is left out.

    `true_landmark`: labels, each once; `true_position` [m]. Returns `estimated` [m]; `true` [m].

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
    """Return the distance of each estimated landmark from the true one of its label.

    `true_landmark`: labels, each once; `true_position` [m]. Returns [m]: NaN where no true landmark
    has the label.

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

    Parameters
    ----------
    error : (n)
        Position errors of a path or of a map [m], heading errors [rad]; at least one. An error
        that is not finite makes the result not finite.

    Returns
    -------
    In the unit of the errors.

    Raises
    ------
    ValueError
        Without errors.

    Notes
    -----
    Bradley & Abaid, Eqs. (26) and (27).

    Examples
    --------
    >>> rmse(np.array([1.0, -7.0]))
    5.0
    """
    if len(error) == 0:
        raise ValueError("rmse needs at least one error, found none")
    return float(np.sqrt(np.mean(np.square(error))))


def alignment(
    points: Float[np.ndarray, "n 2"], reference: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3"]:
    r"""Return the rigid motion, without scale, that brings points closest to a reference.

    .. math:: \min_{\theta, t} \sum_i \lVert R(\theta) p_i + t - q_i \rVert^2: \quad
              \theta = \operatorname{atan2}\Bigl(\sum_i p'_i \times q'_i,
              \sum_i p'_i \cdot q'_i\Bigr), \quad t = \bar q - R(\theta) \bar p

    with p' and q' the offsets from the means.

    `points` [m]: at least one; the rotation is 0 where the points do not determine it; `reference`
    [m]. Returns [m, m, rad]: t and theta: the pose that the origin of the points has in the
    reference.

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
    r"""Move points rigidly.

    .. math:: q_i = R(\theta) p_i + t

    Parameters
    ----------
    points : (n, 2) [m]
    motion : (3) [m, m, rad]
        t and theta, as `alignment` gives them.

    Returns
    -------
    (n, 2) [m]

    Notes
    -----
    The action of SE(2) on the plane.

    Examples
    --------
    >>> moved(np.array([[1.0, 0.0]]), np.array([0.0, 2.0, np.pi / 2])).round(9)
    array([[0., 3.]])
    """
    x, y, theta = motion
    cos, sin = np.cos(theta), np.sin(theta)
    return np.column_stack(
        [cos * points[:, 0] - sin * points[:, 1] + x, sin * points[:, 0] + cos * points[:, 1] + y]
    )
