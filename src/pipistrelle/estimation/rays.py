r"""Rays: passive landmarks as a sequence of Gaussian hypotheses along the first bearing.

A bearing does not measure range. Instead of waiting for parallax, the landmark enters the map as a
*ray*: :math:`N_g` Gaussian hypotheses (members) along the bearing, at ranges that grow by the
factor :math:`\beta`, with standard deviations proportional to range,

.. math:: s_1 = \frac{s_{min}}{1-\alpha}, \quad s_j = \beta s_{j-1}, \quad
          \sigma_j = \alpha s_j, \quad
          N_g = 1 + \left\lceil \log_\beta\left(\frac{1-\alpha}{1+\alpha}
          \frac{s_{max}}{s_{min}}\right) \right\rceil .
   :label: eq-17

A few bearings from different positions distinguish them. Each new bearing has three effects:

1. **Weigh.** The aggregated likelihood of hypothesis j is its probability given all bearings; a
   bearing multiplies it by the likelihood :math:`\lambda_j`:

   .. math:: \Lambda_j = 1 / N_g \text{ at first}, \qquad
             \Lambda_j \leftarrow \Lambda_j \lambda_j \Big/ \sum_i \Lambda_i \lambda_i
      :label: eq-18

2. **Share.** Updating each hypothesis with the full measurement would count its information
   :math:`N_g` times. Federated information sharing gives hypothesis j the share :math:`\rho_j`; the
   shares sum to 1 (principle of measurement reproduction):

   .. math:: R_j = R / \rho_j, \qquad R^{-1} = \sum_j R_j^{-1}
      :label: eq-20

   The shares are

   .. math:: \lambda_j = N(\nu_j; 0, S_j), \qquad
             \rho_j = \lambda_j^n \Big/ \sum_i \lambda_i^n
      :label: eq-19

   with ``weights = "instantaneous"``, the paper's text, or :math:`\rho_j \propto \Lambda_j^n` with
   shares under 0.05 dropped without redistribution (``"aggregated"``, as in Sola's implementation).
   ``likelihood = "printed"`` uses :math:`\exp(-\tfrac12 \nu_j^2 S_j^{-1} / \sqrt{2\pi S_j})`, a
   reading of the unbalanced bracket in the printed formula: no density, and sharper for S below
   1/(2 pi).
3. **Prune.** Hypotheses of small aggregated likelihood are removed,

   .. math:: \Lambda_j < \tau / N
      :label: eq-21

   with N the number before pruning, but never the heaviest. A ray of a single hypothesis is a
   *fully initialised* landmark.

For a *range* to a ray, the paper is ambiguous ("all but the heaviest weighted hypothesis is kept,
the measured range is taken as the true range, and the bearing and correspondence are updated as
usual"). ``ranged`` selects the reading:

- ``anew``: replace the ray by a new landmark at range and bearing;
- ``bearing``: ignore the range, and treat the bearing as above;
- ``moved``: move the heaviest to the measured range, keep the others, and treat the bearing as
  above for all.

Readings that remove members by a single range (only the heaviest stays, moved, reset or updated;
or, to the letter, all but the heaviest) lose most worlds, as the members of a young ray have nearly
equal weights.

``paper`` settings reproduce the paper. ``aggregated`` weights, or a power n of 3 to 8, are far more
consistent, as wrong hypotheses no longer pull the vehicle.

**Limits.** Bearings are only nearly linear in x and y: seen from the side, a hypothesis has a
linearisation error of :math:`\alpha^2/2`, 0.045 rad for 0.3. It is small against the paper's R, but
dominates precise bearings (0.003 rad), and filters diverge even with :math:`\alpha` of 0.05 to 0.2.
``spacing = "auto"`` therefore stores bearings more precise than that until another crosses them
(`estimation.ekf.delayed_initialization`).

Departures from the paper: it prints :math:`\sigma_j = \alpha s_{j-1}`, which contradicts its
:math:`\alpha = \sigma/s` and leaves gaps between hypotheses. The correlation of hypotheses through
the noise of their common bearing is neglected, as in Sola's implementation.

Sources: Bradley & Abaid, Eqs. (17) to (21); Sola, Monin, Devy & Lemaire (2005).
"""

