"""Charts as data, drawn with matplotlib or by the report's page, and their numbers as CSV.

A `Chart` holds panels, a `Panel` holds series over common axes. `draw_chart` draws with matplotlib,
`report` draws the same charts as vectors on its page, `csv_text` writes their numbers. `MARKS` are
the styles of series for both; a new style is a new row.
"""

import csv
import io
import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.figures.style import INK, MAX_COLUMNS, STYLE, TRUTH, picture, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import Locator


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """Drawing style of a data series: line, symbol, band or error bars."""

    joined: bool = False
    """Whether a line joins the points."""
    spread: Literal["band", "bars"] = "band"
    """How `low` and `high` are drawn."""
    symbol: str = ""
    """Marker of matplotlib at each point; empty for none."""
    size: float = 5.0
    edge: float = 0.0
    """Width of the symbol's edge."""
    corners: tuple[tuple[float, float], ...] = ()
    """Corners of the symbol on the page around the point, y down; empty for a circle."""
    radius: float = 3.2
    pinned: bool = False
    """Whether points above the panel are drawn at its edge: small marks of single worlds."""
    written: bool = False
    """Whether `tips` are written at the points in place of symbols."""
    swatch: Literal["line", "dashed", "dot", "star"] = "line"
    """Symbol in the page's legend."""


def _star(outer: float, inner: float) -> tuple[tuple[float, float], ...]:
    """Return the corner points of a five-pointed star, the first at the top."""
    turn = np.pi * (np.arange(10) / 5.0 - 0.5)
    reach = np.where(np.arange(10) % 2, inner, outer)
    return tuple(zip((reach * np.cos(turn)).tolist(), (reach * np.sin(turn)).tolist(), strict=True))


_DASH = ((-9.0, -1.0), (9.0, -1.0), (9.0, 1.0), (-9.0, 1.0))

MARKS = {
    "line": Mark(joined=True),
    "dots": Mark(joined=True, symbol="o"),
    "points": Mark(spread="bars", symbol="o", radius=4.2, swatch="dot"),
    "marks": Mark(symbol="o", size=2.4, radius=3.0, pinned=True),
    "levels": Mark(symbol="_", size=11.0, corners=_DASH, swatch="dashed"),
    "stars": Mark(symbol="*", size=13.0, edge=0.8, corners=_star(9.0, 3.6), swatch="star"),
    "text": Mark(written=True),
}
"""Styles of series by their names in the CSV."""
MOST_NAMES = 6
"""Most entries of a legend."""
WIDTH = {1: 6.0, 2: 9.0, 3: 12.0}
"""Width of a figure by its number of columns [inch]."""
ROW, REST = 3.3, 0.8
"""Height of a row of panels, and of title and legend together [inch]."""
PLAIN = {"text.parse_math": False}
"""Names are not parsed as mathematics: they may contain dollar signs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """A data series of a chart: points with optional intervals, a name and a style."""

    name: str
    role: str
    """Name of the colour: a strategy, "ink", "truth" or "grid"."""
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    """Gaps are not finite."""
    low: Float[np.ndarray, " n"] | None = None
    high: Float[np.ndarray, " n"] | None = None
    """Ends of a band or of bars around y."""
    style: str = "line"
    """Key of `MARKS`."""
    filled: np.ndarray | None = None
    """Mask of the filled points; by default all."""
    strength: float = 1.0
    """Opacity."""
    dashed: bool = False
    tips: tuple[str, ...] = ()
    """Texts of the points, besides their coordinates."""
    listed: bool = True
    """Whether legend and CSV contain the series."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """An axis of a chart's panel: label, limits, scale and ticks."""

    label: str
    limits: tuple[float, float]
    log: bool = False
    ticks: tuple[tuple[float, str], ...]
    named: tuple[tuple[float, str], ...] = ()
    """Values with a text to read out on the page, and the texts; by default the ticks."""
    words: bool = False
    """Whether the numbers only order the names; the CSV then contains the names."""
    slanted: bool = False
    """Whether long texts of ticks are slanted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A panel of a chart: two axes and the data series to draw on them."""

    title: str
    role: str = "ink"
    """Name of the title's colour."""
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    span: tuple[float, float, str] | None = None
    """Band of expected y: low, high and its text."""
    rules: tuple[float, ...] = ()
    """y of thin horizontal lines."""
    posts: tuple[float, ...] = ()
    """x of thin vertical lines."""
    equal: bool = False
    """Whether both axes have one scale and are hidden."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A figure as plain data (title, caption and panels), before it is drawn."""

    name: str
    """Name of its files."""
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: tuple[str, str]


