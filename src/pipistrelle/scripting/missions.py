"""A mission as it was asked for: simulated or recorded, then drawn, kept, looked at again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from pipistrelle.acoustics.callers import Caller
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.config import Config, Strategy
from pipistrelle.detection.logs.readers import Robot
from pipistrelle.detection.logs.recording import Log
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.hearing.world import ANY, World
from pipistrelle.experiments.hearing.world_folder import kept_world
from pipistrelle.experiments.results.scores import TrialResult, is_placed
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.experiments.runs.again import log_entry
from pipistrelle.experiments.runs.preparing import warnings_of
from pipistrelle.experiments.runs.replay import moving_of, replay
from pipistrelle.experiments.runs.trial import Mission, Watch, run_mission
from pipistrelle.own_files import OwnFiles
from pipistrelle.scripting.recorded import SlamConfig, afterwards, driven, surprise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipistrelle.figures.recorder import MissionRecorder


FAR = 4.0
"""How many times the bound a position error may be before that is said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A mission that was done, with all that its folder is to hold.

    Attributes
    ----------
    config : pydantic model
        All settings, as the folder keeps them.
    seed : int
    trials : tuple of TrialResult
    truth : Truth
    callers : tuple of Caller
        Who was heard besides the vehicle, where that is known.
    names : tuple of str
        As measurements name them.
    moving : dict of label to str
        The names of those that move.
    beamwidth : [rad] or None
        Of the vehicle's call.
    ignored_rows : dict
        Number of dropped log rows by reason.
    log : dict or None
        Which log it was (`log_entry`).
    beside : dict of name to content
        Files that are to stand beside the results.
    said : tuple of str
        What a user is to be warned of.
    driven : [m] or None
        How far a log's odometry says that the vehicle drove.
    """

    config: BaseModel
    seed: int
    trials: tuple[TrialResult, ...]
    truth: Truth
    callers: tuple[Caller, ...] = ()
    names: tuple[str, ...] = ()
    moving: Mapping[int, str] = field(default_factory=dict)
    beamwidth: float | None = None
    ignored_rows: Mapping[str, int] = field(default_factory=dict)
    log: Mapping[str, object] | None = None
    beside: Mapping[str, bytes] = field(default_factory=dict)
    said: tuple[str, ...] = ()
    driven: float | None = None


def simulated(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    world: World | None = None,
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> tuple[Done, Mission]:
    """Drive through a world by sound, and map it.

    Parameters
    ----------
    config : Config
    strategies, filters : sequence of str
    world : World, optional
        What is known of it beforehand.
    progress, watch : callable, optional
        As of `run_mission`.

    Returns
    -------
    Done
    Mission
        With its world and its recording.

    Raises
    ------
    InputError
        As `run_mission`.
    """
    looking = {"progress": progress, "watch": watch}
    mission = run_mission(config, strategies, filters, world=world or ANY, **looking)
    return done_of(mission, world), mission


def done_of(mission: Mission, world: World | None) -> Done:
    """Return a simulated mission with all that its folder is to hold, its own world too."""
    config = mission.config
    kept, files = (config, {}) if world is None else kept_world(config, world)
    return Done(
        config=kept,
        seed=config.seed,
        trials=mission.trials,
        truth=mission.drive.truth,
        callers=mission.scenario.callers[1:],
        names=tuple(caller.name for caller in mission.scenario.callers[1:]),
        moving=mission.drive.moving,
        beamwidth=beamwidth_of(config),
        beside=files,
        said=(
            *warnings_of(config, mission.scenario.callers),
            *_far_off(mission.trials),
            *filter(None, map(surprise, mission.trials)),
        ),
    )


def _far_off(trials: Sequence[TrialResult]) -> list[str]:
    """Say which estimates are much farther off than the bound."""
    pairs = [
        (trial, trial.scores.position_rmse_m, trial.scores.position_bound_m) for trial in trials
    ]
    return [
        f"{trial.strategy} {short_name(trial.filter)}: its position error, {error:.3g} m, is "
        f"{error / bound:.1f} times the bound, {bound:.3g} m; what serves each estimator is in "
        "docs/estimators.md"
        for trial, error, bound in pairs
        if error is not None and bound is not None and FAR * bound < error < inf
    ]


def solved(
    place: Path,
    robot: Robot | None,
    log: tuple[Log, Truth],
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    beamwidth: float | None = None,
    *,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Done:
    """Solve a recorded log.

    Parameters
    ----------
    place : Path
        Where it lies.
    robot : int or str, or None
        Whose of several it is.
    log : Log and Truth
        As `load` reads them.
    config : Config
        As `with_log` settles it.
    strategies, filters : sequence of str
    beamwidth : [rad], optional
        Outside which ranges are hidden.
    progress, watch : callable, optional
        As of `replay`.

    Returns
    -------
    Done

    Raises
    ------
    InputError
        For an estimator that cannot be had.
    """
    recorded, truth = log
    looking = {"progress": progress, "watch": watch}
    trials = replay(recorded, truth, strategies, filters, beamwidth, config, **looking)
    entry = log_entry(place, robot, beamwidth)
    said = tuple(afterwards(recorded, trials, place, config))
    return replace(done_of_log(recorded, truth, config, trials, entry), said=said)


def done_of_log(
    recorded: Log,
    truth: Truth,
    config: Config,
    trials: Sequence[TrialResult],
    entry: Mapping[str, Any],
) -> Done:
    """Return a log that was solved with all that its folder is to hold; `log_entry` says which."""
    return Done(
        config=SlamConfig(**{name: getattr(config, name) for name in SlamConfig.model_fields}),
        seed=config.seed,
        trials=tuple(trials),
        truth=truth,
        names=tuple(caller.name for caller in recorded.callers),
        moving=moving_of(recorded),
        beamwidth=entry["beamwidth_rad"],
        ignored_rows=recorded.ignored_rows,
        log=entry,
        driven=driven(recorded),
    )


def failures(done: Done) -> list[str]:
    """Say of each estimate that failed, or whose path is not finite, why."""
    return [
        f"{trial.strategy} {trial.filter} failed: {trial.error or 'its path is not finite'}"
        for trial in done.trials
        if not is_placed(trial)
    ]


def drawn(done: Done) -> "Figure":
    """Draw a mission that was done.

    Parameters
    ----------
    done : Done

    Returns
    -------
    Figure
    """
    from pipistrelle.figures.mission import draw_mission

    return draw_mission(
        done.trials, truth=done.truth, callers=done.callers, beamwidth=done.beamwidth
    )


def filmed(done: Done, watch: "MissionRecorder", path: Path) -> None:
    """Film a mission that was done.

    Parameters
    ----------
    done : Done
    watch : MissionRecorder
        That saw it.
    path : Path
        Ends in .gif or .mp4.

    Raises
    ------
    InputError
        With another ending, or where the film cannot be made.
    """
    from pipistrelle.figures.animation import animate_mission

    scene = {"truth": done.truth, "callers": done.callers, "beamwidth": done.beamwidth}
    animate_mission(watch.snapshots, path, **scene)


def keep(
    done: Done, own: OwnFiles, command: str, more: Callable[[Path], None] = lambda _: None
) -> None:
    """Write a mission into its folder, in place of earlier results.

    Parameters
    ----------
    done : Done
    own : OwnFiles
        The folder, as `result_folder` lends it.
    command : str
        What was asked for, for the reader.
    more : callable, optional
        Given a folder to put other pictures into.

    Raises
    ------
    InputError
        Where a file cannot be written, or one that would be replaced is not as we wrote it.
    """
    from pipistrelle.figures.style import save_figure

    figure = drawn(done)

    def draw(room: Path) -> None:
        save_figure(figure, room, "mission")
        more(room)

    write_results(
        own,
        config=done.config,
        command=command,
        seed=done.seed,
        trials=done.trials,
        truth=done.truth,
        ignored_rows=dict(done.ignored_rows),
        callers=done.names,
        moving=done.moving,
        beside=done.beside,
        log=done.log,
        draw=draw,
    )
