"""A mission as flat arrays: of every frame what was heard and what was believed.

A page and a recording for other viewers are both made of it. Numbers of all frames stand one after
another, so that they can be packed; where those of a frame begin, `Rows.first` says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.acoustics.paths import moves
from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Landmarks, some_of
from pipistrelle.experiments.drives import LabelledPoints
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.figures.animation import pruned
from pipistrelle.figures.excess_paths import (
    MAX_ELLIPSES,
    callers_at,
    callers_marked,
    excess_paths_at,
    resolved,
)
from pipistrelle.figures.maps import view
from pipistrelle.figures.mission import outcome
from pipistrelle.figures.recorder import Snapshot, heard_from
from pipistrelle.files import spelt

MAX_FRAMES = 3000
"""Of a longer recording so many are shown, evenly spaced."""
MAX_PARTICLES = 200
"""Of more particles every second, third, ... is shown."""
POSE_STDS = 3.0
"""Standard deviations of a pose that are shown."""
MAX_COORDINATE = 1000.0
"""Farther from where coordinates begin [m], they are shown about another origin: packed numbers
have seven digits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Rows of numbers, some for each frame."""

    first: Int[np.ndarray, " n"]
    """Those of frame i are the rows first[i] to first[i + 1]."""
    landmark: Int[np.ndarray, " h"]
    """Label."""
    numbers: Float[np.ndarray, "h c"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The measurements and beliefs of one strategy and filter, frame by frame."""

    strategy: str
    filter: str
    outcome: str
    """What came of it, in a line."""
    start: Float[np.ndarray, "3"]
    """[m, m, rad] Where it began."""
    pose: Float[np.ndarray, "n 3"]
    """[m, m, rad]"""
    spread: Float[np.ndarray, "n 4"]
    """Of the pose's covariance xx, xy, yy and that of the heading."""
    heard: Rows
    """Bearing [rad] and range [m], NaN where there is none."""
    mapped: Rows
    """x, y [m], xx, xy, yy [m^2] and weight of each member."""
    pruned: Rows
    """The same of what has no successor, at the frame that lacks it."""
    cloud: Float[np.ndarray, "n p 3"] | None
    """[m, m, rad] The particles' poses."""
    revised_at: Int[np.ndarray, " j"]
    """Frames at which the whole path so far is shown as revised."""
    revised: Rows
    """For each of these the start, and each frame so far: x, y [m]."""
    callers: Float[np.ndarray, "n c 5"] | None
    """Where each caller of the playback is believed to be: x, y [m], xx, xy, yy [m^2], NaN where
    that is not known. None where no picture marks it."""
    excess_paths: Rows
    """Those that make an ellipse, two of a landmark at most: whose call it was, by its place among
    the callers, and how much longer its way [m]."""
    resolved: Int[np.ndarray, " n"]
    """Label of the landmark whose excess paths are shown, -1 for none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Playback:
    """A mission's truth, and all that was heard and believed of it, frame by frame."""

    title: str
    """What the mission is."""
    facts: tuple[str, ...]
    """What else a reader should know of it."""
    time: Float[np.ndarray, " n"]
    """[s] Of the frames, since the start."""
    origin: Float[np.ndarray, "2"]
    """[m] Where the coordinates of everything here begin."""
    limits: tuple[tuple[float, float], tuple[float, float]]
    """[m] Of a map that shows what matters."""
    true_start: Float[np.ndarray, "3"] | None
    """[m, m, rad]"""
    true_pose: Float[np.ndarray, "n 3"] | None
    """[m, m, rad] NaN where it is not known."""
    landmarks: LabelledPoints | None
    """[m]"""
    callers: tuple[tuple[int, str, np.ndarray], ...]
    """Label, name and places, (2) or (n, 2) [m], of each. The label of one that stands is that of
    the landmark which it is. Places are NaN where they are not known: of a log."""
    beamwidth: float | None
    """[rad]"""
    farthest: float
    """[m] That a landmark may be of which a bearing alone is known."""
    estimates: tuple[Estimate, ...]


