"""Sound recordings for Python: heard into a log, and drawn."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from os.path import lexists
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.folder import RowsHeard
from pipistrelle.detection.sounds.check import Overview
from pipistrelle.detection.sounds.description import FILE as ABOUT
from pipistrelle.detection.sounds.description import Description, read_description
from pipistrelle.detection.sounds.hearing import Frame, hear_recording, log_callers
from pipistrelle.experiments.hearing.listening import Progress
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
from pipistrelle.scripting.arguments import folder_named, frames_named
from pipistrelle.settings import Key, Layer, from_keywords, resolve

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

SECTIONS = ("detection", "matching")
"""Settings that count where a recording is heard; the speed of sound that is assumed does, too."""
TRUTH, MEASURED = ("truth.csv", "landmarks.csv"), "measurements.csv"


def is_heard(key: Key) -> bool:
    """Tell whether a setting counts where a recording is heard.

    >>> is_heard(("detection", "false_alarm")), is_heard(("rays", "power"))
    (True, False)
    """
    return key[0] in SECTIONS or key == ("assumed", "speed_of_sound")


def heard_settings(layer: Layer) -> Config:
    """Return settings with which a recording is heard; refuse those that mean nothing to it."""
    for key, given in layer.items():
        if not is_heard(key):
            raise InputError(f"{given.where}: means nothing to a sound recording; leave it out")
    return resolve(layer)


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """What `hear` returns: the echoes of a recording, and a figure of them."""

    overview: Overview
    """Of the first calls, for the figure."""
    log: RowsHeard
    """How many rows there are; what else a log of them says."""
    text: str | None
    """The rows, where they are not kept in a folder."""
    odd: tuple[str, ...] = ()
    """Why the echoes may be wrong, a line each."""
    folder: Path | None = None
    """Where the log is kept, if anywhere."""

    @property
    def measurements(self) -> "pl.DataFrame":
        """The rows of the log: time, caller, bearing, range or excess path, deviations, level."""
        from io import StringIO

        import polars as pl

        text = self.text
        if text is None:
            assert self.folder is not None
            text = read_text(self.folder / MEASURED)
        return pl.read_csv(StringIO(text), infer_schema_length=None)

    def figure(self) -> "Figure":
        """Draw the matched filter's output over the first calls, and what was taken for echoes."""
        from pipistrelle.figures.sound import draw_hearing

        return draw_hearing(self.overview)


def hear(
    folder: Path | str,
    /,
    *,
    frames: str | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Heard:
    """Hear a sound recording into a log that `slam` solves, as `pipistrelle hear` does.

    Parameters
    ----------
    folder : Path
        Sound files, ``recording.toml``, ``array.csv`` and ``odometry.csv``, perhaps ``calls.csv``.
    frames : str, optional
        "A:B": the calls from number A, counted from 0, to before B; all by default.
    output : Path, optional
        The log's folder; nothing is written without it.
    overwrite : bool
        Whether an earlier log there may be replaced.
    progress : callable, optional
        Called with what is done, how many calls of it are, and of how many.
    settings
        Of the sections detection and matching, and ``assumed__speed_of_sound``.

    Returns
    -------
    Heard

    Raises
    ------
    InputError
        For what is no recording, with the file and the key, the line or the channel; where the
        output cannot be had; for settings that mean nothing here.

    Examples
    --------
    >>> import pipistrelle
    >>> pipistrelle.hear("nowhere")
    Traceback (most recent call last):
    pipistrelle.config.InputError: nowhere: found no such folder, expected a sound recording's;
    check the path
    """
    place = folder_named(folder, "hear")
    config = heard_settings(from_keywords(settings))
    asked = place, config, frames, "frames", progress
    if output is None:
        parts: list[str] = []
        heard = heard_of(*asked, parts.append, lambda: "".join(parts))
    else:
        flags = ("output=", "overwrite=True")
        own = claim(folder_named(output, "output"), LOG, overwrite=overwrite, flags=flags)
        heard = heard_into(own, *asked)
    for line in heard.odd:
        warnings.warn(f"{place}: {line}", stacklevel=2)
    return heard


def heard_into(
    own: OwnFiles,
    folder: Path,
    config: Config,
    frames: str | None,
    where: str,
    progress: Progress | None,
) -> Heard:
    """Hear a recording into a log's folder, row by row; write the figure, and truth that is there.

    `where` its frames were given is said in refusals.
    """
    from pipistrelle.figures.style import save_figure

    made = make_folder(own.folder)
    rows = PiecesFile(own.folder / MEASURED)
    try:
        heard = heard_of(
            folder, config, frames, where, progress, lambda text: rows.write(text.encode())
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


def heard_of(
    folder: Path,
    config: Config,
    frames: str | None,
    where: str,
    progress: Progress | None,
    write: Callable[[str], None],
    text: Callable[[], str | None] = lambda: None,
) -> Heard:
    """Hear a recording; `write` is given the rows as text, and `text` returns them all."""
    about = described(folder)
    overview = Overview(names=("vehicle", *(one.name for one in about.callers)))
    log = RowsHeard(folder, about.log, log_callers(about))
    read_truth(folder, log.time)  # refuses odd truth, which is kept beside the log
    write(",".join(log.columns) + "\n")

    def look(frame: Frame) -> None:
        overview.look(frame)
        write(log.text(frame.scan))

    odd = hear_recording(
        folder, about, config, lambda count: frames_named(frames, count, where), look, progress
    )
    log.files()  # refuses a log without rows
    return Heard(overview=overview, log=log, text=text(), odd=tuple(odd))


def faults_of(folder: Path, config: Config) -> list[str]:
    """Return what is odd about a recording, a line each."""
    from pipistrelle.detection.sounds.check import check_recording

    return check_recording(folder, described(folder), config)


def described(folder: Path) -> Description:
    """Return what a recording says of itself; refuse what is no folder."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise refusal(folder, found, "a sound recording's", "check the path")
    if lexists(folder / "log.toml") and not lexists(folder / ABOUT):
        found, fix = "a log, which was heard already", f"solve it by 'pipistrelle slam {folder}'"
        raise refusal(folder, found, f"a sound recording's {ABOUT}", fix)
    return read_description(folder)
