r"""Passive landmarks as a ray of Gaussians.

A bearing alone does not say how far away a landmark is. Instead of waiting for parallax, the
landmark enters the map at once as a *ray*: :math:`N_g` Gaussian members along the bearing, at
ranges that grow by the factor :math:`\beta`, each as long as its range allows,

.. math:: s_1 = \frac{s_{min}}{1-\alpha}, \quad s_j = \beta s_{j-1}, \quad
          \sigma_j = \alpha s_j, \quad
          N_g = 1 + \left\lceil \log_\beta\left(\frac{1-\alpha}{1+\alpha}
          \frac{s_{max}}{s_{min}}\right) \right\rceil .
   :label: eq-17

Seen from the vehicle the members differ in range only, so one bearing cannot tell them apart; a
few bearings from different places can. Each new bearing does three things to a ray:

1. **Weigh.** The aggregated likelihood of member j is its probability given all bearings so far;
   a bearing multiplies it by its own likelihood :math:`\lambda_j`:

   .. math:: \Lambda_j = 1 / N_g \text{ at first}, \qquad
             \Lambda_j \leftarrow \Lambda_j \lambda_j \Big/ \sum_i \Lambda_i \lambda_i
      :label: eq-18

2. **Share.** The measurement is one; the members are several. Were each corrected with the full
   measurement, its information would be counted :math:`N_g` times. Federated information sharing
   gives member j the share :math:`\rho_j`; the shares sum to one, so the information does too (the
   principle of measurement reproduction):

   .. math:: R_j = R / \rho_j, \qquad R^{-1} = \sum_j R_j^{-1}
      :label: eq-20

   The shares are

   .. math:: \lambda_j = N(\nu_j; 0, S_j), \qquad
             \rho_j = \lambda_j^n \Big/ \sum_i \lambda_i^n
      :label: eq-19

   with ``weights = "instantaneous"``, the paper's text, or :math:`\rho_j \propto \Lambda_j^n` with
   shares under 0.05 skipped and not handed on (``"aggregated"``, as in Sola's own implementation).
   With ``likelihood = "printed"`` the likelihood is
   :math:`\exp(-\tfrac12 \nu_j^2 S_j^{-1} / \sqrt{2\pi S_j})`, as the unbalanced bracket of the
   printed formula may be read: no density, and sharper where S is below 1/(2 pi).
3. **Prune.** Members are dropped whose aggregated likelihood has become small,

   .. math:: \Lambda_j < \tau / N
      :label: eq-21

   N the number before this prune. The heaviest always stays. A ray of one member is a landmark:
   *fully initialised*.

A *range* of a landmark that is still a ray is a fourth thing, and here the paper can be read in
several ways ("all but the heaviest weighted hypothesis is kept, the measured range is taken as the
true range, and the bearing and correspondence are updated as usual"). ``ranged`` says which:

- ``anew``: the ray goes, and the landmark is placed at range and bearing as a new one;
- ``heaviest``: the heaviest member alone is kept, its mean at the measured range in its direction,
  its covariance as it was; the bearing corrects it;
- ``reset``: the same, its covariance that of a landmark placed there;
- ``corrected``: the heaviest alone is kept, and corrected by range and bearing as a landmark is;
- ``bearing``: the range is not used; the bearing does its three things to the ray;
- ``others``: the sentence to the letter: the heaviest goes, and the bearing does its three things
  to all others;
- ``moved``: the heaviest is moved to the measured range, the others stay, and the bearing does its
  three things to all.

Which to take? ``paper`` settings reproduce the paper; ``aggregated`` weights, or a power n of 3
to 8, make the filter far more consistent: members that are certainly wrong then no longer pull
the vehicle.

A member is a Gaussian in x and y, and a bearing is linear in them only nearly. Seen at a right
angle a member's far end is nearer by its share :math:`\alpha` than its middle, so its bearing is
off by some :math:`\alpha^2/2`, 0.045 rad for 0.3: nothing beside the paper's R, all there is
beside a bearing good to 0.003 rad. ``spacing = "auto"`` therefore lets bearings more precise than
that wait until another crosses them (`estimation.ekf.delayed_initialization`). Finer members alone
did not do: with :math:`\alpha` of 0.05 to 0.2 the filters still diverged on such bearings.

Departures from the printed page: the paper prints :math:`\sigma_j = \alpha s_{j-1}`, which
contradicts its own :math:`\alpha = \sigma/s` and leaves gaps between the members. Members of one
ray are correlated through the pose; the cross-covariance of the bearing noise that they share is
left out, as in Sola's implementation.

Sources: Bradley & Abaid, Eqs. (17) to (21); Sola, Monin, Devy & Lemaire (2005).
"""

import math
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.config import RayConfig
from pipistrelle.jit import Whole, kernel, no_alloc

SMALLEST_AGGREGATED_SHARE = 0.05
SMALLEST_SHARE = 1e-12
UNDERFLOW = 1e-200
FEDERATED, AS_PRINTED, EXACT, FITTED = range(4)
ANEW, HEAVIEST, RESET, CORRECTED, BEARING, OTHERS, MOVED = range(7)
RANGED = {name: k for k, name in enumerate(get_args(RayConfig.model_fields["ranged"].annotation))}
"""Numbers of the readings of ``rays.ranged``, in its order; from BEARING on a ray stays a ray."""
_SHARING = {
    ("paper", "normal"): FEDERATED, ("paper", "printed"): AS_PRINTED, ("auto", "normal"): FITTED,
}  # fmt: skip


