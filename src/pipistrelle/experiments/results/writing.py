"""Result folders: claimed or newly named, and written with scores, tracks, maps and tables.

``summary.json`` is written last, so it marks a complete folder. Without a given path, results go to
a new folder under ``runs``.

Columns of tables end in their units. Null means that a value does not exist (no truth, a passive
range). Non-finite values of a diverged filter are kept. Errors are NaN where the truth is unknown,
the NEES until an exact start has become uncertain.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from pydantic import BaseModel

from pipistrelle.config import InputError
from pipistrelle.detection.scans import KINDS, OWN, STD_OF, UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track, placed
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.accuracy import heaviest, pose_error, position_error
from pipistrelle.evaluation.association import Causes, births_per_scan
from pipistrelle.evaluation.consistency import track_nees
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.experiments.results.scores import OF_ASSOCIATION, TrialResult, judged
from pipistrelle.files import (
    COMMAND_LINE,
    RESULTS,
    OwnFiles,
    claim,
    drawn_files,
    make_folder,
    partial_of,
    remove_empty,
    shipped_text,
)
from pipistrelle.settings import to_toml
from pipistrelle.text_tables import TEXT_COLUMNS
from pipistrelle.version import find_version

_OURS = re.compile(r"\d{8}-\d{6}-(run|slam)(-\d+)?")
"""Names that `result_folder` gives."""


@contextmanager
def result_folder(
    path: Path | None, name: str, *, overwrite: bool, flags: tuple[str, str] = COMMAND_LINE
) -> Iterator[OwnFiles]:
    """Provide the folder for a mission's results; remove a new folder if it stays empty.

    Without a path it is ``runs/<time>-<name>``; once complete, ``runs/latest`` links to it, if the
    file system has symbolic links and no other file has that name. Earlier results stay until the
    new ones are complete.
    """
    if path is not None:
        yield claim(path, RESULTS, overwrite=overwrite, flags=flags)
        return
    made = _new_folder(name)
    try:
        yield claim(made[0], RESULTS, overwrite=False)
        _point_latest_at(made[0])
    finally:
        remove_empty(made)


def _new_folder(name: str) -> list[Path]:
    """Create the folder ``runs/<time>-<name>``; return it and, if it was created, ``runs``."""
    runs = Path("runs")
    try:
        made = make_folder(runs)[:1]
        stem = f"{datetime.now():%Y%m%d-%H%M%S}-{name}"
        for attempt in count(1):
            folder = runs / (stem if attempt == 1 else f"{stem}-{attempt}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                break
        return [folder, *made]
    except OSError as error:
        why = f"cannot be used as a folder for results ({error.strerror})"
        fix = f"name one that can be written with {COMMAND_LINE[0]}"
        raise InputError(f"{runs}: {why}; {fix}") from error


def _point_latest_at(folder: Path) -> None:
    """Link ``runs/latest`` to a folder, unless another program's file has that name."""
    latest = folder.parent / "latest"
    ours = latest.is_symlink() and _OURS.fullmatch(str(latest.readlink()))
    if os.path.lexists(latest) and not ours:
        return
    link = partial_of(latest)
    with contextlib.suppress(OSError):
        link.symlink_to(folder.name, target_is_directory=True)
        try:
            link.replace(latest)
        finally:
            link.unlink(missing_ok=True)


if TYPE_CHECKING:
    import polars as pl


LOG = ", and which log was solved, how it was heard, and its files' sums"
ONLINE = """\
| track_S_F_online.tum | the same as it was believed at each time; F revised it by what came after |
"""

CALLERS = """\
| caller_N_S_F.tum | estimated places of caller N, which moves, at the frames since it was placed; \
no heading is known, and none told |
| truth_N.tum | its true path, where it is known |
"""


