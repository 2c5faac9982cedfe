"""`pipistrelle view` and `array`: a mission as a page, a microphone array as a picture."""

import io
import math
import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipistrelle.config import SQUARE, InputError
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.files import (
    RESULTS,
    OwnFiles,
    make_folder,
    partial_of,
    remove_empty,
    without_links,
    write_whole,
)
from pipistrelle.refusals import shown
from pipistrelle.settings import resolve
from pipistrelle.verbs.console import text_table
from pipistrelle.verbs.options import NamedSettings, layers
from pipistrelle.verbs.streams import put, say, warn

if TYPE_CHECKING:
    from pipistrelle.arrays.beamforming import Pattern
    from pipistrelle.arrays.layout import Scattered
    from pipistrelle.figures.player.playback import Playback

PAGE = "view.html"
"""Name of the page in a result folder."""


def view(
    folder: Annotated[Path, Parameter(help="The result folder of a run or slam.")],
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"), metavar="FILE.html", help=f"The page. [default: FOLDER/{PAGE}]"
        ),
    ] = None,
    log: Annotated[
        Path | None, Parameter(metavar="DIR", help="The solved log, if it was moved.")
    ] = None,
    estimator: Annotated[
        tuple[str, ...],
        Parameter(
            name=("--filter", "--estimator"),
            metavar="MODULE:CLASS",
            help="Run this code, an estimator of your own that the mission was conducted with. "
            "Code that a folder names runs only if you name it here.",
        ),
    ] = (),
    association: Annotated[
        str | None,
        Parameter(
            name="--association.method",
            metavar="MODULE:CLASS",
            help="Run this code, an association of your own that the mission was conducted with.",
        ),
    ] = None,
    overwrite: Annotated[bool, Parameter(help="Replace an existing FILE.")] = False,
    quiet: Annotated[bool, Parameter(help="Print only the path of the page.")] = False,
) -> None:
    """Write an HTML page that plays a mission, which is run again from its result folder."""
    from pipistrelle.experiments.results.reading import read_summary

    read_summary(folder)
    target = folder / PAGE if output is None else output
    check_place(target, folder, ".html", overwrite)
    from pipistrelle.figures.player.playback import page
    from pipistrelle.scripting.arguments import named_filters

    trusted = (*(named_filters(estimator, "--filter") if estimator else ()), association or "")
    played = _play_again(folder, log, trusted, quiet)
    write_file(target, folder, page(played).encode(), overwrite)
    put(target)


def _play_again(
    folder: Path, log: Path | None, trusted: tuple[str, ...], quiet: bool
) -> "Playback":
    """Run a mission again from its result folder; return its frames for the page."""
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.experiments.runs.replay import rerun
    from pipistrelle.figures.player.playback import playback
    from pipistrelle.figures.recorder import MissionRecorder
    from pipistrelle.kernel_clock import announce
    from pipistrelle.verbs.console import progress

    keep_freed_memory()
    announce(None if quiet else say)
    watch = MissionRecorder(rest=3)  # frames per map of a smoother, which takes an optimisation
    with progress(quiet) as show:
        mission = rerun(folder, log=log, trusted=trusted, progress=show, watch=watch)
    if mission.difference:
        warn(f"{mission.difference}; what is shown is found now")
    return playback(mission, watch.snapshots)


def check_place(path: Path, folder: Path | None, ending: str, overwrite: bool) -> None:
    """Raise if a file cannot be written at a path, before its content is computed."""
    fix = f"name another with -o FILE{ending}"
    if path.suffix.lower() != ending:
        raise InputError(f"-o: found {path}, expected a name that ends in {ending}")
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
                partial_of(path).lstat()  # raises for a name that is too long
        finally:
            remove_empty(made)
    except FileExistsError:  # a file in place of the folder
        raise InputError(f"{path}: cannot be written (Not a directory); {fix}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); {fix}") from None


def _is_in(path: Path, folder: Path) -> bool:
    """Return whether a path is directly in a result folder."""
    return without_links(path.parent) == without_links(folder)


