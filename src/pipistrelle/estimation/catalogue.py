"""The estimators by name: one entry each, and no other list of them anywhere.

Verbs, plans, memory checks, figures and reports take from here what they need to know of an
estimator. To add one, write it (`pipistrelle.estimation.beliefs.Estimator`) and give it an entry.
The estimators themselves are imported when one is built: the command line shows their names at
once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipistrelle.config import Config, InputError

if TYPE_CHECKING:
    from pipistrelle.estimation.beliefs import Estimator
    from pipistrelle.estimation.motion import Motion

DOUBLE = 8
"""Bytes of a number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """What the rest of the package knows of an estimator.

    Attributes
    ----------
    name : str
        As settings, tables and files have it.
    title : str
        As a reader knows it.
    build : function of Config and Motion
        Makes the estimator from the settings, for a vehicle that moves so.
    sections : tuple of str
        The sections of the settings that it reads; none of them changes what is heard.
    nees_limit : float
        A NEES above it means that the estimator has diverged.
    memory : function of the number of landmarks, the members of each, and Config
        Most bytes that it holds at once: all landmarks are there, and all of them still rays.
    """

    name: str
    title: str
    build: "Callable[[Config, Motion], Estimator]"
    sections: tuple[str, ...]
    nees_limit: float
    memory: Callable[[int, int, Config], float]


def entry(name: str) -> Entry:
    """Look an estimator up.

    Parameters
    ----------
    name : str

    Returns
    -------
    Entry

    Raises
    ------
    InputError
        For an unknown name.

    Examples
    --------
    >>> entry("fastslam").title
    'FastSLAM 2.0'
    """
    if name not in CATALOGUE:
        raise InputError(f"filter: found {name!r}, expected one of {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


def _ekf(config: Config, motion: "Motion") -> "Estimator":
    """Build EKF-SLAM."""
    from pipistrelle.estimation.ekf.filter import EkfSlam

    settings = config.filter
    return EkfSlam(
        motion=motion,
        rays=config.rays,
        gate=settings.gate,
    )


def _ekf_bytes(landmarks: int, members: int, _: Config) -> float:
    """Count the covariances: the one before, the one at work, the one after."""
    return 3.0 * DOUBLE * (3 + 2 * landmarks * members) ** 2


def _fastslam(config: Config, motion: "Motion") -> "Estimator":
    """Build FastSLAM 2.0."""
    from pipistrelle.estimation.fastslam.filter import FastSlam

    settings = config.filter
    return FastSlam(
        motion=motion,
        rays=config.rays,
        gate=settings.gate,
        swarm=config.fastslam,
    )


def _fastslam_bytes(landmarks: int, members: int, config: Config) -> float:
    """Count the particles: those before, the corrected ones, the resampled ones."""
    each = 6 * landmarks * members + landmarks
    return 3.0 * DOUBLE * config.fastslam.particles * each


CATALOGUE = {
    known.name: known
    for known in (
        Entry(
            name="ekf",
            title="EKF",
            build=_ekf,
            sections=("filter", "rays"),
            nees_limit=50.0,
            memory=_ekf_bytes,
        ),
        Entry(
            name="fastslam",
            title="FastSLAM 2.0",
            build=_fastslam,
            sections=("filter", "rays", "fastslam"),
            nees_limit=2750.0,
            memory=_fastslam_bytes,
        ),
    )
}
"""All estimators; the limits are those of Bradley & Abaid, Sec. V-A."""
PAPERS = ("ekf", "fastslam")
"""The two of Bradley & Abaid, of which its claims speak."""
