"""Convert a result folder to a recording for the Rerun viewer (https://rerun.io).

    python -m pip install rerun-sdk
    python examples/viewers/rerun_mission.py RESULT MISSION.rrd
    rerun MISSION.rrd

RESULT is a folder of `pipistrelle run` or `slam`; the mission is run again from it, as
`pipistrelle view` does. The world is the plane z = 0. All entities are logged at every frame of
the timeline ``time``, empty ones too. This file is a start for other viewers: `playback` gives
flat arrays of all frames.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.estimation.catalogue import short_name, title_of
from pipistrelle.experiments.runs.replay import rerun as rerun_folder
from pipistrelle.figures.maps import (
    PLACED,
    RAY,
    beam,
    ellipses,
    excess_path_ellipse,
    shades,
    vehicle,
)
from pipistrelle.figures.player import (
    POSE_STDS,
    Estimate,
    Playback,
    Rows,
    playback,
)
from pipistrelle.figures.recorder import MissionRecorder
from pipistrelle.figures.style import INK, TRUTH, strategy_colour
from pipistrelle.geometry import wrap

if TYPE_CHECKING:
    import rerun

VEHICLE, BEAM, THIN, THICK, DOT = 1.8, 14.0, 0.06, 0.2, 0.2
"""Length of the vehicle and of its beam, widths of lines and radius of dots [m]."""
HEIGHT = 1.1
"""Height of the eye above the map, in widths of the map."""
MAX_LEGS = 150
"""Most segments of a path."""


def played_again(folder: Path) -> Playback:
    """Return the frames of a mission that is run again from its result folder."""
    watch = MissionRecorder(rest=3)
    mission = rerun_folder(folder, watch=watch)
    return playback(mission, watch.snapshots)


def recording(playback: Playback) -> bytes:
    """Return the content of a .rrd file with all frames of a mission."""
    import rerun

    with TemporaryDirectory() as room:
        file = Path(room) / "mission.rrd"
        stream = rerun.RecordingStream("pipistrelle", recording_id=playback.title)
        stream.save(file, default_blueprint=_blueprint(playback))
        log = _Log(stream)
        _log_still(log, playback)
        for frame, time in enumerate(playback.time.tolist()):
            stream.set_time("time", duration=time)
            _log_truth(log, playback, frame)
            for estimate in playback.estimates:
                _log_estimate(log, playback, estimate, frame)
        stream.disconnect()
        return file.read_bytes()


class _Log:
    """A recording of lines and dots in the plane."""

    def __init__(self, stream: "rerun.RecordingStream") -> None:
        self.stream = stream

    def lines(
        self,
        name: str,
        lines: Sequence[Float[np.ndarray, "_ 2"]] | Float[np.ndarray, "h k 2"],
        colours: UInt8[np.ndarray, "*h 4"],
        breadth: float | Float[np.ndarray, " h"] = THIN,
    ) -> None:
        """Log lines under a name, in place of earlier ones."""
        import rerun

        strips = [_flat(line) for line in lines]
        self.stream.log(name, rerun.LineStrips3D(strips, colors=colours, radii=breadth))

    def dots(
        self,
        name: str,
        places: Float[np.ndarray, "h 2"],
        colour: UInt8[np.ndarray, "4"],
        *,
        size: float = DOT,
        labels: Sequence[str] | None = None,
        static: bool = False,
    ) -> None:
        """Log dots under a name, in place of earlier ones."""
        import rerun

        dots = rerun.Points3D(
            _flat(places), colors=colour, radii=size, labels=labels, show_labels=False
        )
        self.stream.log(name, dots, static=static)

    def numbers(self, name: str, *values: float) -> None:
        """Log numbers at the current time."""
        import rerun

        self.stream.log(name, rerun.Scalars(list(values)))


def _flat(points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 3"]:
    """Return the finite points with z = 0."""
    known = points[np.isfinite(points).all(axis=-1)]
    return np.column_stack([known, np.zeros(len(known))])


def _rgba(colour: str, weight: Float[np.ndarray, " h"] | None = None) -> UInt8[np.ndarray, "*h 4"]:
    """Return a colour, or a colour for each weight, the more opaque the heavier."""
    opaque = shades(colour, np.ones(1) if weight is None else weight, least=0.2, most=1.0)
    whole = np.rint(255.0 * opaque).astype(np.uint8)
    return whole[0] if weight is None else whole


def _name(estimate: Estimate) -> str:
    """Return the name of an estimate, as in its files."""
    return f"{estimate.strategy}_{short_name(estimate.filter)}"


def _blueprint(playback: Playback) -> Any:
    """Return the layout: a view of the world for each estimate, and the errors of all below."""
    import rerun.blueprint as rrb

    worlds = [
        rrb.Spatial3DView(
            name=f"{estimate.strategy} {title_of(estimate.filter)}",
            origin="/",
            contents=[f"/{_name(estimate)}/**", "/truth/**"],
            background=_rgba("#fbfaf7").tolist(),
            eye_controls=_from_above(playback),
        )
        for estimate in playback.estimates
    ]
    errors = [
        rrb.TimeSeriesView(name="position error and 3σ [m]", origin="/position"),
        rrb.TimeSeriesView(name="heading error and 3σ [deg]", origin="/heading"),
    ]
    rows = [rrb.Horizontal(*worlds), rrb.Horizontal(*errors)]
    return rrb.Blueprint(rrb.Vertical(*rows, row_shares=[3, 1]))


def _from_above(playback: Playback) -> Any:
    """Return the eye above the centre of the map."""
    import rerun.blueprint as rrb

    (left, right), (bottom, top) = playback.limits
    x, y, high = (
        (left + right) / 2.0,
        (bottom + top) / 2.0,
        HEIGHT * max(right - left, top - bottom),
    )
    return rrb.EyeControls3D(position=[x, y, high], look_target=[x, y, 0.0], eye_up=[0.0, 1.0, 0.0])


def _log_still(log: _Log, playback: Playback) -> None:
    """Log facts of the mission, true landmarks and fixed callers."""
    import rerun

    log.stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    x, y = playback.origin.tolist()
    facts = [*playback.facts, *(e.outcome for e in playback.estimates), f"origin ({x:g}, {y:g}) m"]
    about = "\n\n".join([f"# {playback.title}", *facts])
    log.stream.log("about", rerun.TextDocument(about, media_type="text/markdown"), static=True)
    if playback.landmarks is not None:
        labels, places = playback.landmarks
        names = list(map(str, labels.tolist()))
        log.dots("truth/landmarks", places, _rgba(TRUTH), labels=names, static=True)
    for _, name, place in playback.callers:
        if place.ndim == 1 and np.isfinite(place).all():
            spot = {"size": 2.0 * DOT, "labels": [name], "static": True}
            log.dots(f"truth/{name}", place[None], _rgba(INK), **spot)


def _log_truth(log: _Log, playback: Playback, frame: int) -> None:
    """Log the true positions of the vehicle and of moving callers."""
    for _, name, place in playback.callers:
        if place.ndim == 2:
            log.dots(f"truth/{name}", place[[frame]], _rgba(INK), size=2.0 * DOT, labels=[name])
    if playback.true_pose is None or playback.true_start is None:
        return
    path = np.vstack([playback.true_start, playback.true_pose[: frame + 1]])
    log.lines("truth/path", [_so_far(path)], _rgba(TRUTH), THICK)
    log.lines("truth/vehicle", [_dart(path[-1])], _rgba(TRUTH))


def _log_estimate(log: _Log, playback: Playback, estimate: Estimate, frame: int) -> None:
    """Log measurements and belief of an estimate at a frame."""
    name, colour = _name(estimate), _rgba(strategy_colour(estimate.strategy))
    pose = estimate.pose[frame]
    log.lines(
        f"{name}/path", [_so_far(np.vstack([estimate.start, estimate.pose[: frame + 1]]))], colour
    )
    log.lines(f"{name}/vehicle", [_dart(pose), _spread(estimate, frame)], _rgba(INK))
    if playback.beamwidth is not None and estimate.strategy != "passive":
        sector = beam(pose, playback.beamwidth, BEAM)
        log.lines(f"{name}/beam", [np.vstack([sector, sector[:1]])], _rgba(TRUTH))
    if estimate.cloud is not None:
        log.dots(f"{name}/particles", estimate.cloud[frame, :, :2], colour, size=THIN)
    if frame in estimate.revised_at:
        revision = int(np.searchsorted(estimate.revised_at, frame))
        points = _rows_of(estimate.revised, revision)[1]
        log.lines(f"{name}/revised", [_so_far(points)], colour)
    _log_heard(log, playback, estimate, frame)
    _log_excess_paths(log, estimate, frame)
    _log_map(log, estimate, frame)
    _log_errors(log, playback, estimate, frame)


def _log_heard(log: _Log, playback: Playback, estimate: Estimate, frame: int) -> None:
    """Log ranges as lines of their length, bearings without range up to the farthest landmark."""
    pose, (_, heard) = estimate.pose[frame], _rows_of(estimate.heard, frame)
    angle, ranged = pose[2] + heard[:, 0], np.isfinite(heard[:, 1])
    reach = np.where(ranged, heard[:, 1], playback.farthest)
    tip = pose[:2] + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    colour = strategy_colour(estimate.strategy)
    for part, rows, weight in (("ranges", ranged, 1.0), ("bearings", ~ranged, 0.0)):
        lines = [np.stack([pose[:2], end]) for end in tip[rows]]
        shade = _rgba(colour, np.full(len(lines), weight))
        log.lines(f"{_name(estimate)}/{part}", lines, shade, 0.5 * THIN)


def _log_excess_paths(log: _Log, estimate: Estimate, frame: int) -> None:
    """Log estimated positions of callers, and the excess paths of the resolved landmark."""
    if estimate.callers is None:
        return
    name, places = _name(estimate), estimate.callers[frame, :, :2]
    log.dots(f"{name}/callers", places, _rgba(strategy_colour(estimate.strategy)))
    labels, rows = _rows_of(estimate.excess_paths, frame)
    shown = rows[labels == estimate.resolved[frame]]
    vehicle = estimate.pose[frame, :2]
    outlines = [
        excess_path_ellipse(vehicle, places[int(caller)], excess_path)
        for caller, excess_path in shown
    ]
    log.lines(f"{name}/excess_paths", outlines, _rgba(INK), 0.5 * THIN)


def _log_map(log: _Log, estimate: Estimate, frame: int) -> None:
    """Log landmarks, the members of rays by weight, and pruned members."""
    name, colour = _name(estimate), strategy_colour(estimate.strategy)
    labels, rows = _rows_of(estimate.mapped, frame)
    full = placed(_landmarks(labels, rows))
    for part, kept, share in (("placed", full, PLACED), ("rays", ~full, RAY)):
        weight = rows[kept, 5]
        breadth = THIN * (0.5 + 2.0 * weight) if part == "rays" else THIN
        log.lines(f"{name}/{part}", _outlines(rows[kept], share), _rgba(colour, weight), breadth)
    known = rows[full, :2]
    log.dots(
        f"{name}/landmarks", known, _rgba(colour), labels=list(map(str, labels[full].tolist()))
    )
    _, gone = _rows_of(estimate.pruned, frame)
    log.lines(f"{name}/pruned", _outlines(gone, RAY), _rgba(INK))


def _log_errors(log: _Log, playback: Playback, estimate: Estimate, frame: int) -> None:
    """Log three standard deviations and, if the truth is known, the errors."""
    xx, _, yy, turn = np.maximum(estimate.spread[frame], 0.0).tolist()
    bounds = POSE_STDS * np.sqrt(xx + yy), POSE_STDS * np.degrees(np.sqrt(turn))
    for part, bound in zip(("position", "heading"), bounds, strict=True):
        log.numbers(f"{part}/{_name(estimate)}/bound", float(bound))
    if playback.true_pose is None:
        return
    off = estimate.pose[frame] - playback.true_pose[frame]
    log.numbers(f"position/{_name(estimate)}/error", float(np.hypot(off[0], off[1])))
    log.numbers(f"heading/{_name(estimate)}/error", float(np.degrees(wrap(off[2]))))


def _rows_of(rows: Rows, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return labels and numbers of a frame."""
    part = slice(*rows.first[frame : frame + 2].tolist())
    return rows.landmark[part], rows.numbers[part]