def playback(
    done: Mission, snapshots: Mapping[tuple[str, str], Sequence[Snapshot]], most: int = MAX_FRAMES
) -> Playback:
    """Lay out a mission that was done again while a recorder watched.

    `snapshots`: as a `MissionRecorder` keeps them. `most`: frames to be shown: evenly spaced, the
    last among them. Returns: without the estimates that have no frame: of a filter that failed at
    once. Raises InputError where no estimate has a frame.
    """
    trials = [t for t in done.trials if snapshots.get((t.strategy, t.filter))]
    if not trials:
        why = "; ".join(f"{t.strategy} {t.filter}: {t.error}" for t in done.trials if t.error)
        raise InputError(f"no estimate has a frame to show ({why or 'nothing was heard'})")
    longest = max((snapshots[t.strategy, t.filter] for t in trials), key=len)
    chosen = np.unique(
        np.linspace(0, len(longest) - 1, min(most, len(longest))).round().astype(int)
    )
    clock, time = trials[0].track.time, np.array([longest[i].scan.time for i in chosen.tolist()])
    steps = np.minimum(np.searchsorted(clock, time), len(clock) - 1)
    origin = _origin(trials)
    estimates = []
    for trial in trials:
        frames = snapshots[trial.strategy, trial.filter]
        estimates.append(_estimate(trial, frames, time, steps, done, origin))
    true = done.drive.truth.path
    title, facts = _told(done, len(longest), len(time))
    return Playback(
        title=title,
        facts=facts,
        time=time - clock[0],
        origin=origin,
        limits=_limits(done, trials, origin),
        true_start=None if true is None else _moved(true[0], origin),
        true_pose=None if true is None else _moved(true[steps], origin),
        landmarks=_landmarks(done.drive.truth.landmarks, origin),
        callers=_callers(done, steps, origin),
        beamwidth=done.beamwidth,
        farthest=done.config.rays.range_bounds[1],
        estimates=tuple(estimates),
    )


def _told(done: Mission, frames: int, shown: int) -> tuple[str, tuple[str, ...]]:
    """Say what a mission is, and what a reader should know of it."""
    time = done.trials[0].track.time
    facts = [f"{time[-1] - time[0]:.1f} s", f"{frames} frames"]
    if shown < frames:
        facts[-1] += f", of which {shown} are shown"
    if done.beamwidth is not None:
        width = f"{np.degrees(done.beamwidth):.0f}°"
        facts.append(f"beam {width}" if done.scenario else f"ranges within {width}")
    if done.drive.truth.landmarks is not None:
        facts.append(f"{len(done.drive.truth.landmarks[0])} landmarks")
    if done.drive.truth.path is None:
        facts.append("no truth known")
    title = f"Log {spelt(done.log.name)}" if done.log else f"Mission of seed {done.config.seed}"
    return title, tuple(facts)


def _origin(trials: Sequence[TrialResult]) -> Float[np.ndarray, "2"]:
    """Choose where coordinates begin: where they do, unless all is far from there."""
    start = trials[0].track.pose.mean[0, :2]
    far = np.isfinite(start) & (np.abs(start) > MAX_COORDINATE)
    return np.where(far, np.round(start, -2), 0.0)


def _moved(poses: Float[np.ndarray, "*n d"], origin: Float[np.ndarray, "2"]) -> np.ndarray:
    """Return poses, or points, about another origin."""
    shift = np.zeros(poses.shape[-1])
    shift[:2] = origin
    return poses - shift


