"""Particles: dots at the map's scale, and a window in a corner that enlarges them."""

from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.experiments.drives import LabelledPoints
from pipistrelle.figures.outlines import vehicle
from pipistrelle.figures.style import INK, TRUTH

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

SIDE, MARGIN = 0.25, 0.015
"""Of the window, and its distance from the corner, as shares of the map's width."""
MIN_REACH = 0.05
"""Least reach of a window [m]: particles may coincide."""
PATH_POSES = 60
"""Poses of a path that a window shows."""


class Closeup:
    """The particles on a map, and enlarged in a window that follows the vehicle.

    The window shows each particle as a translucent dart, the estimated pose as an outlined one,
    the last of the estimated path, and of the true path and pose in grey.
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
        """What stands on the map, in the order in which it is drawn."""
        return self._dots, self._leader, self._window

    def show(
        self,
        cloud: Float[np.ndarray, "p 3"],
        path: Float[np.ndarray, "k 3"],
        true_path: Float[np.ndarray, "t 3"] | None,
    ) -> None:
        """Look at the end of a path.

        `cloud` [m, m, rad]. `path` [m, m, rad]: estimated, up to now. `true_path` [m, m, rad]: up
        to now.
        """
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
        """Say what the window holds, and how large it is by a bar of a round length."""
        decade = 10.0 ** np.floor(np.log10(self._reach))
        bar = next(float(n * decade) for n in (5, 2, 1) if n * decade <= self._reach)
        style: dict[str, Any] = {"transform": self._window.transAxes, "zorder": 5}
        share = bar / (2.0 * self._reach)
        self._window.plot([0.06, 0.06 + share], [0.07, 0.07], color=INK, lw=1.4, **style)
        self._window.text(0.06, 0.1, f"{bar:g} m", fontsize=7, va="bottom", **style)
        self._window.text(0.06, 0.95, title, fontsize=7, va="top", **style)


def add_closeups(
    maps: "Sequence[Axes]",
    colours: Sequence[str],
    clouds: Sequence[Sequence[Float[np.ndarray, "p 3"]]],
    paths: Sequence[Float[np.ndarray, "_ 3"]],
    landmarks: Sequence[Float[np.ndarray, "_ 2"]],
    true_landmarks: LabelledPoints | None,
) -> list[Closeup | None]:
    """Give every map whose vehicle has particles a window, all of one scale and in one corner.

    `maps`: of common limits. `colours` and `clouds` and `paths`: of the clouds, (p, 3) [m, m, rad],
    those that the window is to show in turn, or none; where a path (k, 3) [m, m, rad] ends is not
    covered. `landmarks` [m]: had better not be covered; nor had the paths. `true_landmarks` [m]:
    the same. Returns: still empty; None where there is no cloud.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> maps, nothing = Figure().subplots(1, 2), np.empty((0, 2))
    >>> pair = add_closeups(maps, ["k", "k"], [[np.eye(3)], []], [np.eye(3)] * 2, [nothing], None)
    >>> [closeup is not None for closeup in pair]
    [True, False]
    """
    marks = [*landmarks, *([] if true_landmarks is None else [true_landmarks[1]])]
    reach = _reach(list(chain.from_iterable(clouds)))
    box = _free_corner(maps[0], [path[-1:] for path in paths], marks, paths)
    return [
        Closeup(axes, colour, box, reach, len(shown[-1])) if shown else None
        for axes, colour, shown in zip(maps, colours, clouds, strict=True)
    ]


def _reach(clouds: Sequence[Float[np.ndarray, "p 3"]]) -> float:
    """Return how far [m] a window reaches from its centre: a typical finite cloud fills half of it.

    Typical: the median, over the clouds, of what 19 of 20 particles keep from their mean.
    """
    points = [cloud[:, :2] for cloud in clouds if np.isfinite(cloud).all()]
    extents = [np.quantile(np.abs(p - p.mean(axis=0)).max(axis=1), 0.95) for p in points]
    return max(2.0 * float(np.median(extents)), MIN_REACH) if extents else MIN_REACH


def _free_corner(
    axes: "Axes", *covered: Sequence[Float[np.ndarray, "_ d"]]
) -> tuple[float, float, float, float]:
    """Return the box, in shares of the map, in the corner that hides the fewest points.

    The first kind of points counts before the second, that before the third.
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
