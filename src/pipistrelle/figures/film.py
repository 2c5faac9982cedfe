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
from pipistrelle.estimation.beliefs import placed
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.figures.maps import RAY, RIGHT, MapPanel, draw_maps, ellipses, shades
from pipistrelle.figures.recorder import Snapshot, heard_from, pruned
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE
from pipistrelle.refusals import refusal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

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
    """Write a film of a mission as GIF or MP4, with a panel per strategy and filter.

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
    longest = max(snapshots.values(), key=len)
    # Evenly spaced from the last frame backwards.
    chosen = np.linspace(len(longest) - 1, 0, min(pictures, len(longest))).round().astype(int)
    times = np.array([longest[i].scan.time for i in chosen[::-1]])
    start = times[0] if truth.path is None else truth.time[0]
    panels = [FilmPanel(*one, beamwidth, truth, callers) for one in snapshots.items()]
    with matplotlib.rc_context(STYLE):
        figure, _ = draw_maps(panels, truth, callers)
        try:
            write(_play(figure, panels, times, start), path)
        except OSError as error:
            why = f"cannot be written ({error.strerror or error}); choose another place"
            raise InputError(f"{path}: {why}") from None


def _play(
    figure: "Figure", panels: Sequence["FilmPanel"], times: Float[np.ndarray, " p"], start: float
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the pictures of a film as RGB arrays; only artists that change are drawn again."""
    from matplotlib.artist import Artist
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(100)
    canvas = FigureCanvasAgg(figure)
    place = (1.0 - RIGHT / figure.get_figwidth(), 1.0 - 0.14 / figure.get_figheight())
    clock = figure.text(*place, "", ha="right", va="top", fontsize=12, animated=True)
    for panel in panels:
        panel.artists.append(panel.line)
        for artist in panel.artists:
            artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for picture, time in enumerate(times):
        canvas.restore_region(background)
        for panel in panels:
            panel.show_picture(picture, time)
            for artist in sorted(panel.artists, key=Artist.get_zorder):
                panel.axes.draw_artist(artist)
        clock.set_text(f"{time - start:.1f} s")
        figure.draw_artist(clock)
        drawn = np.asarray(canvas.buffer_rgba())
        high, wide = (side // 2 * 2 for side in drawn.shape[:2])
        yield drawn[:high, :wide, :3].copy()


class FilmPanel(MapPanel):
    """A map of an estimate in a film, with the measurements and changes of each frame."""

    def __init__(
        self,
        case: tuple[str, str],
        frames: Sequence[Snapshot],
        beamwidth: float | None,
        truth: Truth,
        callers: Sequence[Caller],
    ) -> None:
        super().__init__(case, frames, beamwidth)
        self.times = np.array([frame.scan.time for frame in frames])
        paths = [np.asarray(caller.place) for caller in callers if moves(caller)]
        self.moving = [path for path in paths if len(path) == len(truth.time)]
        self.truth, self.rows, self.first_picture = truth, frames[0].landmarks, {}

    def symbols(self) -> set[str]:
        """Return the names of the legend symbols that occur in any frame."""
        ranged = [np.isfinite(heard_from(frame.scan).range) for frame in self.frames]
        drawn = {
            "range and bearing": any(rows.any() for rows in ranged),
            "bearing without range": any(not rows.all() for rows in ranged),
            "just pruned": any(not placed(frame.landmarks).all() for frame in self.frames),
        }
        return super().symbols() | {name for name, is_drawn in drawn.items() if is_drawn}

    def draw_on(self, axes: "Axes") -> None:
        """Add the artists of map and measurements to axes, empty until a frame is shown."""
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.lines import Line2D

        super().draw_on(axes)
        star = {"marker": "*", "ms": 12, "mfc": INK, "mec": "white", "mew": 0.8}
        dashed = {"lw": 0.7, "ls": (0, (4, 3)), "alpha": 0.6, "zorder": 3.6}
        self.pruned = self.add(PolyCollection([], fc="none", ec=INK, lw=0.8, ls=":", zorder=1.9))
        self.bearings = self.add(LineCollection([], colors=self.colour, **dashed))
        self.ranges = self.add(LineCollection([], colors=self.colour, lw=1.4, zorder=3.6))
        dot: dict[str, Any] = {"marker": "o", "ms": 4.0, "mfc": INK, "mec": "none"}
        self.crossing = self.add(Line2D([], [], ls="", zorder=5.2, **dot))
        self.rings = self.add(PolyCollection([], fc="none", lw=1.6, zorder=5.3))
        self.movers = self.add(Line2D([], [], ls="", zorder=5.4, **star))

    def show_picture(self, picture: int, time: float) -> None:
        """Show the latest frame at a time [s], and the changes since the last picture."""
        now = max(int(np.searchsorted(self.times, time, side="right")) - 1, 0)
        frame, true_path = self.frames[now], None
        if self.truth.path is not None:
            true_path = self.truth.path[self.truth.time <= time + 1e-9]
            positions = [path[len(true_path) - 1] for path in self.moving]
            self.movers.set_data(*np.reshape(positions, (-1, 2)).T)
        tracks = [track[: now + 1] for track in self.tracks]
        self.show(now, self.path[: now + 1], true_path, tracks)
        crossings = [way[1] for way in self.ways.get_segments()[:1]]
        self.crossing.set_data(*np.reshape(crossings, (-1, 2)).T)
        scan, origin = heard_from(frame.scan), frame.pose[:2]
        angle, ranged = frame.pose[2] + scan.bearing, np.isfinite(scan.range)
        reach = np.where(ranged, scan.range, self.size)
        tip = origin + reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        self.ranges.set_segments([np.stack([origin, end]) for end in tip[ranged]])
        self.bearings.set_segments([np.stack([origin, end]) for end in tip[~ranged]])
        rows = frame.landmarks
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
    """Return the function that writes a film, chosen by the file's ending .gif or .mp4.

    Raises InputError for another ending, or for an MP4 without ffmpeg.
    """
    ending, gif = path.suffix.lower(), path.with_suffix(".gif").name
    if ending == ".gif":
        return write_gif
    if ending != ".mp4":
        raise refusal(path, f"the ending {ending!r}", ".gif or .mp4", f"choose {gif}")
    if shutil.which("ffmpeg") is None:
        missing = "found no ffmpeg on the PATH, which .mp4 needs"
        raise InputError(f"{path}: {missing}; install ffmpeg or choose {gif}")
    return write_mp4


def write_gif(pictures: Pictures, path: Path) -> None:
    """Write pictures as a GIF that repeats after `HOLD` seconds, with a palette without flicker."""
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
    """Write pictures as an MP4 (H.264) by ffmpeg; raise InputError with its message on failure."""
    pictures = iter(pictures)
    first = next(pictures)
    height, width, _ = first.shape
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {RATE} -i -"
    target = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart"
    command = ["ffmpeg", "-y", "-loglevel", "error", *source.split(), *target.split(), str(path)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin
        with contextlib.suppress(BrokenPipeError):
            for picture in itertools.chain([first], pictures):
                ffmpeg.stdin.write(picture.tobytes())
        reason = ffmpeg.communicate()[1].decode(errors="replace").strip().splitlines()[:1]
    if ffmpeg.returncode:
        ended = f"status {ffmpeg.returncode} ({[*reason, 'no reason given'][0]})"
        fix = f"mend that or choose {path.with_suffix('.gif').name}"
        raise InputError(f"{path}: ffmpeg ended with {ended}; {fix}")


def _palette() -> "Image":
    """Return a GIF's palette: the strategies' colours, with gradients to white, ink and each other.

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
