"""Sound recordings for Python: heard into a log, and drawn."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.folder import log_files
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.sounds.description import read_description
from pipistrelle.detection.sounds.hearing import hear_recording
from pipistrelle.detection.sounds.overview import Overview
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.files import read_text
from pipistrelle.own_files import LOG, OwnFiles, claim, drawn_files
from pipistrelle.refusals import refusal
from pipistrelle.scripting.arguments import folder_named, frames_named
from pipistrelle.settings import Key, Layer, from_keywords, resolve

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

SECTIONS = ("detection", "matching")
"""Settings that count where a recording is heard; the speed of sound that is assumed does, too."""
TRUTH = ("truth.csv", "landmarks.csv")


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
    """What `hear` returns: the echoes of a recording, a log of them, and a figure."""

    log: Log
    overview: Overview
    """Of the first calls, for the figure."""
    folder: Path | None = None
    """Where the log is kept, if anywhere."""

    @property
    def measurements(self) -> "pl.DataFrame":
        """The rows of the log: time, caller, bearing, range or excess path, deviations, level."""
        import io

        import polars as pl

        return pl.read_csv(io.StringIO(log_files(self.log)["measurements.csv"]))

    def figure(self) -> "Figure":
        """Draw the matched filter's output over the first calls, and what was taken for echoes."""
        from pipistrelle.figures.hearing import draw_hearing

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
    own = None
    if output is not None:
        flags = ("output=", "overwrite=True")
        own = claim(folder_named(output, "output"), LOG, overwrite=overwrite, flags=flags)
    heard = heard_of(place, config, frames, "frames", progress)
    return heard if own is None else keep(heard, place, own)


def heard_of(
    folder: Path, config: Config, frames: str | None, where: str, progress: Progress | None
) -> Heard:
    """Hear a recording; `where` its frames were given is said in refusals."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise refusal(folder, found, "a sound recording's", "check the path")
    about = read_description(folder)
    overview = Overview(names=("vehicle", *(one.name for one in about.callers)))
    log = hear_recording(
        folder,
        config,
        lambda count: frames_named(frames, count, where),
        overview.look,
        progress,
    )
    return Heard(log=log, overview=overview)


def keep(heard: Heard, folder: Path, own: OwnFiles) -> Heard:
    """Write the log and the figure, with the truth that lies beside the sound."""
    from dataclasses import replace

    from pipistrelle.figures.style import save_figure

    truth = {name: read_text(folder / name) for name in TRUTH if (folder / name).exists()}
    figure = heard.figure()

    def draw(room: Path) -> None:
        save_figure(figure, room, "hearing")

    picture = {name: data for name, data in drawn_files(draw).items() if name.endswith(".png")}
    own.replace(truth | picture | log_files(heard.log))
    return replace(heard, folder=own.folder)
