"""The mission as a film: what was heard, and what the filters believed, frame by frame.

A `MissionRecorder` watches filters while they run. `animate_mission` then draws what never moves
once, and on it, picture by picture, what does: the beam, the bearings of the frame's
measurements, rays being born and thinned out, landmarks as they turn full, the path so far.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.experiments.drives import NO_TRUTH, LabelledPoints, Truth
from pipistrelle.figures.closeup import Closeup, add_closeups
from pipistrelle.figures.excess_paths import (
    callers_at,
    callers_believed,
    callers_marked,
    drawn_excess_paths,
    resolved,
)
from pipistrelle.figures.film import film_writer
from pipistrelle.figures.maps import (
    callers_shown,
    cells,
    draw_truth,
    head,
    legend,
    shades,
    view,
)
from pipistrelle.figures.outlines import PLACED, RAY, beam, ellipses, vehicle
from pipistrelle.figures.recorder import Snapshot, heard_from
from pipistrelle.figures.style import INK, STYLE, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

WIDTH, LEFT, RIGHT, TOP, BOTTOM, GAP, LINE = 3.66, 0.58, 0.12, 0.58, 0.54, 0.16, 0.19
"""Of a panel; margins, the space between panels and a line of the legend [inch]."""
DPI = 100
"""Pixels per inch."""
RINGED_PICTURES = 4
"""Pictures during which a landmark that has turned full is ringed."""


def animate_mission(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]],
    path: Path,
    *,
    truth: Truth = NO_TRUTH,
    callers: Sequence[Caller] = (),
    beamwidth: float | None = None,
    pictures: int = 125,
) -> None:
    """Write the film of a mission, one panel per strategy and filter, as GIF or MP4.

    A panel shows the path so far (true: grey), the vehicle with its beam, the frame's
    measurements (a range: solid to where it ends; a bearing alone: dashed), the rays (each member
    at one standard deviation, the heavier the darker; just pruned ones as dotted outlines) and the
    landmarks that are fully initialised in their 95 % ellipses, ringed when they have just become
    so. Particles, if there are any, are enlarged in a corner that follows the vehicle.

    Where excess paths were heard, those of the landmark that they place, weigh or have placed last
    are thin ellipses, two at most, about the vehicle and the caller, with the way of the sound and
    a dark dot where they cross. Callers are then marked where they are believed to be, too, as they
    are where there are several.

    `snapshots`: as a `MissionRecorder` keeps them. `path`: ends in .gif, or in .mp4, which needs
    ffmpeg. `callers`: without the vehicle; one that moves is drawn as its path and a star on it.
    `beamwidth` [rad]. `pictures`: at most so many frames are shown, evenly spaced, the last among
    them. Raises InputError where the path ends otherwise or cannot be written, or ffmpeg is
    missing or fails. Raises ValueError without a single frame.

    Bradley & Abaid, Sec. III-C, "ray of Gaussians", as it happens.

    Examples
    --------
    >>> animate_mission({}, Path("mission.gif"))
    Traceback (most recent call last):
    ValueError: an animation needs at least one frame
    """
    import matplotlib

    write = film_writer(path)
    if not any(snapshots.values()):
        raise ValueError("an animation needs at least one frame")
    with matplotlib.rc_context(STYLE):
        times = _times(snapshots, pictures)
        start = times[0] if truth.path is None else truth.time[0]
        figure, panels = _stage(snapshots, truth, callers, beamwidth)
        try:
            write(_play(figure, panels, times, start), path)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(
                f"{path}: cannot be written ({reason}); choose another place"
            ) from None


def _times(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]], pictures: int
) -> Float[np.ndarray, " p"]:
    """Choose the frames to show from the longest recording, evenly, the last one included."""
    frames = max(snapshots.values(), key=len)
    chosen = np.linspace(len(frames) - 1, 0, min(pictures, len(frames))).round().astype(int)[::-1]
    return np.array([frames[i].scan.time for i in chosen])


def _symbols(snapshots: Mapping[tuple[str, str], Sequence[Snapshot]]) -> list[str]:
    """Name what is heard and believed in any of the frames, in the order of the legend."""
    recorded = list(snapshots.values())
    frames = [frame for seen in recorded for frame in seen]
    ranged = [np.isfinite(heard_from(frame.scan).range) for frame in frames]
    full = [placed(frame.landmarks) for frame in frames]
    rays = any(not rows.all() for rows in full)
    drawn = {
        "range and bearing": any(rows.any() for rows in ranged),
        "bearing alone": any(not rows.all() for rows in ranged),
        "ray, 1σ, darker: likelier": rays,
        "just pruned": rays,
        "placed landmark, 95 %": any(rows.any() for rows in full),
        "excess-path ellipse and its way": any(
            set(resolved(seen)) - {UNLABELLED} for seen in recorded
        ),
        "caller as estimated": any(
            callers_marked([frame.scan for frame in seen])
            and any(np.isfinite(callers_at(frame).mean).any() for frame in seen)
            for seen in recorded
        ),
        "its estimated track": any(len(frame.moving.landmark) for frame in frames),
    }
    return [name for name, there in drawn.items() if there]


def _stage(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]],
    truth: Truth,
    callers: Sequence[Caller],
    beamwidth: float | None,
) -> tuple["Figure", list["_Panel"]]:
    """Draw what never moves and set up what does."""
    from matplotlib.figure import Figure

    paths = [np.array([frame.pose for frame in frames]) for frames in snapshots.values()]
    maps = [frames[-1].landmarks for frames in snapshots.values()]
    limits = view(truth, callers, paths, maps)
    (left, right), (bottom, top) = limits
    places = cells(list(snapshots))
    rows, columns = (1 + max(indices) for indices in zip(*places, strict=True))
    names = [*_symbols(snapshots), *sorted(callers_shown(callers))]
    foot = LINE * -(-len(names) // (2 * columns))
    high = TOP + WIDTH * (top - bottom) / (right - left) + BOTTOM
    size = np.array([LEFT + RIGHT + columns * (WIDTH + GAP) - GAP, rows * high + foot])
    width, height = 2.0 * np.ceil(size * DPI / 2.0) / DPI
    figure = Figure(figsize=(width, height), dpi=DPI)
    panels = []
    for (row, column), ((strategy, name), frames) in zip(places, snapshots.items(), strict=True):
        x, y = LEFT + column * (WIDTH + GAP), height - (row + 1) * high + BOTTOM
        box = (x / width, y / height, WIDTH / width, (high - TOP - BOTTOM) / height)
        axes = figure.add_axes(box)
        axes.set(xlim=limits[0], ylim=limits[1], aspect="equal", xlabel="x [m]")
        leftmost = (row, column - 1) not in places
        axes.set_ylabel("y [m]" if leftmost else "")
        axes.tick_params(labelleft=leftmost)
        axes.grid(True)
        axes.set_axisbelow(True)
        draw_truth(axes, truth.landmarks, callers)
        panels.append(_Panel(axes, head(axes, strategy, name), frames, strategy, truth))
        panels[-1].moving = [np.asarray(one.place) for one in callers if moves(one)]
        panels[-1].beamwidth = None if strategy == "passive" else beamwidth
    _enlarge(panels, truth.landmarks)
    legend(figure, names, 2 * columns, LEFT, RIGHT)
    return figure, panels


def _enlarge(panels: Sequence["_Panel"], true_landmarks: LabelledPoints | None) -> None:
    """Give each cloud of particles its window, on top of everything else."""
    clouds = [[f.cloud for f in panel.frames if f.cloud is not None] for panel in panels]
    ends = [panel.frames[-1].landmarks.mean for panel in panels]
    maps, colours, paths = zip(*((p.axes, p.colour, p.path) for p in panels), strict=True)
    closeups = add_closeups(maps, colours, clouds, paths, ends, true_landmarks)
    for panel, closeup in zip(panels, closeups, strict=True):
        if closeup:
            panel.closeup = closeup
            panel.artists += closeup.artists
            for artist in closeup.artists:
                artist.set_animated(True)


def _play(
    figure: "Figure", panels: Sequence["_Panel"], times: Float[np.ndarray, " p"], start: float
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the pictures: the background is drawn once, what moves on a copy of it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    place = (1.0 - RIGHT / figure.get_figwidth(), 1.0 - 0.14 / figure.get_figheight())
    clock = figure.text(*place, "", ha="right", va="top", fontsize=12, animated=True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for picture, time in enumerate(times):
        canvas.restore_region(background)
        for panel in panels:
            panel.show(time, picture)
        clock.set_text(f"{time - start:.1f} s")
        figure.draw_artist(clock)
        yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _followed(frames: Sequence[Snapshot]) -> list[Float[np.ndarray, "n 2"]]:
    """Return where each caller that moves was believed to be at every frame, NaN until placed."""
    labels = sorted({label for frame in frames for label in frame.moving.landmark.tolist()})
    return [
        np.array([callers_believed(frame.moving, np.array([label])).mean[0] for frame in frames])
        for label in labels
    ]


class _Panel:
    """The things that move on one map, and what has to be remembered of them."""

    def __init__(
        self,
        axes: "Axes",
        line: "Annotation",
        frames: Sequence[Snapshot],
        strategy: str,
        truth: Truth,
    ) -> None:
        self.axes, self.line, self.frames, self.truth = axes, line, frames, truth
        self.times = np.array([frame.scan.time for frame in frames])
        self.path = np.array([frame.pose for frame in frames])
        self.size = axes.get_xlim()[1] - axes.get_xlim()[0]
        self.colour = strategy_colour(strategy)
        self.beamwidth: float | None = None
        self.moving: list[Float[np.ndarray, "t 2"]] = []
        self.resolved = resolved(frames)
        self.marked = callers_marked([frame.scan for frame in frames])
        self.tracks = _followed(frames)
        self.rows, self.turned_full = frames[0].landmarks, {}
        self.artists: list[Artist] = []
        self.closeup: Closeup | None = None
        self._add_artists()

    def _add_artists(self) -> None:
        """Add every artist, empty; in the order in which they are drawn."""
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.lines import Line2D

        def keep(artist: Any) -> Any:
            artist.set_animated(True)
            self.artists.append(artist)
            return artist

        def areas(**style: Any) -> PolyCollection:
            return keep(self.axes.add_collection(PolyCollection([], **style)))

        def lines(**style: Any) -> LineCollection:
            return keep(self.axes.add_collection(LineCollection([], **style)))

        def points(*form: str, **style: Any) -> Line2D:
            return keep(self.axes.plot([], [], *form, **style)[0])

        colour = self.colour
        self.beam = areas(fc=INK, alpha=0.13, lw=0)
        self.members = areas(lw=0.8)
        self.pruned = areas(fc="none", ec=INK, lw=0.8, ls=":")
        self.true = points(color=TRUTH, lw=3.2, alpha=0.45)
        self.excess_paths = areas(fc="none", ec=INK, lw=0.9, alpha=0.7)
        self.ways = lines(colors=INK, lw=0.9, alpha=0.7)
        self.bearings = lines(colors=colour, lw=0.7, ls=(0, (4, 3)), alpha=0.6)
        self.ranges = lines(colors=colour, lw=1.4)
        self.full = areas(fc=shades(colour, np.full(1, 0.2)), ec=colour, lw=0.8)
        self.dots = points("o", ms=2.6, mfc=colour, mec="none")
        self.spot = points("o", ms=4.0, mfc=INK, mec="none")
        self.rings = areas(fc="none", lw=1.6)
        self.trails = lines(colors=colour, lw=1.2, ls=":")
        self.around = areas(fc=shades(colour, np.full(1, 0.2)), ec=colour, lw=0.8)
        self.movers = points("*", ms=12, mfc=INK, mec="white", mew=0.8)
        self.callers = points("*", ms=12, mfc="none", mec=colour, mew=1.1)
        self.estimated = points(color=colour, lw=1.2)
        self.vehicle = areas(fc=INK, ec="white", lw=0.8)
        keep(self.line)

    def show(self, time: float, picture: int) -> None:
        """Set every artist to the latest frame at a time and draw it."""
        now = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        frame = self.frames[now]
        self._show_vehicle(frame.pose, time, now)
        self._show_scan(frame)
        self._show_map(frame.landmarks, picture)
        self._show_excess_paths(frame, self.resolved[now])
        self._show_moving(frame.moving, now)
        for artist in self.artists:
            self.axes.draw_artist(artist)

    def _show_vehicle(self, pose: Float[np.ndarray, "3"], time: float, now: int) -> None:
        """Move the vehicle, its beam and both paths."""
        self.estimated.set_data(*self.path[: now + 1, :2].T)
        self.vehicle.set_verts([vehicle(pose, 0.055 * self.size)])
        if self.beamwidth is not None:
            self.beam.set_verts([beam(pose, self.beamwidth, 0.25 * self.size)])
        true = None
        if self.truth.path is not None:
            true = self.truth.path[self.truth.time <= time + 1e-9]
            self.true.set_data(*true[:, :2].T)
            there = [way[len(true) - 1] for way in self.moving if len(way) == len(self.truth.time)]
            self.movers.set_data(*np.reshape(there, (-1, 2)).T)
        cloud = self.frames[now].cloud
        if self.closeup and cloud is not None:
            self.closeup.show(cloud, self.path[: now + 1], true)

    def _show_scan(self, frame: Snapshot) -> None:
        """Point to what was heard: as far as its range, or out of the map without one."""
        scan, origin = heard_from(frame.scan), frame.pose[:2]
        angle, ranged = frame.pose[2] + scan.bearing, np.isfinite(scan.range)
        reach = np.where(ranged, scan.range, self.size)
        tip = origin + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        self.ranges.set_segments([np.stack([origin, end]) for end in tip[ranged]])
        self.bearings.set_segments([np.stack([origin, end]) for end in tip[~ranged]])

    def _show_excess_paths(self, frame: Snapshot, landmark: int) -> None:
        """Show a landmark's excess paths, and where callers are believed to be."""
        outlines, ways = drawn_excess_paths(frame, landmark)
        self.excess_paths.set_verts(outlines)
        self.ways.set_segments(ways)
        self.spot.set_data(*np.reshape([way[1] for way in ways[:1]], (-1, 2)).T)
        if self.marked:
            self.callers.set_data(*callers_at(frame).mean.T)

    def _show_moving(self, rows: Landmarks, now: int) -> None:
        """Show the tracks of callers that move, and how surely they are where they are now."""
        self.around.set(verts=ellipses(rows.mean, rows.covariance, PLACED))
        self.trails.set_segments([track[: now + 1] for track in self.tracks])

    def _show_map(self, rows: Landmarks, picture: int) -> None:
        """Show rays, what was pruned from them since the last picture, and full landmarks."""
        full = placed(rows)
        self.members.set(
            verts=ellipses(rows.mean[~full], rows.covariance[~full], RAY),
            facecolor=shades(self.colour, rows.weight[~full]),
            edgecolor=shades(self.colour, rows.weight[~full], most=1.0),
        )
        self.full.set(verts=ellipses(rows.mean[full], rows.covariance[full], PLACED))
        self.dots.set_data(*rows.mean[full].T)
        gone = pruned(self.rows, rows)
        outlines = ellipses(self.rows.mean[gone], self.rows.covariance[gone], RAY)
        self.pruned.set(verts=outlines)
        age = np.array(
            [
                picture - self.turned_full.setdefault(i, picture)
                for i in rows.landmark[full].tolist()
            ]
        )
        young = age < RINGED_PICTURES
        radius = 0.016 * self.size * (1.0 + 0.6 * age[young])
        circles = radius[:, None, None] ** 2 * np.eye(2)
        self.rings.set(
            verts=ellipses(rows.mean[full][young], circles, RAY),
            edgecolor=shades(self.colour, 1.0 - age[young] / RINGED_PICTURES, most=1.0),
        )
        rays = len(np.unique(rows.landmark[~full]))
        self.line.set_text(f"{np.sum(full)} placed · {rays} unresolved")
        self.rows = rows


def pruned(before: Landmarks, after: Landmarks) -> Bool[np.ndarray, " h"]:
    """Tell which rows of a map have no successor: none of the same landmark is nearest to them.

    Examples
    --------
    >>> from pipistrelle.estimation.beliefs import no_landmarks
    >>> def row(x):
    ...     point = {"mean": np.array([[x, 0.0]]), "covariance": np.eye(2)[None]}
    ...     return Landmarks(landmark=np.array([7]), weight=np.ones(1), **point)
    >>> pruned(row(1.0), row(1.5)), pruned(row(1.0), no_landmarks())
    (array([False]), array([ True]))
    """
    gone = np.ones(len(before.landmark), dtype=bool)
    if len(gone):
        away = np.linalg.norm(before.mean[:, None] - after.mean, axis=2)
        away[before.landmark[:, None] != after.landmark] = np.inf
        gone[np.argmin(away, axis=0)[np.isfinite(away.min(axis=0))]] = False
    return gone
