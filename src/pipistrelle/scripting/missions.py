"""Missions: simulated or solved from a log; drawn, filmed, kept, and written as logs or sound."""

import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import inf, radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.acoustics.paths import moves
from pipistrelle.config import Config, InputError, Strategy
from pipistrelle.detection.logs.folder import log_files
from pipistrelle.detection.logs.readers import reader_of
from pipistrelle.detection.logs.recording import Log, LogCaller
from pipistrelle.detection.noise import unstated
from pipistrelle.detection.scans import Scan, columns_of
from pipistrelle.estimation.beliefs import KNOWN
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.drives import split_at
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, World, caller_labels
from pipistrelle.experiments.hearing.sound_recorder import SoundRecorder
from pipistrelle.experiments.hearing.world_folder import kept_world, world_files
from pipistrelle.experiments.machine import check_memory
from pipistrelle.experiments.named_settings import (
    check_own,
    each_its_own,
    laid,
    of_estimators,
    own_config,
)
from pipistrelle.experiments.results.scores import TrialResult, is_placed
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.replay import load, log_entry, replay
from pipistrelle.experiments.runs.trial import Watch, run_mission
from pipistrelle.experiments.runs.truth_files import truth_files
from pipistrelle.experiments.runs.validate import checked_scenario, warnings_of
from pipistrelle.files import LOG, SOUND, WORLD, OwnFiles, without_links
from pipistrelle.refusals import refusal
from pipistrelle.scripting.arguments import (
    Door,
    check_open,
    folder_named,
    frames_named,
    number,
    replayed,
    with_log,
)
from pipistrelle.scripting.log_warnings import fit_warnings, labels_of, log_warnings, nis_warning
from pipistrelle.settings import Layer, resolve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipistrelle.figures.recorder import MissionRecorder


MAX_TIMES_BOUND = 4.0
"""Largest ratio of position error to bound without a warning."""
ROUNDING = 1e-9
"""Position error by rounding, which gives no warning where the bound is 0 [m]."""
Conduct = Callable[..., Mission]
"""Conducts a mission, given `progress` and `watch`; repeated calls give the same bits."""


def simulated(
    config: Config,
    strategies: Sequence[Strategy],
    filters: Sequence[str],
    world: World | None = None,
    **conducted: Any,
) -> Mission:
    """Simulate a drive and map it with each estimator; add warnings to the mission."""
    config, world = of_estimators(config, filters), world or ALL_DRAWN
    mission = run_mission(config, strategies, filters, world=world, **conducted)
    assert mission.scenario is not None
    callers = mission.scenario.callers

    def notes() -> Iterator[str]:
        yield from warnings_of(config, callers)
        yield from _far_off(mission.trials)
        yield from filter(None, map(nis_warning, mission.trials))

    return replace(mission, notes=notes)


def _far_off(trials: Sequence[TrialResult]) -> Iterator[str]:
    """Yield a warning for each estimate with a position error far above its lower bound."""
    for trial in trials:
        error, bound = trial.scores.position_rmse_m, trial.scores.position_bound_m
        if error is None or bound is None:
            continue
        if MAX_TIMES_BOUND * bound + ROUNDING < error < inf:
            times = f"{error / bound:.1f} times" if bound > 0.0 else "above"
            yield (
                f"{trial.strategy} {short_name(trial.filter)}: its position error, {error:.3g} m, "
                f"is {times} the bound, {bound:.3g} m; what serves each estimator is in "
                "docs/choose_estimator.md"
            )


