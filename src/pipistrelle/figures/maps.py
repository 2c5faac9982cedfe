"""Maps: outlines, limits, the true world, the panel of an estimate, particles, the legend.

`MapPanel` holds the artists of an estimate; a figure shows it once, a film frame by frame.
"""

from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.figures.style import INK, MAX_COLUMNS, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

PLACED = 0.95
"""Probability inside the ellipse of a landmark that is fully initialised."""
RAY = 0.3935
"""Probability inside the ellipse of a ray's member: one standard deviation."""
SIDE, MARGIN = 0.25, 0.015
"""Side of the window and its distance from the corner, as shares of the map's width."""
MIN_REACH = 0.05
"""Least reach of a window [m], for particles that coincide."""
PATH_POSES = 60
"""Number of poses of a path in a window."""
NOWHERE = np.full((1, 2), np.nan)
"""A point that is not drawn."""


def ellipses(
    mean: Float[np.ndarray, "h 2"], covariance: Float[np.ndarray, "h 2 2"], probability: float
) -> Float[np.ndarray, "h 49 2"]:
    r"""Return the closed ellipses that contain a share of each Gaussian.

    .. math:: (x - \mu)^T P^{-1} (x - \mu) = -2 \ln(1 - p)

    The unit circle goes through the symmetric square root of P, which for 2 by 2 is
    (P + s I) / sqrt(tr P + 2 s), s = sqrt(det P).

    Parameters
    ----------
    mean : (h, 2) [m]
    covariance : (h, 2, 2) [m^2]
        Positive semidefinite; a covariance that is not finite gives an outline that is not.
    probability : p, between 0 and 1

    Returns
    -------
    (h, 49, 2) [m]

    Notes
    -----
    The quantile of chi-square with two degrees of freedom is -2 ln(1 - p): 5.991 for 95 %.

    Examples
    --------
    >>> outline = ellipses(np.zeros((1, 2)), np.diag([4.0, 1.0])[None], 0.95)
    >>> (outline.max(axis=1) ** 2).round(3)
    array([[23.966,  5.991]])
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.sqrt(-2.0 * np.log1p(-probability)) * np.stack([np.cos(angle), np.sin(angle)])
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    s = np.sqrt(np.maximum(a * c - b * b, 0.0))
    trace = np.maximum(a + c + 2.0 * s, np.finfo(np.float64).tiny)
    root = (covariance + s[:, None, None] * np.eye(2)) / np.sqrt(trace)[:, None, None]
    return mean[:, None, :] + np.swapaxes(root @ circle, 1, 2)


def beam(pose: Float[np.ndarray, "3"], beamwidth: float, length: float) -> Float[np.ndarray, "n 2"]:
    """Return the sector of the vehicle's beam, half the beamwidth to each side.

    `pose` [m, m, rad]. `beamwidth` [rad]. `length` [m]. Returns [m]: first the vehicle, then the
    arc.

    Half-power beamwidth of Bradley & Abaid, Eq. (1).

    Examples
    --------
    >>> beam(np.zeros(3), np.pi, 2.0)[[0, 1, -1]].round(9) + 0.0
    array([[ 0.,  0.],
           [ 0., -2.],
           [ 0.,  2.]])
    """
    angle = pose[2] + np.linspace(-0.5, 0.5, 41) * beamwidth
    arc = pose[:2] + length * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([pose[:2], arc])


def vehicle(pose: Float[np.ndarray, "3"], length: float) -> Float[np.ndarray, "4 2"]:
    """Return the outline of the vehicle, a dart along its heading, the tip first [m].

    `pose` [m, m, rad]. `length` [m].

    Examples
    --------
    >>> vehicle(np.array([1.0, 0.0, np.pi / 2]), 2.0)[0].round(9)
    array([1.  , 1.16])
    """
    shape = length * np.array([[0.58, 0.0], [-0.42, 0.36], [-0.2, 0.0], [-0.42, -0.36]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + shape @ np.array([[cos, sin], [-sin, cos]])


def excess_path_ellipse(
    vehicle: Float[np.ndarray, "2"], caller: Float[np.ndarray, "2"], excess_path: float
) -> Float[np.ndarray, "121 2"]:
    r"""Return the ellipse of all points with an excess path, around vehicle and caller.

    .. math:: |b - l| + |l - p| = d + e, \qquad d = |b - p|

    Its half axes are :math:`(d + e)/2` and :math:`\sqrt{(d + e)^2 - d^2}/2`.

    Parameters
    ----------
    vehicle, caller : (2) [m]
        The foci.
    excess path : [m]

    Returns
    -------
    (121, 2) [m]
        A closed outline.

    Examples
    --------
    >>> outline = excess_path_ellipse(np.zeros(2), np.array([6.0, 0.0]), 4.0)
    >>> outline.min(axis=0), outline.max(axis=0)
    (array([-2., -4.]), array([8., 4.]))
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
    """Return a colour (red, green, blue, opacity) per weight, opaque for large weights.

    Examples
    --------
    >>> shades("#ffffff", np.array([0.0, 1.0]))
    array([[1.  , 1.  , 1.  , 0.05],
           [1.  , 1.  , 1.  , 0.5 ]])
    """
    from matplotlib.colors import to_rgba

    rgba = np.tile(to_rgba(colour), (len(weight), 1))
    rgba[:, 3] = least + (most - least) * np.clip(weight, 0.0, 1.0)
    return rgba