def write_results(
    own: OwnFiles,
    *,
    config: BaseModel,
    command: str,
    seed: int,
    trials: Sequence[TrialResult],
    truth: Truth,
    ignored_rows: dict[str, int],
    callers: Sequence[str] = (),
    moving: Mapping[int, str] = MappingProxyType({}),
    beside: Mapping[str, bytes] = MappingProxyType({}),
    log: Mapping[str, object] | None = None,
    draw: Callable[[Path], None] = lambda _: None,
) -> None:
    """Write a mission's results into a folder, replacing earlier results, or change nothing.

    `beside` contains additional files by name; `draw` receives a folder for the figures.

    >>> import tempfile
    >>> from pipistrelle.config import Config
    >>> from pipistrelle.experiments.drives import NO_TRUTH
    >>> from pipistrelle.files import RESULTS, OwnFiles
    >>> with tempfile.TemporaryDirectory() as name:
    ...     run = {"command": "pipistrelle", "seed": 7, "trials": (), "ignored_rows": {}}
    ...     write_results(OwnFiles(Path(name), RESULTS), config=Config(), truth=NO_TRUTH, **run)
    ...     sorted(path.name for path in Path(name).iterdir())
    ['README.md', 'SHA256SUMS', 'config.toml', 'summary.json']
    """
    parts = {
        "online": ONLINE if any(trial.online for trial in trials) else "",
        "log": "" if log is None else LOG,
        "callers": CALLERS if any(trial.track.callers for trial in trials) else "",
    }
    readme = shipped_text("experiments/results/readme.md").format(
        command=command, version=find_version(), seed=seed, **parts
    )
    files: dict[str, str | bytes] = {"config.toml": to_toml(config), "README.md": readme}
    files |= _texts(trials, truth, moving)
    for name, table in tables_of(trials, truth, callers).items():
        buffer = io.BytesIO()
        table.write_parquet(buffer)
        files[f"{name}.parquet"] = buffer.getvalue()
    files |= beside
    files |= drawn_files(draw)
    summary = {
        "format": 1,
        "version": find_version(),
        "config_hash": config_hash(config),
        "seed": seed,
        **({} if log is None else {"log": dict(log)}),
        "runs": [run_entry(trial, ignored_rows) for trial in trials],
    }
    files["summary.json"] = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    own.replace(files)


def _texts(
    trials: Sequence[TrialResult], truth: Truth, moving: Mapping[int, str]
) -> dict[str, str]:
    """Return estimated tracks, maps and true paths as text files, by file name."""
    texts: dict[str, str] = {}
    for trial in trials:
        name, track = f"{trial.strategy}_{short_name(trial.filter)}", trial.track
        texts[f"track_{name}.tum"] = tum_text(track.time, track.pose.mean)
        if track.online is not None:
            texts[f"track_{name}_online.tum"] = tum_text(track.time, track.online.mean)
        texts[f"map_{name}.csv"] = map_text(track.landmarks)
        for label, believed in track.callers.items():
            text = place_text(track.time, believed.mean)
            texts[f"caller_{moving[label]}_{name}.tum"] = text
    if truth.path is not None:
        finite = np.isfinite(truth.path).all(axis=1)
        texts["truth.tum"] = tum_text(truth.time[finite], truth.path[finite])
    for label, path in truth.callers.items():
        texts[f"truth_{moving[label]}.tum"] = place_text(truth.time, path)
    return texts


def tables_of(
    trials: Sequence[TrialResult], truth: Truth, callers: Sequence[str] = ()
) -> "dict[str, pl.DataFrame]":
    """Return the tables ``steps``, ``landmarks`` and ``measurements`` of a mission.

    Trials of a strategy share their measurements, with a null for the filter, unless settings or
    associations make them differ; then each filter has its rows.
    """
    import polars as pl

    def named(table: pl.DataFrame, **names: str | None) -> pl.DataFrame:
        words = (pl.lit(name, pl.String).alias(key) for key, name in names.items())
        return table.select(*words, pl.all())

    def measured(strategy: str) -> Iterator[pl.DataFrame]:
        alike = [trial for trial in trials if trial.strategy == strategy]
        parts = [measurement_table(t.heard, callers, t.track.labels, t.causes) for t in alike]
        if all(part.equals(parts[0]) for part in parts):
            yield named(parts[0], strategy=strategy, filter=None)
        else:
            for trial, part in zip(alike, parts, strict=True):
                yield named(part, strategy=strategy, filter=trial.filter)

    both = [(trial, {"strategy": trial.strategy, "filter": trial.filter}) for trial in trials]
    strategies = dict.fromkeys(trial.strategy for trial in trials)
    tables = {
        "steps": [named(step_table(t.track, truth.path), **names) for t, names in both],
        "landmarks": [
            named(landmark_table(t.track.landmarks, truth.landmarks, t.mapped), **names)
            for t, names in both
        ],
        "measurements": [table for strategy in strategies for table in measured(strategy)],
    }
    return {name: pl.concat(parts) for name, parts in tables.items() if parts}


def config_hash(config: BaseModel) -> str:
    """Return 16 hexadecimal digits that identify a configuration.

    They are the start of the SHA-256 of its JSON with sorted keys and no spaces.
    """
    return settings_hash(config.model_dump(mode="json", exclude_none=True))


