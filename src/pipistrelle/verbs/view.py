"""`pipistrelle view`: a mission, frame by frame, on one page."""

import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipistrelle.config import InputError
from pipistrelle.files import (
    RESULTS,
    OwnFiles,
    make_folder,
    partial_of,
    remove_empty,
    without_links,
    write_whole,
)

if TYPE_CHECKING:
    from pipistrelle.figures.player.playback import Playback

PAGE = "view.html"
"""Name of the page in a result folder."""
FRAMES_PER_MAP = 3
"""A smoother is asked for its map once in so many frames, as each time takes the optimum."""


def view(
    folder: Annotated[Path, Parameter(help="The result folder of a run or slam.")],
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="FILE.html",
            help=f"Where the page goes. [default: FOLDER/{PAGE}]",
        ),
    ] = None,
    log: Annotated[
        Path | None,
        Parameter(
            metavar="DIR",
            help="Where the log is that was solved, if it was moved. [default: where it was]",
        ),
    ] = None,
    estimator: Annotated[
        tuple[str, ...],
        Parameter(
            name="--filter",
            metavar="MODULE:CLASS",
            negative=(),
            help="Run this code, an estimator of your own that the mission was done with. Code "
            "that a folder names is not run unless you name it, too. [default: none]",
        ),
    ] = (),
    association: Annotated[
        str | None,
        Parameter(
            name="--association.method",
            metavar="MODULE:CLASS",
            help="Run this code, an association of your own, likewise. [default: none]",
        ),
    ] = None,
    overwrite: Annotated[
        bool, Parameter(negative=(), help="Replace a FILE that is there already.")
    ] = False,
    quiet: Annotated[bool, Parameter(negative=(), help="Print the page's path alone.")] = False,
) -> None:
    """Play a mission in a browser: do it again from its result folder, and keep every frame."""
    from pipistrelle.experiments.results.reading import read_summary

    read_summary(folder)
    target = folder / PAGE if output is None else output
    check_place(target, folder, ".html", "-o", overwrite)
    from pipistrelle.figures.player.playback import page
    from pipistrelle.scripting.arguments import named_filters
    from pipistrelle.verbs.streams import put

    trusted = (*(named_filters(estimator, "--filter") if estimator else ()), association or "")
    played = _play_again(folder, log, trusted, quiet)
    write_file(target, folder, page(played).encode(), overwrite)
    put(target)


def _play_again(
    folder: Path, log: Path | None, trusted: tuple[str, ...], quiet: bool
) -> "Playback":
    """Do the mission again, and lay out what was seen of it."""
    from pipistrelle.experiments.runs.rerun import rerun
    from pipistrelle.figures.player.playback import playback
    from pipistrelle.figures.recorder import MissionRecorder
    from pipistrelle.verbs import delivery
    from pipistrelle.verbs.console import progress
    from pipistrelle.verbs.options import OutputOptions
    from pipistrelle.verbs.streams import warn

    delivery.get_ready(OutputOptions(quiet=quiet))
    watch = MissionRecorder(rest=FRAMES_PER_MAP)
    with progress(quiet) as show:
        mission = rerun(folder, log=log, trusted=trusted, progress=show, watch=watch)
    if mission.difference:
        warn(f"{mission.difference}; what is shown is found now")
    return playback(mission, watch.snapshots)


def check_place(path: Path, folder: Path | None, ending: str, option: str, overwrite: bool) -> None:
    """Refuse a place that a file cannot have, before there is anything to write."""
    fix = f"name another with {option} FILE{ending}"
    if path.suffix.lower() != ending:
        raise InputError(f"{option}: found {path}, expected a name that ends in {ending}")
    if path.is_dir():
        raise InputError(f"{path}: found a folder, expected a file; {fix}")
    if folder is not None and _is_in(path, folder):
        try:
            OwnFiles(folder, RESULTS).refuse(path.name)
        except InputError as refused:
            raise InputError(str(refused).replace("name another folder", fix)) from None
    elif path.name in (other := OwnFiles(path.parent, RESULTS)):
        raise InputError(f"{path}: is of {other.there} of Pipistrelle, which stays whole; {fix}")
    elif os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: is there already; {fix}, or add --overwrite")
    try:
        made = make_folder(path.parent)
        try:
            TemporaryFile(dir=path.parent).close()
            with suppress(FileNotFoundError):
                partial_of(path).lstat()  # an error of a name that is too long
        finally:
            remove_empty(made)
    except FileExistsError:  # what should be the folder
        raise InputError(f"{path}: cannot be written (Not a directory); {fix}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); {fix}") from None


def _is_in(path: Path, folder: Path) -> bool:
    """Tell whether a file's place is the result folder itself."""
    return without_links(path.parent) == without_links(folder)


def write_file(path: Path, folder: Path | None, data: bytes, overwrite: bool) -> None:
    """Write a file that is whole or not there; in the result folder, as one of its own."""
    if folder is not None and _is_in(path, folder):
        OwnFiles(folder, RESULTS).add(path.name, data)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data, replace=overwrite)
    except OSError as error:
        fix = "make room or name another file"
        raise InputError(f"{path}: could not be written ({error.strerror}); {fix}") from error