def write_file(path: Path, folder: Path | None, data: bytes, overwrite: bool) -> None:
    """Write a file as a whole; in a result folder, add it to the folder's list of files."""
    if folder is not None and _is_in(path, folder):
        OwnFiles(folder, RESULTS).add(path.name, data)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data, replace=overwrite)
    except OSError as error:
        fix = "make room or name another file"
        raise InputError(f"{path}: could not be written ({error.strerror}); {fix}") from error


def array(
    file: Annotated[str, Parameter(help="The array: a file as of receiver.array, or square.")],
    /,
    *,
    frequency: Annotated[
        float | None,
        Parameter(metavar="HZ", help="Frequency [Hz]. [default: that of the vehicle's call]"),
    ] = None,
    named: NamedSettings = None,
    output: Annotated[
        Path | None, Parameter(name=("--output", "-o"), metavar="FILE.png", help="The picture.")
    ] = None,
    overwrite: Annotated[bool, Parameter(help="Replace an existing FILE.png.")] = False,
    quiet: Annotated[bool, Parameter(help="Print only the path of the picture.")] = False,
) -> None:
    """Draw a microphone array; print its aperture, beam widths and ambiguous bearings."""
    if output is not None:
        check_place(output, None, ".png", overwrite)
    from pipistrelle.arrays.beamforming import pattern_of
    from pipistrelle.arrays.layout import read_array, scattered, square_microphones

    settled = resolve(over_named(layers(named, None))[0])
    if frequency is None:
        frequency = settled.emitter.centre
    elif not 1.0 <= frequency <= 1e7:
        raise InputError(f"--frequency: found {shown(frequency)}, expected 1 to 1e+07 [Hz]")
    square = file == SQUARE
    microphones = square_microphones(settled.receiver) if square else read_array(Path(file))
    layout, c = scattered(microphones), settled.medium.sound_speed
    patterns = tuple(
        pattern_of(layout, g, frequency=frequency, speed_of_sound=c)
        for g in range(layout.normal.size)
    )
    if not quiet:
        put(_table(layout, patterns))
        for name, pattern in zip(layout.name, patterns, strict=True):
            if pattern.alike > 0.0:
                this, that = (f"{math.degrees(angle):.0f}°" for angle in pattern.worst)
                put(
                    f"{pattern.alike:.0%} of the bearings are ambiguous, as {this} and {that}: to "
                    f"{f'face {name}' if name else 'these microphones'} they sound nearly or quite "
                    "the same; the deviations of rows say so."
                )
    if output is not None:
        from pipistrelle.figures.sound import draw_array

        name = file if square else Path(file).name
        asked = {"name": name, "frequency": frequency, "speed_of_sound": c}
        picture = io.BytesIO()
        figure = draw_array(microphones, layout, patterns, **asked)
        figure.savefig(picture, format="png", dpi=160, metadata={"Software": None})
        write_file(output, None, picture.getvalue(), overwrite)
        put(output)


def _table(layout: "Scattered", patterns: "tuple[Pattern, ...]") -> str:
    """Format a table with the properties of each group of microphones of an array."""
    hears = [
        "all around" if math.isnan(n) else f"around {round(math.degrees(n))}°"
        for n in layout.normal.tolist()
    ]
    rows = {
        "microphones": [str(p.microphones) for p in patterns],
        "hears": hears,
        "aperture [m]": [f"{p.aperture:.4g}" for p in patterns],
        "next microphone, at most [m]": [f"{p.nearest:.4g}" for p in patterns],
        "waves are plane from [m]": [f"{p.far_field:.3g}" for p in patterns],
        "beam's width [deg]": [_between(*p.width) for p in patterns],
        "highest other lobe [dB]": [f"{p.lobe_db:.1f}" for p in patterns],
        "ambiguous bearings": [f"{p.alike:.0%}" for p in patterns],
        "least deviation at 20 dB [deg]": [_between(*p.std) for p in patterns],
    }
    heads = [["", *(name or "free" for name in layout.name)]]
    return text_table("", heads, [[key, *cells] for key, cells in rows.items()])


def _between(least: float, most: float) -> str:
    """Format two angles [rad] as a range in degrees."""
    low, high = f"{math.degrees(least):.3g}", f"{math.degrees(most):.3g}"
    return low if low == high else f"{low} to {high}"