import math
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.config import FastSlamConfig, RayConfig
from pipistrelle.jit import Whole, kernel, no_alloc

SMALLEST_AGGREGATED_SHARE = 0.05
SMALLEST_SHARE = 1e-12
UNDERFLOW = 1e-200
FEDERATED, AS_PRINTED, EXACT, FITTED = range(4)
ANEW, BEARING, MOVED = range(3)
RANGED = {"anew": ANEW, "bearing": BEARING, "moved": MOVED}
"""Codes of the values of ``rays.range_update``; a ray stays a ray from BEARING on."""
_SHARING = {
    ("paper", "normal"): FEDERATED, ("paper", "printed"): AS_PRINTED, ("auto", "normal"): FITTED,
}  # fmt: skip


def ray_members(rays: RayConfig) -> tuple[Float[np.ndarray, " h"], Float[np.ndarray, " h"]]:
    """Return the ranges [m] of a new bearing-only landmark's hypotheses, and their stds.

    Ranges s_j rise; sigma_j = alpha s_j. Source: Bradley & Abaid, Eq. (17), with sigma_j corrected
    (see the module docstring).

    >>> range, range_std = ray_members(RayConfig())
    >>> range.round(2)
    array([ 0.71,  2.14,  6.43, 19.29])
    """
    near, far = rays.range_bounds
    first = near / (1.0 - rays.relative_std)
    span = (1.0 - rays.relative_std) / (1.0 + rays.relative_std) * far / near
    members = 1 + max(0, math.ceil(math.log(span) / math.log(rays.range_ratio)))
    ranges = first * rays.range_ratio ** np.arange(members)
    return ranges, rays.relative_std * ranges


class UpdateParams(NamedTuple):
    """Parameters of gates and of bearing-only landmarks, for compiled functions."""

    passive_bound: float  # largest squared Mahalanobis distance of a bearing
    active_bound: float  # largest squared Mahalanobis distance of range and bearing
    ray_ranges: Float[np.ndarray, " h"]  # [m], read-only
    ray_stds: Float[np.ndarray, " h"]  # [m], read-only
    power: float
    prune: float
    merge: float
    aggregated: bool
    ranged: int  # effect of a range on a ray: a code of `RANGED`
    sharing: int
    """Update of hypotheses by a bearing: FEDERATED, AS_PRINTED (federated, other reading of the
    likelihood), EXACT (Gaussian mixture) or FITTED (federated, with ``spacing = "auto"``)."""
    loss: int  # code of the robust loss (`rows.robust_loss`)
    rays_weigh: bool  # whether bearing-only landmarks weigh particles (`estimation.fastslam`)


@lru_cache(maxsize=16)
def gate_bounds(gate: float) -> tuple[float, float]:
    """Return the chi-square gates for one and two degrees of freedom; infinite for a gate of 1.

    >>> [round(bound, 2) for bound in gate_bounds(0.999)]
    [10.83, 13.82]
    """
    if gate >= 1.0:
        return math.inf, math.inf
    return NormalDist().inv_cdf(0.5 * (1.0 + gate)) ** 2, -2.0 * math.log(1.0 - gate)