def prepare_slam(
    door: Door, layer: Layer, strategies: Sequence[Strategy], filters: Sequence[str]
) -> Conduct:
    """Read a recorded log and resolve its settings; return a function that solves the log.

    The door gets notes of the reader, and warnings. Its flags override `layer`; ranges outside its
    `beamwidth` [deg] about the heading are hidden.
    """
    place, robot = folder_named(door.asked["log"], "log"), door.asked["robot"]
    given = door.flags | door.short()
    check_open(door.flags)
    layer = laid(layer, given)
    check_own(layer)
    bag, width = resolve(layer).bag, door.given("beamwidth")
    if width.value is not None and not 0 < number(width) <= 360:
        expected = "above 0 and up to 360 [deg]"
        raise InputError(f"{width.where}: found {width.value:g}, expected {expected}")
    of_bags, reader = [it for key, it in given.items() if key[0] == "bag"], reader_of(place)
    if of_bags and reader.recognises(place) and not reader.configured:
        raise InputError(f"{of_bags[0].where}: means nothing to {reader.title}; leave it out")
    recorded, truth = load(place, robot, bag=bag)
    config, overruled = with_log(layer, recorded, place)
    config = of_estimators(config, filters)
    for own, names in each_its_own(config, filters):
        check_memory(names, len(labels_of(recorded)), own, passive=True)
    for note in recorded.notes:
        door.note(f"pipistrelle: {place}: {note}")
    door.warn(*overruled, *log_warnings(recorded, truth, place))
    rows = columns_of(recorded.scans)
    aimed, ranged = ~np.isnan([rows["bearing"], rows["range"]])
    if "fastslam" in filters and (ranged & ~aimed).any() and {*strategies} != {"passive"}:
        fix = f"take {door.option('filters', 'ekf,iekf,smoother')}"
        raise refusal(place, "ranges without bearings", "none with FastSLAM, which omits them", fix)
    if not aimed.any() and not {"ekf", "iekf"}.isdisjoint(filters):
        fix = f"{door.option('filters', 'smoother')} is more accurate than EKFs"
        door.warn(f"{place}: no row has a bearing; with ranges only, {fix}")
    beam = None if width.value is None else radians(width.value)

    def conduct(*, progress: Progress | None = None, watch: Watch | None = None) -> Mission:
        asked = (strategies, filters, beam, config)
        mission = replay(recorded, truth, *asked, progress=progress, watch=watch)
        notes = partial(fit_warnings, recorded, mission.trials, place, config)
        return replace(mission, source=log_entry(place, robot, beam), notes=notes)

    return conduct


def failures(mission: Mission) -> list[str]:
    """Return a message for each estimate that failed or has a path that is not finite."""
    return [
        f"{trial.strategy} {trial.filter} failed: {trial.error or 'its path is not finite'}"
        for trial in mission.trials
        if not is_placed(trial)
    ]


def strategy_names(mission: Mission) -> dict[str, str]:
    """Return headings for strategies: "all rows" if a log is solved only by fused sensing."""
    alone = mission.log is not None and {trial.strategy for trial in mission.trials} == {"fused"}
    return {"fused": "all rows"} if alone else {}


def drawn(mission: Mission) -> "Figure":
    """Draw the figure of a mission: maps and errors of all estimates."""
    from pipistrelle.figures.mission import draw_mission

    return draw_mission(
        mission.trials,
        truth=mission.drive.truth,
        callers=mission.callers,
        beamwidth=mission.beamwidth,
        names=strategy_names(mission),
    )


def filmed(mission: Mission, watch: "MissionRecorder", path: Path) -> None:
    """Write a film of a mission's recorded snapshots as a .gif or .mp4 file."""
    from pipistrelle.figures.film import animate_mission

    animate_mission(
        watch.snapshots,
        path,
        truth=mission.drive.truth,
        callers=mission.callers,
        beamwidth=mission.beamwidth,
    )


def caller_names(mission: Mission) -> tuple[str, ...]:
    """Return the names of a mission's callers, without the vehicle."""
    callers = mission.callers if mission.log is None else mission.log.callers
    return tuple(caller.name for caller in callers)


