"""Missions as they were asked for: simulated or solved from a log, then drawn, filmed, kept."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import inf, radians
from pathlib import Path
from typing import TYPE_CHECKING

from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.logs.readers import Robot
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.hearing.listening import Keep, Progress
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, World
from pipistrelle.experiments.hearing.world_folder import kept_world
from pipistrelle.experiments.named_settings import check_own, laid, of_estimators
from pipistrelle.experiments.results.scores import TrialResult, is_placed
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.replay import load, replay
from pipistrelle.experiments.runs.rerun import log_entry
from pipistrelle.experiments.runs.trial import Watch, run_mission
from pipistrelle.experiments.runs.validate import warnings_of
from pipistrelle.files import OwnFiles
from pipistrelle.scripting.arguments import number, short_names
from pipistrelle.scripting.log_settings import (
    check_bag,
    check_open,
    check_room,
    fit_warnings,
    log_warnings,
    nis_warning,
    replayed,
    with_log,
)
from pipistrelle.settings import Given, Layer, resolve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipistrelle.figures.recorder import MissionRecorder


MAX_TIMES_BOUND = 4.0
"""Ratio of position error to bound above which a warning is given."""
ROUNDING = 1e-9
"""Position error that comes of arithmetic and gives no warning where the bound is 0 [m]."""
Conduct = Callable[..., Mission]
"""Does a mission, given `progress` and `watch`; the same settings give the same bits."""


def simulated(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    world: World | None = None,
    *,
    keep: Keep | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Drive through a world by sound and map it, with notes on what looks odd (`run_mission`)."""
    config = of_estimators(config, filters)
    mission = run_mission(
        config,
        strategies,
        filters,
        world=world or ALL_DRAWN,
        keep=keep,
        progress=progress,
        watch=watch,
    )
    assert mission.scenario is not None
    callers = mission.scenario.callers

    def notes() -> Iterator[str]:
        yield from warnings_of(config, callers)
        yield from _far_off(mission.trials)
        yield from filter(None, map(nis_warning, mission.trials))

    return replace(mission, notes=notes)


def _far_off(trials: Sequence[TrialResult]) -> list[str]:
    """Warn of estimates whose position error is many times the bound."""
    pairs = [
        (trial, trial.scores.position_rmse_m, trial.scores.position_bound_m) for trial in trials
    ]
    return [
        f"{trial.strategy} {short_name(trial.filter)}: its position error, {error:.3g} m, is "
        + (f"{error / bound:.1f} times" if bound > 0.0 else "above")
        + f" the bound, {bound:.3g} m; what serves each estimator is in docs/estimators.md"
        for trial, error, bound in pairs
        if error is not None
        and bound is not None
        and MAX_TIMES_BOUND * bound + ROUNDING < error < inf
    ]


def prepare_slam(
    place: Path,
    layers: tuple[Layer, Layer, Layer],
    robot: Robot | None,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    beamwidth: Given,
) -> tuple[Conduct, list[str], list[str]]:
    """Read a recorded log and settle what it decides.

    Returns what solves it, lines on what its reader chose, and warnings.

    The layers are the settings beneath, those by their own names, and those by short names; ranges
    outside the beamwidth [deg] about the heading are hidden, where it is not None.
    """
    beneath, flags, short = layers
    check_open(flags)
    given = flags | short_names(short, flags)
    layer = laid(beneath, given)
    check_own(layer)
    asked = resolve(layer)
    if beamwidth.value is not None and not 0 < number(beamwidth) <= 360:
        raise InputError(
            f"{beamwidth.where}: found {beamwidth.value:g}, expected above 0 and up to 360 [deg]"
        )
    check_bag(given, place)
    recorded, truth = load(place, robot, bag=asked.bag)
    config, overruled = with_log(layer, recorded, place)
    config = of_estimators(config, filters)
    check_room(recorded, filters, config)
    beam = None if beamwidth.value is None else radians(beamwidth.value)

    def conduct(*, progress: Progress | None = None, watch: Watch | None = None) -> Mission:
        asked = (strategies, filters, beam, config)
        mission = replay(recorded, truth, *asked, progress=progress, watch=watch)
        notes = partial(fit_warnings, recorded, mission.trials, place, config)
        return replace(mission, source=log_entry(place, robot, beam), notes=notes)

    warnings = [*overruled, *log_warnings(recorded, truth, place)]
    return conduct, [f"{place}: {note}" for note in recorded.notes], warnings


def failures(mission: Mission) -> list[str]:
    """Return a line for each estimate that failed, or whose path is not finite."""
    return [
        f"{trial.strategy} {trial.filter} failed: {trial.error or 'its path is not finite'}"
        for trial in mission.trials
        if not is_placed(trial)
    ]


def strategy_names(mission: Mission) -> dict[str, str]:
    """Return headings for strategies: a log that is solved by fused sensing only gives all rows."""
    alone = mission.log is not None and {trial.strategy for trial in mission.trials} == {"fused"}
    return {"fused": "all rows"} if alone else {}


def drawn(mission: Mission) -> "Figure":
    """Draw the maps and errors of a mission."""
    from pipistrelle.figures.mission import draw_mission

    return draw_mission(
        mission.trials,
        truth=mission.drive.truth,
        callers=mission.callers,
        beamwidth=mission.beamwidth,
        names=strategy_names(mission),
    )


def filmed(mission: Mission, watch: "MissionRecorder", path: Path) -> None:
    """Film a mission that a recorder has watched into a .gif or .mp4 file."""
    from pipistrelle.figures.film import animate_mission

    animate_mission(
        watch.snapshots,
        path,
        truth=mission.drive.truth,
        callers=mission.callers,
        beamwidth=mission.beamwidth,
    )


def caller_names(mission: Mission) -> tuple[str, ...]:
    """Return the names of the callers besides the vehicle, as measurements name them."""
    callers = mission.callers if mission.log is None else mission.log.callers
    return tuple(caller.name for caller in callers)


def keep(
    mission: Mission, own: OwnFiles, command: str, more: Callable[[Path], None] = lambda _: None
) -> None:
    """Write a mission into its folder, in place of earlier results.

    The command is for the reader; `more` is given a folder to put other pictures into.
    """
    from pipistrelle.figures.style import save_figure

    figure, config, files = drawn(mission), mission.config, {}
    if mission.log is not None:
        kept = replayed(config)
    elif mission.world is not None:
        kept, files = kept_world(config, mission.world)
    else:
        kept = config

    def draw(room: Path) -> None:
        save_figure(figure, room, "mission")
        more(room)

    write_results(
        own,
        config=kept,
        command=command,
        seed=config.seed,
        trials=mission.trials,
        truth=mission.drive.truth,
        ignored_rows={} if mission.log is None else dict(mission.log.ignored_rows),
        callers=caller_names(mission),
        moving=mission.drive.moving,
        beside=files,
        log=mission.source,
        draw=draw,
    )