def settings_hash(settings: Mapping[str, object]) -> str:
    """Return 16 hexadecimal digits that identify settings, as nested in ``config.toml``."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_entry(trial: TrialResult, ignored_rows: Mapping[str, int]) -> dict[str, object]:
    """Return a trial's entry for ``summary.json``; non-finite scores become None."""
    scores = asdict(trial.scores)
    if all(scores[name] is None for name in OF_ASSOCIATION):
        scores = {name: score for name, score in scores.items() if name not in OF_ASSOCIATION}
    run: dict[str, object] = {
        "strategy": trial.strategy,
        "filter": trial.filter,
        **_finite(scores),
        "gated_of": judged(trial.scans),
        **({"calibration": calibrated} if (calibrated := calibration_of(trial.track)) else {}),
        "ignored_rows": {
            **ignored_rows,
            **{f"unsure_{name}".removesuffix("_std"): n.size for name, n in trial.left_out.items()},
        },
        "wall_s": trial.wall_s,
        **({"births_per_scan": births_per_scan(labels)} if (labels := trial.track.labels) else {}),
        **trial.track.report,
    }
    return run if trial.online is None else run | {"online": _finite(trial.online)}


def calibration_of(track: Track) -> dict[str, float]:
    """Return the estimated calibration parameters and their standard deviations, by name."""
    both = track.calibration.items()
    return {
        key: one
        for name, (value, std) in both
        for key, one in ((name, value), (f"{name}_std", std))
    }


