"""A mission as a film, frame by frame: measurements and beliefs, as GIF or MP4.

A `MissionRecorder` watches estimators while they run. `animate_mission` draws the fixed artists
once and the others on a copy of them, picture by picture.
"""

import contextlib
import itertools
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.figures.maps import (
    RAY,
    MapPanel,
    add_closeups,
    callers_shown,
    cells,
    draw_truth,
    ellipses,
    head,
    legend,
    shades,
    view,
)
from pipistrelle.figures.recorder import (
    Snapshot,
    callers_at,
    callers_believed,
    callers_marked,
    drawn_excess_paths,
    heard_from,
    pruned,
    resolved,
)
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation
    from PIL.Image import Image

WIDTH, LEFT, RIGHT, TOP, BOTTOM, GAP, LINE = 3.66, 0.58, 0.12, 0.58, 0.54, 0.16, 0.19
"""Width of a panel; margins, the space between panels and a line of the legend [inch]."""
DPI = 100
"""Pixels per inch."""
VEHICLE = 0.055
"""Length of the vehicle as a share of the map's width."""
RINGED_PICTURES = 4
"""Pictures in which a landmark is ringed after its initialisation."""
Pictures = Iterable[UInt8[np.ndarray, "h w 3"]]
"""Red, green and blue; all of one size, both sides even."""
RATE = 12.5
"""Pictures per second; a GIF counts in hundredths of a second."""
HOLD = 2.0
"""Time for which a GIF shows its last picture before it starts again [s]."""


