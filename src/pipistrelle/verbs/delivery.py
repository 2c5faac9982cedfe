"""Doing a mission on the command line: its folder, figure, film and table."""

import contextlib
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipistrelle.detection.logs.bag import need_rosbags
from pipistrelle.experiments.results import writing as folder
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.files import OwnFiles, spelt
from pipistrelle.scripting.log_settings import distance_driven
from pipistrelle.scripting.missions import Conduct, failures, filmed, keep, strategy_names
from pipistrelle.verbs.console import announced, closing_table, progress
from pipistrelle.verbs.options import OutputOptions
from pipistrelle.verbs.streams import put, say, warn

if TYPE_CHECKING:
    from pipistrelle.figures.recorder import MissionRecorder


@contextmanager
def result_folder(options: OutputOptions, name: str) -> Iterator[OwnFiles]:
    """Lend the folder for results (`folder.result_folder`); refuse what cannot be made for it."""
    if options.animate:
        from pipistrelle.figures.film import film_writer

        film_writer(Path(f"mission.{options.animate}"))
    if options.save_bag:
        need_rosbags("--save-bag")
    with folder.result_folder(options.output, name, overwrite=options.overwrite) as own:
        yield own


def recorder(options: OutputOptions) -> "MissionRecorder | None":
    """Return a recorder of the filters, if a film is wanted."""
    if options.animate is None:
        return None
    from pipistrelle.figures.recorder import MissionRecorder

    return MissionRecorder()


def get_ready(options: OutputOptions) -> None:
    """Keep memory that is freed, and have kernels announced that must be compiled."""
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.kernel_clock import announce

    keep_freed_memory()
    announce(None if options.quiet else say)


def conduct(
    mission_of: Conduct,
    options: OutputOptions,
    name: str,
    save: Callable[[Mission], None] = lambda _: None,
    compiling: AbstractContextManager[None] | None = None,
) -> int:
    """Do a mission, watched as the options say, and deliver it; return the exit status.

    `save` writes what else was asked for, after the results; `compiling` lasts for the mission.
    """
    with result_folder(options, name) as own:
        get_ready(options)
        watch = recorder(options)
        with compiling or contextlib.nullcontext(), progress(options.quiet) as show:
            mission = mission_of(progress=show, watch=watch)
        return deliver(own, mission, options, watch, save)


def deliver(
    own: OwnFiles,
    mission: Mission,
    options: OutputOptions,
    watch: "MissionRecorder | None" = None,
    save: Callable[[Mission], None] = lambda _: None,
) -> int:
    """Write results, pictures and bag in place of earlier ones; print the table, the folder last.

    `save` writes more, and the warnings come after it, so neither can lose the results.

    Returns the exit status: 1 if an estimate is not finite or a filter failed, else 0.
    """

    def more(room: Path) -> None:
        if watch is not None and watch.snapshots:
            path = room / f"mission.{options.animate}"
            message = f"Drawing {path.name} ..."
            with contextlib.nullcontext() if options.quiet else announced(message):
                filmed(mission, watch, path)
        if options.save_bag:
            from pipistrelle.experiments.results.ros import BAG, told_of, write_bag

            write_bag(room / BAG, [*told_of(mission.trials)])

    keep(mission, own, command_line(), more)
    save(mission)
    warn(*mission.notes())
    if not options.quiet:
        landmarks, log = mission.drive.truth.landmarks, mission.log
        there = None if landmarks is None else len(landmarks[0])
        driven = None if log is None else distance_driven(log)
        put(closing_table(mission.trials, there, driven, strategy_names(mission)))
    failed = failures(mission)
    warn(*failed)
    put(own.folder)
    return 1 if failed else 0


def command_line() -> str:
    """Return the command line as text in one line, with bytes that are no text escaped."""
    return spelt(shlex.join(["pipistrelle", *sys.argv[1:]]))
