r"""Moving callers in the graph: a place and a velocity at each node.

The velocity of a caller is a random walk of spectral density :math:`q = \sigma^2`, as in the EKFs
(`estimation.ekf.caller_motion`). In a time T, place b and velocity v become

.. math:: v' = v + w, \qquad b' = b + \tfrac12 T (v + v') + u, \qquad
          \operatorname{var} w = q T, \qquad \operatorname{var} u = \tfrac1{12} q T^3

along each axis, with u and w independent, which is the same law: the place moves by the mean of
both velocities, with little noise of its own. The factor is linear, so it never calls Python back.
It has four variables and GTSAM's constructor takes three, so the displacement u by the mean
velocity is a fifth, which is eliminated at once.

A caller's *chain* begins at the node from which it was first placed. What was heard of it before is
dropped: nothing links where it was then to where it is.
"""

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple

import gtsam
import numpy as np
from jaxtyping import Float

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.smoother.graph import joint_covariance, landmark_key
from pipistrelle.estimation.smoother.preintegration import symmetric


class Chain(NamedTuple):
    """A moving caller in the graph: its number there, and the node from which it was placed."""

    number: int
    first: int


Chains = Mapping[int, Chain]
"""All moving callers in the graph, by their labels."""
NO_CHAINS: Chains = MappingProxyType({})
LEAST_STD = 1e-4
"""Added in quadrature to the noise of a velocity [m/s] and a place [m] from one node to the next: a
solver cannot represent less."""
_NODES = 32
"""Bits of a node's number in a key."""
_WAY = gtsam.symbol("u", 0)


def place_key(chain: Chain, node: int) -> int:
    """Return the key of a caller's place in the graph."""
    return gtsam.symbol("c", (chain.number << _NODES) + node)


def velocity_key(chain: Chain, node: int) -> int:
    """Return the key of a caller's velocity in the graph."""
    return gtsam.symbol("v", (chain.number << _NODES) + node)


def point_key(label: int, node: int, chains: Chains) -> int:
    """Return the key of a landmark, or of the place of a moving caller at a node.

    >>> chains = {9: Chain(number=0, first=3)}
    >>> point_key(4, 7, chains) == landmark_key(4), point_key(9, 7, chains) == landmark_key(9)
    (True, False)
    """
    chain = chains.get(label)
    return landmark_key(label) if chain is None else place_key(chain, node)


def is_there(label: int, node: int, chains: Chains) -> bool:
    """Tell whether a moving caller was in the graph at a node."""
    return label in chains and chains[label].first <= node


def walk_factor(
    chain: Chain, node: int, seconds: float, walk_std: float
) -> gtsam.LinearContainerFactor:
    """Return the factor between a caller's place and velocity at a node and at the node before.

    ``walk_std`` is that of a velocity after 1 s [m/s].

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
    factors = gtsam.GaussianFactorGraph()
    factors.add(gtsam.JacobianFactor(_WAY, half, earlier, -mean, velocity, -mean, zero, unit))
    factors.add(gtsam.JacobianFactor(_WAY, -half, before, -half, place, half, zero, unit))
    factors.add(gtsam.JacobianFactor(earlier, -stray, velocity, stray, zero, unit))
    first, about = gtsam.Ordering(), gtsam.Values()
    first.push_back(_WAY)
    for key in (before, earlier, place, velocity):
        about.insert(key, zero)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(factors).eliminate(first)[1], about)


def speed_factor(chain: Chain, std: float) -> gtsam.PriorFactorPoint2:
    """Return the prior of a caller's first velocity: its standard deviation along an axis [m/s]."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, std)
    return gtsam.PriorFactorPoint2(velocity_key(chain, chain.first), np.zeros(2), noise)


def insert_state(
    values: gtsam.Values, chain: Chain, node: int, state: Float[np.ndarray, "4"]
) -> None:
    """Add the initial estimate x, y [m] and velocity [m/s] of a caller at a node."""
    values.insert(place_key(chain, node), state[:2])
    values.insert(velocity_key(chain, node), state[2:])


def state_of(isam: gtsam.ISAM2, chain: Chain, node: int) -> Gaussian:
    """Return a caller's place and velocity at a node as a solver has them, (4) and (4, 4)."""
    keys = place_key(chain, node), velocity_key(chain, node)
    mean = np.concatenate([isam.calculateEstimatePoint2(key) for key in keys])
    return Gaussian(mean=mean, covariance=symmetric(joint_covariance(isam, *keys)))


def propagated_caller(state: Gaussian, seconds: float, walk_std: float) -> Gaussian:
    """Return a caller's place and velocity after a time, (4) and (4, 4).

    >>> still = Gaussian(mean=np.array([5.0, 0.0, 1.0, 0.0]), covariance=np.zeros((4, 4)))
    >>> later = propagated_caller(still, 3.0, 1.0)
    >>> later.mean, later.covariance.diagonal()
    (array([8., 0., 1., 0.]), array([9., 9., 3., 3.]))
    """
    mean = state.mean.copy()
    mean[:2] += seconds * mean[2:]
    return Gaussian(
        mean=mean, covariance=propagated_covariance(state.covariance, seconds, walk_std)
    )


def propagated_covariance(
    joint: Float[np.ndarray, "d d"], seconds: float, walk_std: float
) -> Float[np.ndarray, "d d"]:
    """Return a covariance after a time; its last four rows are a caller's place and velocity."""
    F, q, eye = np.eye(len(joint)), walk_std * walk_std, np.eye(2)
    F[-4:-2, -2:] = seconds * eye
    spread, both = F @ joint @ F.T, 0.5 * q * seconds**2 * eye
    spread[-4:, -4:] += np.block([[q * seconds**3 / 3.0 * eye, both], [both, q * seconds * eye]])
    return spread


def labels_in_graph(mapped: Collection[int], chains: Chains) -> Collection[int]:
    """Return the labels of all landmarks and moving callers in the graph."""
    return {*mapped, *chains} if chains else mapped
