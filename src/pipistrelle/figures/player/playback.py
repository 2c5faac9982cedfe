"""A mission as flat arrays of all frames, and the page that plays it.

`playback` concatenates the numbers of all frames; `Rows.first` has the first row of each frame.
`page` returns an HTML file without external resources: style, script and numbers (as base64) are
embedded, and all text is escaped by the template. A script for another viewer is
`examples/viewers/rerun_mission.py`.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from pipistrelle import __version__
from pipistrelle.acoustics.paths import moves
from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Landmarks, some_of
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.experiments.drives import LabelledPoints
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.figures.maps import PLACED, RAY, view
from pipistrelle.figures.mission import outcome
from pipistrelle.figures.recorder import (
    MAX_ELLIPSES,
    Snapshot,
    callers_at,
    callers_marked,
    excess_paths_at,
    heard_from,
    pruned,
    resolved,
)
from pipistrelle.figures.style import STRATEGY_COLOURS, page_colours
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
    """Numbers of landmarks or scan rows in all frames, with the first row of each frame."""

    first: Int[np.ndarray, " n"]
    """Frame i has the rows first[i] to first[i + 1]."""
    landmark: Int[np.ndarray, " h"]
    """Label of each row."""
    numbers: Float[np.ndarray, "h c"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Measurements and beliefs of a strategy and filter at all frames."""

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
    """Truth, measurements and beliefs of a mission at all frames."""

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
    """Return a recorded mission as flat arrays.

    `snapshots`: of a `MissionRecorder`. `most`: largest number of frames, evenly spaced, with the
    last. Estimates without frames, of filters that failed at once, are omitted; raises InputError
    if none remains.
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
    true, points = done.drive.truth.path, done.drive.truth.landmarks
    title, facts = _title_and_facts(done, len(longest), len(time))
    return Playback(
        title=title,
        facts=facts,
        time=time - clock[0],
        origin=origin,
        limits=_limits(done, trials, origin),
        true_start=None if true is None else _moved(true[0], origin),
        true_pose=None if true is None else _moved(true[steps], origin),
        landmarks=points and (points[0], points[1] - origin),
        callers=_callers(done, steps, origin),
        beamwidth=done.beamwidth,
        farthest=done.config.rays.range_bounds[1],
        estimates=tuple(estimates),
    )


def _title_and_facts(done: Mission, frames: int, shown: int) -> tuple[str, tuple[str, ...]]:
    """Return title and facts of a mission."""
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
    """Return the origin of coordinates: 0 unless the start is far from it."""
    start = trials[0].track.pose.mean[0, :2]
    far = np.isfinite(start) & (np.abs(start) > MAX_COORDINATE)
    return np.where(far, np.round(start, -2), 0.0)


def _moved(poses: Float[np.ndarray, "*n d"], origin: Float[np.ndarray, "2"]) -> np.ndarray:
    """Return poses or points relative to an origin."""
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


def _callers(
    done: Mission, steps: Int[np.ndarray, " n"], origin: Float[np.ndarray, "2"]
) -> tuple[tuple[int, str, np.ndarray], ...]:
    """Return label, name and position, or positions at the frames, of each caller."""
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
    """Return an estimate at each time, by the latest of its frames."""
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
    """Return the labels of the corresponding true landmarks, below -1 without any."""
    if trial.mapped is None:
        return labels
    pairs = zip(
        trial.track.landmarks.landmark.tolist(), trial.mapped.landmark.tolist(), strict=True
    )
    names = {UNLABELLED: UNLABELLED, **dict(pairs)}
    return np.array([names.get(label, -2 - label) for label in labels.tolist()], dtype=int)


def _rows(landmarks: Sequence[np.ndarray], numbers: Sequence[np.ndarray], columns: int) -> Rows:
    """Return the rows of all frames, concatenated."""
    return Rows(
        first=np.cumsum([0, *map(len, numbers)]),
        landmark=np.concatenate([np.empty(0, int), *landmarks]),
        numbers=np.concatenate([np.empty((0, columns)), *numbers]),
    )


def _heard(frames: Sequence[Snapshot]) -> Rows:
    """Return bearings and ranges of all frames."""
    scans = [heard_from(frame.scan) for frame in frames]
    numbers = [np.column_stack([scan.bearing, scan.range]) for scan in scans]
    return _rows([scan.landmark for scan in scans], numbers, 2)


def _callers_believed(
    frames: Sequence[Snapshot], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n c 5"]:
    """Return mean and covariance of the callers' positions at all frames."""
    believed = [callers_at(frame) for frame in frames]
    return np.array(
        [
            np.column_stack([b.mean - origin, b.covariance[:, (0, 0, 1), (0, 1, 1)]])[1:]
            for b in believed
        ]
    )


