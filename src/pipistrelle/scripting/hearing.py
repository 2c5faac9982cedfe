"""`hear`: the echoes of a sound recording, as a log and as a figure."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from os.path import lexists
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import wrong_kind
from pipistrelle.files import (
    LOG,
    OwnFiles,
    PiecesFile,
    drawn_files,
    make_folder,
    read_text,
    remove_empty,
)
from pipistrelle.scripting.arguments import Door, Progress, folder_named, frames_named
from pipistrelle.settings import Key, Layer, from_keywords, resolve

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

    from pipistrelle.detection.logs.folder import RowsHeard
    from pipistrelle.detection.sounds.check import Overview
    from pipistrelle.detection.sounds.hearing import Frame
    from pipistrelle.detection.sounds.sound_file import Description

SECTIONS = ("detection", "matching")
"""Sections of settings that `hear` uses, besides ``assumed.speed_of_sound``."""
TRUTH, MEASURED = ("truth.csv", "landmarks.csv"), "measurements.csv"


def is_heard(key: Key) -> bool:
    """Return whether the function `hear` uses a setting."""
    return key[0] in SECTIONS or key == ("assumed", "speed_of_sound")


def heard_settings(layer: Layer) -> Config:
    """Resolve the settings of the function `hear`; raise for a setting that it does not use."""
    for key, given in layer.items():
        if not is_heard(key):
            raise InputError(f"{given.where}: means nothing to a sound recording; leave it out")
    return resolve(layer)


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """Result of `hear`: the echoes detected in a sound recording, and their figure."""

    overview: "Overview"
    """Matched-filter output of the first calls, for the figure."""
    log: "RowsHeard"
    """Number of rows, and the other contents of the log."""
    text: str | None
    """The rows, unless they are kept in a folder."""
    odd: tuple[str, ...] = ()
    """Warnings, a line each."""
    folder: Path | None = None
    """Folder of the log, if it is kept."""

    @property
    def measurements(self) -> "pl.DataFrame":
        """Table of the echoes: time, caller, bearing, range, excess path, deviations, level."""
        from io import StringIO

        import polars as pl

        text = self.text
        if text is None:
            assert self.folder is not None
            text = read_text(self.folder / MEASURED)
        return pl.read_csv(StringIO(text), infer_schema_length=None)

    def figure(self) -> "Figure":
        """Draw the matched-filter output of the first calls, with the detected echoes."""
        from pipistrelle.figures.sound import draw_hearing

        return draw_hearing(self.overview)


def hear(
    recording: Path | str,
    /,
    *,
    frames: str | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Heard:
    """Detect the echoes in a sound recording for `slam`, as `pipistrelle hear` does.

    Parameters
    ----------
    recording : Path
        Folder with sound files, recording.toml, array.csv, odometry.csv, and perhaps calls.csv.
    frames : str, optional
        Calls of the vehicle: A:B is from number A, counted from 0, to before B.
    output : Path, optional
        Folder of the log.
    overwrite : bool
        Replace an earlier log in it.
    progress : callable, optional
        Called with the stage, the number of calls done, and their total.
    **settings
        Of the sections detection and matching, and ``assumed__speed_of_sound``.

    Raises
    ------
    InputError
        For an error in the recording, with its file and key, line or channel; for an unusable
        output or setting.

    Examples
    --------
    >>> import pipistrelle
    >>> pipistrelle.hear("nowhere")
    Traceback (most recent call last):
    pipistrelle.config.InputError: nowhere: found no such folder, expected the folder of a sound
    recording; check the path
    """
    door = Door(
        asked={**locals()},
        beneath={},
        flags=from_keywords(settings),
        command="pipistrelle.hear(...)",
        working=lambda: nullcontext(progress),
    )
    return hear_by(door)


def hear_by(door: Door) -> Heard:
    """Detect the echoes in a recording as `hear` does, with the arguments in `door`."""
    place, config = folder_named(door.asked["recording"], "hear"), heard_settings(door.flags)
    own = door.claimed("output", LOG)
    if own is None:
        parts: list[str] = []
        with door.working() as progress:
            heard = _heard(place, config, door, progress, parts.append)
        heard = replace(heard, text="".join(parts))
    else:
        with door.working() as progress:
            heard = _heard_into(own, place, config, door, progress)
    door.warn(*(f"{place}: {line}" for line in heard.odd))
    return heard


def _heard_into(
    own: OwnFiles, folder: Path, config: Config, door: Door, progress: Progress | None
) -> Heard:
    """Write the echoes of a recording, its figure and its truth into the folder of a log."""
    from pipistrelle.figures.style import save_figure

    made = make_folder(own.folder)
    rows = PiecesFile(own.folder / MEASURED)
    try:
        heard = _heard(folder, config, door, progress, lambda text: rows.write(text.encode()))
        rows.close()
        figure = heard.figure()
        drawn = drawn_files(lambda room: save_figure(figure, room, "hearing"))
        picture = {name: data for name, data in drawn.items() if name.endswith(".png")}
        truth = {name: read_text(folder / name) for name in TRUTH if lexists(folder / name)}
        own.replace(truth | picture | {MEASURED: rows} | heard.log.files())
    finally:
        rows.discard()
        remove_empty(made)
    return replace(heard, folder=own.folder)


def _heard(
    folder: Path,
    config: Config,
    door: Door,
    progress: Progress | None,
    write: Callable[[str], object],
) -> Heard:
    """Detect the echoes of a recording, and pass each call's measurements as text to `write`."""
    from pipistrelle.detection.logs.folder import RowsHeard
    from pipistrelle.detection.sounds.check import Overview
    from pipistrelle.detection.sounds.hearing import hear_recording, log_callers
    from pipistrelle.experiments.runs.truth_files import read_truth

    about = described(folder)
    overview = Overview(names=("vehicle", *(caller.name for caller in about.callers)))
    log = RowsHeard(folder, about.log, log_callers(about))
    read_truth(folder, log.time)  # raises for bad truth, which is copied to the log
    write(",".join(log.columns) + "\n")

    def look(frame: "Frame") -> None:
        overview.look(frame)
        write(log.text(frame.scan))

    def chosen(count: int) -> range:
        return frames_named(door.given("frames"), count)

    odd = hear_recording(folder, about, config, chosen, look, progress)
    log.files()  # raises for a log without rows
    return Heard(overview=overview, log=log, text=None, odd=tuple(odd))


def described(folder: Path) -> "Description":
    """Read the description of a sound recording; raise if the folder holds no recording."""
    from pipistrelle.detection.sounds.sound_file import FILE, read_description

    if not lexists(folder / FILE):
        raise wrong_kind(folder, "the folder of a sound recording", FILE)
    return read_description(folder)
