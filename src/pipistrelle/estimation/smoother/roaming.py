r"""Callers that move, in the graph: of each node a place and a velocity, tied to those before.

How a caller drives is the random walk of its velocity that the EKFs take it for
(`estimation.ekf.roaming`), of spectral density :math:`q = \sigma^2`. In a time T, place b and
velocity v go on by

.. math:: v' = v + w, \qquad b' = b + \tfrac12 T (v + v') + u, \qquad
          \operatorname{var} w = q T, \qquad \operatorname{var} u = \tfrac1{12} q T^3

along each axis, u and w on their own, which is the same law: the place goes by the mean of both
velocities, and nearly so surely. That is linear, so a factor of it never asks Python again. Of the
four variables GTSAM's constructor takes three, so the way u that the mean velocity leads is a fifth
which is eliminated at once.

A caller begins its *chain* at the node from which it was first placed; what had been heard of it
before is dropped, for it says where it was, which nothing ties to where it is.
"""

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.smoother.graph import landmark_key
from pipistrelle.estimation.smoother.legs import symmetric


class Chain(NamedTuple):
    """A caller that moves in the graph: its number there, and the node from which it was placed."""

    number: int
    first: int


Chains = Mapping[int, Chain]
"""Those of all callers that move and are in the graph, by their labels."""
NO_CHAINS: Chains = MappingProxyType({})
LEAST_STD = 1e-4
"""Added in quadrature to what a velocity [m/s] and a place [m] stray from one node to the next: a
solver has no digits for what is surer."""
_NODES = 32
"""Bits of a node's number in a name."""
_WAY = gtsam.symbol("u", 0)


def place_key(chain: Chain, node: int) -> int:
    """Name the place of a caller in the graph."""
    return gtsam.symbol("c", (chain.number << _NODES) + node)


def velocity_key(chain: Chain, node: int) -> int:
    """Name the velocity of a caller in the graph."""
    return gtsam.symbol("v", (chain.number << _NODES) + node)


def point_key(label: int, node: int, chains: Chains) -> int:
    """Name in the graph where a landmark is, or where a caller is that moves, at a node.

    Examples
    --------
    >>> chains = {9: Chain(number=0, first=3)}
    >>> point_key(4, 7, chains) == landmark_key(4), point_key(9, 7, chains) == landmark_key(9)
    (True, False)
    """
    chain = chains.get(label)
    return landmark_key(label) if chain is None else place_key(chain, node)


def is_there(label: int, node: int, chains: Chains) -> bool:
    """Tell whether a caller that moves was in the graph at a node.

    Examples
    --------
    >>> [is_there(9, node, {9: Chain(number=0, first=3)}) for node in (2, 3)]
    [False, True]
    """
    return label in chains and chains[label].first <= node


def walk_factor(
    chain: Chain, node: int, seconds: float, walk_std: float
) -> gtsam.LinearContainerFactor:
    """Return what ties a caller's place and velocity at a node to those at the node before.

    Parameters
    ----------
    chain : Chain
    node : int
    seconds : float
    walk_std : float
        How far the velocity strays in a second [m/s].

    Returns
    -------
    LinearContainerFactor

    Examples
    --------
    >>> factor, values = walk_factor(Chain(0, 0), 1, 2.0, 0.5), gtsam.Values()
    >>> for node, place in enumerate((0.0, 6.0)):
    ...     values.insert(place_key(Chain(0, 0), node), np.full(2, place))
    ...     values.insert(velocity_key(Chain(0, 0), node), np.full(2, 3.0))
    >>> factor.error(values)
    0.0
    """
    q, eye, zero = walk_std * walk_std, np.eye(2), np.zeros(2)
    place, before = place_key(chain, node), place_key(chain, node - 1)
    velocity, earlier = velocity_key(chain, node), velocity_key(chain, node - 1)
    stray = eye / math.sqrt(q * seconds + LEAST_STD**2)
    half = eye / math.sqrt(0.5 * (q * seconds**3 / 12.0 + LEAST_STD**2))
    mean, unit = 0.5 * seconds * half, gtsam.noiseModel.Unit.Create(2)
    told = gtsam.GaussianFactorGraph()
    told.add(gtsam.JacobianFactor(_WAY, half, earlier, -mean, velocity, -mean, zero, unit))
    told.add(gtsam.JacobianFactor(_WAY, -half, before, -half, place, half, zero, unit))
    told.add(gtsam.JacobianFactor(earlier, -stray, velocity, stray, zero, unit))
    first, about = gtsam.Ordering(), gtsam.Values()
    first.push_back(_WAY)
    for key in (before, earlier, place, velocity):
        about.insert(key, zero)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(told).eliminate(first)[1], about)


def speed_factor(chain: Chain, std: float) -> gtsam.PriorFactorPoint2:
    """Return what is known of a caller's first velocity: its spread along an axis [m/s]."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, std)
    return gtsam.PriorFactorPoint2(velocity_key(chain, chain.first), np.zeros(2), noise)


def insert_state(
    values: gtsam.Values, chain: Chain, node: int, state: Float[np.ndarray, "4"]
) -> None:
    """Say where a caller is thought to be at a node, and how fast, x, y [m] and [m/s]."""
    values.insert(place_key(chain, node), state[:2])
    values.insert(velocity_key(chain, node), state[2:])


def state_of(isam: gtsam.ISAM2, chain: Chain, node: int) -> Gaussian:
    """Return a caller's place and velocity at a node as a solver has them, (4) and (4, 4)."""
    keys = place_key(chain, node), velocity_key(chain, node)
    told = isam.jointMarginalCovariance(list(keys))
    covariance = np.block([[told.at(a, b) for b in keys] for a in keys])
    mean = np.concatenate([isam.calculateEstimatePoint2(key) for key in keys])
    return Gaussian(mean=mean, covariance=symmetric(covariance))


def gone_on(state: Gaussian, seconds: float, walk_std: float) -> Gaussian:
    """Return a caller's place and velocity after a time, (4) and (4, 4).

    Parameters
    ----------
    state : Gaussian of (4) and (4, 4)
    seconds : float
    walk_std : float
        [m/s]

    Returns
    -------
    Gaussian

    Examples
    --------
    >>> still = Gaussian(mean=np.array([5.0, 0.0, 1.0, 0.0]), covariance=np.zeros((4, 4)))
    >>> later = gone_on(still, 3.0, 1.0)
    >>> later.mean, later.covariance.diagonal()
    (array([8., 0., 1., 0.]), array([9., 9., 3., 3.]))
    """
    mean = state.mean.copy()
    mean[:2] += seconds * mean[2:]
    return Gaussian(mean=mean, covariance=spread_on(state.covariance, seconds, walk_std))


def spread_on(
    joint: Float[np.ndarray, "d d"], seconds: float, walk_std: float
) -> Float[np.ndarray, "d d"]:
    """Return a covariance after a time; in its last four a caller's place and velocity stand."""
    F, q, eye = np.eye(len(joint)), walk_std * walk_std, np.eye(2)
    F[-4:-2, -2:] = seconds * eye
    spread, both = F @ joint @ F.T, 0.5 * q * seconds**2 * eye
    spread[-4:, -4:] += np.block([[q * seconds**3 / 3.0 * eye, both], [both, q * seconds * eye]])
    return spread


def known_of(mapped: Collection[int], chains: Chains) -> Collection[int]:
    """Return the labels of all that is in the graph."""
    return {*mapped, *chains} if chains else mapped
