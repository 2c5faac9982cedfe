"""What every mission ends in: a folder that is filled, a picture, a table, a place to look."""

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipistrelle.experiments.results import folder
from pipistrelle.own_files import OwnFiles
from pipistrelle.scripting.missions import Done, failures, filmed, keep
from pipistrelle.verbs.console import announced, closing_table
from pipistrelle.verbs.options import OutputOptions
from pipistrelle.verbs.streams import put, say, warn

if TYPE_CHECKING:
    from pipistrelle.figures.recorder import MissionRecorder


@contextmanager
def result_folder(options: OutputOptions, name: str) -> Iterator[OwnFiles]:
    """Lend the folder for results (`folder.result_folder`); refuse a film that cannot be made."""
    if options.animate:
        from pipistrelle.figures.film import film_writer

        film_writer(Path(f"mission.{options.animate}"))
    with folder.result_folder(options.output, name, overwrite=options.overwrite) as own:
        yield own


def recorder(options: OutputOptions) -> "MissionRecorder | None":
    """Return what watches the filters, if a film is wanted."""
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


def deliver(
    own: OwnFiles, done: Done, options: OutputOptions, watch: "MissionRecorder | None" = None
) -> int:
    """Write results, figure and film in place of earlier ones, print the table, the folder last.

    Parameters
    ----------
    own : OwnFiles
        The folder.
    done : Done
        Of at least one trial.
    options : OutputOptions
    watch : MissionRecorder, optional
        What it saw becomes the film.

    Returns
    -------
    int
        Exit status: 1 if an estimate is not finite or a filter failed, else 0.
    """

    def film(room: Path) -> None:
        if watch is not None and watch.snapshots:
            path = room / f"mission.{options.animate}"
            message = f"Drawing {path.name} ..."
            with contextlib.nullcontext() if options.quiet else announced(message):
                filmed(done, watch, path)

    keep(done, own, command_line(), film)
    if not options.quiet:
        known = done.truth.landmarks
        put(closing_table(done.trials, None if known is None else len(known[0]), done.driven))
    failed = failures(done)
    warn(*failed)
    put(own.folder)
    return 1 if failed else 0


def command_line() -> str:
    """Return the command line as text, names that are no text by their bytes.

    Returns
    -------
    str
    """
    words = shlex.join(["pipistrelle", *sys.argv[1:]])
    return os.fsencode(words).decode(errors="backslashreplace")