def animate_mission(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]],
    path: Path,
    *,
    truth: Truth = NO_TRUTH,
    callers: Sequence[Caller] = (),
    beamwidth: float | None = None,
    pictures: int = 125,
) -> None:
    """Write the film of a mission, a panel per strategy and filter, as GIF or MP4.

    A panel shows the path so far (true: grey), the vehicle with its beam, the frame's measurements
    (a range: solid to its end; a bearing without range: dashed), the rays (each member at its
    standard deviation, the heavier the darker; just pruned ones as dotted outlines) and the fully
    initialised landmarks in their 95 % ellipses, ringed in their first pictures. Particles are
    enlarged in a corner that follows the vehicle.

    Excess paths are shown of the landmark that they initialise, weigh or have initialised last: at
    most two thin ellipses around vehicle and caller, with the way of the sound and a dark dot
    where they cross. The estimated positions of callers are then marked too, as with several
    callers.

    `snapshots`: of a `MissionRecorder`. `path`: ends in .gif, or in .mp4, which needs ffmpeg.
    `callers`: without the vehicle; a moving caller is its path and a star on it. `beamwidth`
    [rad]. `pictures`: at most so many frames are shown, evenly spaced, the last included. Raises
    InputError for another ending, if the path cannot be written, or if ffmpeg is missing or fails.
    Raises ValueError without frames.

    Bradley & Abaid, Sec. III-C, "ray of Gaussians", over time.

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
    """Return evenly spaced times of the longest recording, with the last."""
    frames = max(snapshots.values(), key=len)
    chosen = np.linspace(len(frames) - 1, 0, min(pictures, len(frames))).round().astype(int)[::-1]
    return np.array([frames[i].scan.time for i in chosen])


def _symbols(snapshots: Mapping[tuple[str, str], Sequence[Snapshot]]) -> list[str]:
    """Return the names of all symbols in any of the frames, in the order of the legend."""
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
    return [name for name, is_drawn in drawn.items() if is_drawn]


def _stage(
    snapshots: Mapping[tuple[str, str], Sequence[Snapshot]],
    truth: Truth,
    callers: Sequence[Caller],
    beamwidth: float | None,
) -> tuple["Figure", list["_FilmPanel"]]:
    """Return the figure with its fixed artists, and the panels with the animated ones."""
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
        line = head(axes, strategy, name)
        own_beam = None if strategy == "passive" else beamwidth
        panels.append(_FilmPanel(axes, line, frames, strategy, truth, callers, own_beam))
    clouds = [[f.cloud for f in frames if f.cloud is not None] for frames in snapshots.values()]
    add_closeups(panels, clouds, paths, [rows.mean for rows in maps], truth.landmarks)
    for panel in panels:
        for artist in panel.artists:
            artist.set_animated(True)
    legend(figure, names, 2 * columns, LEFT, RIGHT)
    return figure, panels


def _play(
    figure: "Figure", panels: Sequence["_FilmPanel"], times: Float[np.ndarray, " p"], start: float
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the pictures: the animated artists on copies of the background."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    place = (1.0 - RIGHT / figure.get_figwidth(), 1.0 - 0.14 / figure.get_figheight())
    clock = figure.text(*place, "", ha="right", va="top", fontsize=12, animated=True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for picture, time in enumerate(times):
        canvas.restore_region(background)
        for panel in panels:
            panel.show_frame(time, picture)
            for artist in panel.artists:
                panel.axes.draw_artist(artist)
        clock.set_text(f"{time - start:.1f} s")
        figure.draw_artist(clock)
        yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


class _FilmPanel(MapPanel):
    """A map with the measurements and the changes of each frame."""

    def __init__(
        self,
        axes: "Axes",
        line: "Annotation",
        frames: Sequence[Snapshot],
        strategy: str,
        truth: Truth,
        callers: Sequence[Caller],
        beamwidth: float | None,
    ) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        super().__init__(axes, strategy, VEHICLE, beamwidth)
        self.line, self.frames, self.truth = line, frames, truth
        self.times = np.array([frame.scan.time for frame in frames])
        self.path = np.array([frame.pose for frame in frames])
        self.resolved = resolved(frames)
        self.marked = callers_marked([frame.scan for frame in frames])
        labels = sorted({label for frame in frames for label in frame.moving.landmark.tolist()})
        self.tracks = [
            np.array([callers_believed(frame.moving, np.array([n])).mean[0] for frame in frames])
            for n in labels
        ]
        paths = [np.asarray(caller.place) for caller in callers if moves(caller)]
        self.moving = [path for path in paths if len(path) == len(truth.time)]
        self.rows, self.first_picture = frames[0].landmarks, {}
        star: dict[str, Any] = {"ms": 12, "mfc": INK, "mec": "white", "mew": 0.8}
        self.pruned = PolyCollection([], fc="none", ec=INK, lw=0.8, ls=":")
        dashed = {"lw": 0.7, "ls": (0, (4, 3)), "alpha": 0.6}
        self.bearings = LineCollection([], colors=self.colour, **dashed)
        self.ranges = LineCollection([], colors=self.colour, lw=1.4)
        self.rings = PolyCollection([], fc="none", lw=1.6)
        for artist in (self.pruned, self.bearings, self.ranges, self.rings):
            axes.add_collection(artist, autolim=False)
        self.crossing = axes.plot([], [], "o", ms=4.0, mfc=INK, mec="none")[0]
        self.movers = axes.plot([], [], "*", **star)[0]

    @property
    def artists(self) -> "list[Artist]":
        """The animated artists, from back to front."""
        window = self.closeup.artists if self.closeup else ()
        lit = () if self.beamwidth is None else (self.beam,)
        return [
            *lit, self.members, self.pruned, self.true, self.excess_paths, self.ways,
            self.bearings, self.ranges, self.full, self.dots, self.crossing, self.rings,
            self.trails, self.around, self.movers, self.callers, self.estimated, self.vehicle,
            self.line, *window,
        ]  # fmt: skip

    def show_frame(self, time: float, picture: int) -> None:
        """Show the latest frame at a time."""
        now = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        frame, true = self.frames[now], None
        if self.truth.path is not None:
            true = self.truth.path[self.truth.time <= time + 1e-9]
            positions = [path[len(true) - 1] for path in self.moving]
            self.movers.set_data(*np.reshape(positions, (-1, 2)).T)
        outlines, ways = drawn_excess_paths(frame, self.resolved[now])
        self.show(
            self.path[: now + 1],
            frame.landmarks,
            true_path=true,
            cloud=frame.cloud,
            excess_paths=(outlines, ways),
            callers=callers_at(frame).mean if self.marked else None,
            moving=frame.moving,
            trails=[track[: now + 1] for track in self.tracks],
        )
        self.crossing.set_data(*np.reshape([way[1] for way in ways[:1]], (-1, 2)).T)
        self._show_scan(frame)
        self._show_changes(frame.landmarks, picture)

    def _show_scan(self, frame: Snapshot) -> None:
        """Show ranges as lines of their length, bearings without range as lines out of the map."""
        scan, origin = heard_from(frame.scan), frame.pose[:2]
        angle, ranged = frame.pose[2] + scan.bearing, np.isfinite(scan.range)
        reach = np.where(ranged, scan.range, self.size)
        tip = origin + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        self.ranges.set_segments([np.stack([origin, end]) for end in tip[ranged]])
        self.bearings.set_segments([np.stack([origin, end]) for end in tip[~ranged]])

    def _show_changes(self, rows: Landmarks, picture: int) -> None:
        """Show members pruned since the last picture, and rings around new landmarks."""
        full, gone = placed(rows), pruned(self.rows, rows)
        self.pruned.set(verts=ellipses(self.rows.mean[gone], self.rows.covariance[gone], RAY))
        labels = rows.landmark[full].tolist()
        age = np.array([picture - self.first_picture.setdefault(n, picture) for n in labels])
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


def film_writer(path: Path) -> Callable[[Pictures, Path], None]:
    """Return the writer of a film by the ending of its name.

    `path`: ends in .gif or .mp4. Raises InputError for another ending, or for an MP4 without
    ffmpeg.

    Examples
    --------
    >>> film_writer(Path("mission.gif")).__name__
    'write_gif'
    """
    ending = path.suffix.lower()
    if ending == ".gif":
        return write_gif
    if ending != ".mp4":
        raise InputError(
            f"{path}: found the ending {ending!r}, expected .gif or .mp4; "
            f"choose {path.with_suffix('.gif').name}"
        )
    if shutil.which("ffmpeg") is None:
        raise InputError(
            f"{path}: found no ffmpeg on the PATH, which .mp4 needs; "
            f"install ffmpeg or choose {path.with_suffix('.gif').name}"
        )
    return write_mp4


def write_gif(pictures: Pictures, path: Path) -> None:
    """Write a GIF that repeats after `HOLD` seconds, in a fixed palette against flicker.

    `pictures`: at least one.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "grey.gif"
    >>> write_gif([np.full((4, 4, 3), level, np.uint8) for level in (0, 99)], path)
    >>> path.read_bytes()[:6]
    b'GIF89a'
    """
    from PIL import Image

    palette = _palette()
    first, *others = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    duration = [round(1000.0 / RATE)] * len(others) + [round(1000.0 * HOLD)]
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)


def write_mp4(pictures: Pictures, path: Path) -> None:
    """Write an MP4 (H.264) through ffmpeg.

    `pictures`: h and w even. Raises InputError with the message of ffmpeg if it fails, ValueError
    without pictures.

    Examples
    --------
    >>> write_mp4([], Path("mission.mp4"))
    Traceback (most recent call last):
    ValueError: a film needs at least one picture
    """
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a film needs at least one picture")
    path.parent.mkdir(parents=True, exist_ok=True)
    command = _ffmpeg(first.shape[1], first.shape[0], path)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin
        with contextlib.suppress(BrokenPipeError):
            for picture in itertools.chain([first], pictures):
                ffmpeg.stdin.write(picture.tobytes())
        reason = ffmpeg.communicate()[1].decode(errors="replace").strip().splitlines()[:1]
    if ffmpeg.returncode:
        raise InputError(
            f"{path}: ffmpeg ended with status {ffmpeg.returncode} "
            f"({reason[0] if reason else 'no reason given'}); "
            f"mend that or choose {path.with_suffix('.gif').name}"
        )


def _ffmpeg(width: int, height: int, path: Path) -> list[str]:
    """Return the command that converts raw pictures on its input to an MP4."""
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {RATE} -i -"
    target = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart"
    return ["ffmpeg", "-y", "-loglevel", "error", *source.split(), *target.split(), str(path)]


def _palette() -> "Image":
    """Return the palette: the strategies' colours with gradients to white, to ink and between them.

    Pillow compares colours by their upper six bits: steps towards white are wide enough to keep
    white.
    """
    from matplotlib.colors import to_rgb
    from PIL import Image

    white, ink = np.ones(3), np.array(to_rgb(INK))
    inks = [np.array(to_rgb(colour)) for colour in STRATEGY_COLOURS.values()]
    ramps = [(white, end, 16) for end in (ink, *inks)]
    ramps += [(colour, ink, 6) for colour in inks]
    ramps += [(one, other, 6) for one, other in itertools.pairwise(inks)]
    steps = [a + (b - a) * np.linspace(0.0, 1.0, n)[:, None] for a, b, n in ramps]
    colours = np.rint(255.0 * np.concatenate(steps)).astype(np.uint8)
    image = Image.new("P", (1, 1))
    image.putpalette(colours.tobytes())
    return image