@lru_cache(maxsize=16)
def update_params(
    rays: RayConfig, gate: float, *, loss: int = 0, swarm: FastSlamConfig | None = None
) -> UpdateParams:
    """Return parameters of gates and bearing-only landmarks; ``swarm``: FastSLAM's settings."""
    passive_bound, active_bound = gate_bounds(gate)
    ray_ranges, ray_stds = ray_members(rays)
    ray_ranges.setflags(write=False)  # shared by all estimators with the same settings
    ray_stds.setflags(write=False)
    exact = swarm is not None and swarm.mixture == "exact"
    return UpdateParams(
        passive_bound=passive_bound,
        active_bound=active_bound,
        ray_ranges=ray_ranges,
        ray_stds=ray_stds,
        power=rays.exponent,
        prune=rays.prune_threshold,
        merge=rays.merge,
        aggregated=rays.weights == "aggregated",
        ranged=RANGED[rays.range_update],
        sharing=EXACT if exact else _SHARING[rays.precise_bearings, rays.likelihood],
        loss=loss,
        rays_weigh=swarm is not None and swarm.weighed_by == "all",
    )


@kernel
def log_likelihood(innovation: float, variance: float, printed: bool) -> float:
    """Return a normal log density without constant, or with Eq. (19) as literally printed."""
    squared = innovation * innovation / variance
    if printed:
        return -0.5 * squared / math.sqrt(2.0 * math.pi * variance)
    return -0.5 * (squared + math.log(variance))


@no_alloc
def heaviest_member(weights: Float[np.ndarray, " h"], count: Whole) -> Whole:
    """Return the index of the largest of the first ``count`` weights, the first of equals."""
    best = 0
    for j in range(1, count):
        if weights[j] > weights[best]:
            best = j
    return best


@no_alloc
def weigh_and_share(
    log_likelihoods: Float[np.ndarray, " m"],
    weights: Float[np.ndarray, " h"],
    count: Whole,
    power: float,
    aggregated: bool,
    share: Float[np.ndarray, " m"],
) -> float:
    """Multiply hypotheses' weights by their likelihoods; write how much each shares in an update.

    ``weights`` (Lambda) and ``share`` (rho) are written; hypotheses with a share of zero are not
    updated. Returns the log of the ray's likelihood, the sum of Lambda lambda, without constant.
    Bradley & Abaid, Eqs. (18) and (19).
    """
    largest = log_likelihoods[0]
    for j in range(1, count):
        largest = max(largest, log_likelihoods[j])
    total = 0.0
    for j in range(count):
        share[j] = math.exp(log_likelihoods[j] - largest)
        total += weights[j] * share[j]
    if total > UNDERFLOW:
        log_total = largest + math.log(total)
        for j in range(count):
            weights[j] *= share[j] / total
    else:  # underflow
        highest, total = -np.inf, 0.0
        for j in range(count):
            log_weight = math.log(weights[j]) if weights[j] > 0.0 else -np.inf
            weights[j] = log_likelihoods[j] + log_weight
            highest = max(highest, weights[j])
        for j in range(count):
            weights[j] = math.exp(weights[j] - highest)
            total += weights[j]
        for j in range(count):
            weights[j] /= total
        log_total = highest + math.log(total)
    total, most = 0.0, weights[heaviest_member(weights, count)] if aggregated else 1.0
    for j in range(count):
        if aggregated:
            share[j] = (weights[j] / most) ** power
        elif power != 1.0:
            share[j] = math.exp(power * (log_likelihoods[j] - largest))
        total += share[j]
    smallest = SMALLEST_AGGREGATED_SHARE if aggregated else SMALLEST_SHARE
    for j in range(count):
        share[j] /= total
        if share[j] < smallest:
            share[j] = 0.0
    return log_total


@no_alloc
def survivors(
    weights: Float[np.ndarray, " h"], count: Whole, prune: float, keep: Bool[np.ndarray, " m"]
) -> Whole:
    """Mark hypotheses to keep after pruning, renormalise their weights and return their number.

    Pruned are weights under prune / count, but not the heaviest. Bradley & Abaid, Eq. (21).
    """
    strongest = heaviest_member(weights, count)
    kept, total = 0, 0.0
    for j in range(count):
        keep[j] = j == strongest or weights[j] >= prune / count
        if keep[j]:
            kept += 1
            total += weights[j]
    for j in range(count):
        if keep[j]:
            weights[j] /= total
    return kept