def _limits(
    done: Mission, trials: Sequence[TrialResult], origin: Float[np.ndarray, "2"]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits of the mission's figure."""
    paths = [trial.track.pose.mean for trial in trials]
    (left, right), (bottom, top) = view(
        done.drive.truth, done.callers, paths, [trial.track.landmarks for trial in trials]
    )
    x, y = origin.tolist()
    return (left - x, right - x), (bottom - y, top - y)


def _landmarks(
    landmarks: LabelledPoints | None, origin: Float[np.ndarray, "2"]
) -> LabelledPoints | None:
    """Return the true landmarks about another origin."""
    return None if landmarks is None else (landmarks[0], landmarks[1] - origin)


def _callers(
    done: Mission, steps: Int[np.ndarray, " n"], origin: Float[np.ndarray, "2"]
) -> tuple[tuple[int, str, np.ndarray], ...]:
    """Return the callers with their labels, and of a path the places at the frames."""
    if done.log is not None:
        unknown = np.full(2, np.nan)
        return tuple((caller.landmark, caller.name, unknown) for caller in done.log.callers)
    count = 0 if done.scenario is None else len(done.scenario.landmarks)
    places = [np.asarray(caller.place, dtype=float) for caller in done.callers]
    return tuple(
        (label, caller.name, (place[steps] if moves(caller) else place) - origin)
        for label, (caller, place) in enumerate(
            zip(done.callers, places, strict=True), start=count + 1
        )
    )


def _estimate(
    trial: TrialResult,
    frames: Sequence[Snapshot],
    time: Float[np.ndarray, " n"],
    steps: Int[np.ndarray, " n"],
    done: Mission,
    origin: Float[np.ndarray, "2"],
) -> Estimate:
    """Lay out one estimate; at each time by the latest of its frames."""
    at = np.searchsorted([frame.scan.time for frame in frames], time, side="right") - 1
    at = np.maximum(at, 0)
    if len(time) == len(frames):  # scans may share a time
        at = np.arange(len(frames))
    shown = [frames[i] for i in at.tolist()]
    if trial.track.online is not None:
        shown[-1] = replace(shown[-1], landmarks=trial.track.landmarks)
    covariance = np.array([frame.covariance for frame in shown])
    before = [None, *(frame.landmarks for frame in shown[:-1])]
    gone = [_gone(old, frame.landmarks) for old, frame in zip(before, shown, strict=True)]
    first = trial.track.online or trial.track.pose
    revised_at, revised = _revised(trial, frames, at, steps, origin)

    def named(rows: Rows) -> Rows:
        return replace(rows, landmark=_named(rows.landmark, trial))

    return Estimate(
        strategy=trial.strategy,
        filter=trial.filter,
        outcome=f"failed: {trial.error}" if trial.error else outcome(trial, done.drive.truth),
        start=_moved(first.mean[0], origin),
        pose=_moved(np.array([frame.pose for frame in shown]), origin),
        spread=covariance[:, (0, 0, 1, 2), (0, 1, 1, 2)],
        heard=named(_heard(shown)),
        mapped=named(_mapped([frame.landmarks for frame in shown], origin)),
        pruned=named(_mapped(gone, origin)),
        cloud=_cloud(shown, origin),
        revised_at=revised_at,
        revised=revised,
        callers=_callers_believed(shown, origin) if callers_marked(trial.scans) else None,
        excess_paths=named(_excess_paths(shown)),
        resolved=_named(np.array(resolved(frames), dtype=int)[at], trial),
    )


def _named(labels: Int[np.ndarray, " n"], trial: TrialResult) -> Int[np.ndarray, " n"]:
    """Return labels as the true landmarks for which they stand; below -1 if they stand for none."""
    if trial.mapped is None:
        return labels
    pairs = zip(
        trial.track.landmarks.landmark.tolist(), trial.mapped.landmark.tolist(), strict=True
    )
    names = {UNLABELLED: UNLABELLED, **dict(pairs)}
    return np.array([names.get(label, -2 - label) for label in labels.tolist()], dtype=int)


def _rows(landmarks: Sequence[np.ndarray], numbers: Sequence[np.ndarray], columns: int) -> Rows:
    """Lay the rows of frames out one after another."""
    return Rows(
        first=np.cumsum([0, *map(len, numbers)]),
        landmark=np.concatenate([np.empty(0, int), *landmarks]),
        numbers=np.concatenate([np.empty((0, columns)), *numbers]),
    )


def _heard(frames: Sequence[Snapshot]) -> Rows:
    """Lay out what was heard."""
    scans = [heard_from(frame.scan) for frame in frames]
    numbers = [np.column_stack([scan.bearing, scan.range]) for scan in scans]
    return _rows([scan.landmark for scan in scans], numbers, 2)


def _callers_believed(
    frames: Sequence[Snapshot], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n c 5"]:
    """Lay out where the callers are believed to be, the vehicle left out."""
    believed = [callers_at(frame) for frame in frames]
    return np.array(
        [
            np.column_stack([b.mean - origin, b.covariance[:, (0, 0, 1), (0, 1, 1)]])[1:]
            for b in believed
        ]
    )


def _excess_paths(frames: Sequence[Snapshot]) -> Rows:
    """Lay out the excess paths that make ellipses: callers are counted without the vehicle."""
    labels, numbers = [], []
    for frame in frames:
        rows = [
            row
            for found in excess_paths_at(frame).values()
            for row in found[:MAX_ELLIPSES].tolist()
        ]
        scan = frame.scan
        labels.append(scan.landmark[rows].astype(int))
        numbers.append(np.column_stack([scan.caller[rows] - 1, scan.excess_path[rows]]))
    return _rows(labels, numbers, 2)


def _mapped(maps: Sequence[Landmarks], origin: Float[np.ndarray, "2"]) -> Rows:
    """Lay out maps, their members by mean, covariance and weight."""
    numbers = [
        np.column_stack([rows.mean - origin, rows.covariance[:, (0, 0, 1), (0, 1, 1)], rows.weight])
        for rows in maps
    ]
    return _rows([rows.landmark for rows in maps], numbers, 6)


def _gone(before: Landmarks | None, after: Landmarks) -> Landmarks:
    """Return the map members of a frame that the next frame does not have."""
    rows = after if before is None else before
    kept = np.zeros(len(rows.landmark), bool)
    if before is not None and before is not after:
        kept = pruned(before, after)
    return some_of(rows, kept)


def _cloud(
    frames: Sequence[Snapshot], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n p 3"] | None:
    """Return the particles of all frames, a part of them where there are many."""
    clouds = [frame.cloud for frame in frames if frame.cloud is not None]
    if len(clouds) < len(frames) or len({len(cloud) for cloud in clouds}) != 1:
        return None
    every = -(-len(clouds[0]) // MAX_PARTICLES)
    return _moved(np.array([cloud[::every] for cloud in clouds]), origin)


def _revised(
    trial: TrialResult,
    frames: Sequence[Snapshot],
    at: Int[np.ndarray, " n"],
    steps: Int[np.ndarray, " n"],
    origin: Float[np.ndarray, "2"],
) -> tuple[Int[np.ndarray, " j"], Rows]:
    """Return the revised paths, from the start to each such frame, and these frames."""
    revised = [(i, frame.path) for i, frame in enumerate(frames) if frame.path is not None]
    found = [(int(np.searchsorted(at, i)), path) for i, path in revised]
    found = [(shown, path) for shown, path in found if shown < len(at) - 1]
    if trial.track.online is not None:
        found.append((len(at) - 1, trial.track.pose.mean[:, :2]))
    points = []
    for shown, path in found:
        so_far = np.concatenate([[0], steps[: shown + 1]])
        points.append(path[so_far[so_far < len(path)]] - origin)
    nobody = [np.zeros(len(part), int) for part in points]
    return np.array([shown for shown, _ in found], dtype=int), _rows(nobody, points, 2)
