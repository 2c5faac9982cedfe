"""The scores of an estimate: title, unit, digits and places of each.

Tables, comparisons, reports, figures and notebooks read them from `SCORES`. To add a score, compute
it (`experiments.results.scores`) and add an entry here.
"""

from dataclasses import dataclass
from typing import Literal

Place = Literal["mission", "missions", "studies", "effects", "levels", "cases", "notebook"]
"""Where a score is shown: the table of `run` and `slam`; `compare` of missions; `compare` of
studies, as a table and a panel; a report's effects and cases; a report's charts over a
variable; a report's cases, only as a mean; a notebook's table of a mission."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Title, unit and format of a score, and the places that show it."""

    title: str
    """Without its unit, as in a sentence."""
    unit: str = ""
    """"m", "rad", "landmarks" or nothing."""
    digits: int
    """Decimals of one mission's score."""
    mean_digits: int | None = None
    """Decimals of a mean over worlds; None: `digits`."""
    ratio: bool = False
    """Whether it is compared by ratio: never negative, and over decades."""
    bound: str = ""
    """The score of its lower bound; empty if it has none."""
    shown: frozenset[Place] = frozenset()
    """Places that show it; all files contain every score."""


def _in(*places: Place) -> frozenset[Place]:
    """Return the given display places of a score as a set."""
    return frozenset(places)


EVERYWHERE: frozenset[Place] = _in("mission", "missions", "studies", "effects", "levels")
SCORES = {
    "position_rmse_m": Score(
        title="position RMSE", unit="m", digits=3, bound="position_bound_m",
        shown=EVERYWHERE | _in("notebook"),
    ),
    "heading_rmse_rad": Score(
        title="heading RMSE", unit="rad", digits=4, bound="heading_bound_rad", shown=EVERYWHERE
    ),
    "map_rmse_m": Score(
        title="map RMSE", unit="m", digits=3,
        shown=_in("mission", "missions", "effects", "levels", "notebook"),
    ),
    "position_rmse_aligned_m": Score(
        title="position RMSE, aligned", unit="m", digits=3, shown=EVERYWHERE | _in("notebook")
    ),
    "map_rmse_aligned_m": Score(
        title="map RMSE, aligned", unit="m", digits=3,
        shown=_in("mission", "missions", "studies", "levels"),
    ),
    "map_rmse_shared_m": Score(
        title="map RMSE of shared, aligned", unit="m", digits=3, shown=_in("mission", "missions")
    ),
    "position_floor_m": Score(
        title="position floor", unit="m", digits=3, shown=_in("missions", "cases")
    ),
    "position_bound_m": Score(
        title="position bound over worlds", unit="m", digits=3,
        shown=_in("mission", "missions", "cases"),
    ),
    "heading_bound_rad": Score(
        title="heading bound over worlds", unit="rad", digits=4, shown=_in("mission", "missions")
    ),
    "caller_rmse_m": Score(title="moving callers' RMSE", unit="m", digits=3, shown=EVERYWHERE),
    "caller_rmse_aligned_m": Score(
        title="moving callers' RMSE, aligned", unit="m", digits=3,
        shown=_in("mission", "missions", "studies", "levels")
    ),
    "nees_mean": Score(
        title="NEES, mean", digits=2, ratio=True,
        shown=_in("mission", "missions", "effects", "levels", "notebook"),
    ),
    "nees_max": Score(title="NEES, largest", digits=1, shown=_in("mission", "missions")),
    "landmarks_full": Score(
        title="landmarks placed", unit="landmarks", digits=0, mean_digits=2,
        shown=_in("missions", "studies", "effects", "levels", "notebook"),
    ),
    "landmarks_total": Score(
        title="landmarks heard", unit="landmarks", digits=0, mean_digits=2,
        shown=_in("missions", "notebook"),
    ),
    "associated_right": Score(
        title="rows rightly associated", digits=3,
        shown=_in("mission", "missions", "studies", "effects", "levels"),
    ),
    "associated_found": Score(
        title="rows of landmarks associated", digits=3,
        shown=_in("mission", "missions", "levels"),
    ),
    "landmarks_missed": Score(
        title="landmarks missed", unit="landmarks", digits=0, mean_digits=2,
        shown=_in("mission", "missions", "studies", "levels"),
    ),
    "landmarks_false": Score(
        title="landmarks false", unit="landmarks", digits=0, mean_digits=2,
        shown=_in("mission", "missions", "studies", "levels"),
    ),
    "landmarks_twice": Score(
        title="landmarks twice", unit="landmarks", digits=0, mean_digits=2,
        shown=_in("mission", "missions", "studies", "levels"),
    ),
    "gospa_m": Score(
        title="GOSPA of the map", unit="m", digits=2, shown=_in("mission", "missions", "levels")
    ),
    "measurements_per_frame": Score(
        title="measurements per frame", digits=2, shown=_in("missions")
    ),
    "gated": Score(title="rejected by the gate", digits=0, shown=_in("missions")),
    "diverged": Score(title="diverged", digits=0, shown=_in("missions")),
    "wall_s": Score(title="time of the filter", unit="s", digits=2, shown=_in("missions")),
}  # fmt: skip
"""Every score by its name in ``summary.json`` and in tables, in the order of display."""
NOT_MEANS = frozenset(("diverged", "gated", "wall_s", "map_rmse_shared_m"))
"""Scores that are not averaged over the worlds of a study."""


def shown_in(place: Place) -> dict[str, Score]:
    """Return the scores, by name, that a place such as a report or a table shows.

    >>> list(shown_in("studies"))[:2]
    ['position_rmse_m', 'heading_rmse_rad']
    """
    return {name: score for name, score in SCORES.items() if place in score.shown}


def heading(score: Score) -> str:
    """Return a score's title with its unit.

    >>> heading(SCORES["position_rmse_m"]), heading(SCORES["landmarks_full"])
    ('position RMSE [m]', 'landmarks placed')
    """
    return f"{score.title} [{score.unit}]" if score.unit in ("m", "rad", "s") else score.title
