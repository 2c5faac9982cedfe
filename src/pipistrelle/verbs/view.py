"""`pipistrelle view`, `look` and `array`: a page of a mission, pictures of logs and arrays."""

import math
import os
from contextlib import suppress
from inspect import Parameter as Argument
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

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
from pipistrelle.scripting import hearing
from pipistrelle.settings import resolve
from pipistrelle.verbs.console import output_to, text_table
from pipistrelle.verbs.missions import SLAM_OPTIONS
from pipistrelle.verbs.options import NamedSettings, door_of, layers, setting_flags, switch, verb_of
from pipistrelle.verbs.streams import put, say, warn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipistrelle.arrays.beamforming import Pattern
    from pipistrelle.arrays.layout import Scattered
    from pipistrelle.figures.player import Playback

PAGE = "view.html"
"""Name of the page in a result folder."""
PICTURES = (".png", ".svg", ".pdf")
Picture = Annotated[Path | None, output_to("PICTURE", "A .png, .svg or .pdf file.")]
"""The option for a picture, and the endings of its name."""


def _own_code(kind: str, *names: str) -> Parameter:
    """Return the option of `view` that allows code of the user to run again."""
    words = f"Run this code, an {kind} of your own that the mission was conducted with. Code that "
    words += "a folder names runs only if you name it here."
    return Parameter(name=names, metavar="MODULE:CLASS", help=words)


def view(
    folder: Annotated[Path, Parameter(help="The result folder of a run or slam.")],
    /,
    *,
    output: Annotated[Path | None, output_to("FILE.html", "The page.", f"FOLDER/{PAGE}")] = None,
    log: Annotated[
        Path | None, Parameter(metavar="DIR", help="The solved log, if it was moved.")
    ] = None,
    estimator: Annotated[tuple[str, ...], _own_code("estimator", "--filter", "--estimator")] = (),
    association: Annotated[str | None, _own_code("association", "--association.method")] = None,
    overwrite: Annotated[bool, Parameter(help="Replace an existing FILE.")] = False,
    quiet: Annotated[bool, Parameter(help="Print only the path of the page.")] = False,
) -> None:
    """Write an HTML page that plays a mission, which is run again from its result folder."""
    from pipistrelle.experiments.results.reading import read_summary

    read_summary(folder)
    target = folder / PAGE if output is None else output
    check_place(target, folder, overwrite, ".html")
    from pipistrelle.figures.player import page
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
    from pipistrelle.figures.player import playback
    from pipistrelle.figures.recorder import MissionRecorder
    from pipistrelle.jit import announce
    from pipistrelle.verbs.console import progress

    keep_freed_memory()
    announce(None if quiet else say)
    watch = MissionRecorder(rest=3)  # frames per map of a smoother, which takes an optimisation
    with progress(quiet) as show:
        mission = rerun(folder, log=log, trusted=trusted, progress=show, watch=watch)
    if mission.difference:
        warn(f"{mission.difference}; what is shown is found now")
    return playback(mission, watch.snapshots)


def check_place(path: Path, folder: Path | None, overwrite: bool, *endings: str) -> None:
    """Raise if a file cannot be written at a path, before its content is computed."""
    fix = f"name another with -o FILE{endings[0]}"
    if path.suffix.lower() not in endings:
        expected = f"a name that ends in {' or '.join(endings)}"
        raise InputError(f"-o: found {path}, expected {expected}")
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


def _write_picture(path: Path, figure: "Figure", overwrite: bool) -> None:
    """Write a figure as a file of the kind that its name ends in, and print its path."""
    from pipistrelle.figures.style import picture_bytes

    write_file(path, None, picture_bytes(figure, path.suffix.lower()), overwrite)
    put(path)


def _look(asked: dict[str, Any]) -> None:
    """Print the content of a log or recording for `pipistrelle look`, and draw it if asked."""
    output, overwrite = asked["output"], asked["overwrite"]
    if output is not None:
        check_place(output, None, overwrite, *PICTURES)
    found = hearing.look_by(door_of(asked))
    put("\n".join(found.lines))
    warn(*found.odd)
    if output is not None:
        _write_picture(output, found.figure(), overwrite)


look = verb_of(
    hearing.look,
    _look,
    settings=setting_flags(lambda key: key[0] == "bag" or hearing.is_heard(key)),
    options={name: SLAM_OPTIONS[name] for name in ("robot", "truth")},
    extra=[
        Argument("output", Argument.KEYWORD_ONLY, default=None, annotation=Picture),
        switch("overwrite", "Replace an existing PICTURE."),
    ],
)


def array(
    file: Annotated[str, Parameter(help="The array: a file as of receiver.array, or square.")],
    /,
    *,
    frequency: Annotated[
        float | None,
        Parameter(metavar="HZ", help="Frequency [Hz]. [default: that of the vehicle's call]"),
    ] = None,
    named: NamedSettings = None,
    output: Picture = None,
    overwrite: Annotated[bool, Parameter(help="Replace an existing PICTURE.")] = False,
    quiet: Annotated[bool, Parameter(help="Print only the path of the picture.")] = False,
) -> None:
    """Draw a microphone array; print its aperture, beam widths and ambiguous bearings."""
    if output is not None:
        check_place(output, None, overwrite, *PICTURES)
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
                this, that = (math.degrees(math.remainder(at, math.tau)) for at in pattern.worst)
                put(
                    f"{pattern.alike:.0%} of the bearings are ambiguous, as {this:.0f}° and "
                    f"{that:.0f}°: to {f'face {name}' if name else 'these microphones'} they sound "
                    "nearly or quite the same; the deviations of rows say so."
                )
    if output is not None:
        from pipistrelle.figures.sound import draw_array

        name = file if square else Path(file).name
        asked = {"name": name, "frequency": frequency, "speed_of_sound": c}
        _write_picture(output, draw_array(microphones, layout, patterns, **asked), overwrite)


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
