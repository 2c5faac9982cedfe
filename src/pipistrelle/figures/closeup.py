"""A swarm of particles: dots at the map's scale, and a window in a corner that enlarges them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.figures.maps import vehicle
from pipistrelle.figures.style import INK, TRUTH

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

Limits = tuple[tuple[float, float], tuple[float, float]]
"""(left, right), (bottom, top) [m]"""
SIDE, MARGIN = 0.25, 0.015
"""Of the window, and its distance from the corner, as shares of the map's width."""
NARROWEST = 0.05
"""Least reach of a window [m]: particles may coincide."""
TAIL = 60
"""Poses of a path that a window shows."""


def reach_of(clouds: Sequence[Float[np.ndarray, "p 3"]]) -> float | None:
    """How far a window reaches around its centre, so that a typical cloud fills half of it.

    Twice the median, over the clouds, of the distance along an axis from a cloud's mean that
    19 of 20 particles keep.

    Parameters
    ----------
    clouds : of (p, 3) [m, m, rad]
        Those that are not finite do not count.

    Returns
    -------
    [m], at least `NARROWEST`; None where there is no cloud to show

    Examples
    --------
    >>> ring = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    >>> reach_of([ring, 3 * ring, np.full((4, 3), np.nan)]), reach_of([])
    (4.0, None)
    """
    points = [cloud[:, :2] for cloud in clouds if cloud.size and np.isfinite(cloud).all()]
    if not points:
        return None
    extent = [np.quantile(np.abs(p - p.mean(axis=0)).max(axis=1), 0.95) for p in points]
    return max(2.0 * float(np.median(extent)), NARROWEST)


def free_corner(
    limits: Limits, *covered: Sequence[Float[np.ndarray, "_ d"]]
) -> tuple[float, float, float, float]:
    """Choose the corner of a map where a window hides least.

    Parameters
    ----------
    limits : (left, right), (bottom, top) [m]
    covered : of (n, 2 or more) [m]
        Points that had better stay visible; the first kind counts before the second.

    Returns
    -------
    left, bottom, width, height, as shares of the map's

    Examples
    --------
    >>> free_corner(((0, 10), (0, 5)), [np.array([[9.0, 4.0]])], [np.array([[1.0, 1.0]])])
    (0.015, 0.47, 0.25, 0.5)
    """
    (left, right), (bottom, top) = limits
    ratio = (right - left) / (top - bottom)
    size = np.array([SIDE, SIDE * ratio])
    low, high = np.array([MARGIN, MARGIN * ratio]), 1.0 - size - [MARGIN, MARGIN * ratio]
    span = np.array([right - left, top - bottom])
    kinds = [(np.concatenate([p[:, :2] for p in kind]) - [left, bottom]) / span for kind in covered]

    def hidden(corner: np.ndarray) -> list[int]:
        inside = [(points > corner) & (points < corner + size) for points in kinds]
        return [int(np.sum(within.all(axis=1))) for within in inside]

    corners = [np.array([x, y]) for y in (high[1], low[1]) for x in (high[0], low[0])]
    x, y = min(corners, key=hidden).tolist()
    return x, y, SIDE, SIDE * ratio


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
        self._swarm = PolyCollection([], fc=colour, alpha=0.2, lw=0, zorder=3)
        self._vehicles = PolyCollection([], fc=["none", TRUTH], ec=[INK, "white"], lw=0.8, zorder=4)
        for darts in (self._swarm, self._vehicles):
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

        Parameters
        ----------
        cloud : (p, 3) [m, m, rad]
        path : (k, 3) [m, m, rad]
            Estimated, up to now.
        true_path : (t, 3) [m, m, rad], optional
            Up to now.
        """
        cloud, pose = cloud[np.isfinite(cloud).all(axis=1)], path[-1]
        if not np.isfinite(pose).all():
            return
        self._dots.set_data(*cloud[:, :2].T)
        corner = self._map.transLimits.inverted().transform(self._middle)
        self._leader.set_data(*np.stack([pose[:2], corner]).T)
        for axis, middle in zip("xy", pose, strict=False):
            self._window.set(**{f"{axis}lim": (middle - self._reach, middle + self._reach)})
        self._path.set_data(*path[-TAIL:, :2].T)
        self._swarm.set_verts([vehicle(particle, 0.24 * self._reach) for particle in cloud])
        seen = [pose]
        if true_path is not None and np.isfinite(true_path[-1]).all():
            self._true.set_data(*true_path[-TAIL:, :2].T)
            seen.append(true_path[-1])
        self._vehicles.set_verts([vehicle(pose, 0.34 * self._reach) for pose in seen])

    def _label(self, title: str) -> None:
        """Say what the window holds, and how large it is by a bar of a round length."""
        decade = 10.0 ** np.floor(np.log10(self._reach))
        bar = next(float(n * decade) for n in (5, 2, 1) if n * decade <= self._reach)
        style: dict[str, Any] = {"transform": self._window.transAxes, "zorder": 5}
        share = bar / (2.0 * self._reach)
        self._window.plot([0.06, 0.06 + share], [0.07, 0.07], color=INK, lw=1.4, **style)
        self._window.text(0.06, 0.1, f"{bar:g} m", fontsize=7, va="bottom", **style)
        self._window.text(0.06, 0.95, title, fontsize=7, va="top", **style)
