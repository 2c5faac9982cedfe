"""The scores of an estimate: title, unit, digits and places of each.

Tables, comparisons, reports, figures and notebooks read them from `SCORES`. To add a score, compute
it (`experiments.results.scores`) and add an entry to ``scores.toml``.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pipistrelle.files import shipped_text

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
    chart: Mapping[str, Any] = field(default_factory=dict)
    """Other attributes of its chart in a report (`report.charts.Level`)."""


SCORES = {
    name: Score(**score | {"shown": frozenset(score["shown"])})
    for name, score in tomllib.loads(shipped_text("evaluation/scores.toml")).items()
}
"""Every score by its name in ``summary.json`` and in tables, in the order of display."""
POSITION, POSITION_ALIGNED = "position_rmse_m", "position_rmse_aligned_m"
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