def _finite(scores: Mapping[str, object]) -> dict[str, object]:
    """Replace non-finite scores by None, as JSON has no NaN."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in scores.items()
    }


@np.errstate(invalid="ignore")
def tum_text(time: Float[np.ndarray, " k"], path: Float[np.ndarray, "k 3"]) -> str:
    r"""Format a path in the TUM format: lines of time, x, y, z and a unit quaternion.

    .. math:: q = (0, 0, \sin(\theta / 2), \cos(\theta / 2))

    Times are rounded to 1e-6 s, poses to 1e-12.

    >>> print(tum_text(np.array([0.125]), np.array([[1.0, 2.0, -np.pi]])), end="")
    0.125000 1.000000000000 2.000000000000 0 0 0 -1.000000000000 0.000000000000
    """
    half = path[:, 2] / 2.0
    rows = np.column_stack([time, path[:, :2], np.sin(half), np.cos(half)])
    line = "{:.6f} {:.12f} {:.12f} 0 0 0 {:.12f} {:.12f}\n"
    return "".join(line.format(*row) for row in rows)


def place_text(time: Float[np.ndarray, " k"], place: Float[np.ndarray, "k 2"]) -> str:
    """Format positions without heading in the TUM format, omitting NaN."""
    finite = ~np.isnan(place).any(axis=1)
    return tum_text(time[finite], np.column_stack((place[finite], np.zeros(finite.sum()))))


def map_text(landmarks: Landmarks) -> str:
    """Format a map as CSV, a line per landmark: mean, covariance and status.

    A partially initialised landmark is represented by its heaviest hypothesis.
    """
    estimate = heaviest(landmarks)
    lines = ["landmark,x,y,xx,xy,yy,status"]
    columns = estimate.landmark, estimate.mean, estimate.covariance, estimate.full
    for label, mean, P, full in zip(*columns, strict=True):
        numbers = ",".join(f"{value:.15g}" for value in (*mean, P[0, 0], P[0, 1], P[1, 1]))
        lines.append(f"{label},{numbers},{'full' if full else 'partial'}")
    return "\n".join(lines) + "\n"


@np.errstate(over="ignore", invalid="ignore")
def step_table(track: Track, true_path: Float[np.ndarray, "k 3"] | None) -> "pl.DataFrame":
    """Return a track as a table, a row per pose: estimate, standard deviations, errors, NEES.

    Columns that need the truth are null without it.

    Bradley & Abaid, the terms of Eqs. (23) and (26).
    """
    import polars as pl

    mean = track.pose.mean
    true = np.full_like(mean, np.nan) if true_path is None else true_path
    error = pose_error(mean, true)
    scored = {
        **_pose_columns("true_{}", true),
        "position_error_m": position_error(mean, true),
        "heading_error_rad": error[:, 2],
        "nees": track_nees(track.pose, true),
    }
    truth = pl.DataFrame(scored)
    estimate = path_table(track.time, track.pose)
    return estimate.hstack(truth if true_path is not None else truth.clear(len(mean)))


def path_table(time: Float[np.ndarray, " k"], path: Gaussian) -> "pl.DataFrame":
    """Return poses and their standard deviations as a table, a row per time."""
    import polars as pl

    std = np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    poses = {**_pose_columns("{}", path.mean), **_pose_columns("{}_std", std)}
    return pl.DataFrame({"time_s": time, **poses})


def _pose_columns(name: str, poses: Float[np.ndarray, "k 3"]) -> dict[str, np.ndarray]:
    """Return x, y and heading of poses as table columns, named by the pattern `name`."""
    units = (("x", "m"), ("y", "m"), ("heading", "rad"))
    return {f"{name.format(part)}_{unit}": poses[:, i] for i, (part, unit) in enumerate(units)}


def landmark_table(
    landmarks: Landmarks, true_landmarks: LabelledPoints | None, mapped: Landmarks | None = None
) -> "pl.DataFrame":
    """Return a map as a table, a row per hypothesis of each landmark, with true positions.

    ``landmark`` is the label in the map. ``true_landmark`` is the true landmark that it represents:
    the same label, or by `mapped`, the same rows with true labels. ``status`` is full, partial or,
    for a true landmark missing from the map, unseen.

    Bradley & Abaid, the terms of Eq. (27).
    """
    import polars as pl

    label, mean, P = landmarks.landmark, landmarks.mean, landmarks.covariance
    found = pl.DataFrame(
        {
            "landmark": label.astype(np.int64),
            "status": np.where(placed(landmarks), "full", "partial").astype(str).tolist(),
            "weight": landmarks.weight,
            "x_m": mean[:, 0],
            "y_m": mean[:, 1],
            "xx_m2": P[:, 0, 0],
            "xy_m2": P[:, 0, 1],
            "yy_m2": P[:, 1, 1],
            "true_landmark": (mapped or landmarks).landmark.astype(np.int64),
        },
        schema_overrides={"status": pl.String},
    )
    labels, positions = true_landmarks or (np.empty(0, np.int64), np.empty((0, 2)))
    x, y = positions.T
    columns = {"true_landmark": labels.astype(np.int64), "true_x_m": x, "true_y_m": y}
    truth = pl.DataFrame(columns)
    table = found.join(
        truth, on="true_landmark", how="full", coalesce=True, maintain_order="left_right"
    )
    across, along = pl.col("x_m") - pl.col("true_x_m"), pl.col("y_m") - pl.col("true_y_m")
    if mapped is None:
        table = table.with_columns(pl.col("landmark").fill_null(pl.col("true_landmark")))
    return table.with_columns(
        pl.col("status").fill_null("unseen"),
        error_m=(across**2 + along**2).sqrt(),
        true_landmark=pl.when(pl.col("true_x_m").is_not_null()).then("true_landmark"),
    ).select(pl.exclude("true_landmark"), "true_landmark")


def measurement_table(
    scans: Sequence[Scan],
    callers: Sequence[str] = (),
    labels: Sequence[Int[np.ndarray, " m"]] = (),
    causes: Causes | None = None,
) -> "pl.DataFrame":
    """Return scans as a table, a row per measurement; null for a quantity that was not measured.

    ``caller`` is the name of the emitter of an echo, number 1 being the first name; null for the
    vehicle. ``assigned`` is the label from an association, with an array of `labels` for each scan.
    ``true_landmark`` is the landmark that caused the row: by `causes`, else its recorded label.
    """
    import polars as pl

    def joined(parts: Sequence[np.ndarray], dtype: type) -> np.ndarray:
        return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype)

    recorded = joined([s.landmark for s in scans], np.int64)
    true = recorded if causes is None else joined(causes, np.int64)
    decided = joined(labels, np.int64) if labels else np.full(recorded.size, UNLABELLED)
    return pl.DataFrame(
        {
            "time_s": joined([np.full(len(s.landmark), s.time) for s in scans], np.float64),
            "landmark": recorded,
            "caller": [_name(j, callers) for s in scans for j in s.caller.tolist()],
            **{
                f"{name}_{TEXT_COLUMNS[name].unit}": joined(
                    [getattr(s, name) for s in scans], np.float64
                )
                for name in (*KINDS, *STD_OF.values())
            },
            "assigned": decided,
            "true_landmark": true,
        },
        schema_overrides={"caller": pl.String},
    ).with_columns(
        pl.col("assigned", "true_landmark").replace(UNLABELLED, None),
        # Every row has all standard deviations, whether it has these measurements or not.
        *(
            pl.when(pl.col(f"{kind}_{unit}").is_not_nan()).then(name).fill_nan(None).alias(name)
            for kind, unit in ((kind, TEXT_COLUMNS[kind].unit) for kind in KINDS)
            for name in (f"{kind}_{unit}", f"{kind}_std_{unit}")
        ),
    )


def _name(number: int, callers: Sequence[str]) -> str | None:
    """Return a caller's name, or ``callerN`` if it has none; None for the vehicle."""
    if number == OWN:
        return None
    return callers[number - 1] if number <= len(callers) else f"caller{number}"
