"""The truth of a recorded log, from files in its folder or from the log itself.

A format's reader (`pipistrelle.detection.logs.readers`) never receives the truth. A function of the
same name here calls it with the arguments that select a log, and returns the log with its truth. It
can pass the start time and set the initial pose, if the log's files do not contain them.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from os.path import lexists
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipistrelle.config import BagConfig
from pipistrelle.detection.logs.poses import path_of
from pipistrelle.detection.logs.readers import Robot
from pipistrelle.detection.logs.recording import Log, check_seconds
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.files import LOG, OwnFiles
from pipistrelle.geometry import poses_at
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import Schema, check_unique, points_of, read_table, table_text

TRUTH = Schema(
    file="truth.csv",
    row="a row is a true pose; for scoring only",
    columns=("time", "x", "y", "heading"),
)
LANDMARKS = Schema(
    file="landmarks.csv",
    row="a row is a true landmark; for scoring only",
    columns=("landmark", "x", "y"),
)
FILES = (TRUTH.file, LANDMARKS.file)

Read = Callable[..., Log]
"""Reads the log of a folder, and of a robot if there are several."""


def with_files_beside(read: Read, folder: Path, *robot: Robot) -> tuple[Log, Truth]:
    """Read a log, and its truth from ``truth.csv`` and ``landmarks.csv`` in its folder."""
    log = read(folder, *robot)
    return log, read_truth(folder, log.time)


def with_mrclam_truth(read: Read, folder: Path, robot: int) -> tuple[Log, Truth]:
    """Read a robot's MRCLAM log, cut to the times of known truth, starting at the true pose."""
    time, path = read_path(folder / f"Robot{robot}_Groundtruth.dat", None)
    columns = ("subject", "x", "y", "x_std", "y_std")
    landmarks = read_landmarks(folder / "Landmark_Groundtruth.dat", columns, None)
    log = read(folder, robot, span=(time[0].item(), time[-1].item()))
    path = poses_at(log.time, time, path)
    x, y, heading = path[0].tolist()
    truth = Truth(time=log.time, path=path, landmarks=landmarks)
    return replace(log, initial_pose=(x, y, heading)), truth


def with_bag_truth(read: Read, path: Path, settings: BagConfig) -> tuple[Log, Truth]:
    """Read a ROS bag as a log; a named topic gives the true path, and with it the first pose."""
    from pipistrelle.detection.logs.bag_log import Remarks, read_poses

    remarks = Remarks()
    if (known := read_poses(path, settings, remarks)) is None:
        log = read(path, settings)
        return log, Truth(time=log.time)
    time, path_there = known
    log = read(path, settings, span=(time[0].item(), math.inf))
    there = poses_at(log.time, time, path_there)
    if np.isnan(there).all():
        expected = f"poses between the log's times {log.time[0]!r} and {log.time[-1]!r}"
        where = f"{path}, topic {settings.truth}"
        raise refusal(where, "none", expected, "name another topic, or --bag.stamps received")
    x, y, heading = there[0].tolist()
    ignored = Counter(log.ignored_rows) + remarks.ignored
    odd = {"ignored_rows": dict(ignored), "doubts": (*log.doubts, *remarks.doubts)}
    return replace(log, initial_pose=(x, y, heading), **odd), Truth(time=log.time, path=there)


WithTruth = Callable[..., tuple[Log, Truth]]
TRUTHS: Mapping[str, WithTruth] = {"mrclam": with_mrclam_truth, "bag": with_bag_truth}
"""Functions that read the truth, by the reader's name; others use the files in the log's folder."""


def read_truth(folder: Path, time: Float[np.ndarray, " k"]) -> Truth:
    """Read ``truth.csv`` and ``landmarks.csv`` from a log's folder, if they exist.

    The path is interpolated at the times `time` [s], the heading unwrapped; NaN outside the
    recorded poses.
    """
    path_file, landmark_file = folder / TRUTH.file, folder / LANDMARKS.file
    path = landmarks = None
    if lexists(path_file):  # also a broken link, which raises
        path = poses_at(time, *read_path(path_file, ","))
        if np.isnan(path).all():
            expected = f"poses between the log's times {time[0].item()!r} and {time[-1].item()!r}"
            raise refusal(path_file, "none", expected, "use the log's clock or remove the file")
    if lexists(landmark_file):
        landmarks = read_landmarks(landmark_file, LANDMARKS.columns, ",")
    return Truth(time=time, path=path, landmarks=landmarks)


def write_truth(folder: Path, truth: Truth) -> None:
    """Write the truth as ``truth.csv`` and ``landmarks.csv`` into a log's folder, unrounded.

    NaN rows of the path are omitted. Raises InputError if a file cannot be written, or was changed
    since Pipistrelle wrote it.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> posts = (np.array([4]), np.array([[1.0, -2.5]]))
    >>> truth = Truth(time=np.array([0.0]), landmarks=posts)
    >>> with TemporaryDirectory() as place:
    ...     write_truth(Path(place), truth)
    ...     print((Path(place) / "landmarks.csv").read_text())
    landmark,x,y
    4,1.0,-2.5
    """
    own = OwnFiles(folder, LOG)
    for name, text in truth_files(truth).items():
        own.add(name, text.encode())


def truth_files(truth: Truth) -> dict[str, str]:
    """Format the truth as the files ``truth.csv`` and ``landmarks.csv``, as far as known."""
    files = {}
    if truth.path is not None:
        rows = np.column_stack((truth.time, truth.path))[np.isfinite(truth.path).all(axis=1)]
        files[TRUTH.file] = table_text(dict(zip(TRUTH.columns, rows.T, strict=True)))
    if truth.landmarks is not None:
        labels, positions = truth.landmarks
        columns = (labels, *positions.T)
        files[LANDMARKS.file] = table_text(dict(zip(LANDMARKS.columns, columns, strict=True)))
    return files


def read_path(
    path: Path, separator: str | None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Read times [s] and poses [m, m, rad] from a table, with unwrapped headings.

    The later of two rows with equal time wins. Without a separator, columns are split at spaces and
    there is no header.
    """
    table = read_table(path, TRUTH.columns, separator=separator)
    check_seconds(table)
    return path_of(table)


def read_landmarks(path: Path, columns: tuple[str, ...], separator: str | None) -> LabelledPoints:
    r"""Read labels and positions [m] of landmarks; raise if a label occurs twice.

    The first of the `columns` has the labels (``landmark`` or ``subject``); the others include
    ``x`` and ``y``. Without a separator, columns are split at spaces and there is no header.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as place:
    ...     file = Path(place) / "chart.txt"
    ...     _ = file.write_text("4 1.0 -2.5\n9 0.0 3.0\n")
    ...     labels, places = read_landmarks(file, ("landmark", "x", "y"), None)
    >>> labels, places[0]
    (array([4, 9]), array([ 1. , -2.5]))
    """
    table = read_table(path, columns, separator=separator)
    check_unique(table, columns[0])
    return table.column[columns[0]], points_of(table)
