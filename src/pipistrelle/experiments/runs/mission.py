"""The record of a mission, simulated or solved from a recorded log."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from pipistrelle.acoustics.callers import Caller
from pipistrelle.config import Config
from pipistrelle.detection.faces import FrameMeasurements
from pipistrelle.detection.logs.recording import Log
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.hearing.scenario import Scenario
from pipistrelle.experiments.hearing.world import World
from pipistrelle.experiments.results.scores import TrialResult


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission, simulated or from a log: what was driven and heard, and each estimate of it."""

    config: Config
    """Of a log, the sections that estimators read count."""
    drive: Drive
    trials: tuple[TrialResult, ...]
    beamwidth: float | None
    """Full half-power width of the vehicle's beam; of a log, that outside which ranges were hidden
    [rad]."""
    callers: tuple[Caller, ...] = ()
    """Callers besides the vehicle, where the world is known."""
    scenario: Scenario | None = None
    """The world that was drawn; None for a log."""
    world: World | None = None
    """The user's own world, if one was given."""
    heard: tuple[FrameMeasurements, ...] = ()
    """The frames of a simulated mission."""
    log: Log | None = None
    """The recorded log; None for a simulated mission."""
    source: Mapping[str, object] | None = None
    """Which log it was, for ``summary.json`` (`log_entry`)."""
    notes: Callable[[], Iterable[str]] = tuple
    """Returns the warnings for the user; it is called after the results are written."""
    difference: str = ""
    """Of a mission that was rerun: how its tracks differ from those of its folder, in a line."""