def _excess_paths(frames: Sequence[Snapshot]) -> Rows:
    """Return caller, without the vehicle, and excess path of the ellipses of all frames."""
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
    """Return mean, covariance and weight of all Gaussian hypotheses of the frames' maps."""
    numbers = [
        np.column_stack([rows.mean - origin, rows.covariance[:, (0, 0, 1), (0, 1, 1)], rows.weight])
        for rows in maps
    ]
    return _rows([rows.landmark for rows in maps], numbers, 6)


def _gone(before: Landmarks | None, after: Landmarks) -> Landmarks:
    """Return the members of a map that the next map lacks."""
    rows = after if before is None else before
    kept = np.zeros(len(rows.landmark), bool)
    if before is not None and before is not after:
        kept = pruned(before, after)
    return some_of(rows, kept)


def _cloud(
    frames: Sequence[Snapshot], origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n p 3"] | None:
    """Return at most MAX_PARTICLES particles of all frames."""
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
    """Return the frames with a revised path, and the paths from the start to each."""
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


def page(playback: Playback) -> str:
    """Return the HTML page that plays a mission."""
    from jinja2 import Environment, StrictUndefined

    here = files("pipistrelle.figures.player")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((here / "page.html").read_text(encoding="utf-8"))
    script = "".join((here / name).read_text(encoding="utf-8") for name in SCRIPTS)
    text = template.render(
        title=playback.title,
        excess_paths=any(len(estimate.excess_paths.landmark) for estimate in playback.estimates),
        facts=playback.facts,
        version=__version__,
        colours=Markup(page_colours()),
        style=Markup((here / "page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        numbers=Markup(_json(_numbers(playback))),
    )
    return upright(text)


def _numbers(playback: Playback) -> dict[str, Any]:
    """Return the input of the page's script."""
    landmarks, true = playback.landmarks, playback.true_pose
    return {
        "time": _packed(playback.time),
        "origin": playback.origin.tolist(),
        "limits": playback.limits,
        "trueStart": None if playback.true_start is None else _packed(playback.true_start),
        "truePose": None if true is None else _packed(true),
        "landmarks": None
        if landmarks is None
        else {"label": _packed(landmarks[0]), "place": _packed(landmarks[1])},
        "callers": [
            {
                "label": label,
                "name": upright(name),
                "moves": place.ndim == 2,
                "place": _packed(place),
            }
            for label, name, place in playback.callers
        ],
        "beamwidth": playback.beamwidth,
        "farthest": playback.farthest,
        "scales": {"placed": _scale(PLACED), "ray": _scale(RAY), "pose": POSE_STDS},
        "estimates": [_packed_estimate(estimate) for estimate in playback.estimates],
    }


def _packed_estimate(estimate: Estimate) -> dict[str, Any]:
    """Return the input of the page's script for an estimate."""
    known = estimate.strategy in STRATEGY_COLOURS
    optional = {}
    if estimate.callers is not None:
        optional["callers"] = _packed(estimate.callers)
    if len(estimate.excess_paths.landmark):
        optional |= {
            "excessPaths": _packed_rows(estimate.excess_paths),
            "resolved": _packed(estimate.resolved),
        }
    return optional | {
        "name": f"{estimate.strategy} · {title_of(estimate.filter)}",
        "role": estimate.strategy if known else "ink",
        "calls": estimate.strategy != "passive",
        "outcome": upright(estimate.outcome),
        "start": _packed(estimate.start),
        "pose": _packed(estimate.pose),
        "spread": _packed(estimate.spread),
        "heard": _packed_rows(estimate.heard),
        "mapped": _packed_rows(estimate.mapped),
        "pruned": _packed_rows(estimate.pruned),
        "cloud": None
        if estimate.cloud is None
        else {"particles": estimate.cloud.shape[1], "pose": _packed(estimate.cloud)},
        "revisedAt": _packed(estimate.revised_at),
        "revised": _packed_rows(estimate.revised),
    }


def _packed_rows(rows: Rows) -> dict[str, Any]:
    """Pack rows."""
    columns = rows.numbers.shape[1]
    packed = {"first": rows.first, "landmark": rows.landmark, "numbers": rows.numbers}
    return {"columns": columns} | {name: _packed(part) for name, part in packed.items()}


@np.errstate(over="ignore", invalid="ignore")
def _packed(numbers: np.ndarray) -> dict[str, str]:
    """Return numbers in base64, as little-endian int32 or float32."""
    whole = np.issubdtype(numbers.dtype, np.integer)
    name, kind = ("int32", "<i4") if whole else ("float32", "<f4")
    return {name: base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")}


def _scale(probability: float) -> float:
    """Return the size, in standard deviations, of an ellipse that contains a probability."""
    return float(np.sqrt(-2.0 * np.log1p(-probability)))


def _json(value: Any) -> str:
    """Return JSON without characters that could end its element of the page."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("&", "\\u0026")
