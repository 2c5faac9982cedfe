"""Progress and tables for the terminal."""

import io
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from math import inf, isfinite, nan, sqrt
from textwrap import fill
from threading import Timer
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.scores import POSITION_ALIGNED, heading, shown_in
from pipistrelle.files import spelt
from pipistrelle.verbs.streams import say

if TYPE_CHECKING:
    from pipistrelle.experiments.results.scores import TrialResult
    from pipistrelle.experiments.runs.trial import Mission, Progress


NIS_TITLE = "innovations, NIS"
NIS = (
    "NIS: how large innovations are, squared, beside what the filter expects; 1 where it believes "
    "rightly."
)
"""Note below a table with innovations."""
ALIGNED = {
    POSITION_ALIGNED: "aligned path error",
    "map_rmse_shared_m": "aligned error of the landmarks that all strategies placed",
}
"""Scores of the closing sentence of a mission, in words."""


def command_line() -> str:
    """Return the command line of this process as text, with undecodable bytes escaped."""
    return spelt(shlex.join(["pipistrelle", *sys.argv[1:]]))


def output_to(metavar: str, words: str, default: str = "") -> Parameter:
    """Return the option ``-o`` of a verb, with its placeholder and its help text."""
    words += f" [default: {default}]" * bool(default)
    return Parameter(name=("--output", "-o"), metavar=metavar, help=words)