def _landmarks(labels: np.ndarray, rows: Float[np.ndarray, "h 6"]) -> Landmarks:
    """Return the rows of a map as `Landmarks`."""
    covariance = rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Landmarks(landmark=labels, mean=rows[:, :2], covariance=covariance, weight=rows[:, 5])


def _outlines(rows: Float[np.ndarray, "h 6"], share: float) -> Float[np.ndarray, "h 17 2"]:
    """Return the ellipses of rows of a map."""
    return ellipses(rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2), share)[:, ::3]


def _spread(estimate: Estimate, frame: int) -> Float[np.ndarray, "49 2"]:
    """Return the ellipse of a pose."""
    covariance = estimate.spread[frame, [0, 1, 1, 2]].reshape(1, 2, 2)
    share = -np.expm1(-0.5 * POSE_STDS**2)
    return ellipses(estimate.pose[[frame], :2], covariance, float(share))[0]


def _dart(pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "5 2"]:
    """Return the vehicle's outline, closed."""
    return vehicle(pose, VEHICLE)[[0, 1, 2, 3, 0]]


def _so_far(path: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "_ 2"]:
    """Return a path of at most MAX_LEGS segments, with its end."""
    every = -(-len(path) // MAX_LEGS)
    return np.vstack([path[::every, :2], path[-1:, :2]])


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    folder, target = map(Path, sys.argv[1:])
    target.write_bytes(recording(played_again(folder)))
