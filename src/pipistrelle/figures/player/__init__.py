"""A mission as flat arrays of all frames, and the page that plays it.

`playback` concatenates the numbers of all frames; `Rows.first` has the first row of each frame.
`page` returns an HTML file without external resources: style, script and numbers (as base64) are
embedded, and all text is escaped by the template. A script for another viewer is
`examples/viewers/rerun_mission.py`.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup
from pydantic.alias_generators import to_camel

from pipistrelle import __version__
from pipistrelle.acoustics.paths import moves
from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, no_landmarks, some_of
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.figures.maps import PLACED, RAY, view
from pipistrelle.figures.mission import outcome
from pipistrelle.figures.recorder import (
    Snapshot,
    callers_at,
    callers_marked,
    excess_paths_at,
    heard_from,
    pruned,
    resolved,
)
from pipistrelle.figures.style import STRATEGY_COLOURS, page_of
from pipistrelle.files import spelt, upright

MAX_FRAMES = 3000
"""Most frames of a playback; of more frames evenly spaced ones are kept."""
MAX_PARTICLES = 200
"""Most particles of a playback."""
POSE_STDS = 3.0
"""Size of the pose's ellipse in standard deviations."""
MAX_COORDINATE = 1000.0
"""Largest coordinate [m] without a shift of the origin, as packed numbers have seven digits."""
SCRIPTS = ("numbers.js", "drawing.js", "map.js", "charts.js", "player.js")
"""Scripts of the page, in order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Table of all frames' landmarks or measurements, with the index of each frame's first row."""

    first: Int[np.ndarray, " n"]
    """Frame i has the rows first[i] to first[i + 1]."""
    landmark: Int[np.ndarray, " h"]
    """Label of each row."""
    numbers: Float[np.ndarray, "h c"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Measurements and beliefs of a strategy and filter at all frames, as arrays."""

    strategy: str
    filter: str
    outcome: str
    """Errors and counts in a line."""
    start: Float[np.ndarray, "3"]
    """Start pose [m, m, rad]."""
    pose: Float[np.ndarray, "n 3"]
    """[m, m, rad]"""
    spread: Float[np.ndarray, "n 4"]
    """Covariance xx, xy, yy of the position and variance of the heading."""
    heard: Rows
    """Bearing [rad] and range [m], NaN without a range."""
    mapped: Rows
    """x, y [m], xx, xy, yy [m^2] and weight of each member."""
    pruned: Rows
    """Pruned members at the frame that lacks them, with the columns of `mapped`."""
    cloud: Float[np.ndarray, "n p 3"] | None
    """Poses of the particles [m, m, rad]."""
    revised_at: Int[np.ndarray, " j"]
    """Frames with a revised path."""
    revised: Rows
    """Revised positions of the start and all frames so far, for each such frame: x, y [m]."""
    callers: Float[np.ndarray, "n c 5"] | None
    """Estimated x, y [m], xx, xy, yy [m^2] of each caller, NaN if unknown; None if callers are not
    marked."""
    excess_paths: Rows
    """Index of the caller, without the vehicle, and excess path [m] of at most two ellipses of a
    landmark."""
    resolved: Int[np.ndarray, " n"]
    """Label of the landmark to show with its excess paths, -1 for none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Playback:
    """Truth, measurements and beliefs of a mission at all frames, for an HTML page."""

    title: str
    """Title of the mission."""
    facts: tuple[str, ...]
    """Facts about the mission, in words."""
    time: Float[np.ndarray, " n"]
    """Times of the frames since the start [s]."""
    origin: Float[np.ndarray, "2"]
    """Origin of all coordinates in the playback [m]."""
    limits: tuple[tuple[float, float], tuple[float, float]]
    """Limits of the map [m]."""
    true_start: Float[np.ndarray, "3"] | None
    """[m, m, rad]"""
    true_pose: Float[np.ndarray, "n 3"] | None
    """True poses [m, m, rad], NaN if unknown."""
    landmarks: LabelledPoints | None
    """[m]"""
    callers: tuple[tuple[int, str, np.ndarray], ...]
    """Label (of its landmark if it is fixed), name and positions, (2) or (n, 2) [m], of each
    caller; NaN if unknown, as in logs."""
    beamwidth: float | None
    """[rad]"""
    farthest: float
    """Largest range of a landmark without a range [m]."""
    estimates: tuple[Estimate, ...]


def playback(
    done: Mission, snapshots: Mapping[tuple[str, str], Sequence[Snapshot]], most: int = MAX_FRAMES
) -> Playback:
    """Convert a recorded mission to the arrays that the HTML page plays.

    `snapshots`: of a `MissionRecorder`. `most`: largest number of frames, evenly spaced, with the
    last. Estimates without frames, of filters that failed at once, are omitted; raises InputError
    if none remains.
    """
    trials = [t for t in done.trials if snapshots.get((t.strategy, t.filter))]
    if not trials:
        why = "; ".join(f"{t.strategy} {t.filter}: {t.error}" for t in done.trials if t.error)
        raise InputError(f"no estimate has a frame to show ({why or 'nothing was heard'})")
    longest = max((snapshots[t.strategy, t.filter] for t in trials), key=len)
    chosen = np.linspace(0, len(longest) - 1, min(most, len(longest))).round().astype(int)
    clock = trials[0].track.time
    time = np.array([longest[i].scan.time for i in np.unique(chosen).tolist()])
    steps = np.minimum(np.searchsorted(clock, time), len(clock) - 1)
    start = trials[0].track.pose.mean[0, :2]
    far = np.isfinite(start) & (np.abs(start) > MAX_COORDINATE)
    origin = np.where(far, np.round(start, -2), 0.0)
    truth, (x, y) = done.drive.truth, origin.tolist()
    true_path = None if truth.path is None else truth.path - [x, y, 0.0]
    paths = [trial.track.pose.mean for trial in trials]
    maps = [trial.track.landmarks for trial in trials]
    (left, right), (bottom, top) = view(truth, done.callers, paths, maps)
    return Playback(
        title=f"Log {spelt(done.log.name)}" if done.log else f"Mission of seed {done.config.seed}",
        facts=_facts(done, len(longest), len(time)),
        time=time - clock[0],
        origin=origin,
        limits=((left - x, right - x), (bottom - y, top - y)),
        true_start=None if true_path is None else true_path[0],
        true_pose=None if true_path is None else true_path[steps],
        landmarks=truth.landmarks and (truth.landmarks[0], truth.landmarks[1] - origin),
        callers=_callers(done, steps, origin),
        beamwidth=done.beamwidth,
        farthest=done.config.rays.range_bounds[1],
        estimates=tuple(
            _estimate(trial, snapshots[trial.strategy, trial.filter], time, steps, truth, origin)
            for trial in trials
        ),
    )


def _facts(done: Mission, frames: int, shown: int) -> tuple[str, ...]:
    """Return short facts about a mission as text: duration, frames, beam, landmarks."""
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
    return tuple(facts)


def _callers(
    done: Mission, steps: Int[np.ndarray, " n"], origin: Float[np.ndarray, "2"]
) -> tuple[tuple[int, str, np.ndarray], ...]:
    """Return label, name and position [m] of each caller; a moving caller's at every frame."""
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
    truth: Truth,
    origin: Float[np.ndarray, "2"],
) -> Estimate:
    """Convert a trial's snapshots to arrays, with the latest snapshot at each time."""
    at = np.searchsorted([frame.scan.time for frame in frames], time, side="right") - 1
    at = np.maximum(at, 0)
    if len(time) == len(frames):  # scans may share a time
        at = np.arange(len(frames))
    shown = [frames[i] for i in at.tolist()]
    if trial.track.online is not None:
        shown[-1] = replace(shown[-1], landmarks=trial.track.landmarks)
    covariance, shift = np.array([frame.covariance for frame in shown]), np.append(origin, 0.0)
    scans, heard = [frame.scan for frame in shown], [heard_from(frame.scan) for frame in shown]
    maps, nothing = [frame.landmarks for frame in shown], no_landmarks()
    gone = [
        nothing if old is new else some_of(old, pruned(old, new))
        for old, new in pairwise([nothing, *maps])
    ]
    timed = [[row for rows in excess_paths_at(frame).values() for row in rows] for frame in shown]
    clouds = [frame.cloud for frame in shown if frame.cloud is not None]
    whole = len(clouds) == len(shown) and len({len(cloud) for cloud in clouds}) == 1
    every = -(-len(clouds[0]) // MAX_PARTICLES) if whole else 1
    revised_at, paths = _revised(trial, frames, at, steps)

    def moments(of: Gaussian | Landmarks) -> Float[np.ndarray, "h 5"]:
        return np.column_stack([of.mean - origin, of.covariance[:, (0, 0, 1), (0, 1, 1)]])

    callers = np.array([moments(callers_at(frame))[1:] for frame in shown])
    return Estimate(
        strategy=trial.strategy,
        filter=trial.filter,
        outcome=f"failed: {trial.error}" if trial.error else outcome(trial, truth),
        start=(trial.track.online or trial.track.pose).mean[0] - shift,
        pose=np.array([frame.pose for frame in shown]) - shift,
        spread=covariance[:, (0, 0, 1, 2), (0, 1, 1, 2)],
        heard=_rows(trial, [(scan.landmark, scan.bearing, scan.range) for scan in heard]),
        mapped=_rows(trial, [(m.landmark, moments(m), m.weight) for m in maps]),
        pruned=_rows(trial, [(m.landmark, moments(m), m.weight) for m in gone]),
        cloud=np.array([cloud[::every] for cloud in clouds]) - shift if whole else None,
        revised_at=revised_at,
        revised=_rows(trial, [(np.zeros(len(path), int), path - origin) for path in paths]),
        callers=callers if callers_marked(trial.scans) else None,
        excess_paths=_rows(
            trial,
            [
                (scan.landmark[rows], scan.caller[rows] - 1, scan.excess_path[rows])
                for scan, rows in zip(scans, timed, strict=True)
            ],
        ),
        resolved=_named(np.array(resolved(frames), dtype=int)[at], trial),
    )


def _named(labels: Int[np.ndarray, " n"], trial: TrialResult) -> Int[np.ndarray, " n"]:
    """Replace map labels by labels of true landmarks; false landmarks get numbers below -1."""
    if trial.mapped is None:
        return labels
    own, true = trial.track.landmarks.landmark, trial.mapped.landmark
    pairs = zip(own.tolist(), true.tolist(), strict=True)
    names = {UNLABELLED: UNLABELLED, **dict(pairs)}
    return np.array([names.get(label, -2 - label) for label in labels.tolist()], dtype=int)


def _rows(trial: TrialResult, frames: Sequence[tuple[np.ndarray, ...]]) -> Rows:
    """Stack the labels and numbers of all frames in a table; record each frame's first row."""
    labels = np.concatenate([np.empty(0, int), *(labels.astype(int) for labels, *_ in frames)])
    numbers = [np.column_stack(columns) for _, *columns in frames]
    return Rows(
        first=np.cumsum([0, *map(len, numbers)]),
        landmark=_named(labels, trial),
        numbers=np.concatenate(numbers) if numbers else np.empty((0, 2)),
    )


def _revised(
    trial: TrialResult,
    frames: Sequence[Snapshot],
    at: Int[np.ndarray, " n"],
    steps: Int[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " j"], list[Float[np.ndarray, "_ 2"]]]:
    """Return the frames with a revised path, and the revised path up to each of them [m]."""
    found = [
        (int(np.searchsorted(at, i)), frame.path)
        for i, frame in enumerate(frames)
        if frame.path is not None
    ]
    found = [(shown, path) for shown, path in found if shown < len(at) - 1]
    if trial.track.online is not None:
        found.append((len(at) - 1, trial.track.pose.mean[:, :2]))
    paths = []
    for shown, path in found:
        so_far = np.concatenate([[0], steps[: shown + 1]])
        paths.append(path[so_far[so_far < len(path)]])
    return np.array([shown for shown, _ in found], dtype=int), paths


def page(playback: Playback) -> str:
    """Return an HTML page that plays a mission, with its scripts and numbers."""
    numbers = json.dumps(_numbers(playback), allow_nan=False, separators=(",", ":"))
    return page_of(
        "pipistrelle.figures.player",
        SCRIPTS,
        title=playback.title,
        excess_paths=any(len(estimate.excess_paths.landmark) for estimate in playback.estimates),
        facts=playback.facts,
        version=__version__,
        # No character may end the element of the page.
        numbers=Markup(numbers.replace("<", "\\u003c").replace("&", "\\u0026")),
    )


def _numbers(playback: Playback) -> dict[str, Any]:
    """Return the numbers of a playback as JSON values for the page's script."""
    return _packed(replace(playback, callers=(), estimates=())) | {
        "callers": [
            {"label": label, "name": upright(name), "moves": place.ndim == 2}
            | {"place": _packed(place)}
            for label, name, place in playback.callers
        ],
        "scales": {"placed": _scale(PLACED), "ray": _scale(RAY), "pose": POSE_STDS},
        "estimates": [
            _packed(estimate)
            | {
                "name": f"{estimate.strategy} · {title_of(estimate.filter)}",
                "role": estimate.strategy if estimate.strategy in STRATEGY_COLOURS else "ink",
            }
            for estimate in playback.estimates
        ],
    }


@np.errstate(over="ignore", invalid="ignore")
def _packed(value: Any) -> Any:
    """Convert a value for JSON: records to dicts without None, arrays to base64 binary."""
    if is_dataclass(value):
        parts = {to_camel(field.name): getattr(value, field.name) for field in fields(value)}
        return {name: _packed(part) for name, part in parts.items() if part is not None}
    if isinstance(value, tuple):
        return [_packed(part) for part in value]
    if isinstance(value, str):
        return upright(value)
    if not isinstance(value, np.ndarray):
        return value
    whole = np.issubdtype(value.dtype, np.integer)
    name, kind = ("int32", "<i4") if whole else ("float32", "<f4")
    return {name: base64.b64encode(value.astype(kind).tobytes()).decode("ascii")}


def _scale(probability: float) -> float:
    """Return the size, in standard deviations, of an ellipse that contains a probability."""
    return float(np.sqrt(-2.0 * np.log1p(-probability)))
