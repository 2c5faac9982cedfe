"""`hear` and `look`: echoes of a sound recording, and the content of a log or recording."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from math import log
from os.path import lexists
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import Robot, wrong_kind
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
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.detection.sounds.check import Overview
    from pipistrelle.detection.sounds.hearing import Frame
    from pipistrelle.detection.sounds.sound_file import Description
    from pipistrelle.experiments.drives import Truth
    from pipistrelle.figures.sound import Rows

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
    own, parts = door.claimed("output", LOG), list[str]()
    with door.working() as progress:
        if own is None:
            heard = _heard(place, config, door, progress, parts.append)
            heard = replace(heard, text="".join(parts))
        else:
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
    rows = RowsHeard(folder, about.log, log_callers(about))
    read_truth(folder, rows.time)  # raises for bad truth, which is copied to the log
    write(",".join(rows.columns) + "\n")

    def take(frame: "Frame") -> None:
        overview.look(frame)
        write(rows.text(frame.scan))

    def chosen(count: int) -> range:
        return frames_named(door.given("frames"), count)

    odd = hear_recording(folder, about, config, chosen, take, progress)
    rows.files()  # raises for a log without rows
    return Heard(overview=overview, log=rows, text=None, odd=tuple(odd))


def described(folder: Path) -> "Description":
    """Read the description of a sound recording; raise if the folder holds no recording."""
    from pipistrelle.detection.sounds.sound_file import FILE, read_description

    if not lexists(folder / FILE):
        raise wrong_kind(folder, "the folder of a sound recording", FILE)
    return read_description(folder)


UNITS = {"range": "m", "bearing": "rad", "excess_path": "m", "level_db": "dB"}
"""Units of the measured quantities, by the names of their columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Result of `look`: numbers of a log or a recording, doubts about it, and its figure."""

    lines: tuple[str, ...]
    """What it contains, a line each."""
    odd: tuple[str, ...]
    """Warnings, a line each."""
    figure: "Callable[[], Figure]" = field(repr=False)
    """Draws its content."""


def look(
    path: Path | str, /, *, robot: Robot | None = None, truth: str | None = None, **settings: Any
) -> Look:
    """Describe a log, a ROS bag or a sound recording, as `pipistrelle look` does.

    Parameters
    ----------
    path : Path
        A log folder, a ROS bag, a MRCLAM folder, or the folder of a sound recording.
    robot : int or str, optional
        The robot, by number or name, if there are several.
    truth : str, optional
        Topic of a ROS bag with the true pose of the vehicle; sets bag.truth.
    **settings
        Of the section bag; of a recording, of the sections detection and matching.

    Raises
    ------
    InputError
        For an error in the log or the recording, with its file and its line or key.
    """
    flags = from_keywords(settings, look.__kwdefaults__ or ())
    return look_by(Door(asked={**locals()}, beneath={}, flags=flags, command="pipistrelle.look"))


def look_by(door: Door) -> Look:
    """Describe a log or a recording as `look` does, with the arguments in `door`."""
    from pipistrelle.detection.sounds.sound_file import FILE
    from pipistrelle.experiments.runs.replay import load

    place, given = folder_named(door.asked["path"], "look"), door.flags | door.short()
    if (place / FILE).exists():
        return _recording(place, given)
    if useless := [one.where for key, one in given.items() if key[0] != "bag"]:
        raise InputError(f"{useless[0]}: means nothing to a log before it is solved")
    return _log(place, *load(place, door.asked["robot"], bag=resolve(given).bag))


def _log(place: Path, recorded: "Log", truth: "Truth") -> Look:
    """Describe a recorded log."""
    from pipistrelle.detection.scans import columns_of
    from pipistrelle.experiments.drives import reckoned
    from pipistrelle.experiments.runs.replay import drive_of
    from pipistrelle.figures.sound import draw_log
    from pipistrelle.scripting.log_warnings import early_warnings

    rows, gaps = columns_of(recorded.scans), long_gaps(recorded)
    path = reckoned(drive_of(recorded, truth)).mean
    return Look(
        lines=(*recorded.notes, *_numbers(recorded, truth, rows, gaps)),
        odd=tuple(early_warnings(recorded, truth, place)),
        figure=lambda: draw_log(recorded, truth, path, rows, gaps),
    )


def long_gaps(recorded: "Log") -> Float[np.ndarray, "g 2"]:
    """Return begin and end [s] of each interval without scans that chance hardly explains.

    Of n intervals of random scans, the longest exceeds log(n / p) times their mean with a
    probability of at most p (`log_warnings.CHANCE`).
    """
    from pipistrelle.scripting.log_warnings import CHANCE

    scans = [scan.time for scan in recorded.scans]
    edges = np.unique([recorded.time[0], *scans, recorded.time[-1]])
    length, ends = np.diff(edges), np.column_stack((edges[:-1], edges[1:]))
    return ends[length > length.mean() * log(length.size / CHANCE)]


def _numbers(
    recorded: "Log", truth: "Truth", rows: "Rows", gaps: Float[np.ndarray, "g 2"]
) -> Iterator[str]:
    """Yield a line for each number of a recorded log."""
    from pipistrelle.detection.scans import UNLABELLED
    from pipistrelle.scripting.log_warnings import distance_driven

    time, count, scans = recorded.time, rows["time"].size, len(recorded.scans)
    yield f"time         {time[-1] - time[0]:.6g} s, from {time[0]:.15g} s to {time[-1]:.15g} s"
    steps = f"{len(time) - 1} steps of {np.median(recorded.dt):.3g} s ({recorded.motion})"
    yield f"odometry     {steps}, {distance_driven(recorded):.4g} m"
    yield f"rows         {count} in {scans} scans, {count / max(scans, 1):.3g} in each"
    labels, seen = np.unique(rows["landmark"], return_counts=True)
    known = labels != UNLABELLED
    more = ", for --association.method marginal (bearing and range, or excess paths)"
    more *= int((~known).any())
    yield f"labels       {seen[known].sum()} rows with a label, {seen[~known].sum()} without{more}"
    if known.any():
        spread = np.quantile(seen[known], (0.0, 0.25, 0.5, 0.75, 1.0))
        few, *quarters, most = (f"{number:.0f}" for number in spread)
        each = f"each in {few} to {most} rows (quartiles {', '.join(quarters)})"
        yield f"landmarks    {known.sum()}, {each}"
    if recorded.callers:
        names = ("vehicle", *(caller.name for caller in recorded.callers))
        calls = np.bincount(rows["caller"], minlength=len(names))
        whose = (f"{name} {number}" for name, number in zip(names, calls, strict=True))
        yield f"callers      rows of {', '.join(whose)}"
    for name, unit in UNITS.items():
        title = name.removesuffix("_db").replace("_", " ")
        yield f"{title:<13}{_quantity(recorded, rows, name, unit)}"
    longest = gaps[np.argsort(gaps[:, 0] - gaps[:, 1])[:3]].tolist()
    where = ", ".join(f"{end - begin:.4g} s from {begin:.15g} s" for begin, end in longest)
    yield f"gaps         {f'{len(gaps)} without scans, the longest {where}' if where else 'none'}"
    known_steps = 0 if truth.path is None else np.isfinite(truth.path[:, 0]).sum()
    placed = 0 if truth.landmarks is None else len(truth.landmarks[0])
    true = f"{known_steps} of {time.size} poses, {placed} landmarks"
    yield f"truth        {true if known_steps or placed else 'none'}"


def _quantity(recorded: "Log", rows: "Rows", name: str, unit: str) -> str:
    """Describe a measured quantity: its share of rows, its values and standard deviations."""
    values = rows[name][~np.isnan(rows[name])]
    if not values.size:
        return "none"
    share, low, high = values.size / rows[name].size, values.min(), values.max()
    text = f"in {share:.0%} of the rows, {low:.3g} to {high:.3g} {unit}"
    if name == "level_db":
        return text
    stds = rows[f"{name}_std"][~np.isnan(rows[name])]
    stated, general = stds[~np.isnan(stds)], getattr(recorded, f"{name}_std")
    if stated.size < stds.size and general is not None:
        text += f", std {general:.3g} {unit}"
    if stated.size:
        text += f", std of {stated.size} rows {stated.min():.3g} to {stated.max():.3g} {unit}"
    return text


def _recording(place: Path, given: Layer) -> Look:
    """Describe a sound recording."""
    from pipistrelle.acoustics.call import extent_of
    from pipistrelle.detection.sounds.check import check_recording
    from pipistrelle.detection.sounds.hearing import GAPS, prepared
    from pipistrelle.detection.sounds.sound_file import open_sound
    from pipistrelle.figures.sound import draw_recording

    about, config = described(place), heard_settings(given)
    with open_sound(place, about) as sound:
        array, _, sent, calls = prepared(place, sound, about)
        parts = [samples[:, array.used] for samples in calls.gaps(sound, calls.spread(GAPS))]
        first, end = int(calls.sample[0]), int(calls.sample[:2][-1] + calls.length[0])
        begin = sound.read(first, min(end, sound.samples) - first)
    square = np.mean([np.mean(np.square(part, dtype=float), axis=0) for part in parts], axis=0)
    peak = np.max([np.abs(part).max(axis=0) for part in parts], axis=0)
    with np.errstate(divide="ignore"):
        levels = 10.0 * np.log10(square), 20.0 * np.log10(peak)
    rms, top = (f"{level.min():.1f} to {level.max():.1f} dB" for level in levels)
    names = "vehicle", *(caller.name for caller in about.callers)
    bands = {n: extent_of(call, sound.rate) for n, call in zip(names, sent, strict=True)}
    heard = (
        f"{name} {low / 1e3:.4g}" + f" to {high / 1e3:.4g}" * (high > low) + " kHz"
        for name, (low, high) in bands.items()
    )
    length, apart = sound.samples / sound.rate, np.median(calls.length) / sound.rate
    lines = (
        f"time         {length:.6g} s from {about.start:.15g} s, files: {len(sound.paths)}",
        f"channels     {sound.channels} at {sound.rate:g} Hz, {array.used.size} with a microphone",
        f"calls        {calls.sample.size} of the vehicle, {apart:.4g} s apart, "
        f"{1e3 * about.call.duration:.4g} ms long",
        f"callers      {', '.join(heard)}",
        f"level        RMS {rms}, largest sample {top}, where 1 in the file is 0 dB",
    )
    drawn: dict[str, Any] = {"rate": sound.rate, "duration": about.call.duration, "bands": bands}
    drawn |= {"calls": (calls.sample[:2] - first) / sound.rate}
    loudest = begin[:, array.used[np.argmax(square)]]
    odd = tuple(f"{place}: {fault}" for fault in check_recording(place, about, config))
    return Look(lines=lines, odd=odd, figure=lambda: draw_recording(loudest, **drawn))