def ray_members(rays: RayConfig) -> tuple[Float[np.ndarray, " h"], Float[np.ndarray, " h"]]:
    """Return the ranges of a new ray's members and their standard deviations.

    Parameters
    ----------
    rays : RayConfig

    Returns
    -------
    range : (h) [m]
        s_j, rising.
    range_std : (h) [m]
        sigma_j = alpha s_j.

    Notes
    -----
    Bradley & Abaid, Eq. (17), with sigma_j mended (see the module's head).

    Examples
    --------
    >>> range, range_std = ray_members(RayConfig())
    >>> range.round(2)
    array([ 0.71,  2.14,  6.43, 19.29])
    """
    near, far = rays.range_bounds
    first = near / (1.0 - rays.ratio)
    span = (1.0 - rays.ratio) / (1.0 + rays.ratio) * far / near
    members = 1 + max(0, math.ceil(math.log(span) / math.log(rays.density)))
    ranges = first * rays.density ** np.arange(members)
    return ranges, rays.ratio * ranges


class UpdateParams(NamedTuple):
    """What kernels need to know of gates and rays."""

    passive_bound: float  # largest squared Mahalanobis distance of a bearing
    active_bound: float  # the same of range and bearing
    ray_ranges: Float[np.ndarray, " h"]  # [m], read-only
    ray_stds: Float[np.ndarray, " h"]  # [m], read-only
    power: float
    prune: float
    merge: float
    aggregated: bool
    ranged: int  # what a range does to a ray: a number of `RANGED`
    sharing: int
    """How members take a bearing: FEDERATED, AS_PRINTED (federated, by the other reading of the
    likelihood), EXACT (each takes all of it, as in a Gaussian mixture) or FITTED (federated, and
    ``spacing = "auto"``). One number for all, as a shorter record makes the filter faster."""
    robust: bool  # whether Huber's rule is used (`estimation.ekf.huber`)


@lru_cache(maxsize=16)
def gate_bounds(gate: float) -> tuple[float, float]:
    """Return the chi-square quantiles of one and two degrees of freedom; infinite of a gate of 1.

    >>> [round(bound, 2) for bound in gate_bounds(0.999)]
    [10.83, 13.82]
    """
    if gate >= 1.0:
        return math.inf, math.inf
    return NormalDist().inv_cdf(0.5 * (1.0 + gate)) ** 2, -2.0 * math.log(1.0 - gate)


@lru_cache(maxsize=16)
def update_params(
    rays: RayConfig, gate: float, *, robust: bool = False, exact: bool = False
) -> UpdateParams:
    """Gather what kernels need to know of gates and rays, once per filter.

    With ``exact`` a bearing corrects every member by R itself, as in a Gaussian mixture (FastSLAM).
    """
    passive_bound, active_bound = gate_bounds(gate)
    ray_ranges, ray_stds = ray_members(rays)
    ray_ranges.setflags(write=False)  # all who ask for the same share them
    ray_stds.setflags(write=False)
    return UpdateParams(
        passive_bound=passive_bound,
        active_bound=active_bound,
        ray_ranges=ray_ranges,
        ray_stds=ray_stds,
        power=rays.power,
        prune=rays.prune,
        merge=rays.merge,
        aggregated=rays.weights == "aggregated",
        ranged=RANGED[rays.ranged],
        sharing=EXACT if exact else _SHARING[rays.spacing, rays.likelihood],
        robust=robust,
    )


@kernel
def log_likelihood(innovation: float, variance: float, printed: bool) -> float:
    """Log of N(innovation; 0, variance) without its constant, or of Eq. (19) as printed.

    In logs, for a product of many likelihoods underflows.
    """
    squared = innovation * innovation / variance
    if printed:
        return -0.5 * squared / math.sqrt(2.0 * math.pi * variance)
    return -0.5 * (squared + math.log(variance))


@no_alloc
def _weigh_in_logs(
    log_likelihoods: Float[np.ndarray, " m"], weights: Float[np.ndarray, " h"], count: Whole
) -> float:
    """Multiply weights by likelihoods whose products underflow; return the log of their sum."""
    largest, total = -np.inf, 0.0
    for j in range(count):
        log_weight = math.log(weights[j]) if weights[j] > 0.0 else -np.inf
        weights[j] = log_likelihoods[j] + log_weight
        largest = max(largest, weights[j])
    for j in range(count):
        weights[j] = math.exp(weights[j] - largest)
        total += weights[j]
    for j in range(count):
        weights[j] /= total
    return largest + math.log(total)


@no_alloc
def heaviest_member(weights: Float[np.ndarray, " h"], count: Whole) -> Whole:
    """Return the index of the largest weight, the first of equals."""
    best = 0
    for j in range(1, count):
        if weights[j] > weights[best]:
            best = j
    return best


@no_alloc
def renormalise(weights: Float[np.ndarray, " h"], count: Whole) -> None:
    """Make the first weights sum to one; all equal where their sum has underflown."""
    total = 0.0
    for j in range(count):
        total += weights[j]
    for j in range(count):
        weights[j] = weights[j] / total if total > 0.0 else 1.0 / count


@no_alloc
def weigh_and_share(
    log_likelihoods: Float[np.ndarray, " m"],
    weights: Float[np.ndarray, " h"],
    count: Whole,
    power: float,
    aggregated: bool,
    share: Float[np.ndarray, " m"],
) -> float:
    """Multiply the members' weights by their likelihoods and divide the measurement among them.

    ``weights`` (Lambda) and ``share`` (rho) are written; a share of zero means: skip the member.
    Returns the log of the ray's likelihood, the sum of Lambda lambda, without its constant.
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
    else:
        log_total = _weigh_in_logs(log_likelihoods, weights, count)
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
    """Mark the members that stay, renormalise their weights in place and return their number.

    A member goes when its weight is under prune / count; the heaviest (the first of equals)
    always stays. Bradley & Abaid, Eq. (21).
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