@contextmanager
def announced(message: str, after: float = 3.0) -> Iterator[None]:
    """Print a message if the body of the context takes longer than `after` seconds."""
    timer = Timer(after, say, (message,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def bars(quiet: bool, width: int) -> "Iterator[Callable[[str, int, int, str], None] | None]":
    """Yield a function that draws progress bars on a terminal, from name, steps, total and text.

    None if it is `quiet`, or standard error is no terminal. `width` is of the column of names.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    names, texts = TextColumn(f"{{task.description:<{width}}}"), TextColumn("{task.fields[text]}")
    tasks = {}
    with Progress(names, BarColumn(), texts, console=Console(stderr=True)) as shown:

        def draw(name: str, done: int, total: int, text: str) -> None:
            if name not in tasks:
                tasks[name] = shown.add_task(name, total=total, text="")
            shown.update(tasks[name], completed=done, text=text)

        yield draw


@contextmanager
def progress(quiet: bool) -> "Iterator[Progress]":
    """Yield a function that prints the progress of a mission, a line for each stage.

    It takes the stage, the frames done and their total. On a terminal the line moves; elsewhere it
    is printed at the end of the stage.
    """
    elapsed = _stopwatch()
    with bars(quiet, 17) as draw:

        def show(stage: str, done: int, total: int) -> None:
            time = elapsed(stage)
            speed = f", {done / time:.0f} frames/s" if time > 0 and done else ""
            rate = f"{done:>5} frames{speed}"
            if draw is not None:
                draw(stage, done, total, rate)
            elif done == total and not quiet:
                say(f"{stage:<17}{rate}")

        yield show


def _stopwatch() -> Callable[[str], float]:
    """Return a function that measures the time of a stage [s], without compilation."""
    from pipistrelle.jit import wall_s

    began, latest = {}, wall_s()

    def elapsed(stage: str) -> float:
        nonlocal latest
        begin = began.setdefault(stage, latest)
        latest = wall_s()
        return latest - begin

    return elapsed


def closing_table(mission: "Mission", names: Mapping[str, str]) -> str:
    """Format the scores of a mission as a table with a column per estimate, and notes below it.

    A table wider than the terminal, and than 100 characters, is printed in parts. `names` overrides
    headings of strategies.
    """
    from pipistrelle.evaluation.bound import IN_ONE_WORLD
    from pipistrelle.experiments.drives import reckoned
    from pipistrelle.experiments.results.scores import score_path
    from pipistrelle.scripting.log_warnings import distance_driven

    trials, landmarks = mission.trials, mission.drive.truth.landmarks
    count = None if landmarks is None else len(landmarks[0])
    driven = None if mission.log is None else distance_driven(mission.log)
    odometry = score_path(reckoned(mission.drive), mission.drive.truth.path)
    raw, aligned = (number(odometry[name], 3) for name in ("position_rmse_m", POSITION_ALIGNED))
    columns = [dict(_cells(trial, count, driven)) for trial in trials]
    filters = [short_name(trial.filter) for trial in trials]
    heads = [names.get(trial.strategy, trial.strategy) for trial in trials]
    lines = [("", *heads), ("", *filters)]
    width = max(11, 1 + max(map(len, filters)))
    for title in dict.fromkeys(title for column in columns for title in column):
        cells = [column.get(title, "") for column in columns]
        if any(cells):
            lines.append((title, *(text or "-" for text in cells)))
    first = max(32, 1 + max(len(line[0]) for line in lines))
    each = max(1, (max(100, shutil.get_terminal_size().columns) - first) // width)
    rows = [
        f"{title:<{first}}" + "".join(f"{cell:>{width}}" for cell in cells[k : k + each])
        for k in range(0, len(trials), each)
        for title, *cells in ([("",)] * (k > 0) + lines)
    ]
    bounded = any(trial.scores.position_bound_m is not None for trial in trials)
    weighed = any(column.get(NIS_TITLE) for column in columns)
    scores = [asdict(trial.scores) | {"final_std_m": _final_std(trial)} for trial in trials]
    turned = [
        title
        for title in ("position", "map")
        if all(
            (one[f"{title}_rmse_aligned_m"] or inf) < sqrt(0.5) * (one[f"{title}_rmse_m"] or 0.0)
            for one in scores
        )
    ]
    notes = [
        *[f"By odometry only: position RMSE {raw} m, aligned {aligned} m."] * bool(aligned),
        *[IN_ONE_WORLD] * bounded,
        *[f"Most of the raw {' and '.join(turned)} error is one rigid motion."] * bool(turned),
        *[NIS] * weighed,
    ]
    ways = zip(heads, filters, scores, strict=True)
    return "\n".join([*rows, *notes, "", fill(answer(ways), 100)])


def answer(estimates: Iterable[tuple[str, str, Mapping[str, Any]]]) -> str:
    """Summarise a mission in a sentence: its most accurate estimate, and the effect of listening.

    `estimates`: strategy, estimator and scores of each; without truth also `final_std_m`.
    """
    found = {(way, name): scores for way, name, scores in estimates}
    pairs = [key for key in found if key[0] == "fused" and ("active", key[1]) in found]
    errors = {key: found[key].get(POSITION_ALIGNED) or nan for key in pairs or found}
    best = min(errors, key=lambda key: (not isfinite(errors[key]), errors[key]))
    scores, other = found[best], found["active", best[1]] if pairs else {}
    count, before = scores["landmarks_full"], other.get("landmarks_full")
    said = [f"{count} landmark{'s' * (count != 1)}"]
    said[0] += (", as without" if count == before else f" instead of {before}") * bool(pairs)
    for score, title in ALIGNED.items():
        ends = [one[score] for one in (scores, other) if isfinite(one.get(score) or nan)]
        if len(ends) == 1 + bool(pairs):
            said.append(f"{title} {' instead of '.join(map(_length, ends))}")
    if std := scores.get("final_std_m"):
        said.append(f"standard deviation of the final position {_length(std)}")
    said += ["diverged"] * bool(scores.get("diverged"))
    name = f"Listening, {best[1]}" if pairs else " ".join(best[len(found) == 1 :])
    return f"{name}: {'; '.join(said)}."


def _length(value: float) -> str:
    """Format a length in millimetres, or in metres from 1 m on."""
    return f"{1e3 * value:.0f} mm" if value < 1.0 else f"{value:.2f} m"


def _cells(
    trial: "TrialResult", count: int | None, driven: float | None
) -> Iterator[tuple[str, str]]:
    """Yield title and text of each score of an estimate; the text is "" if it is missing."""
    from pipistrelle.experiments.results.scores import judged

    s = trial.scores
    for name, score in shown_in("mission").items():
        yield heading(score), number(getattr(s, name), score.digits)
    yield "landmarks, placed / heard", f"{s.landmarks_full} / {s.landmarks_total}"
    yield "landmarks in the world", "" if count is None else str(count)
    yield "fully placed, particles' mean", number(trial.track.full, 1)
    yield "measurements per frame", number(s.measurements_per_frame, 2)
    yield "rejected by the gate", str(s.gated or "")
    if s.position_rmse_m is None:
        measurements = judged(trial.scans)
        share = 100.0 * s.gated / measurements if measurements else None
        yield NIS_TITLE, number(s.nis_mean, 2)
        yield "rejected by the gate [%]", number(share, 2)
        yield "final position, 1 sigma [m]", number(_final_std(trial), 3)
        yield "driven, by the odometry [m]", number(driven, 1)
    for name, (value, std) in trial.track.calibration.items():
        yield name.replace("_", " "), f"{value:.5g}"
        yield f"{name.replace('_', ' ')}, 1 sigma", f"{std:.2g}"
    yield "diverged", "yes" if s.diverged else ""


def _final_std(trial: "TrialResult") -> float | None:
    """Return the standard deviation of the final position [m]; None if there is truth."""
    covariance = trial.track.pose.covariance[-1]
    variance = max(float(covariance[0, 0] + covariance[1, 1]), 0.0)
    return sqrt(variance) if trial.scores.position_rmse_m is None else None


def number(value: float | None, digits: int, missing: str = "") -> str:
    """Format a number with `digits` decimals, or fewer digits if it is huge; None as `missing`."""
    if value is None or (missing and value != value):
        return missing
    return f"{value:.{digits}f}" if abs(value) < 1e5 else f"{value:.3g}"


def text_table(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Format a text table, the first column left-aligned, others right-aligned.

    >>> print(text_table("", [["", "A", "B"]], [["NEES", "2.1", "10.0"]]))
            A     B
    NEES  2.1  10.0
    """
    return _drawn(title, heads, rows) if sys.stdout.isatty() else _plain(title, heads, rows)


def _plain(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Format a table as plain text, with two spaces between columns."""
    lines = [*heads, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    texts = (
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
    return "\n".join([*filter(None, [title]), *texts])


def _drawn(title: str, heads: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    """Format a table with lines and headings for a terminal, within its width."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title) if title else None, title_justify="left", box=box.SIMPLE_HEAD)
    for i, column in enumerate(zip(*heads, strict=True)):
        head = Text("\n".join(column).strip("\n") if i else "\n".join(column))
        table.add_column(head, justify="right" if i else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    out = io.StringIO()
    width = shutil.get_terminal_size().columns
    Console(file=out, force_terminal=True, width=width).print(table)
    return "\n".join(line.rstrip() for line in out.getvalue().rstrip("\n").splitlines())
