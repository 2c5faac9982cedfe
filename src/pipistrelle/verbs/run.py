"""`pipistrelle run`: one random world, by sound, to a map."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipistrelle.config import InputError
from pipistrelle.files import LOG, WORLD, OwnFiles
from pipistrelle.scripting.asking import named_strategies
from pipistrelle.verbs.options import (
    Chosen,
    ChosenFilter,
    MissionOptions,
    OutputOptions,
    filters,
    mission_config,
)

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log, LogCaller
    from pipistrelle.detection.scans import Scan
    from pipistrelle.experiments.runs.trial import Mission


def run(
    *,
    strategy: Annotated[Chosen, Parameter(help="What the vehicle listens to.")] = "all",
    estimator: Annotated[
        ChosenFilter, Parameter(name="--filter", help="What draws the map.")
    ] = "ekf",
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
) -> int:
    """Drive through one random world and map it, the three strategies side by side."""
    mission, output = mission or MissionOptions(), output or OutputOptions()
    config, known = mission_config(mission)
    ways = filters(estimator, mission.particles)
    _check_saved(save_log, save_world, output)
    from pipistrelle.experiments.hearing.world_folder import write_world
    from pipistrelle.scripting.missions import simulated
    from pipistrelle.verbs import delivery
    from pipistrelle.verbs.console import progress
    from pipistrelle.verbs.streams import warn

    with delivery.result_folder(output, "run") as folder:
        delivery.get_ready(output)
        watch, chosen = delivery.recorder(output), named_strategies(strategy)
        with progress(output.quiet) as show:
            done, heard = simulated(config, chosen, ways, known, progress=show, watch=watch)
        warn(*done.said)
        if save_world is not None:
            write_world(save_world, heard.scenario, config)
        if save_log is not None:
            scans = {trial.strategy: trial.scans for trial in done.trials}
            _save_log(save_log, heard, scans.get("fused", done.trials[0].scans))
        return delivery.deliver(folder, done, output, watch)


def _check_saved(log: Path | None, world: Path | None, output: OutputOptions) -> None:
    """Refuse to write a log or a world over anything else, or both into one folder."""
    from pipistrelle.detection.logs import folder as log_folder
    from pipistrelle.experiments.hearing import world_folder
    from pipistrelle.experiments.runs import truth_files

    if log is not None:
        _check_vacant("--save-log", log, LOG, (*log_folder.FILES, *truth_files.FILES), output)
    if world is not None:
        _check_vacant("--save-world", world, WORLD, world_folder.FILES, output)
    if log is not None and world is not None and log.resolve() == world.resolve():
        raise InputError(f"--save-world: {world} is that of --save-log; name another")


def _check_vacant(
    flag: str, folder: Path, kind: str, names: Sequence[str], output: OutputOptions
) -> None:
    """Refuse a folder in which anything but what we wrote of a kind would be replaced."""
    if output.output is not None and folder.resolve() == output.output.resolve():
        raise InputError(f"{flag}: {folder} is the result folder; name another")
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not output.overwrite:
        raise InputError(f"{flag}: {folder} is not empty; name a new folder or add --overwrite")
    if not (own := OwnFiles(folder, kind)):
        what = kind.removeprefix("a ")
        raise InputError(
            f"{flag}: {folder} is not empty and holds no {what} of Pipistrelle (its SHA256SUMS "
            "would name it), so nothing in it was overwritten; name a new folder"
        )
    own.check(names)


def _save_log(folder: Path, mission: "Mission", scans: "Sequence[Scan]") -> None:
    """Write what was heard as a log, and the truth beside it."""
    from pipistrelle.detection.logs.folder import write_log
    from pipistrelle.experiments.runs.truth_files import write_truth

    try:
        write_log(folder, _log(mission, scans))
        write_truth(folder, mission.drive.truth)
    except BaseException:  # half a log is none
        with contextlib.suppress(InputError):
            OwnFiles(folder, LOG).clear()
        raise


def _log(mission: "Mission", scans: "Sequence[Scan]") -> "Log":
    """Return a mission as its recorder would have seen it."""
    import numpy as np

    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.detection.noise import unstated

    config, drive = mission.config, mission.drive
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
        detour_std=config.filter.detour_std if timing else None,
        callers=_log_callers(mission) if timing else (),
        range_bounds=config.rays.range_bounds,
        gate=config.filter.gate,
        ignored_rows={},
    )


def _log_callers(mission: "Mission") -> "tuple[LogCaller, ...]":
    """Return whoever else called, as a log names them."""
    from pipistrelle.acoustics.callers import moves
    from pipistrelle.detection.logs.recording import LogCaller
    from pipistrelle.experiments.hearing.scenario import caller_labels

    world = mission.scenario
    labelled = zip(world.callers[1:], caller_labels(world)[1:].tolist(), strict=True)
    return tuple(
        LogCaller(name=caller.name, landmark=label, moves=moves(caller))
        for caller, label in labelled
    )
