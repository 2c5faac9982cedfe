"""A map around what is estimated: its limits, the true world, the panel's name, the legend."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.estimation.catalogue import title_of
from pipistrelle.experiments.drives import LabelledPoints, Truth
from pipistrelle.figures.outlines import PLACED, RAY, beam, ellipses, excess_path_ellipse, vehicle
from pipistrelle.figures.style import INK, MAX_COLUMNS, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation


def shades(
    colour: str, weight: Float[np.ndarray, " h"], *, least: float = 0.05, most: float = 0.5
) -> Float[np.ndarray, "h 4"]:
    """Return one colour per weight: the larger the weight, the more opaque.

    Returns: red, green, blue, opacity.

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
    """Return the limits of a map of the truth or, without it, of the estimate, and ellipses.

    The ellipses of placed landmarks, and of rays, widen it by at most half, a quarter to each side.

    `callers` are all but the vehicle, `paths` are poses [m, m, rad]. Of `maps`, the places of those
    that are not fully initialised do not count, their ellipses do. The result [m] is at most twice
    as wide as high, and at most 1.2 times as high as wide.

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
    """Grow half a width and half a height until neither is too small for the other."""
    return np.maximum(half, half[::-1] / np.array([1.2, 2.0]))


@np.errstate(over="ignore", invalid="ignore")
def _around_ellipses(
    maps: Sequence[Landmarks], centre: Float[np.ndarray, "2"], half: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the lowest and highest corner of a frame that grows for ellipses in its reach."""
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
    """Draw the true landmarks as open circles, each caller as a star or, where it moves, its path.

    Stars and paths bear their names; the legend names the paper's one beacon.

    `true_landmarks` [m]: callers may be among them. `callers`: without the vehicle.

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
    """Return the names that some callers need in the legend.

    `callers`: without the vehicle. Returns: of those that stand ``beacon``, where it is one of that
    name, else ``caller``.

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
    """Place panels: a column for each strategy and a row for each filter, or line by line.

    Returns: line by line where there is one strategy or one filter, or where there are more
    strategies than `MAX_COLUMNS`.

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
    """Write a panel's name above it, and leave a line below the name for what is to be said.

    `estimator`: the filter; `name`: that of the strategy, where it has another. Returns: the
    line below, still empty.

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


def legend(figure: "Figure", names: Sequence[str], columns: int, left: float, right: float) -> None:
    """Explain symbols once for all panels, in neutral ink, at the bottom of a figure.

    `names`: as they are to be read; without any there is no legend. `left` and `right` [inch]:
    margins. Raises KeyError for a name without a symbol.

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
    """Return what each name in a legend stands for; several lie upon each other."""
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