def view(
    truth: Truth,
    callers: Sequence[Caller],
    paths: Sequence[Float[np.ndarray, "_ 3"]],
    maps: Sequence[Landmarks],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the limits [m] of a map of the truth, or of the estimates without it.

    Ellipses of landmarks and of rays widen the map by at most a quarter to each side; of rays only
    the ellipses count, not the means. The map is at most twice as wide as high, and at most 1.2
    times as high as wide. `callers`: without the vehicle; `paths` [m, m, rad].

    Examples
    --------
    >>> from pipistrelle.experiments.drives import NO_TRUTH
    >>> path = np.array([[0.0, 9.0, 0.0], [10.0, 0.0, 0.0]])
    >>> beacon = Caller(name="beacon", frequency=30e3, level_db=42.8, place=np.ones(2))
    >>> np.round(view(NO_TRUTH, [beacon], [path], []), 9)
    array([[-0.6 , 10.6 ],
           [-0.54,  9.54]])
    """
    points = paths if truth.path is None else [truth.path]
    marks = [rows.mean[placed(rows)] for rows in maps]
    marks = marks if truth.landmarks is None else [truth.landmarks[1]]
    marks += [np.reshape(np.asarray(caller.place), (-1, 2)) for caller in callers]
    shown = np.concatenate([*(poses[:, :2] for poses in points), *marks])
    shown = shown[np.isfinite(shown).all(axis=1)]
    shown = shown if len(shown) else np.zeros((1, 2))
    low, high = shown.min(axis=0), shown.max(axis=0)
    centre, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 0.5)
    half = 1.12 * _readable(half)
    low, high = _around_ellipses(maps, centre, half)
    centre, half = (low + high) / 2.0, _readable((high - low) / 2.0)
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


def _readable(half: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return half width and half height, enlarged to an allowed ratio."""
    return np.maximum(half, half[::-1] / np.array([1.2, 2.0]))


@np.errstate(over="ignore", invalid="ignore")
def _around_ellipses(
    maps: Sequence[Landmarks], centre: Float[np.ndarray, "2"], half: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the corners of a rectangle that is enlarged for ellipses within its reach."""
    corners = [centre - half, centre + half]
    for rows in maps:
        full, near = placed(rows), np.all(np.abs(rows.mean - centre) < 1.5 * half, axis=1)
        for shown, size in ((near & full, PLACED), (near & ~full, RAY)):
            outlines = ellipses(rows.mean[shown], rows.covariance[shown], size).reshape(-1, 2)
            outlines = outlines[np.isfinite(outlines).all(axis=1)]
            corners.extend(np.clip(outlines, centre - 1.5 * half, centre + 1.5 * half))
    return np.min(corners, axis=0), np.max(corners, axis=0)


def draw_truth(
    axes: "Axes",
    true_landmarks: LabelledPoints | None,
    callers: Sequence[Caller],
) -> None:
    """Draw true landmarks as open circles, fixed callers as stars, moving callers as paths.

    Callers have labels, except a single beacon. `true_landmarks` [m]: callers may be among them.
    `callers`: without the vehicle.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> axes = Figure().add_subplot()
    >>> beacon = Caller(name="beacon", frequency=30e3, level_db=42.8, place=np.ones(2))
    >>> draw_truth(axes, (np.array([1]), np.zeros((1, 2))), [beacon])
    >>> len(axes.lines)
    2
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
    """Return the names of the legend's symbols for callers, without the vehicle.

    Examples
    --------
    >>> path = np.zeros((9, 2))
    >>> callers_shown([Caller(name="boat", frequency=30e3, level_db=42.8, place=path)])
    {'moving caller'}
    """
    standing = [caller.name for caller in callers if not moves(caller)]
    star = "beacon" if standing == ["beacon"] else "caller"
    return {"moving caller" if moves(caller) else star for caller in callers}


def cells(cases: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """Return row and column of each panel: a column per strategy, a row per filter.

    A single strategy or filter, or more than `MAX_COLUMNS` strategies, fill row after row.

    Examples
    --------
    >>> cells([("active", "ekf"), ("active", "fastslam"), ("fused", "fastslam")])
    [(0, 0), (1, 0), (1, 1)]
    >>> cells([("fused", "ekf"), ("fused", "fastslam")])
    [(0, 0), (0, 1)]
    """
    strategies, filters = (list(dict.fromkeys(names)) for names in zip(*cases, strict=True))
    if 1 < len(strategies) <= MAX_COLUMNS and len(filters) > 1:
        return [(filters.index(name), strategies.index(strategy)) for strategy, name in cases]
    return [divmod(i, MAX_COLUMNS) for i in range(len(cases))]


def head(axes: "Axes", strategy: str, estimator: str, name: str = "") -> "Annotation":
    """Write strategy and estimator above a panel; return the empty line of text below them.

    `name`: heading in place of the strategy.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> head(Figure().add_subplot(), "fused", "ekf").get_text()
    ''
    """
    above: dict[str, Any] = {"xy": (0, 1), "xycoords": "axes fraction"}
    above["textcoords"] = "offset points"
    style = {"color": strategy_colour(strategy), "fontsize": 13, "weight": "bold"}
    first = axes.annotate(name or strategy, xytext=(0, 21), **style, **above)
    beside = above | {"xy": (1, 0), "xycoords": first, "va": "bottom"}
    axes.annotate(title_of(estimator), xytext=(6, 0), fontsize=13, parse_math=False, **beside)
    return axes.annotate("", xytext=(0, 7), fontsize=9.5, **above)


class MapPanel:
    """The artists of an estimate on a map, empty until they are shown.

    `length`: of the vehicle, as a share of the map's width. `beamwidth` [rad]: None for no beam.
    """

    def __init__(
        self, axes: "Axes", strategy: str, length: float, beamwidth: float | None = None
    ) -> None:
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.lines import Line2D
        from matplotlib.patches import Polygon

        def areas(zorder: float, **style: Any) -> PolyCollection:
            artist = PolyCollection([], zorder=zorder, **style)
            axes.add_collection(artist, autolim=False)
            return artist

        def points(zorder: float, *form: str, **style: Any) -> Line2D:
            return axes.plot([], [], *form, zorder=zorder, **style)[0]

        self.axes, self.colour, self.beamwidth = axes, strategy_colour(strategy), beamwidth
        self.size = axes.get_xlim()[1] - axes.get_xlim()[0]
        self.length = length * self.size
        self.closeup: Closeup | None = None
        colour, star = self.colour, {"ms": 12, "mfc": "none", "mec": self.colour, "mew": 1.1}
        filled = {"fc": shades(colour, np.full(1, 0.2)), "ec": colour, "lw": 0.8}
        self.members = areas(1.0, lw=0.8)
        self.beam = Polygon(NOWHERE, fc=INK, alpha=0.13, lw=0, zorder=1.8)
        self.true = points(2.0, color=TRUTH, lw=3.2, alpha=0.45)
        self.excess_paths = areas(3.5, fc="none", ec=INK, lw=0.9, alpha=0.7)
        self.ways = LineCollection([], colors=INK, lw=0.9, alpha=0.7, zorder=3.5)
        axes.add_collection(self.ways, autolim=False)
        self.full = areas(4.0, **filled)
        self.around = areas(4.0, **filled)
        self.dots = points(5.0, "o", ms=2.6, mfc=colour, mec="none")
        self.trails = points(5.5, color=colour, lw=1.2, ls=":")
        self.callers = points(5.5, "*", **star)
        self.estimated = points(6.0, color=colour, lw=1.2)
        self.vehicle = Polygon(NOWHERE, fc=INK, ec="white", lw=0.8, zorder=8.0)
        for patch in (self.vehicle, *([] if beamwidth is None else [self.beam])):
            axes.add_patch(patch)

    def show(
        self,
        path: Float[np.ndarray, "k 3"],
        landmarks: Landmarks,
        *,
        true_path: Float[np.ndarray, "t 3"] | None = None,
        cloud: Float[np.ndarray, "p 3"] | None = None,
        excess_paths: tuple[Sequence[np.ndarray], Sequence[np.ndarray]] = ((), ()),
        callers: Float[np.ndarray, "c 2"] | None = None,
        moving: Landmarks | None = None,
        trails: Sequence[Float[np.ndarray, "_ 2"]] = (),
    ) -> None:
        """Show an estimate at the end of its path.

        `path`, `true_path`, `cloud` [m, m, rad]. `excess_paths`: ellipses and ways [m]. `callers`
        [m]: their estimated positions. `moving`: the tracked callers in sight, `trails` [m] the
        tracks of all.
        """
        self.estimated.set_data(*path[:, :2].T)
        self.vehicle.set_xy(vehicle(path[-1], self.length))
        if self.beamwidth is not None:
            self.beam.set_xy(beam(path[-1], self.beamwidth, 0.25 * self.size))
        if true_path is not None:
            self.true.set_data(*true_path[:, :2].T)
        if self.closeup and cloud is not None:
            self.closeup.show(cloud, path, true_path)
        full = placed(landmarks)
        mean, covariance, weight = landmarks.mean, landmarks.covariance, landmarks.weight[~full]
        self.members.set(
            verts=ellipses(mean[~full], covariance[~full], RAY),
            facecolor=shades(self.colour, weight),
            edgecolor=shades(self.colour, weight, most=1.0),
        )
        self.full.set(verts=ellipses(mean[full], covariance[full], PLACED))
        self.dots.set_data(*mean[full].T)
        self.excess_paths.set_verts(excess_paths[0])
        self.ways.set_segments(excess_paths[1])
        if callers is not None:
            self.callers.set_data(*callers.T)
        if moving is not None:
            self.around.set(verts=ellipses(moving.mean, moving.covariance, PLACED))
        lines = [part for trail in trails for part in (NOWHERE, trail)]
        self.trails.set_data(*np.concatenate([np.empty((0, 2)), *lines[1:]]).T)


class Closeup:
    """The particles on a map, and enlarged in a window that follows the vehicle.

    The window shows particles as translucent darts, the estimated pose as an outline, the last part
    of the estimated path, and the true path and pose in grey.
    """

    def __init__(
        self,
        axes: "Axes",
        colour: str,
        box: tuple[float, float, float, float],
        reach: float,
        particles: int,
    ) -> None:
        from matplotlib.collections import PolyCollection

        dots: dict[str, Any] = {"ms": 1.6, "mfc": colour, "mec": "none", "alpha": 0.3}
        self._reach, (x, y, width, height) = reach, box
        self._middle = np.array([x + width / 2.0, y + height / 2.0])
        self._map = axes
        self._dots = axes.plot([], [], "o", **dots, zorder=8.5)[0]
        self._leader = axes.plot([], [], color=INK, lw=0.6, alpha=0.5, zorder=8.6)[0]
        self._window = axes.inset_axes(box, zorder=9)
        self._window.set(xticks=[], yticks=[])
        for spine in self._window.spines.values():
            spine.set(visible=True, color=INK, linewidth=0.6)
        self._true = self._window.plot([], [], color=TRUTH, lw=3.2, alpha=0.45)[0]
        self._path = self._window.plot([], [], color=colour, lw=1.2)[0]
        self._darts = PolyCollection([], fc=colour, alpha=0.2, lw=0, zorder=3)
        self._vehicles = PolyCollection([], fc=["none", TRUTH], ec=[INK, "white"], lw=0.8, zorder=4)
        for darts in (self._darts, self._vehicles):
            self._window.add_collection(darts, autolim=False)
        self._label(f"{particles} particle{'s' if particles != 1 else ''}")

    @property
    def artists(self) -> "tuple[Artist, Artist, Artist]":
        """The artists on the map, from back to front."""
        return self._dots, self._leader, self._window

    def show(
        self,
        cloud: Float[np.ndarray, "p 3"],
        path: Float[np.ndarray, "k 3"],
        true_path: Float[np.ndarray, "t 3"] | None,
    ) -> None:
        """Show particles and paths [m, m, rad] around the end of the estimated path."""
        cloud, pose = cloud[np.isfinite(cloud).all(axis=1)], path[-1]
        if not np.isfinite(pose).all():
            return
        self._dots.set_data(*cloud[:, :2].T)
        corner = self._map.transLimits.inverted().transform(self._middle)
        self._leader.set_data(*np.stack([pose[:2], corner]).T)
        for axis, middle in zip("xy", pose, strict=False):
            self._window.set(**{f"{axis}lim": (middle - self._reach, middle + self._reach)})
        self._path.set_data(*path[-PATH_POSES:, :2].T)
        self._darts.set_verts([vehicle(particle, 0.24 * self._reach) for particle in cloud])
        true = path[:0] if true_path is None else true_path[-PATH_POSES:]
        self._true.set_data(*true[:, :2].T)
        seen = [pose, *(last for last in true[-1:] if np.isfinite(last).all())]
        self._vehicles.set_verts([vehicle(dart, 0.34 * self._reach) for dart in seen])

    def _label(self, title: str) -> None:
        """Write the title of the window and draw a bar of a round length."""
        decade = 10.0 ** np.floor(np.log10(self._reach))
        bar = next(float(n * decade) for n in (5, 2, 1) if n * decade <= self._reach)
        style: dict[str, Any] = {"transform": self._window.transAxes, "zorder": 5}
        share = bar / (2.0 * self._reach)
        self._window.plot([0.06, 0.06 + share], [0.07, 0.07], color=INK, lw=1.4, **style)
        self._window.text(0.06, 0.1, f"{bar:g} m", fontsize=7, va="bottom", **style)
        self._window.text(0.06, 0.95, title, fontsize=7, va="top", **style)


def add_closeups(
    panels: Sequence[MapPanel],
    clouds: Sequence[Sequence[Float[np.ndarray, "p 3"]]],
    paths: Sequence[Float[np.ndarray, "_ 3"]],
    landmarks: Sequence[Float[np.ndarray, "_ 2"]],
    true_landmarks: LabelledPoints | None,
) -> None:
    """Give each panel with particles a window, all of the same scale and in the same corner.

    `panels`: of common limits. `clouds` [m, m, rad]: for each panel the clouds to show in turn, or
    none. `paths` [m, m, rad]: their ends are not covered. `landmarks` and `true_landmarks` [m]:
    not covered if possible, as the rest of the paths.
    """
    marks = [*landmarks, *([] if true_landmarks is None else [true_landmarks[1]])]
    reach = _reach(list(chain.from_iterable(clouds)))
    box = _free_corner(panels[0].axes, [path[-1:] for path in paths], marks, paths)
    for panel, shown in zip(panels, clouds, strict=True):
        if shown:
            panel.closeup = Closeup(panel.axes, panel.colour, box, reach, len(shown[-1]))


def _reach(clouds: Sequence[Float[np.ndarray, "p 3"]]) -> float:
    """Return the reach [m] of a window: twice the median reach of the finite clouds.

    The reach of a cloud contains 19 of 20 particles.
    """
    points = [cloud[:, :2] for cloud in clouds if np.isfinite(cloud).all()]
    extents = [np.quantile(np.abs(p - p.mean(axis=0)).max(axis=1), 0.95) for p in points]
    return max(2.0 * float(np.median(extents)), MIN_REACH) if extents else MIN_REACH


def _free_corner(
    axes: "Axes", *covered: Sequence[Float[np.ndarray, "_ d"]]
) -> tuple[float, float, float, float]:
    """Return the box, in shares of the map, in the corner that hides the fewest points.

    Points of the first kind count before the second kind, and so on.
    """
    low = np.array([axes.get_xlim()[0], axes.get_ylim()[0]])
    span = np.array([axes.get_xlim()[1], axes.get_ylim()[1]]) - low
    size, margin = (share * np.array([1.0, span[0] / span[1]]) for share in (SIDE, MARGIN))
    kinds = [(np.concatenate([p[:, :2] for p in kind]) - low) / span for kind in covered]

    def hidden(corner: tuple[float, float]) -> list[int]:
        inside = [(points > corner) & (points < corner + size) for points in kinds]
        return [int(np.sum(within.all(axis=1))) for within in inside]

    left, bottom = margin.tolist()
    right, top = (1.0 - margin - size).tolist()
    corners = [(right, top), (left, top), (right, bottom), (left, bottom)]
    return *min(corners, key=hidden), *size.tolist()


def legend(figure: "Figure", names: Sequence[str], columns: int, left: float, right: float) -> None:
    """Draw the legend of all panels at the bottom of a figure, if there are names.

    `left` and `right` [inch]: margins. Raises KeyError for a name without a symbol.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> figure = Figure()
    >>> legend(figure, ["true path", "beacon"], 2, 0.1, 0.1)
    >>> [text.get_text() for text in figure.legends[0].texts]
    ['true path', 'beacon']
    """
    if not names:
        return
    width, height = figure.get_size_inches()
    symbols = _symbols()
    figure.legend(
        handles=[symbols[name] for name in names],
        labels=names,
        loc="lower left",
        bbox_to_anchor=(left / width, 0.07 / height, 1.0 - (left + right) / width, 0.0),
        mode="expand",
        ncols=columns,
        borderaxespad=0.0,
        borderpad=0.0,
    )


def _symbols() -> dict[str, "Artist | tuple[Artist, ...]"]:
    """Return the symbol, or the superimposed symbols, of each name in a legend."""
    from matplotlib.lines import Line2D
    from matplotlib.path import Path

    def line(colour: str = INK, **style: Any) -> Line2D:
        return Line2D([], [], color=colour, **style)

    def mark(marker: Any, size: float, face: str, edge: str = "none", **style: Any) -> Line2D:
        return Line2D([], [], lw=0, marker=marker, ms=size, mfc=face, mec=edge, **style)

    dart, sector = Path(vehicle(np.zeros(3), 1.0)), Path(beam(np.array([-0.5, 0, 0]), 0.8, 1.0))
    member = Path(ellipses(np.zeros((1, 2)), np.array([[[1.0, 0.4], [0.4, 0.4]]]), RAY)[0])
    oval = Path(excess_path_ellipse(np.array([-0.4, 0.0]), np.array([0.4, 0.0]), 0.2))
    full, tie = mark("o", 7.5, "#33333330", INK), line(lw=0.7)
    return {
        "true path": line(TRUTH, lw=3.2, alpha=0.45),
        "estimated path": line(lw=1.2),
        "true landmark": mark("o", 5.0, "none", TRUTH),
        "placed landmark, 95 %": full,
        "placed landmark, 95 %, and its error": (full, tie),
        "unresolved ray, 1σ, darker: likelier": mark(member, 14.0, "#33333350"),
        "beacon": mark("*", 11.0, INK, "white"),
        "caller": mark("*", 11.0, INK, "white"),
        "moving caller": line(lw=1.0, ls="-."),
        "caller as estimated": mark("*", 11.0, "none", INK),
        "its estimated track": line(lw=1.2, ls=":"),
        "excess-path ellipse and its way": mark(oval, 16.0, "none", "#33333399"),
        "vehicle at the end": mark(dart, 10.0, INK),
        "its beam": mark(sector, 14.0, "#33333338"),
        "particles": mark(dart, 10.0, "#33333350"),
        "range and bearing": line(lw=1.4),
        "bearing alone": line(lw=0.7, ls=(0, (4, 3))),
        "ray, 1σ, darker: likelier": mark(member, 14.0, "#33333350"),
        "just pruned": line(lw=1.0, ls=":"),
    }
