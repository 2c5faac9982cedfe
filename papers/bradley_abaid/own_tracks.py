"""Follow a drive by a filter of these scripts, and read a swarm's pose and covariance in many ways.

`follow` moves a filter through a drive scan by scan, as `pipistrelle.experiments.runs.trial` does,
and keeps the swarm of particles at every step; `READINGS` are estimates from it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Track
from pipistrelle.estimation.motion import SMALLEST_STD
from pipistrelle.experiments.drives import Drive
from pipistrelle.geometry import wrap


class Swarm(NamedTuple):
    """Particles at a moment, or (with a leading axis) at all steps of a drive."""

    pose: np.ndarray
    """(p, 3) [m, m, rad]."""
    P: np.ndarray
    """(p, 3, 3), covariance since the last sample; 0 after a scan."""
    refined: np.ndarray
    """(p, 3, 3), after a scan the covariance of the Gaussian that the pose was sampled from."""
    weight: np.ndarray
    """(p)."""


Path = tuple[np.ndarray, np.ndarray]
"""Means (k, 3) and covariances (k, 3, 3)."""


class Followed(NamedTuple):
    """What a filter did along a drive."""

    path: Path | None
    """Of a filter that estimates a pose itself."""
    before: Swarm | None
    """Of a particle filter, before the resampling."""
    after: Swarm | None


def follow(slam: Any, drive: Drive, scans: Sequence[Scan], rng: np.random.Generator) -> Followed:
    """Move a filter through a drive, and keep its estimates at each step."""
    slam.start(drive.start.mean, drive.start.covariance, rng)
    steps, dt = np.searchsorted(drive.time, [scan.time for scan in scans]), np.diff(drive.time)
    at = dict(zip(steps.tolist(), scans, strict=True))
    kept: list[Any] = [_now(slam)]
    for k, control in enumerate(drive.controls, start=1):
        slam.move(control, float(dt[k - 1]))
        if k in at:
            slam.hear(at[k])
        kept.append(_now(slam))
    if not hasattr(slam, "swarm"):
        means, covariances = zip(*kept, strict=True)
        return Followed((np.array(means), np.array(covariances)), None, None)
    before, after = zip(*kept, strict=True)
    return Followed(None, _stacked(before), _stacked(after))


def _now(slam: Any) -> tuple[Any, Any]:
    """Return a filter's swarm before and after resampling, or its mean and covariance."""
    return (slam.swarm, slam.after) if hasattr(slam, "swarm") else slam.pose()


def _stacked(swarms: Sequence[Swarm]) -> Swarm:
    return Swarm(*(np.stack(parts) for parts in zip(*swarms, strict=True)))


def track_of(path: Path, drive: Drive, landmarks: Any) -> Track:
    """Return a track for scoring."""
    mean, covariance = path[0].copy(), path[1].copy()
    mean[0], covariance[0] = drive.start.mean, drive.start.covariance
    pose = Gaussian(mean=mean, covariance=covariance)
    return Track(time=drive.time, pose=pose, landmarks=landmarks, gated=0)


def circular(swarm: Swarm) -> np.ndarray:
    """Return the weighted mean poses, of the headings the direction of the mean direction."""
    mean = np.einsum("kp,kpd->kd", swarm.weight, swarm.pose)
    sine, cosine = (np.sum(swarm.weight * f(swarm.pose[..., 2]), axis=1) for f in (np.sin, np.cos))
    mean[:, 2] = np.arctan2(sine, cosine)
    return mean


def spread(swarm: Swarm, mean: np.ndarray, *, plain: bool = False) -> np.ndarray:
    """Return the weighted covariance of the poses about a mean; plain: headings not wrapped."""
    off = swarm.pose - mean[:, np.newaxis]
    if not plain:
        off[..., 2] = wrap(off[..., 2])
    return np.einsum("kp,kpa,kpb->kab", swarm.weight, off, off) + SMALLEST_STD**2 * np.eye(3)


def own(swarm: Swarm, part: str = "P") -> np.ndarray:
    """Return the mean over the particles of their own covariances."""
    return np.einsum("kp,kpab->kab", swarm.weight, getattr(swarm, part))


def whole(swarm: Swarm) -> Path:
    """Return the package's estimate: circular mean; spread, and covariance since the sample."""
    mean = circular(swarm)
    return mean, spread(swarm, mean) + own(swarm)


def plainly(swarm: Swarm) -> Path:
    """Return plain means and deviations of wrapped headings."""
    mean = np.einsum("kp,kpd->kd", swarm.weight, swarm.pose)
    return mean, spread(swarm, mean, plain=True) + own(swarm)


def plainly_wrapped(swarm: Swarm) -> Path:
    """Return plain means of wrapped headings, with deviations that are wrapped."""
    mean = np.einsum("kp,kpd->kd", swarm.weight, swarm.pose)
    return mean, spread(swarm, mean) + own(swarm)


def unweighted(swarm: Swarm) -> Path:
    """Return plain moments of the poses with equal weights, as the MATLAB package does."""
    even = swarm._replace(weight=np.full_like(swarm.weight, 1.0 / swarm.weight.shape[1]))
    mean = np.einsum("kp,kpd->kd", even.weight, even.pose)
    return mean, _once_sampled(spread(even, mean, plain=True), swarm)


def spread_alone(swarm: Swarm) -> Path:
    """Leave out the covariance that the particles have accumulated since their sample."""
    mean = circular(swarm)
    return mean, _once_sampled(spread(swarm, mean), swarm)


def _once_sampled(covariance: np.ndarray, swarm: Swarm) -> np.ndarray:
    """Add the particles' own covariance before the first sample, when they are all alike."""
    alike = (swarm.pose == swarm.pose[:, :1]).all(axis=(1, 2))
    return covariance + alike[:, np.newaxis, np.newaxis] * own(swarm)


def own_alone(swarm: Swarm) -> Path:
    """Leave out the spread; after a scan, the covariance from which the pose was sampled."""
    return circular(swarm), own(swarm, "refined") + SMALLEST_STD**2 * np.eye(3)


def heaviest_alone(swarm: Swarm) -> Path:
    """Take pose and covariance of the heaviest particle."""
    best, rows = swarm.weight.argmax(axis=1), np.arange(len(swarm.weight))
    return swarm.pose[rows, best], swarm.refined[rows, best] + SMALLEST_STD**2 * np.eye(3)


def about_heaviest(swarm: Swarm) -> Path:
    """Take the pose of the heaviest particle, and the spread of all about it."""
    best = swarm.weight.argmax(axis=1)
    mean = swarm.pose[np.arange(len(best)), best]
    return mean, spread(swarm, mean) + own(swarm)


READINGS: dict[str, tuple[Callable[[Swarm], Path], str]] = {
    "plain mean of headings": (plainly, "before"),
    "plain mean of headings, deviations wrapped": (plainly_wrapped, "before"),
    "spread alone": (spread_alone, "before"),
    "own covariance alone": (own_alone, "before"),
    "after resampling": (whole, "after"),
    "after resampling, unweighted, plain": (unweighted, "after"),
    "heaviest particle alone": (heaviest_alone, "before"),
    "heaviest particle, spread of all": (about_heaviest, "before"),
}
"""Estimates from a swarm, and whether from that before or after the resampling."""
