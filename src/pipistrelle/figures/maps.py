"""The map of an estimate: outlines, limits, the true world, the estimate, particles, the legend.

A figure of maps is laid out by `draw_maps`. A `MapPanel` holds the frames of an estimate and the
artists that show a frame; `mission` shows the last frame, `film` a frame per picture.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Landmarks, joined, placed, some_of
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.figures.recorder import (
    Snapshot,
    callers_at,
    callers_marked,
    excess_paths_at,
    likeliest,
    resolved,
)
from pipistrelle.figures.style import INK, MAX_COLUMNS, TRUTH, picture, strategy_colour

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

PLACED = 0.95
"""Probability inside the ellipse of a landmark that is fully initialised."""
RAY = 0.3935
"""Probability inside the ellipse of a ray's member: one standard deviation."""
MIN_REACH = 0.05
"""Least reach of a window [m], for particles that coincide."""
PATH_POSES = 60
"""Number of poses of a path in a window."""
NOWHERE = np.array([[np.nan, np.nan]])
"""A point that is not drawn."""
LEFT, RIGHT, GAP = 0.76, 0.16, 0.2
"""Margins of a figure and the space between its columns [inch]."""
TITLE, LABEL, LEGEND = 0.58, 0.42, 0.28
"""Heights of a panel's title and of its lowest label, and of a line of the legend [inch]."""
VEHICLE = 0.045
"""Length of the vehicle as a share of the map's width."""
TIED = "placed landmark, 95 %, and its error"


