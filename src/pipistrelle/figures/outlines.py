"""Outlines of what stands on a map: uncertainty ellipses, the beam, the vehicle."""

import numpy as np
from jaxtyping import Float

PLACED = 0.95
"""Probability inside the ellipse of a landmark that is fully initialised."""
RAY = 0.3935
"""Probability inside the ellipse of a ray's member: one standard deviation."""


def ellipses(
    mean: Float[np.ndarray, "h 2"], covariance: Float[np.ndarray, "h 2 2"], probability: float
) -> Float[np.ndarray, "h 49 2"]:
    r"""Return the closed outlines that hold a share of each Gaussian.

    .. math:: (x - \mu)^T P^{-1} (x - \mu) = -2 \ln(1 - p)

    The unit circle goes through the symmetric square root of P, which for 2 by 2 is
    (P + s I) / sqrt(tr P + 2 s), s = sqrt(det P).

    Parameters
    ----------
    mean : (h, 2) [m]
    covariance : (h, 2, 2) [m^2]
        Positive semidefinite; where it is not finite, neither is the outline.
    probability : p, between 0 and 1

    Returns
    -------
    (h, 49, 2) [m]

    Notes
    -----
    The quantile of chi-square with two degrees of freedom is -2 ln(1 - p): 5.991 for 95 %.

    Examples
    --------
    >>> outline = ellipses(np.zeros((1, 2)), np.diag([4.0, 1.0])[None], 0.95)
    >>> (outline.max(axis=1) ** 2).round(3)
    array([[23.966,  5.991]])
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.sqrt(-2.0 * np.log1p(-probability)) * np.stack([np.cos(angle), np.sin(angle)])
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    s = np.sqrt(np.maximum(a * c - b * b, 0.0))
    trace = np.maximum(a + c + 2.0 * s, np.finfo(np.float64).tiny)
    root = (covariance + s[:, None, None] * np.eye(2)) / np.sqrt(trace)[:, None, None]
    return mean[:, None, :] + np.swapaxes(root @ circle, 1, 2)


def beam(pose: Float[np.ndarray, "3"], beamwidth: float, length: float) -> Float[np.ndarray, "n 2"]:
    """Outline of the sector that the vehicle's call lights up, half the beamwidth to each side.

    `pose` [m, m, rad]. `beamwidth` [rad]. `length` [m]. Returns [m]: the vehicle first, then the
    arc.

    Half-power beamwidth of Bradley & Abaid, Eq. (1).

    Examples
    --------
    >>> beam(np.zeros(3), np.pi, 2.0)[[0, 1, -1]].round(9) + 0.0
    array([[ 0.,  0.],
           [ 0., -2.],
           [ 0.,  2.]])
    """
    angle = pose[2] + np.linspace(-0.5, 0.5, 41) * beamwidth
    arc = pose[:2] + length * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([pose[:2], arc])


def vehicle(pose: Float[np.ndarray, "3"], length: float) -> Float[np.ndarray, "4 2"]:
    """Outline of the vehicle, a dart that points along its heading.

    `pose` [m, m, rad]. `length` [m]. Returns [m]: the tip first.

    Examples
    --------
    >>> vehicle(np.array([1.0, 0.0, np.pi / 2]), 2.0)[0].round(9)
    array([1.  , 1.16])
    """
    shape = length * np.array([[0.58, 0.0], [-0.42, 0.36], [-0.2, 0.0], [-0.42, -0.36]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + shape @ np.array([[cos, sin], [-sin, cos]])


def excess_path_ellipse(
    vehicle: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"], excess_path: float
) -> Float[np.ndarray, "121 2"]:
    r"""Return where all points lie that have an excess path: an ellipse about vehicle and caller.

    .. math:: |b - l| + |l - p| = d + e, \qquad d = |b - p|

    Its half axes are :math:`(d + e)/2` and :math:`\sqrt{(d + e)^2 - d^2}/2`.

    Parameters
    ----------
    vehicle, caller : (2) [m]
        The foci.
    excess path : [m]

    Returns
    -------
    (121, 2) [m]
        A closed outline.

    Examples
    --------
    >>> outline = excess_path_ellipse(np.zeros(2), np.array([6.0, 0.0]), 4.0)
    >>> outline.min(axis=0), outline.max(axis=0)
    (array([-2., -4.]), array([8., 4.]))
    """
    across = caller - vehicle
    straight = np.hypot(*across)
    long = 0.5 * (straight + excess_path)
    short = np.sqrt(np.maximum(long**2 - 0.25 * straight**2, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    c, s = across / straight if straight > 0.0 else np.array([1.0, 0.0])
    x, y = long * np.cos(angle), short * np.sin(angle)
    return 0.5 * (vehicle + caller) + np.column_stack([c * x - s * y, s * x + c * y])
