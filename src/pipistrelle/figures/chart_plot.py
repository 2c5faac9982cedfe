"""Charts on paper: the same numbers as on the report's page, for a document or a slide."""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.figures.chart import Axis, Chart, Panel, Series
from pipistrelle.figures.style import COLUMNS, INK, STYLE, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = {1: 6.0, 2: 9.0, 3: 12.0}
"""Of a figure, by the number of panels beside each other [inch]."""
ROW, REST = 3.3, 0.8
"""Height of a row of panels, and of title and legend together [inch]."""
TEXT = {"grid": "#8a8a8a"}
"""Colours of text where it would be too faint in its role's own."""
BAND = 0.15
"""Opacity of a band."""


def draw_chart(chart: Chart) -> "Figure":
    """Draw a chart.

    Parameters
    ----------
    chart : Chart

    Returns
    -------
    Figure
        Not known to pyplot.

    Raises
    ------
    ValueError
        Without panels.

    Examples
    --------
    >>> draw_chart(Chart(name="", title="", caption="", panels=(), columns=("x", "y")))
    Traceback (most recent call last):
    ValueError: a chart's figure needs at least one panel
    """
    import matplotlib
    from matplotlib.figure import Figure

    count = len(chart.panels)
    if count == 0:
        raise ValueError("a chart's figure needs at least one panel")
    columns = count if count <= COLUMNS else 2
    rows = -(-count // columns)
    height = ROW
    if (first := chart.panels[0]).equal:
        (left, right), (low, high) = first.x.limits, first.y.limits
        height = WIDTH[columns] / columns * (high - low) / (right - left)
    size = (WIDTH[columns], rows * height + REST)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size)
        figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.06)
        figure.suptitle(chart.title, x=0.01, ha="left", fontsize=12, weight="bold")
        for i, panel in enumerate(chart.panels):
            axes = figure.add_subplot(rows, columns, i + 1)
            _draw_panel(axes, panel)
        if handles := _handles(chart):
            figure.legend(handles=handles, loc="outside lower left", ncols=min(len(handles), 6))
    return figure


def _colour(role: str) -> str:
    """Return the colour of a role."""
    return {"ink": INK, "truth": TRUTH, "grid": "#d8d8d8"}.get(role) or strategy_colour(role)


def _draw_panel(axes: "Axes", panel: Panel) -> None:
    """Draw what a panel holds, the band and the rules below the series."""
    from matplotlib.ticker import NullLocator

    if panel.title:
        axes.set_title(panel.title, color=_colour(panel.role), loc="left", weight="bold")
    if panel.equal:
        axes.set_aspect("equal")
        axes.set_axis_off()
    else:
        axes.grid(True)
    axes.set_axisbelow(True)
    axes.set(xscale=_scale(panel.x), yscale=_scale(panel.y))
    axes.set(xlim=panel.x.limits, ylim=panel.y.limits, xlabel=panel.x.label, ylabel=panel.y.label)
    for axis, given in ((axes.xaxis, panel.x), (axes.yaxis, panel.y)):
        axis.set_minor_locator(NullLocator())
        axis.set_ticks([value for value, _ in given.ticks], [text for _, text in given.ticks])
    if panel.span:
        axes.axhspan(*panel.span[:2], color="#d0d0d0", alpha=0.55, lw=0, zorder=0.5)
    for y in panel.rules:
        axes.axhline(y, color=INK, lw=0.8, zorder=1)
    for x in panel.posts:
        axes.axvline(x, color=TRUTH, lw=0.8, ls=(0, (2, 3)), zorder=1)
    for order, series in enumerate(panel.series):
        _draw_series(axes, series, panel.y.limits[1], 2.0 + 0.01 * order)


def _scale(axis: Axis) -> str:
    return "log" if axis.log else "linear"


def _draw_series(axes: "Axes", series: Series, top: float, order: float) -> None:
    """Draw one series in its style; single worlds above the panel are pinned to its edge."""
    colour, alpha = _colour(series.role), series.strength
    given: dict[str, Any] = {"color": colour, "alpha": alpha, "zorder": order}
    x, y = series.x, series.y
    if series.style == "text":
        for at, up, text in zip(x, y, series.tips, strict=True):
            axes.text(at, up, text, color=TEXT.get(series.role, colour), ha="center", va="center",
                      fontsize=8, zorder=order)  # fmt: skip
        return
    if series.style == "marks":
        inside = y <= top
        given |= {"lw": 0, "mec": "none"}
        axes.plot(x[inside], y[inside], "o", ms=2.4, **given)
        axes.plot(x[~inside], np.full(x[~inside].shape, 0.985 * top), "^", ms=3.4, **given)
        return
    if series.style == "stars":
        axes.plot(x, y, "*", ms=13, color=colour, mec="white", mew=0.8, zorder=order)
        return
    if series.low is not None and series.high is not None:
        if series.style == "points":
            axes.vlines(x, series.low, series.high, lw=1.6, **given)
        else:
            axes.fill_between(
                x, series.low, series.high, color=colour, alpha=BAND, lw=0, zorder=order
            )
    style = (0, (4, 3)) if series.dashed else "-"
    if series.style != "points":
        axes.plot(x, y, lw=1.4, ls=style, **given)
    if series.style in ("dots", "points"):
        filled = np.ones(len(x), bool) if series.filled is None else series.filled
        mark = {"ms": 5.0, "lw": 0, "mec": colour, "zorder": order + 0.005}
        axes.plot(x[filled], y[filled], "o", mfc=colour, **mark)
        axes.plot(x[~filled], y[~filled], "o", mfc="white", **mark)


def _handles(chart: Chart) -> list[Any]:
    """Return one legend entry per name; many alike are told by the caption instead."""
    named = {
        series.name: series
        for panel in chart.panels
        for series in panel.series
        if series.listed and series.style not in ("marks", "text")
    }
    if len(named) > 6:
        return []
    return [_handle(name, series) for name, series in named.items()]


def _handle(name: str, series: Series) -> Any:
    """Return one legend entry."""
    from matplotlib.lines import Line2D

    colour = _colour(series.role)
    hollow = series.filled is not None and not series.filled.any()
    line = series.style in ("line", "dots") or series.low is not None
    return Line2D(
        [],
        [],
        color=colour,
        ls="--" if series.dashed else "-",
        lw=1.4 if line else 0.0,
        marker={"dots": "o", "points": "o", "stars": "*"}.get(series.style, ""),
        ms=10 if series.style == "stars" else 5,
        mfc="none" if hollow else colour,
        label=textwrap.shorten(name, 60),
    )