def ellipses(
    mean: Float[np.ndarray, "h 2"], covariance: Float[np.ndarray, "h 2 2"], probability: float
) -> Float[np.ndarray, "h 49 2"]:
    r"""Return for each Gaussian the outline of the ellipse that contains a given probability.

    .. math:: (x - \mu)^T P^{-1} (x - \mu) = -2 \ln(1 - p)

    The unit circle goes through the symmetric square root of P, which for 2 by 2 is
    (P + s I) / sqrt(tr P + 2 s), s = sqrt(det P). A covariance that is not finite gives an outline
    that is not.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.sqrt(-2.0 * np.log1p(-probability)) * np.stack([np.cos(angle), np.sin(angle)])
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    s = np.sqrt(np.maximum(a * c - b * b, 0.0))
    trace = np.maximum(a + c + 2.0 * s, np.finfo(np.float64).tiny)
    root = (covariance + s[:, None, None] * np.eye(2)) / np.sqrt(trace)[:, None, None]
    return mean[:, None, :] + np.swapaxes(root @ circle, 1, 2)


def beam(pose: Float[np.ndarray, "3"], beamwidth: float, length: float) -> Float[np.ndarray, "n 2"]:
    """Return the outline of the vehicle's beam: a sector of a circle with its tip at the vehicle.

    Half-power beamwidth of Bradley & Abaid, Eq. (1).
    """
    angle = pose[2] + np.linspace(-0.5, 0.5, 41) * beamwidth
    arc = pose[:2] + length * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([pose[:2], arc])


def vehicle(pose: Float[np.ndarray, "3"], length: float) -> Float[np.ndarray, "4 2"]:
    """Return the outline of the vehicle's symbol: a dart along its heading, the tip first."""
    shape = length * np.array([[0.58, 0.0], [-0.42, 0.36], [-0.2, 0.0], [-0.42, -0.36]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + shape @ np.array([[cos, sin], [-sin, cos]])


def excess_path_ellipse(
    vehicle: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"], excess_path: float
) -> Float[np.ndarray, "121 2"]:
    r"""Return the ellipse of all points with a given excess path; its foci are vehicle and caller.

    .. math:: |b - l| + |l - p| = d + e, \qquad d = |b - p|

    Its half axes are :math:`(d + e)/2` and :math:`\sqrt{(d + e)^2 - d^2}/2`.
    """
    across = caller - vehicle
    straight = np.hypot(*across)
    long = 0.5 * (straight + excess_path)
    short = np.sqrt(np.maximum(long**2 - 0.25 * straight**2, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    c, s = across / straight if straight > 0.0 else np.array([1.0, 0.0])
    x, y = long * np.cos(angle), short * np.sin(angle)
    return 0.5 * (vehicle + caller) + np.column_stack([c * x - s * y, s * x + c * y])


def shades(
    colour: str, weight: Float[np.ndarray, " h"], *, least: float = 0.05, most: float = 0.5
) -> Float[np.ndarray, "h 4"]:
    """Return an RGBA colour for each weight; the larger the weight, the more opaque."""
    from matplotlib.colors import to_rgba

    rgba = np.tile(to_rgba(colour), (len(weight), 1))
    rgba[:, 3] = least + (most - least) * np.clip(weight, 0.0, 1.0)
    return rgba


@np.errstate(over="ignore", invalid="ignore")
def view(
    truth: Truth,
    callers: Sequence[Caller],
    paths: Sequence[Float[np.ndarray, "_ 3"]],
    maps: Sequence[Landmarks],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return x and y limits [m] of a map that shows the truth or, without it, the estimates.

    Ellipses of landmarks and of rays widen the map by at most a quarter to each side; of rays only
    the ellipses count, not the means. The map is at most twice as wide as high, and at most 1.2
    times as high as wide. `callers`: without the vehicle; `paths` [m, m, rad].
    """

    def readable(half: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        return np.maximum(half, half[::-1] / np.array([1.2, 2.0]))

    points = paths if truth.path is None else [truth.path]
    marks = [rows.mean[placed(rows)] for rows in maps]
    marks = marks if truth.landmarks is None else [truth.landmarks[1]]
    marks += [np.reshape(np.asarray(caller.place), (-1, 2)) for caller in callers]
    shown = np.concatenate([*(poses[:, :2] for poses in points), *marks])
    shown = shown[np.isfinite(shown).all(axis=1)]
    shown = shown if len(shown) else np.zeros((1, 2))
    low, high = shown.min(axis=0), shown.max(axis=0)
    centre, half = (low + high) / 2.0, 1.12 * readable(np.maximum((high - low) / 2.0, 0.5))
    corners = [centre - half, centre + half]
    for rows in maps:
        full, near = placed(rows), np.all(np.abs(rows.mean - centre) < 1.5 * half, axis=1)
        for some, size in ((near & full, PLACED), (near & ~full, RAY)):
            outlines = ellipses(rows.mean[some], rows.covariance[some], size).reshape(-1, 2)
            outlines = outlines[np.isfinite(outlines).all(axis=1)]
            corners.extend(np.clip(outlines, centre - 1.5 * half, centre + 1.5 * half))
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    centre, half = (low + high) / 2.0, readable((high - low) / 2.0)
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


def drawn_excess_paths(
    frame: Snapshot, label: int
) -> tuple[list[Float[np.ndarray, "121 2"]], list[Float[np.ndarray, "3 2"]]]:
    """Return at most two excess-path ellipses of a landmark, and the sound path of each [m].

    A sound path leads from the caller by way of the likeliest member to the vehicle.
    """
    outlines, ways = [], []
    for row in excess_paths_at(frame).get(label, []):
        spot, caller = likeliest(frame, label), callers_at(frame).mean[frame.scan.caller[row]]
        excess_path = float(frame.scan.excess_path[row])
        outlines.append(excess_path_ellipse(frame.pose[:2], caller, excess_path))
        ways.append(np.stack([caller, spot, frame.pose[:2]]))
    return outlines, ways


def draw_truth(
    axes: "Axes", true_landmarks: LabelledPoints | None, callers: Sequence[Caller]
) -> None:
    """Draw true landmarks as open circles, fixed callers as stars and moving callers as paths.

    Callers have labels, except a single beacon. `true_landmarks` [m]: callers may be among them.
    `callers`: without the vehicle.
    """
    if true_landmarks is not None:
        x, y = true_landmarks[1].T
        axes.plot(x, y, "o", ms=5.0, mfc="none", mec=TRUTH, mew=0.8, zorder=3)
    named = "caller" in callers_shown(callers)
    style: dict[str, Any] = {"xytext": (6, 5), "textcoords": "offset points", "fontsize": 8}
    for caller in callers:
        place = np.asarray(caller.place)
        if moves(caller):
            axes.plot(*place.reshape(-1, 2).T, color=INK, lw=1.0, ls="-.", zorder=3.4)
        else:
            axes.plot(*place, "*", ms=12, mfc=INK, mec="white", mew=0.8, zorder=3.5)
        if named or moves(caller):
            end = place.reshape(-1, 2)[-1]
            axes.annotate(caller.name, end, parse_math=False, color=INK, zorder=7, **style)


def callers_shown(callers: Sequence[Caller]) -> set[str]:
    """Return the names of the legend symbols that a map needs for its callers."""
    standing = [caller.name for caller in callers if not moves(caller)]
    star = "beacon" if standing == ["beacon"] else "caller"
    return {"moving caller" if moves(caller) else star for caller in callers}


def cells(cases: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """Return the grid position of each panel: a column per strategy, a row per filter.

    More filters than strategies are in columns. A single strategy or filter, or more than
    `MAX_COLUMNS` strategies, fill row after row, four panels two by two.
    """
    strategies, filters = (list(dict.fromkeys(names)) for names in zip(*cases, strict=True))
    if 1 < len(strategies) <= MAX_COLUMNS and len(filters) > 1:
        places = [(filters.index(name), strategies.index(strategy)) for strategy, name in cases]
        return [place[::-1] for place in places] if len(filters) > len(strategies) else places
    return [divmod(i, 2 if len(cases) == 4 else MAX_COLUMNS) for i in range(len(cases))]


def head(axes: "Axes", strategy: str, estimator: str, name: str = "") -> "Annotation":
    """Write strategy and estimator above a panel; return the empty text line below them."""
    above: dict[str, Any] = {"xy": (0, 1), "xycoords": "axes fraction"}
    above["textcoords"] = "offset points"
    style = {"color": strategy_colour(strategy), "fontsize": 13, "weight": "bold"}
    first = axes.annotate(name or strategy, xytext=(0, 21), **style, **above)
    beside = above | {"xy": (1, 0), "xycoords": first, "va": "bottom"}
    axes.annotate(title_of(estimator), xytext=(6, 0), fontsize=13, parse_math=False, **beside)
    return axes.annotate("", xytext=(0, 7), fontsize=9.5, **above)


class MapPanel:
    """A map panel: the snapshots of an estimate at its frames, and the artists that show them.

    `case`: strategy and filter. `frames`: not empty. `beamwidth` [rad]: None for no beam; a
    passive strategy has none.
    """

    line: "Annotation"
    """The text below the panel's title."""

    def __init__(
        self, case: tuple[str, str], frames: Sequence[Snapshot], beamwidth: float | None
    ) -> None:
        self.case, self.frames, self.colour = case, frames, strategy_colour(case[0])
        self.beamwidth = None if case[0] == "passive" else beamwidth
        self.path = np.array([frame.pose for frame in frames])
        self.resolved = resolved(frames)
        self.marked = callers_marked([frame.scan for frame in frames])
        self.tracks = [
            np.array(
                [np.vstack([f.moving.mean[f.moving.landmark == n], NOWHERE])[0] for f in frames]
            )
            for n in np.unique([label for frame in frames for label in frame.moving.landmark])
        ]
        self.artists: list[Artist] = []
        """All artists that `show` changes."""
        self.closeup: Closeup | None = None

    def symbols(self) -> set[str]:
        """Return the names of the legend symbols that occur in any frame."""
        full = [placed(frame.landmarks) for frame in self.frames]
        drawn = {
            "placed landmark, 95 %": any(rows.any() for rows in full),
            "unresolved ray, 1σ, darker: likelier": any(not rows.all() for rows in full),
            "caller as estimated": any(len(self._stars(frame)) for frame in self.frames),
            "its estimated track": bool(self.tracks),
            "excess-path ellipse, sound path": bool(set(self.resolved) - {UNLABELLED}),
        }
        return {name for name, is_drawn in drawn.items() if is_drawn}

    def _stars(self, frame: Snapshot) -> Float[np.ndarray, "c 2"]:
        """Return the estimated positions [m] of callers to mark with stars at a frame."""
        mean = callers_at(frame).mean if self.marked else frame.moving.mean
        return mean[np.isfinite(mean).all(axis=1)]

    def add(self, artist: "Artist") -> Any:
        """Add an artist to the map and to the list of artists that `show` changes."""
        self.artists.append(artist)
        return self.axes.add_artist(artist)

    def draw_on(self, axes: "Axes") -> None:
        """Add this estimate's artists to the axes of a map, empty until a frame is shown."""
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.lines import Line2D
        from matplotlib.patches import Polygon

        self.axes = axes
        self.size = axes.get_xlim()[1] - axes.get_xlim()[0]
        colour, add = self.colour, self.add
        star: dict[str, Any] = {"marker": "*", "ms": 12, "mfc": "none", "mec": colour, "mew": 1.1}
        filled = {"fc": shades(colour, np.full(1, 0.2)), "ec": colour, "lw": 0.8}
        thin: dict[str, Any] = {"lw": 0.9, "alpha": 0.7, "zorder": 3.5}
        self.members = add(PolyCollection([], lw=0.8, zorder=1.0))
        if self.beamwidth is not None:
            self.beam = add(Polygon(NOWHERE, fc=INK, alpha=0.13, lw=0, zorder=1.8))
        self.true = add(Line2D([], [], color=TRUTH, lw=3.2, alpha=0.45, zorder=2.0))
        self.excess_paths = add(PolyCollection([], fc="none", ec=INK, **thin))
        self.ways = add(LineCollection([], colors=INK, **thin))
        self.full = add(PolyCollection([], zorder=4.0, **filled))
        dot: dict[str, Any] = {"marker": "o", "ms": 2.6, "mfc": colour, "mec": "none"}
        self.dots = add(Line2D([], [], ls="", zorder=5.0, **dot))
        self.trails = add(Line2D([], [], color=colour, lw=1.2, ls=":", zorder=5.5))
        self.callers = add(Line2D([], [], ls="", zorder=5.5, **star))
        self.estimated = add(Line2D([], [], color=colour, lw=1.2, zorder=6.0))
        self.vehicle = add(Polygon(NOWHERE, fc=INK, ec="white", lw=0.8, zorder=8.0))

    def show(
        self,
        now: int,
        path: Float[np.ndarray, "k 3"],
        true_path: Float[np.ndarray, "t 3"] | None,
        trails: Sequence[Float[np.ndarray, "_ 2"]],
    ) -> None:
        """Show a frame on the map: paths so far, landmarks, and callers' tracks so far [m]."""
        frame = self.frames[now]
        rows, full = frame.landmarks, placed(frame.landmarks)
        self.estimated.set_data(*path[:, :2].T)
        self.vehicle.set_xy(vehicle(path[-1], VEHICLE * self.size))
        if self.beamwidth is not None:
            self.beam.set_xy(beam(path[-1], self.beamwidth, 0.25 * self.size))
        if true_path is not None:
            self.true.set_data(*true_path[:, :2].T)
        if self.closeup and frame.cloud is not None:
            self.closeup.show(frame.cloud, path, true_path)
        self.members.set(
            verts=ellipses(rows.mean[~full], rows.covariance[~full], RAY),
            facecolor=shades(self.colour, rows.weight[~full]),
            edgecolor=shades(self.colour, rows.weight[~full], most=1.0),
        )
        areas = joined(some_of(rows, full), frame.moving)
        self.full.set(verts=ellipses(areas.mean, areas.covariance, PLACED))
        self.dots.set_data(*rows.mean[full].T)
        outlines, ways = drawn_excess_paths(frame, self.resolved[now])
        self.excess_paths.set_verts(outlines)
        self.ways.set_segments(ways)
        self.callers.set_data(*self._stars(frame).T)
        lines = [part for trail in trails for part in (NOWHERE, trail)]
        self.trails.set_data(*np.concatenate([np.empty((0, 2)), *lines[1:]]).T)


class Closeup:
    """The particles on a map, also enlarged in an inset that follows the vehicle.

    The inset shows particles as translucent darts, the estimated pose as an outline, the last part
    of the estimated path, and the true path and pose in grey. `box`: in shares of the map.
    `reach` [m]: half the window's side.
    """

    def __init__(
        self, panel: MapPanel, box: tuple[float, float, float, float], reach: float, particles: int
    ) -> None:
        from matplotlib.collections import PolyCollection
        from matplotlib.lines import Line2D

        dots: dict[str, Any] = {"marker": "o", "ms": 1.6, "mfc": panel.colour, "mec": "none"}
        self._reach, (x, y, width, height) = reach, box
        self._middle = np.array([x + width / 2.0, y + height / 2.0])
        self._map = panel.axes
        self.dots = panel.add(Line2D([], [], ls="", alpha=0.3, zorder=8.5, **dots))
        self.leader = panel.add(Line2D([], [], color=INK, lw=0.6, alpha=0.5, zorder=8.6))
        self.window = window = panel.axes.inset_axes(box, zorder=9)
        panel.artists.append(window)
        window.set(xticks=[], yticks=[])
        for spine in window.spines.values():
            spine.set(visible=True, color=INK, linewidth=0.6)
        self.true = window.plot([], [], color=TRUTH, lw=3.2, alpha=0.45)[0]
        self.path = window.plot([], [], color=panel.colour, lw=1.2)[0]
        self.darts = PolyCollection([], fc=panel.colour, alpha=0.2, lw=0, zorder=3)
        self.vehicles = PolyCollection([], fc=["none", TRUTH], ec=[INK, "white"], lw=0.8, zorder=4)
        for darts in (self.darts, self.vehicles):
            window.add_collection(darts, autolim=False)
        decade = 10.0 ** np.floor(np.log10(reach))
        bar = next(float(n * decade) for n in (5, 2, 1) if n * decade <= reach)
        style: dict[str, Any] = {"transform": window.transAxes, "zorder": 5}
        ends = [0.06, 0.06 + bar / (2.0 * reach)]
        window.plot(ends, [0.07, 0.07], color=INK, lw=1.4, **style)
        window.text(0.06, 0.1, f"{bar:g} m", fontsize=7, va="bottom", **style)
        title = f"{particles} particle{'s' if particles != 1 else ''}"
        wide = 72.0 * width * panel.axes.bbox.width / window.figure.dpi
        size = min(7.0, wide / (0.6 * len(title)))
        window.text(0.06, 0.95, title, fontsize=size, va="top", **style)

    def show(
        self,
        cloud: Float[np.ndarray, "p 3"],
        path: Float[np.ndarray, "k 3"],
        true_path: Float[np.ndarray, "t 3"] | None,
    ) -> None:
        """Show the particles and the last part of the paths around the estimated pose."""
        cloud, pose = cloud[np.isfinite(cloud).all(axis=1)], path[-1]
        if not np.isfinite(pose).all():
            return
        self.dots.set_data(*cloud[:, :2].T)
        corner = self._map.transLimits.inverted().transform(self._middle)
        self.leader.set_data(*np.stack([pose[:2], corner]).T)
        for axis, middle in zip("xy", pose, strict=False):
            self.window.set(**{f"{axis}lim": (middle - self._reach, middle + self._reach)})
        self.path.set_data(*path[-PATH_POSES:, :2].T)
        self.darts.set_verts([vehicle(particle, 0.24 * self._reach) for particle in cloud])
        true = path[:0] if true_path is None else true_path[-PATH_POSES:]
        self.true.set_data(*true[:, :2].T)
        seen = [pose, *(last for last in true[-1:] if np.isfinite(last).all())]
        self.vehicles.set_verts([vehicle(dart, 0.34 * self._reach) for dart in seen])


def add_closeups(panels: Sequence[MapPanel], true_landmarks: LabelledPoints | None) -> None:
    """Add to each panel with particles an inset that enlarges them, with common scale and corner.

    `panels`: of common limits. The ends of the paths are not covered; landmarks, the true ones [m]
    and the rest of the paths are not covered if possible.
    """
    clouds = [[f.cloud for f in p.frames if f.cloud is not None] for p in panels]
    paths, marks = [p.path for p in panels], [p.frames[-1].landmarks.mean for p in panels]
    marks += [] if true_landmarks is None else [true_landmarks[1]]
    reach = window_reach([cloud for shown in clouds for cloud in shown])
    box = free_corner(panels[0].axes, [path[-1:] for path in paths], marks, paths)
    for panel, shown in zip(panels, clouds, strict=True):
        if shown:
            panel.closeup = Closeup(panel, box, reach, len(shown[-1]))


def window_reach(clouds: Sequence[Float[np.ndarray, "p 3"]]) -> float:
    """Return half the side [m] of the insets: twice the median extent of finite particle clouds.

    The extent of a cloud contains 19 of 20 particles.
    """
    points = [cloud[:, :2] for cloud in clouds if np.isfinite(cloud).all()]
    extents = [np.quantile(np.abs(p - p.mean(axis=0)).max(axis=1), 0.95) for p in points]
    return max(2.0 * float(np.median(extents)), MIN_REACH) if extents else MIN_REACH


def free_corner(
    axes: "Axes", *covered: Sequence[Float[np.ndarray, "_ d"]]
) -> tuple[float, float, float, float]:
    """Return the box of an inset, as fractions of the map, in the corner that hides fewest points.

    Points of the first kind count before the second kind, and so on.
    """
    low = np.array([axes.get_xlim()[0], axes.get_ylim()[0]])
    span = np.array([axes.get_xlim()[1], axes.get_ylim()[1]]) - low
    size, margin = (share * np.array([1.0, span[0] / span[1]]) for share in (0.25, 0.015))
    kinds = [(np.concatenate([p[:, :2] for p in kind]) - low) / span for kind in covered]

    def hidden(corner: tuple[float, float]) -> list[int]:
        inside = [(points > corner) & (points < corner + size) for points in kinds]
        return [int(np.sum(within.all(axis=1))) for within in inside]

    left, bottom = margin.tolist()
    right, top = (1.0 - margin - size).tolist()
    corners = [(right, top), (left, top), (right, bottom), (left, bottom)]
    return *min(corners, key=hidden), *size.tolist()


def draw_maps(
    panels: Sequence[MapPanel],
    truth: Truth,
    callers: Sequence[Caller],
    *,
    names: Mapping[str, str] = MappingProxyType({}),
    rows: Mapping[str, float] = MappingProxyType({}),
) -> tuple["Figure", list[list["Axes"]]]:
    """Create a figure of maps with common scales and a legend; the estimates are shown later.

    `names`: headings of strategies. `rows`: label and height [inch] of axes below each map; more
    than two maps on top of each other are narrow, with only the first of these rows.
    Returns the figure, and the axes below the map of each panel.
    """
    maps = [panel.frames[-1].landmarks for panel in panels]
    limits = view(truth, callers, [panel.path for panel in panels], maps)
    (left, right), (bottom, top) = limits
    places = cells([panel.case for panel in panels])
    blocks, columns = (1 + max(indices) for indices in zip(*places, strict=True))
    drawn = callers_shown(callers).union(*(panel.symbols() for panel in panels))
    if TIED in drawn:
        drawn.remove("placed landmark, 95 %")
    across, rows = (max(columns, 4), dict([*rows.items()][:1])) if blocks > 2 else (columns, rows)
    total, entries = {1: (6.4, 2), 2: (9.0, 4)}.get(across, (12.0, 4))
    width = (total - LEFT - RIGHT - (across - 1) * GAP) / across
    total -= (across - columns) * (width + GAP)
    heights = {"y [m]": width * (top - bottom) / (right - left), **rows}
    gaps = [TITLE, 0.5, *[0.12] * len(rows)][: len(heights)]
    block = sum(heights.values()) + sum(gaps) + LABEL
    page = blocks * block + LEGEND * -(-len(drawn) // entries)
    figure = picture(total, page)
    grid: list[list[Axes]] = []
    for panel, (row, column) in zip(panels, places, strict=True):
        x, y = LEFT + column * (width + GAP), page - row * block
        cell: list[Axes] = []
        for (label, tall), gap in zip(heights.items(), gaps, strict=True):
            y -= gap + tall
            first = grid[0][len(cell)] if grid else None
            axes = figure.add_axes(
                (x / total, y / page, width / total, tall / page),
                sharex=cell[1] if len(cell) > 1 else first,
                sharey=first,
            )
            if (row, column - 1) in places:
                axes.tick_params(labelleft=False)
            else:
                axes.set_ylabel(label, multialignment="center")
                axes.yaxis.set_label_coords(-0.42 / width, 0.5)
            cell.append(axes)
        cell[0].set(xlim=limits[0], ylim=limits[1], xlabel="x [m]", aspect="equal")
        draw_truth(cell[0], truth.landmarks, callers)
        panel.draw_on(cell[0])
        panel.line = head(cell[0], *panel.case, names.get(panel.case[0], ""))
        grid.append(cell)
    add_closeups(panels, truth.landmarks)
    if drawn:
        _draw_legend(figure, drawn, entries)
    return figure, [cell[1:] for cell in grid]


def _draw_legend(figure: "Figure", drawn: set[str], columns: int) -> None:
    """Draw the common legend of all panels at the bottom of a figure."""
    symbols = legend_symbols()
    names = sorted(drawn, key=list(symbols).index)
    width, height = figure.get_size_inches()
    figure.legend(
        handles=[symbols[name] for name in names],
        labels=names,
        loc="lower left",
        bbox_to_anchor=(LEFT / width, 0.07 / height, 1.0 - (LEFT + RIGHT) / width, 0.0),
        mode="expand",
        ncols=columns,
        borderaxespad=0.0,
        borderpad=0.0,
    )


def legend_symbols() -> dict[str, "Artist | tuple[Artist, ...]"]:
    """Return the legend's symbols by name, in the order of the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.path import Path

    def line(colour: str = INK, **style: Any) -> Line2D:
        return Line2D([], [], color=colour, **style)

    def mark(marker: Any, size: float, face: str, edge: str = "none") -> Line2D:
        return Line2D([], [], lw=0, marker=marker, ms=size, mfc=face, mec=edge)

    dart, sector = Path(vehicle(np.zeros(3), 1.0)), Path(beam(np.array([-0.5, 0, 0]), 0.8, 1.0))
    member = Path(ellipses(np.zeros((1, 2)), np.array([[[1.0, 0.4], [0.4, 0.4]]]), RAY)[0])
    oval = Path(excess_path_ellipse(np.array([-0.4, 0.0]), np.array([0.4, 0.0]), 0.2))
    full, star = mark("o", 7.5, "#33333330", INK), mark("*", 11.0, INK, "white")
    return {
        "true path": line(TRUTH, lw=3.2, alpha=0.45),
        "estimated path": line(lw=1.2),
        "range and bearing": line(lw=1.4),
        "bearing without range": line(lw=0.7, ls=(0, (4, 3))),
        "true landmark": mark("o", 5.0, "none", TRUTH),
        TIED: (full, line(lw=0.7)),
        "placed landmark, 95 %": full,
        "unresolved ray, 1σ, darker: likelier": mark(member, 14.0, "#33333350"),
        "just pruned": line(lw=1.0, ls=":"),
        "beacon": star,
        "caller": star,
        "moving caller": line(lw=1.0, ls="-."),
        "caller as estimated": mark("*", 11.0, "none", INK),
        "its estimated track": line(lw=1.2, ls=":"),
        "excess-path ellipse, sound path": mark(oval, 16.0, "none", "#33333399"),
        "vehicle at the end": mark(dart, 10.0, INK),
        "its beam": mark(sector, 14.0, "#33333338"),
        "particles": mark(dart, 10.0, "#33333350"),
    }
