"""The truth beside a recorded log, for scoring alone."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.logs.text_tables import check_unique, read_table, refusal, write_table
from pipistrelle.experiments.drives import LabelledPoints

_PATH = ("time", "x", "y", "heading")


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What is known of the truth of a recorded log, for scoring alone.

    Attributes
    ----------
    time : (k) [s]
        Times of the track: the start, then the end of each step.
    path : (k, 3) [m, m, rad] or None
        True poses, linear between the recorded ones, the heading unwrapped; NaN before the first
        and after the last of them.
    landmarks : labels (n) and positions (n, 2) [m], or None
    """

    time: Float[np.ndarray, " k"]
    path: Float[np.ndarray, "k 3"] | None
    landmarks: LabelledPoints | None


def read_truth(folder: Path, time: Float[np.ndarray, " k"]) -> Truth | None:
    """Read ``truth.csv`` and ``landmarks.csv`` of a log folder, where they are.

    Parameters
    ----------
    folder : Path
    time : (k) [s]
        Times of the track.

    Returns
    -------
    Truth, or None without either file

    Raises
    ------
    InputError
        With the file and the line; also where no true pose lies within the track.
    """
    path_file, landmark_file = folder / "truth.csv", folder / "landmarks.csv"
    path = landmarks = None
    if path_file.exists():
        path = poses_at(time, *read_path(path_file, ","))
        if np.isnan(path).all():
            expected = f"poses between the log's times {time[0].item()!r} and {time[-1].item()!r}"
            raise refusal(path_file, "none", expected, "use the log's clock or remove the file")
    if landmark_file.exists():
        landmarks = read_landmarks(landmark_file, ("landmark", "x", "y"), ",")
    if path is None and landmarks is None:
        return None
    return Truth(time=time, path=path, landmarks=landmarks)


def write_truth(folder: Path, truth: Truth) -> None:
    """Write ``truth.csv`` and ``landmarks.csv`` beside a log, exactly.

    Parameters
    ----------
    folder : Path
        The log's folder.
    truth : Truth
        Rows of the path that are NaN are left out.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> posts = (np.array([4]), np.array([[1.0, -2.5]]))
    >>> truth = Truth(time=np.array([0.0]), path=np.array([[0.0, 1.0, 0.5]]), landmarks=posts)
    >>> with TemporaryDirectory() as place:
    ...     write_truth(Path(place), truth)
    ...     print((Path(place) / "landmarks.csv").read_text())
    landmark,x,y
    4,1.0,-2.5
    """
    if truth.path is not None:
        rows = np.column_stack((truth.time, truth.path))[np.isfinite(truth.path).all(axis=1)]
        write_table(folder / "truth.csv", _PATH, *rows.T)
    if truth.landmarks is not None:
        labels, positions = truth.landmarks
        write_table(folder / "landmarks.csv", ("landmark", "x", "y"), labels, *positions.T)


def read_path(
    path: Path, separator: str | None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Times and poses, the heading unwrapped; of two rows with one time the later wins."""
    column = read_table(path, _PATH, separator=separator).column
    last = np.append(np.diff(column["time"]) > 0, True)
    heading = np.unwrap(column["heading"][last])
    return column["time"][last], np.column_stack((column["x"][last], column["y"][last], heading))


def read_landmarks(path: Path, columns: tuple[str, ...], separator: str | None) -> LabelledPoints:
    """Labels and positions; each label once."""
    table = read_table(path, columns, separator=separator)
    check_unique(table, columns[0])
    return table.column[columns[0]], np.column_stack((table.column["x"], table.column["y"]))


def poses_at(
    time: Float[np.ndarray, " k"], known: Float[np.ndarray, " n"], path: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "k 3"]:
    """Poses at other times, linear in between, NaN outside."""
    columns = [np.interp(time, known, column, left=np.nan, right=np.nan) for column in path.T]
    return np.column_stack(columns)