def keep(
    mission: Mission,
    own: OwnFiles,
    command: str,
    *,
    film: Callable[[Path], None] = lambda _: None,
    save_bag: bool = False,
) -> None:
    """Write the results of a mission into its folder, in place of earlier results.

    `command` is recorded for the reader; `film` may write into the folder that it is given.
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
        film(room)
        if save_bag:
            from pipistrelle.experiments.results.ros import BAG, messages_of, write_bag

            write_bag(room / BAG, [*messages_of(mission.trials)])

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


class Recordings:
    """Writer of a simulated mission's log, world and sound into folders.

    The folders are claimed, and the size of the sound is checked, before the mission begins.
    """

    def __init__(self, config: Config, world: World | None, door: Door) -> None:
        self._config, self._world = config, world
        seen: dict[Path, str] = {}
        for name in ("output", "save_log", "save_world", "save_sound"):
            folder, option = door.folder(name), door.option(name)
            if folder and (other := seen.setdefault(without_links(folder), option)) != option:
                raise InputError(f"{option}: {folder} is that of {other}; name another")

        self._log = door.claimed("save_log", LOG)
        self._drawn = door.claimed("save_world", WORLD)
        self.sound: SoundRecorder | None = None
        frames, own = door.given("frames"), door.claimed("save_sound", SOUND)
        if own is None:
            if frames.value is not None:
                sound = door.option("save_sound")
                why = f"found {frames.value}, which is of {sound}"
                raise InputError(f"{frames.where}: {why}; add it")
            return
        count = config.scenario.steps // config.scenario.steps_per_frame
        chosen = frames_named(frames, count)
        bits = int(door.asked["sound_bits"])
        self.sound = SoundRecorder(own=own, config=config, frames=chosen, bits=bits)
        self.sound.check_room()
        door.note(
            f"{own.folder}: {len(chosen)} frames of {self.sound.channels} channels, "
            f"{self.sound.size / 1e9:.3g} GB"
        )

    def conduct(self, mission_of: Conduct, **watched: Any) -> Mission:
        """Run a mission and write its sound frame by frame."""
        if (sound := self.sound) is None:
            return mission_of(**watched)
        sound.begin(checked_scenario(self._config, world=self._world or ALL_DRAWN))
        mission = mission_of(keep=sound.keep, **watched)
        return replace(mission, notes=lambda: (*mission.notes(), *sound.notes()))

    def write(self, mission: Mission) -> None:
        """Write the log, the world and the sound of a finished mission into their folders."""
        if self._drawn is not None:
            assert mission.scenario is not None
            self._drawn.replace(world_files(mission.scenario, self._config))
        if self._log is not None:
            self._log.replace(files_of_log(mission))
        if self.sound is not None:
            assert mission.scenario is not None
            log = log_files(_log(mission, mission.trials[-1], ()))
            about = tomllib.loads(log["log.toml"])
            kept = {name: about[name] for name in about if name not in ("format", "callers")}
            files: dict[str, Any] = truth_files(mission.drive.truth)
            files |= {"odometry.csv": log["odometry.csv"]}
            files |= self.sound.files(mission.scenario, kept)
            files["recording.toml"] = files.pop("recording.toml")  # written last
            self.sound.own.replace(files)

    def close(self) -> None:
        """Delete the sound file if the recording was not completed."""
        if self.sound is not None:
            self.sound.discard()


def files_of_log(mission: Mission) -> dict[str, str]:
    """Return the files of a log made from a simulated mission, with the truth.

    They are the fused ones, if that strategy was sensed. If the settings of the filters differ, a
    filter with known labels, excess paths and standard deviations per row is preferred, since
    `slam` can discard each of these; the first name decides among equals.
    """

    def rank(trial: TrialResult) -> tuple[bool, bool, bool, str]:
        own = own_config(mission.config, trial.filter)
        unlabelled = own.association.method != KNOWN
        constant = own.filter.noise == "constant"
        return unlabelled, not own.listening.excess_paths, constant, trial.filter

    strategies = [trial.strategy for trial in mission.trials]
    chosen = "fused" if "fused" in strategies else strategies[-1]
    trial = min((t for t in mission.trials if t.strategy == chosen), key=rank)
    return truth_files(mission.drive.truth) | log_files(_log(mission, trial, trial.heard))


def _log(mission: Mission, trial: TrialResult, scans: Sequence[Scan]) -> Log:
    """Convert a simulated mission to a recorded log, with the settings of a trial's filter."""
    config = own_config(mission.config, trial.filter)
    drive, _ = split_at(mission.drive, [scan.time for scan in scans])
    timing = config.listening.excess_paths
    if config.filter.noise == "constant":  # log.toml has the standard deviations
        scans = list(map(unstated, scans))
    world = mission.scenario
    assert world is not None
    labelled = zip(world.callers[1:], caller_labels(world)[1:].tolist(), strict=True)
    callers = tuple(
        LogCaller(name=caller.name, landmark=label, moves=moves(caller))
        for caller, label in labelled
    )
    x, y, heading = drive.start.mean.tolist()
    return Log(
        name=f"run-{config.seed}",
        time=drive.time,
        controls=drive.controls,
        dt=np.diff(drive.time),
        scans=tuple(scans),
        motion=drive.motion.model,
        wheelbase=drive.motion.wheelbase,
        control_std=drive.motion.control_std,
        initial_pose=(x, y, heading),
        initial_pose_std=config.filter.initial_pose_std,
        range_std=config.filter.range_std,
        bearing_std=config.filter.bearing_std,
        excess_path_std=config.filter.excess_path_std if timing else None,
        callers=callers if timing else (),
        range_bounds=config.rays.range_bounds,
        gate=None if config.filter.gate == "auto" else config.filter.gate,
        ignored_rows={},
    )
