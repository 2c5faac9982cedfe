"""What every mission ends in: a folder that is filled, a picture, a table, a place to look."""

import contextlib
import os
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.results.folder import prepare_folder
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.results.writing import write_results
from pipistrelle.verbs.console import announced, closing_table
from pipistrelle.verbs.options import OutputOptions
from pipistrelle.verbs.streams import put, warn

if TYPE_CHECKING:
    from pipistrelle.acoustics.callers import Caller
    from pipistrelle.figures.recorder import MissionRecorder


@contextmanager
def result_folder(options: OutputOptions, name: str) -> Iterator[Path]:
    """Make the result folder at once, and remove it if nothing comes to stand in it.

    Earlier results that may be overwritten stay in it until `deliver`.

    Parameters
    ----------
    options : OutputOptions
    name : str
        What runs.

    Yields
    ------
    Path

    Raises
    ------
    InputError
        Where the folder cannot be had, or the film not be made.
    """
    if options.animate:
        from pipistrelle.figures.film import film_writer

        film_writer(Path(f"mission.{options.animate}"))
    folder = prepare_folder(options.output, name, options.overwrite)
    try:
        yield folder
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()
            latest = folder.parent / "latest"
            if options.output is None and not latest.exists():
                latest.unlink()
        raise


def recorder(options: OutputOptions) -> "MissionRecorder | None":
    """Return what watches the filters, if a film is wanted."""
    if options.animate is None:
        return None
    from pipistrelle.figures.recorder import MissionRecorder

    return MissionRecorder()


def get_ready(options: OutputOptions) -> None:
    """Compile all kernels, or load them, and say so if it takes long; keep memory for them."""
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.experiments.runs.compiling import compile_kernels

    keep_freed_memory()
    with _waiting("Compiling kernels (once) ...", options):
        compile_kernels()


def deliver(
    folder: Path,
    trials: Sequence[TrialResult],
    truth: Truth,
    *,
    config: BaseModel,
    seed: int,
    options: OutputOptions,
    callers: Sequence["Caller"] = (),
    beamwidth: float | None = None,
    ignored_rows: dict[str, int] | None = None,
    beside: Mapping[str, bytes] = MappingProxyType({}),
    log: Mapping[str, object] | None = None,
    watch: "MissionRecorder | None" = None,
) -> int:
    """Write results, figure and film in place of earlier ones, print the table, the folder last.

    Parameters
    ----------
    folder : Path
    trials : sequence of TrialResult, at least one
    truth : Truth
    config : pydantic model
        All settings.
    seed : int
    options : OutputOptions
    callers : sequence of Caller, optional
        Who is heard besides the vehicle.
    beamwidth : [rad], optional
        Of the vehicle's call.
    ignored_rows : dict, optional
        Number of dropped log rows by reason; without it there was no log.
    beside : dict of name to content, optional
        Files that are to stand beside the results.
    log : mapping, optional
        Which log it was (`log_entry`).
    watch : MissionRecorder, optional
        What it saw becomes the film.

    Returns
    -------
    int
        Exit status: 1 if an estimate is not finite or a filter failed, else 0.
    """
    from pipistrelle.figures.mission import draw_mission
    from pipistrelle.figures.style import save_figure

    scene: dict[str, Any] = {"truth": truth, "callers": callers, "beamwidth": beamwidth}
    figure = draw_mission(trials, **scene)

    def draw(room: Path) -> None:
        save_figure(figure, room, "mission")
        if watch is not None and watch.snapshots:
            _film(watch, room / f"mission.{options.animate}", scene, options)

    write_results(
        folder,
        config=config,
        command=_command(),
        seed=seed,
        trials=trials,
        truth=truth,
        ignored_rows=ignored_rows or {},
        beside=beside,
        log=log,
        draw=draw,
    )
    if not options.quiet:
        there = None if truth.landmarks is None else len(truth.landmarks[0])
        put(closing_table(trials, there))
    failed = [t for t in trials if not np.all(np.isfinite(t.track.pose.mean))]
    for trial in failed:
        why = trial.error or "its path is not finite"
        warn(f"{trial.strategy} {trial.filter} failed: {why}")
    put(folder)
    return 1 if failed else 0


def _command() -> str:
    """Return the command line as text, names that are no text by their bytes."""
    words = shlex.join(["pipistrelle", *sys.argv[1:]])
    return os.fsencode(words).decode(errors="backslashreplace")


def _film(
    watch: "MissionRecorder", path: Path, scene: dict[str, Any], options: OutputOptions
) -> None:
    """Draw the film; say so, for it takes longer than the mission."""
    from pipistrelle.figures.animation import animate_mission

    with _waiting(f"Drawing {path.name} ...", options):
        animate_mission(watch.snapshots, path, **scene)


def _waiting(message: str, options: OutputOptions) -> AbstractContextManager[None]:
    """Say what takes long, unless quiet."""
    return contextlib.nullcontext() if options.quiet else announced(message)