def ticks(low: float, high: float, log: bool = False) -> tuple[tuple[float, str], ...]:
    """Return about five round numbers between two limits as ticks, each with its text.

    `low` is below `high`, and above 0 on a logarithmic axis. `log`: powers of ten, with 3 in
    between if they are fewer than three; linear ticks if fewer than two remain.
    """
    from matplotlib.ticker import LogLocator, MaxNLocator

    def inside(locator: "Locator", room: float = 0.0) -> list[float]:
        found = map(float, locator.tick_values(low, high))
        return [value for value in found if low - room <= value <= high + room]

    found = inside(LogLocator(subs=[1.0])) if log else []
    if log and len(found) < 3:
        found = inside(LogLocator(subs=[1.0, 3.0]))
    if len(found) >= 2:
        return tuple((value, f"{value:g}") for value in found)
    found = inside(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]), 1e-9 * (high - low))
    return tuple((value, f"{value:.10g}") for value in found)


def linear_axis(label: str, values: Iterable[float], *, floor: float | None = None) -> Axis:
    """Return a linear axis that contains all finite values, with a margin.

    `floor`: start of the axis; by default it starts below the smallest value.

    Examples
    --------
    >>> linear_axis("error [m]", [0.2, 1.0], floor=0.0).limits
    (0.0, 1.05)
    """
    finite = [value for value in values if math.isfinite(value)] or [0.0, 1.0]
    low, high = min(finite), max(finite)
    if floor is not None:
        low = floor
    room = 0.05 * (high - low) or 0.5
    limits = (low if floor is not None else low - room, high + room)
    return Axis(label=label, limits=limits, ticks=ticks(*limits))


def log_axis(label: str, values: Iterable[float]) -> Axis:
    """Return a logarithmic axis that contains all finite positive values."""
    finite = [value for value in values if math.isfinite(value) and value > 0.0] or [1.0, 10.0]
    limits = (0.9 * min(finite), 1.12 * max(finite))
    return Axis(label=label, limits=limits, log=True, ticks=ticks(*limits, log=True))


def ends(found: Iterable[Series]) -> list[float]:
    """Return all y values of several data series, including the ends of their intervals."""
    return [
        float(value)
        for series in found
        for part in (series.y, series.low, series.high)
        if part is not None
        for value in part
    ]


def column_count(count: int) -> int:
    """Return how many columns a figure has for a number of panels.

    Up to `style.MAX_COLUMNS` panels are in a single row; more have that many columns if they fill
    their rows, otherwise two.
    """
    if count <= MAX_COLUMNS:
        return count
    return 2 if count % MAX_COLUMNS else MAX_COLUMNS


def legend_series(panels: Iterable[Panel]) -> dict[str, Series]:
    """Return the data series that a legend lists, by name; none for more than `MOST_NAMES`."""
    named = {s.name: s for panel in panels for s in panel.series if s.listed and explained(s)}
    return named if len(named) <= MOST_NAMES else {}


def explained(series: Series) -> bool:
    """Return whether a data series belongs in the legend, unlike texts and single worlds' marks."""
    mark = MARKS[series.style]
    return not (mark.pinned or mark.written)


def csv_rows(chart: Chart, **constant: str) -> list[list[str]]:
    """Return the numbers of a chart as CSV rows with nine digits, a row per point.

    `constant`: first columns with the same value in all rows.
    """
    x, y = chart.columns
    rows = [[*constant, "panel", "series", "kind", x, y, f"{y}_low", f"{y}_high"]]
    for panel in chart.panels:
        for series in panel.series:
            if not series.listed:
                continue
            nothing = np.full(len(series.x), np.nan)
            low = nothing if series.low is None else series.low
            high = nothing if series.high is None else series.high
            head = [*constant.values(), panel.title, series.name, series.style]
            for place, *point in zip(series.x, series.y, low, high, strict=True):
                numbers = ("" if math.isnan(v) else f"{v:.9g}" for v in point)
                rows.append([*head, _place(panel.x, place), *numbers])
    return rows


