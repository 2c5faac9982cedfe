"""Results: how good each estimate is, and the folder that keeps them for other tools.

``summary.json`` is written last: its presence means that the folder is complete.
"""

import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from pipistrelle import __version__
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.models import Track
from pipistrelle.evaluation.accuracy import (
    alignment,
    heaviest,
    moved,
    pose_error,
    position_error,
    rmse,
    scored_landmarks,
)
from pipistrelle.evaluation.consistency import diverged, track_nees
from pipistrelle.experiments.folder import clear_results, write_file
from pipistrelle.experiments.tables import (
    LabelledPoints,
    landmark_table,
    map_text,
    measurement_table,
    step_table,
    tum_text,
)

FORMAT = 1
TimedPath = tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 3"]]
"""Times [s] and poses [m, m, rad]."""
README = """\
# Results

    {command}

Pipistrelle {version}, seed {seed}. SI units and radians; headings are counter-clockwise from +x,
bearings counter-clockwise from the heading. S is the sensing strategy, F the filter.

| file | what it holds |
|---|---|
| summary.json | the scores of each estimate; null: no truth, or not a finite number |
| config.toml | every setting |
| track_S_F.tum | estimated path, the start and every control step: time x y z qx qy qz qw |
| truth.tum | true path at the same times, where it is known |
| map_S_F.csv | final map with covariances; a partial landmark by its heaviest hypothesis |
| steps.parquet | estimated and true poses, standard deviations, errors, NEES |
| landmarks.parquet | every hypothesis of every landmark, beside the true positions |
| measurements.parquet | what each strategy measured; no range where it was passive |
| mission.* | pictures |

RMSE and NEES leave out the start; after an exact one the NEES begins where the covariance is
positive definite. "aligned": path and map, each after the rigid motion without
scale that fits it best to the truth. Map errors are those of the fully initialised landmarks
whose true positions are known. measurements_per_frame counts before the gate, gated what the
gate rejected, ignored_rows what was dropped from a recorded log.

    evo_ape tum truth.tum track_S_F.tum --align
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """How one trial did, under the names of ``summary.json``.

    None where there is no truth or nothing to score; infinite or NaN where the trial diverged.
    Errors and NEES are over the control steps, the start excluded.

    Attributes
    ----------
    position_rmse_m, heading_rmse_rad : float or None
        Of the path.
    map_rmse_m : float or None
        Of the fully initialised landmarks whose true positions are known.
    position_rmse_aligned_m, map_rmse_aligned_m : float or None
        The same, path and map each after its own rigid motion; at least two points.
    nees_mean, nees_max : float or None
    diverged : bool or None
        Whether any NEES is not finite or above the limit; without truth, True where the path is
        not finite, else None.
    landmarks_full, landmarks_total : int
        Fully initialised; fully and partially.
    measurements_per_frame : float or None
        Mean over the scans.
    gated : int
        Measurements that the gate rejected.
    """

    position_rmse_m: float | None
    heading_rmse_rad: float | None
    map_rmse_m: float | None
    position_rmse_aligned_m: float | None
    map_rmse_aligned_m: float | None
    nees_mean: float | None
    nees_max: float | None
    diverged: bool | None
    landmarks_full: int
    landmarks_total: int
    measurements_per_frame: float | None
    gated: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult:
    """One estimate: a strategy's scans, what a filter made of them, and how good it is.

    Attributes
    ----------
    strategy : "active", "fused" or "passive"
    filter : "ekf" or "fastslam"
    track : Track
    scans : tuple of Scan
        One per frame, empty ones included.
    scores : Scores
    wall_s : [s]
        Time that the estimate took.
    """

    strategy: str
    filter: str
    track: Track
    scans: tuple[Scan, ...]
    scores: Scores
    wall_s: float


@np.errstate(over="ignore", invalid="ignore")
def score(
    track: Track,
    true_path: Float[np.ndarray, "k 3"] | None,
    true_landmarks: LabelledPoints | None,
    scans: Sequence[Scan],
    limit: float,
) -> Scores:
    """Score a track and its map against the truth.

    Parameters
    ----------
    track : Track of k poses, the start first
    true_path : (k, 3) [m, m, rad], optional
        At the times of the track; NaN where it is not known, which is not scored.
    true_landmarks : labels (n) and positions (n, 2) [m], optional
    scans : sequence of Scan
        What the filter was given: one per frame, empty ones included.
    limit : float
        A NEES above it means divergence.

    Returns
    -------
    Scores

    Raises
    ------
    ValueError
        Where track and truth differ in length.

    Notes
    -----
    Bradley & Abaid, Eqs. (23), (26) and (27) and Sec. V-A.

    Examples
    --------
    >>> from pipistrelle.estimation.models import Gaussian, Landmarks
    >>> nothing = Landmarks(
    ...     landmark=np.empty(0, int),
    ...     mean=np.empty((0, 2)),
    ...     covariance=np.empty((0, 2, 2)),
    ...     weight=np.empty(0),
    ... )
    >>> pose = Gaussian(mean=np.zeros((2, 3)), covariance=np.tile(np.eye(3), (2, 1, 1)))
    >>> still = Track(time=np.arange(2.0), pose=pose, landmarks=nothing, gated=0)
    >>> scores = score(still, np.array([[0.0, 0, 0], [3, 4, 0]]), None, (), 50.0)
    >>> scores.position_rmse_m, scores.nees_max, scores.map_rmse_m
    (5.0, 25.0, None)
    """
    known = np.full_like(track.pose.mean, np.nan) if true_path is None else true_path
    if len(known) != len(track.pose.mean):
        raise ValueError(f"{len(track.pose.mean)} poses, but {len(known)} true ones")
    rows = np.isfinite(known).all(axis=1) & (np.arange(len(known)) > 0)
    path, truth = track.pose.mean[rows], known[rows]
    error = pose_error(path, truth)
    epsilon = track_nees(track.pose.mean, track.pose.covariance, known)[1:]
    epsilon = epsilon[~np.isnan(epsilon)]
    estimate = heaviest(track.landmarks)
    labels, positions = true_landmarks or (np.empty(0, int), np.empty((0, 2)))
    mapped, true = scored_landmarks(estimate, labels, positions)
    finite = bool(np.all(np.isfinite(track.pose.mean)))
    return Scores(
        position_rmse_m=_rmse(position_error(path, truth)),
        heading_rmse_rad=_rmse(error[:, 2]),
        map_rmse_m=_rmse(position_error(mapped, true)),
        position_rmse_aligned_m=_aligned_rmse(path[:, :2], truth[:, :2]),
        map_rmse_aligned_m=_aligned_rmse(mapped, true),
        nees_mean=float(np.mean(epsilon)) if len(epsilon) else None,
        nees_max=float(np.max(epsilon)) if len(epsilon) else None,
        diverged=diverged(epsilon, limit) if len(epsilon) else (None if finite else True),
        landmarks_full=int(np.sum(estimate.full)),
        landmarks_total=len(estimate.landmark),
        measurements_per_frame=sum(len(s.landmark) for s in scans) / len(scans) if scans else None,
        gated=track.gated,
    )


def _rmse(error: Float[np.ndarray, " n"]) -> float | None:
    """Return the RMSE, None of no errors."""
    return rmse(error) if len(error) else None


def _aligned_rmse(points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "n 2"]) -> float | None:
    """Return the RMSE after the best rigid motion, None of fewer than two points."""
    if len(points) < 2:
        return None
    return rmse(position_error(moved(points, alignment(points, true)), true))


def write_results(
    folder: Path,
    *,
    config: BaseModel,
    command: str,
    seed: int,
    trials: Sequence[TrialResult],
    truth_path: TimedPath | None,
    true_landmarks: LabelledPoints | None,
    ignored_rows: dict[str, int],
) -> None:
    """Write everything but the figures into a result folder, in place of earlier results.

    Parameters
    ----------
    folder : Path
        As `prepare_folder` gives it.
    config : pydantic model
        All settings; those that are None are left out of ``config.toml``.
    command : str
        The command line, for the reader.
    seed : int
    trials : sequence of TrialResult
        Each strategy and filter once.
    truth_path : times (k) [s] and true poses (k, 3) [m, m, rad], optional
        At the times of the tracks; NaN where not known, which ``truth.tum`` leaves out.
    true_landmarks : labels (n) and positions (n, 2) [m], optional
    ignored_rows : dict
        Number of dropped log rows by reason.

    Raises
    ------
    InputError
        Where a file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pipistrelle.config import Config
    >>> with tempfile.TemporaryDirectory() as name:
    ...     world = {"truth_path": None, "true_landmarks": None, "ignored_rows": {}}
    ...     write_results(
    ...         Path(name), config=Config(), command="pipistrelle", seed=7, trials=(), **world
    ...     )
    ...     sorted(path.name for path in Path(name).iterdir())
    ['README.md', 'config.toml', 'summary.json']
    """
    import tomli_w

    clear_results(folder)
    settings = config.model_dump(mode="json", exclude_none=True)
    write_file(folder / "config.toml", tomli_w.dumps(settings))
    readme = README.format(command=command, version=__version__, seed=seed)
    write_file(folder / "README.md", readme)
    for trial in trials:
        name, track = f"{trial.strategy}_{trial.filter}", trial.track
        write_file(folder / f"track_{name}.tum", tum_text(track.time, track.pose.mean))
        write_file(folder / f"map_{name}.csv", map_text(track.landmarks))
    if truth_path is not None:
        known = np.isfinite(truth_path[1]).all(axis=1)
        write_file(folder / "truth.tum", tum_text(truth_path[0][known], truth_path[1][known]))
    _write_tables(folder, trials, None if truth_path is None else truth_path[1], true_landmarks)
    summary = {
        "format": FORMAT,
        "version": __version__,
        "config_hash": config_hash(config),
        "seed": seed,
        "runs": [_run(trial, ignored_rows) for trial in trials],
    }
    write_file(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def _write_tables(
    folder: Path,
    trials: Sequence[TrialResult],
    true_path: Float[np.ndarray, "k 3"] | None,
    true_landmarks: LabelledPoints | None,
) -> None:
    """Write the tables of all trials; those of one strategy share their measurements."""
    import polars as pl

    def named(table: pl.DataFrame, **names: str) -> pl.DataFrame:
        return table.select(*(pl.lit(name).alias(key) for key, name in names.items()), pl.all())

    both = [(trial, {"strategy": trial.strategy, "filter": trial.filter}) for trial in trials]
    heard = {trial.strategy: trial.scans for trial in trials}
    tables = {
        "steps": [named(step_table(t.track, true_path), **names) for t, names in both],
        "landmarks": [
            named(landmark_table(t.track.landmarks, true_landmarks), **names) for t, names in both
        ],
        "measurements": [named(measurement_table(s), strategy=name) for name, s in heard.items()],
    }
    for name, parts in tables.items():
        if parts:
            buffer = io.BytesIO()
            pl.concat(parts).write_parquet(buffer)
            write_file(folder / f"{name}.parquet", buffer.getvalue())


def config_hash(config: BaseModel) -> str:
    """Sixteen hexadecimal digits that stand for a configuration.

    The head of the SHA-256 of its JSON with sorted keys and no spaces.

    Parameters
    ----------
    config : pydantic model

    Returns
    -------
    str

    Examples
    --------
    >>> from pipistrelle.config import Config
    >>> config_hash(Config(seed=7)) == config_hash(Config()), len(config_hash(Config()))
    (True, 16)
    """
    settings = config.model_dump(mode="json", exclude_none=True)
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _run(trial: TrialResult, ignored_rows: dict[str, int]) -> dict[str, object]:
    """Return a trial's entry of the summary; what is not finite becomes null."""
    run = {
        "strategy": trial.strategy,
        "filter": trial.filter,
        **asdict(trial.scores),
        "ignored_rows": dict(ignored_rows),
        "wall_s": trial.wall_s,
    }
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in run.items()
    }
