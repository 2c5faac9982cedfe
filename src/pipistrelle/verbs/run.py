"""`pipistrelle run`: one random world, by sound, to a map."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from pipistrelle.config import InputError
from pipistrelle.experiments.named_settings import own_config
from pipistrelle.files import LOG, SOUND, WORLD, Kind, OwnFiles, claim, without_links
from pipistrelle.scripting.arguments import named_strategies
from pipistrelle.verbs.options import (
    Chosen,
    ChosenFilter,
    MissionOptions,
    OutputOptions,
    filters,
    mission_config,
)

if TYPE_CHECKING:
    from pipistrelle.config import Config
    from pipistrelle.detection.logs.recording import Log, LogCaller
    from pipistrelle.detection.scans import Scan
    from pipistrelle.experiments.hearing.sound_recorder import SoundRecorder
    from pipistrelle.experiments.results.scores import TrialResult
    from pipistrelle.experiments.runs.heard_world import Mission


def run(
    *,
    strategy: Annotated[Chosen, Parameter(help="What the vehicle listens to.")] = "all",
    estimator: Annotated[
        ChosenFilter | None,
        Parameter(
            name="--filter",
            help="What draws the map; several, parted by commas, side by side. "
            "[default: that of the settings, of best the smoother]",
        ),
    ] = None,
    mission: Annotated[MissionOptions | None, Parameter(name="*")] = None,
    output: Annotated[OutputOptions | None, Parameter(name="*")] = None,
    save_log: Annotated[
        Path | None,
        Parameter(
            metavar="DIR",
            help="Write what was heard (of all strategies: fused) as a log for `pipistrelle slam`. "
            "[default: no]",
        ),
    ] = None,
    save_world: Annotated[
        Path | None,
        Parameter(
            metavar="DIR",
            help="Write the world that was drawn as one for --world. [default: no]",
        ),
    ] = None,
    save_sound: Annotated[
        Path | None,
        Parameter(
            metavar="DIR",
            help="Write what the microphones heard, as a recording for `pipistrelle hear`. "
            "[default: no]",
        ),
    ] = None,
    frames: Annotated[
        str | None,
        Parameter(
            metavar="A:B",
            help="Of the sound, only the frames from number A, counted from 0, to before B. "
            "[default: all]",
        ),
    ] = None,
    sound_bits: Annotated[
        Literal["32", "16"],
        Parameter(help="Samples of the sound: floats of 32 bits, or whole numbers of 16."),
    ] = "32",
) -> int:
    """Drive through one random world and map it, the three strategies side by side."""
    mission, output = mission or MissionOptions(), output or OutputOptions()
    config, own_world, usual = mission_config(mission)
    ways = filters(estimator or usual, mission.particles)
    folders = {"save_log": save_log, "save_world": save_world, "save_sound": save_sound}
    _check_apart(output=output.output, **folders)
    log = _claimed("--save-log", save_log, LOG, output.overwrite)
    world = _claimed("--save-world", save_world, WORLD, output.overwrite)
    sound = _sound_recorder(config, save_sound, frames, int(sound_bits), output)
    from pipistrelle.experiments.hearing.world_folder import world_files
    from pipistrelle.experiments.runs.compiling import in_two_processes
    from pipistrelle.scripting.missions import simulated
    from pipistrelle.verbs import delivery
    from pipistrelle.verbs.streams import say

    def save(mission: "Mission") -> None:
        if world is not None:
            assert mission.scenario is not None
            world.replace(world_files(mission.scenario, config))
        if log is not None:
            log.replace(_log_files(mission, _logged(mission)))
        if sound is not None:
            sound.own.replace(_sound_files(mission, sound))

    asked = config, named_strategies(strategy), ways, own_world
    compiling = in_two_processes(None if output.quiet else say, config, ways)
    if sound is None:
        return delivery.conduct(partial(simulated, *asked), output, "run", save, compiling)
    try:
        return delivery.conduct(
            lambda **watched: _recorded(simulated, asked, sound, watched),
            output,
            "run",
            save,
            compiling,
        )
    finally:
        sound.discard()


def _claimed(flag: str, folder: Path | None, kind: Kind, overwrite: bool) -> OwnFiles | None:
    """Claim the folder that a flag names beside that of the results."""
    if folder is None:
        return None
    return claim(folder, kind, overwrite=overwrite, flags=(f"{flag} DIR", "--overwrite"))


def _check_apart(**folders: Path | None) -> None:
    """Refuse flags that name the same folder."""
    seen: dict[Path, str] = {}
    for name, folder in folders.items():
        flag = f"--{name.replace('_', '-')}"
        if folder is None:
            continue
        if (other := seen.setdefault(without_links(folder), flag)) != flag:
            raise InputError(f"{flag}: {folder} is that of {other}; name another")


def _sound_recorder(
    config: "Config", folder: Path | None, frames: str | None, bits: int, output: OutputOptions
) -> "SoundRecorder | None":
    """Claim the folder of a recording, and say how large it will be."""
    if folder is None:
        if frames is not None:
            raise InputError(f"--frames: found {frames}, which is of --save-sound; add it")
        return None
    from pipistrelle.experiments.hearing.sound_recorder import SoundRecorder
    from pipistrelle.scripting.arguments import frames_named
    from pipistrelle.verbs.streams import say

    count = config.scenario.steps // config.scenario.steps_per_frame
    chosen = frames_named(frames, count, "--frames")
    own = _claimed("--save-sound", folder, SOUND, output.overwrite)
    assert own is not None
    recorder = SoundRecorder(own=own, config=config, frames=chosen, bits=bits)
    recorder.check_room()
    if not output.quiet:
        say(
            f"{folder}: {len(chosen)} frames of {recorder.channels} channels, "
            f"{recorder.size / 1e9:.3g} GB"
        )
    return recorder


def _recorded(
    simulated: Any, asked: tuple[Any, ...], sound: "SoundRecorder", watched: dict[str, Any]
) -> "Mission":
    """Do a mission whose sound is written down."""
    from dataclasses import replace

    from pipistrelle.experiments.hearing.scenario import ALL_DRAWN
    from pipistrelle.experiments.runs.validate import checked_scenario

    config, _, _, own_world = asked
    sound.begin(checked_scenario(config, world=own_world or ALL_DRAWN))
    mission = simulated(*asked, keep=sound.keep, **watched)
    return replace(mission, notes=lambda: (*mission.notes(), *sound.notes()))


def _sound_files(mission: "Mission", sound: "SoundRecorder") -> dict[str, Any]:
    """Return the files of a recording: the sound, what it is, odometry and truth."""
    import tomllib

    from pipistrelle.detection.logs.folder import log_files
    from pipistrelle.experiments.runs.truth_files import truth_files

    log = log_files(_log(mission, mission.trials[-1], ()))
    about = tomllib.loads(log["log.toml"])
    kept = {name: value for name, value in about.items() if name not in ("format", "callers")}
    assert mission.scenario is not None
    files = sound.files(mission.scenario, kept)
    last = {"recording.toml": files.pop("recording.toml")}
    return truth_files(mission.drive.truth) | {"odometry.csv": log["odometry.csv"]} | files | last


def _logged(mission: "Mission") -> "TrialResult":
    """Return the trial whose measurements are logged, whatever the order of the filters.

    It is fused, if that was sensed, and of filters whose settings differ one that takes known
    labels, excess paths and the standard deviations of each row, as far as any does: a log without
    these can be had of it, by settings of `slam`. Among equals the first name counts.
    """
    from pipistrelle.estimation.association import KNOWN

    def rank(trial: "TrialResult") -> tuple[bool, bool, bool, str]:
        own = own_config(mission.config, trial.filter)
        bare = own.association.method != KNOWN
        return bare, not own.listening.timing, own.filter.noise == "constant", trial.filter

    strategies = [trial.strategy for trial in mission.trials]
    chosen = "fused" if "fused" in strategies else strategies[-1]
    return min((t for t in mission.trials if t.strategy == chosen), key=rank)


def _log_files(mission: "Mission", trial: "TrialResult") -> dict[str, str]:
    """Return the measurements of a trial as a log, and the truth beside it."""
    from pipistrelle.detection.logs.folder import log_files
    from pipistrelle.experiments.runs.truth_files import truth_files

    log = _log(mission, trial, trial.heard)
    return truth_files(mission.drive.truth) | log_files(log)


def _log(mission: "Mission", trial: "TrialResult", scans: "Sequence[Scan]") -> "Log":
    """Return a mission as its recorder would have seen it, by the settings of a trial's filter."""
    import numpy as np

    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.detection.noise import unstated
    from pipistrelle.experiments.drives import split_at

    config = own_config(mission.config, trial.filter)
    drive, _ = split_at(mission.drive, [scan.time for scan in scans])
    timing = config.listening.timing
    if config.filter.noise == "constant":  # log.toml says it
        scans = list(map(unstated, scans))
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
        callers=_log_callers(mission) if timing else (),
        range_bounds=config.rays.range_bounds,
        gate=None if config.filter.gate == "auto" else config.filter.gate,
        ignored_rows={},
    )


def _log_callers(mission: "Mission") -> "tuple[LogCaller, ...]":
    """Return the callers besides the vehicle, as a log lists them."""
    from pipistrelle.acoustics.paths import moves
    from pipistrelle.detection.logs.recording import LogCaller
    from pipistrelle.experiments.hearing.scenario import caller_labels

    world = mission.scenario
    assert world is not None
    labelled = zip(world.callers[1:], caller_labels(world)[1:].tolist(), strict=True)
    return tuple(
        LogCaller(name=caller.name, landmark=label, moves=moves(caller))
        for caller, label in labelled
    )