def _place(axis: Axis, value: float) -> str:
    """Format a position on an axis: the nearest name if the axis has words, else the number."""
    if axis.words:
        return min(axis.named, key=lambda name: abs(name[0] - value))[1]
    return "" if math.isnan(value) else f"{value:.9g}"


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    """Format rows as CSV text, with quotes around fields that need them."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def draw_chart(chart: Chart) -> "Figure":
    """Draw a chart with matplotlib; raise ValueError without panels."""
    import matplotlib

    count = len(chart.panels)
    if count == 0:
        raise ValueError("a chart's figure needs at least one panel")
    columns = column_count(count)
    rows = -(-count // columns)
    height = ROW
    if (first := chart.panels[0]).equal:
        (left, right), (low, high) = first.x.limits, first.y.limits
        height = WIDTH[columns] / columns * (high - low) / (right - left)
    size = (WIDTH[columns], rows * height + REST)
    with matplotlib.rc_context(STYLE | PLAIN):
        figure = picture(*size)
        figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.06)
        figure.suptitle(chart.title, x=0.01, ha="left", fontsize=12, weight="bold")
        for i, panel in enumerate(chart.panels):
            axes = figure.add_subplot(rows, columns, i + 1)
            _draw_panel(axes, panel)
        if handles := [_handle(*named) for named in legend_series(chart.panels).items()]:
            longest = max(len(handle.get_label()) for handle in handles)
            fitting = max(1, int(size[0] / (0.5 + 0.065 * longest)))  # inches of a letter
            ncols = min(len(handles), 6, fitting)
            figure.legend(handles=handles, loc="outside lower left", ncols=ncols)
    return figure


def _colour(role: str) -> str:
    """Return the colour of a role, such as a strategy, "ink", "truth" or "grid"."""
    return {"ink": INK, "truth": TRUTH, "grid": "#d8d8d8"}.get(role) or strategy_colour(role)


def _draw_panel(axes: "Axes", panel: Panel) -> None:
    """Draw a panel of a chart on axes: background band and lines, then its data series."""
    from matplotlib.ticker import NullLocator

    if panel.title:
        axes.set_title(panel.title, color=_colour(panel.role), loc="left", weight="bold")
    if panel.equal:
        axes.set_aspect("equal")
        axes.set_axis_off()
    for name, axis, given in (("x", axes.xaxis, panel.x), ("y", axes.yaxis, panel.y)):
        scale = "log" if given.log else "linear"
        axes.set(**{f"{name}scale": scale, f"{name}lim": given.limits, f"{name}label": given.label})
        axis.set_minor_locator(NullLocator())
        axis.set_ticks([value for value, _ in given.ticks], [text for _, text in given.ticks])
        if given.slanted:
            for label in axis.get_ticklabels():
                label.set(rotation=35, ha="right", rotation_mode="anchor")
    if panel.span:
        axes.axhspan(*panel.span[:2], color="#d0d0d0", alpha=0.55, lw=0, zorder=0.5)
    for y in panel.rules:
        axes.axhline(y, color=INK, lw=0.8, zorder=1)
    for x in panel.posts:
        axes.axvline(x, color=TRUTH, lw=0.8, ls=(0, (2, 3)), zorder=1)
    for order, series in enumerate(panel.series):
        _draw_series(axes, series, panel.y.limits[1], 2.0 + 0.01 * order)


def _draw_series(axes: "Axes", series: Series, top: float, order: float) -> None:
    """Draw a data series on axes, in the style that it names in `MARKS`."""
    mark = MARKS[series.style]
    colour, alpha = _colour(series.role), series.strength
    given: dict[str, Any] = {"color": colour, "alpha": alpha, "zorder": order}
    x, y = series.x, series.y
    if mark.written:
        style = {"color": TRUTH if series.role == "grid" else colour, "ha": "center"}
        for at, up, text in zip(x, y, series.tips, strict=True):
            axes.text(at, up, text, va="center", fontsize=8, zorder=order, **style)
        return
    if mark.pinned:
        inside = y <= top
        given |= {"lw": 0, "mec": "none"}
        axes.plot(x[inside], y[inside], mark.symbol, ms=mark.size, **given)
        axes.plot(x[~inside], np.full(x[~inside].shape, 0.985 * top), "^", ms=3.4, **given)
        return
    if series.low is not None and series.high is not None:
        if mark.spread == "bars":
            axes.vlines(x, series.low, series.high, lw=1.6, **given)
        else:  # every band under every line
            band = {"color": colour, "alpha": 0.15, "lw": 0, "zorder": order - 0.5}
            axes.fill_between(x, series.low, series.high, **band)
    if mark.joined:
        axes.plot(x, y, lw=1.4, ls=(0, (4, 3)) if series.dashed else "-", **given)
    if mark.symbol:
        filled = np.ones(len(x), bool) if series.filled is None else series.filled
        look: dict[str, Any] = {"ms": mark.size, "lw": 0, "mec": colour, "zorder": order + 0.005}
        if mark.edge:
            look |= {"mec": "white", "mew": mark.edge}
        axes.plot(x[filled], y[filled], mark.symbol, mfc=colour, **look)
        axes.plot(x[~filled], y[~filled], mark.symbol, mfc="white", **look)


def _handle(name: str, series: Series) -> Any:
    """Return the matplotlib legend entry of a data series."""
    from matplotlib.lines import Line2D

    mark, colour = MARKS[series.style], _colour(series.role)
    hollow = series.filled is not None and not series.filled.any()
    return Line2D(
        [],
        [],
        color=colour,
        alpha=series.strength if series.strength < 1.0 else None,
        ls="--" if series.dashed else "-",
        lw=1.4 if mark.joined or series.low is not None else 0.0,
        marker=mark.symbol,
        ms=min(mark.size, 10.0),
        mfc="none" if hollow else colour,
        label=textwrap.shorten(name, 60),
    )
