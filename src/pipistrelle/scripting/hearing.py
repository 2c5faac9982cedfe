"""`hear`: the echoes of a sound recording, as a log and as a figure."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from os.path import lexists
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.folder import RowsHeard
from pipistrelle.detection.sounds.check import Overview
from pipistrelle.detection.sounds.hearing import Frame, hear_recording, log_callers
from pipistrelle.detection.sounds.sound_file import FILE as ABOUT
from pipistrelle.detection.sounds.sound_file import Description, read_description
from pipistrelle.experiments.runs.truth_files import read_truth
from pipistrelle.files import (
    LOG,
    OwnFiles,
    PiecesFile,
    claim,
    drawn_files,
    make_folder,
    read_text,
    remove_empty,
)
from pipistrelle.refusals import refusal
from pipistrelle.scripting.arguments import (
    Progress,
    folder_named,
    frames_named,
    keyword,
    warn_caller,
)
from pipistrelle.settings import Key, Layer, from_keywords, resolve

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

SECTIONS = ("detection", "matching")
"""Sections of settings that `hear` uses, besides ``assumed.speed_of_sound``."""
TRUTH, MEASURED = ("truth.csv", "landmarks.csv"), "measurements.csv"


def is_heard(key: Key) -> bool:
    """Return whether `hear` uses a setting.

    >>> is_heard(("detection", "false_alarm")), is_heard(("rays", "power"))
    (True, False)
    """
    return key[0] in SECTIONS or key == ("assumed", "speed_of_sound")


def heard_settings(layer: Layer) -> Config:
    """Resolve the settings of `hear`; raise for a setting that it does not use."""
    for key, given in layer.items():
        if not is_heard(key):
            raise InputError(f"{given.where}: means nothing to a sound recording; leave it out")
    return resolve(layer)


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """Result of `hear`: the echoes of a recording, and their figure."""

    overview: Overview
    """Matched-filter output of the first calls, for the figure."""
    log: RowsHeard
    """Number of rows, and the other contents of the log."""
    text: str | None
    """The rows, unless they are kept in a folder."""
    odd: tuple[str, ...] = ()
    """Warnings, a line each."""
    folder: Path | None = None
    """Folder of the log, if it is kept."""

    @property
    def measurements(self) -> "pl.DataFrame":
        """Rows of the log: time, caller, bearing, range, excess path, their stds, level."""
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
    """Detect the echoes in a sound recording, as a log for `slam`, as `pipistrelle hear` does.

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

    Returns
    -------
    Heard

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
    pipistrelle.config.InputError: nowhere: found no such folder, expected a sound recording's;
    check the path
    """
    place = folder_named(recording, "hear")
    config = heard_settings(from_keywords(settings))
    if output is None:
        parts: list[str] = []
        heard = _heard(place, config, frames, keyword, progress, parts.append)
        heard = replace(heard, text="".join(parts))
    else:
        flags = ("output=", "overwrite=True")
        own = claim(folder_named(output, "output"), LOG, overwrite=overwrite, flags=flags)
        heard = heard_into(own, place, config, frames, keyword, progress)
    warn_caller(*(f"{place}: {line}" for line in heard.odd))
    return heard


def heard_into(
    own: OwnFiles,
    folder: Path,
    config: Config,
    frames: str | None,
    option: Callable[[str], str],
    progress: Progress | None,
) -> Heard:
    """Write the echoes of a recording, its figure and its truth into the folder of a log.

    Rows are written one call at a time; `option` formats the name of an option for messages.
    """
    from pipistrelle.figures.style import save_figure

    made = make_folder(own.folder)
    rows = PiecesFile(own.folder / MEASURED)
    try:
        heard = _heard(
            folder, config, frames, option, progress, lambda text: rows.write(text.encode())
        )
        rows.close()
        figure = heard.figure()

        def draw(room: Path) -> None:
            save_figure(figure, room, "hearing")

        picture = {n: data for n, data in drawn_files(draw).items() if n.endswith(".png")}
        truth = {name: read_text(folder / name) for name in TRUTH if lexists(folder / name)}
        own.replace(truth | picture | {MEASURED: rows} | heard.log.files())
    finally:
        rows.discard()
        remove_empty(made)
    return replace(heard, folder=own.folder)


def _heard(
    folder: Path,
    config: Config,
    frames: str | None,
    option: Callable[[str], str],
    progress: Progress | None,
    write: Callable[[str], object],
) -> Heard:
    """Detect the echoes of a recording, and pass the rows of each call to `write` as text."""
    about = described(folder)
    overview = Overview(names=("vehicle", *(one.name for one in about.callers)))
    log = RowsHeard(folder, about.log, log_callers(about))
    read_truth(folder, log.time)  # raises for bad truth, which is copied to the log
    write(",".join(log.columns) + "\n")

    def look(frame: Frame) -> None:
        overview.look(frame)
        write(log.text(frame.scan))

    def chosen(count: int) -> range:
        return frames_named(frames, count, option("frames"))

    odd = hear_recording(folder, about, config, chosen, look, progress)
    log.files()  # raises for a log without rows
    return Heard(overview=overview, log=log, text=None, odd=tuple(odd))


def faults_of(folder: Path, config: Config) -> list[str]:
    """Return the faults of a recording, a line each."""
    from pipistrelle.detection.sounds.check import check_recording

    return check_recording(folder, described(folder), config)


def described(folder: Path) -> Description:
    """Read the description of a recording; raise if it is not a folder of a recording."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise refusal(folder, found, "a sound recording's", "check the path")
    if lexists(folder / "log.toml") and not lexists(folder / ABOUT):
        found, fix = "a log, which was heard already", f"solve it by 'pipistrelle slam {folder}'"
        raise refusal(folder, found, f"a sound recording's {ABOUT}", fix)
    return read_description(folder)
