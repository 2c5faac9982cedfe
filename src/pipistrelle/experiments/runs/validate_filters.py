"""Checks of estimators before anything is heard, and records of those that fail later.

A trial that fails costs its own estimate; what the others found is kept.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from traceback import extract_tb, format_exc

import numpy as np

from pipistrelle.config import Config, InputError
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Belief, Gaussian, Track, no_landmarks
from pipistrelle.estimation.catalogue import CATALOGUE, check_distinct, entry
from pipistrelle.estimation.data_association.methods import association_of
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.outside import worded
from pipistrelle.experiments.cases import Case
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.results.scores import TrialResult, score
from pipistrelle.kernel_clock import judging


def check_filters(
    filters: Sequence[str], motion: Motion, config: Config, moving: Iterable[str] = ()
) -> None:
    """Refuse estimators and associations that cannot be built or begun, before anything is heard.

    `moving`: names of the callers that move.
    """
    check_distinct(filters)
    followed = () if association_of(config) is None or not config.listening.timing else moving
    for name in filters:
        check_follows(name, followed)
        if name in CATALOGUE:
            check_calibrates(name, config)
            continue
        try:
            belief = first_belief(name, motion, config)
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"filter {name}: init fails: {_placed(error)}") from error
        parts = ("pose", "landmarks", "gated")
        if lacking := [part for part in parts if not hasattr(belief, part)]:
            raise InputError(
                f"filter {name}: init returns a belief that lacks {', '.join(lacking)}; a belief "
                f"has {', '.join(parts)}"
            )
        methods = ("pose", "landmarks", "path", "cloud")
        if fixed := [part for part in methods if not callable(getattr(belief, part, _nothing))]:
            raise InputError(
                f"filter {name}: init returns a belief whose {', '.join(fixed)} cannot be called; "
                f"of a belief {', '.join(methods)} are methods, the last two where it has them"
            )


def check_calibrates(name: str, config: Config) -> None:
    """Refuse ``filter.calibrate`` with a listed estimator that calibrates nothing."""
    asked = config.filter.calibrate
    if asked and not CATALOGUE[name].calibrates:
        able = ", ".join(known.name for known in CATALOGUE.values() if known.calibrates)
        raise InputError(
            f"filter.calibrate: found {', '.join(asked)} with the filter {name}, which calibrates "
            f"nothing; take {able}, or leave it out (in a plan, name it under [own.{able}])"
        )


def check_follows(name: str, moving: Iterable[str]) -> None:
    """Refuse callers that move, and that an association is to find, of a filter that follows none.

    >>> check_follows("iekf", ["boat"])
    """
    if (names := ", ".join(moving)) and not entry(name).follows:
        able = ", ".join(known.name for known in CATALOGUE.values() if known.follows)
        raise InputError(
            f"association.method: found callers that move ({names}) with the filter {name}, which "
            f"follows none; take {able}, or add --listening.timing false"
        )


def _nothing() -> None:
    """Stand for a method that a belief need not have."""


@judging()
def first_belief(name: str, motion: Motion, config: Config) -> Belief:
    """Return the belief of an estimator before the vehicle has moved or heard anything.

    >>> still = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> first_belief("fastslam", still, Config()).landmarks().landmark.size
    0
    """
    return entry(name).build(config, motion).init(Gaussian(mean=np.zeros(3), covariance=np.eye(3)))


def failed_trial(case: Case, drive: Drive, scans: Sequence[Scan], error: Exception) -> TrialResult:
    """Return the result of a filter that failed: its poses are NaN, and it has no map.

    An interruption that a library hid behind the error is raised (`let_interruptions_pass`).
    """
    let_interruptions_pass(error)
    k = drive.time.size
    nowhere = Gaussian(mean=np.full((k, 3), np.nan), covariance=np.full((k, 3, 3), np.nan))
    track = Track(time=drive.time, pose=nowhere, landmarks=no_landmarks(), gated=0)
    return TrialResult(
        strategy=case.strategy,
        filter=case.filter,
        track=track,
        heard=tuple(scans),
        scans=tuple(scans),
        scores=score(track, drive.truth, scans, 0.0),
        wall_s=0.0,
        error=_placed(error),
    )


def failure_text(error: Exception) -> str:
    """Return the traceback of the current error, with its message as the last line.

    An interruption that a library hid behind the error is raised (`let_interruptions_pass`).
    """
    let_interruptions_pass(error)
    return f"{format_exc()}{worded(error)}\n"


def let_interruptions_pass(error: Exception) -> None:
    """Raise an interruption that a library hid behind an error of its own."""
    behind: BaseException | None = error
    while behind is not None:
        if isinstance(behind, KeyboardInterrupt):
            raise behind
        behind = behind.__cause__ or behind.__context__


def _placed(error: Exception) -> str:
    """Return the message of an error that a filter raised, with file and line."""
    place = extract_tb(error.__traceback__)[-1]
    return f"{worded(error)} ({Path(place.filename).name}, line {place.lineno})"
