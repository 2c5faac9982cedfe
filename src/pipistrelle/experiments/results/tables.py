"""Contents of a result folder: tracks and maps as text, poses, maps and scans as tables.

Column names end in their units. Null means that a value does not exist (no truth, a passive range).
Non-finite values of a diverged filter are kept. Errors are NaN where the truth is unknown, the NEES
until an exact start has become uncertain.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.scans import OWN, UNLABELLED, Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track, placed
from pipistrelle.evaluation.accuracy import heaviest, pose_error, position_error
from pipistrelle.evaluation.association import Causes
from pipistrelle.evaluation.consistency import track_nees
from pipistrelle.experiments.drives import LabelledPoints

if TYPE_CHECKING:
    import polars as pl


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
    return "".join(
        f"{t:.6f} {x:.12f} {y:.12f} 0 0 0 {qz:.12f} {qw:.12f}\n" for t, x, y, qz, qw in rows
    )


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
    for label, mean, P, full in zip(
        estimate.landmark, estimate.mean, estimate.covariance, estimate.full, strict=True
    ):
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
    landmarks: Landmarks,
    true_landmarks: LabelledPoints | None,
    mapped: Landmarks | None = None,
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
    truth = pl.DataFrame(
        {
            "true_landmark": labels.astype(np.int64),
            "true_x_m": positions[:, 0],
            "true_y_m": positions[:, 1],
        }
    )
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
            "bearing_rad": joined([s.bearing for s in scans], np.float64),
            "range_m": joined([s.range for s in scans], np.float64),
            "excess_path_m": joined([s.excess_path for s in scans], np.float64),
            "excess_path_std_m": joined([s.excess_path_std for s in scans], np.float64),
            "caller": [_name(j, callers) for s in scans for j in s.caller.tolist()],
            "bearing_std_rad": joined([s.bearing_std for s in scans], np.float64),
            "range_std_m": joined([s.range_std for s in scans], np.float64),
            "assigned": decided,
            "true_landmark": true,
        },
        schema_overrides={"caller": pl.String},
    ).with_columns(
        pl.col("bearing_rad", "range_m", "excess_path_m").fill_nan(None),
        pl.col("assigned", "true_landmark").replace(UNLABELLED, None),
        # Every row has all standard deviations, whether it has these measurements or not.
        *(
            pl.when(pl.col(f"{name}_{unit}").is_not_nan())
            .then(f"{name}_std_{unit}")
            .fill_nan(None)
            .alias(f"{name}_std_{unit}")
            for name, unit in (("bearing", "rad"), ("range", "m"), ("excess_path", "m"))
        ),
    )


def _name(number: int, callers: Sequence[str]) -> str | None:
    """Return a caller's name, or ``callerN`` if it has none; None for the vehicle."""
    if number == OWN:
        return None
    return callers[number - 1] if number <= len(callers) else f"caller{number}"
