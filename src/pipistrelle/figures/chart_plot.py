"""Charts on paper: the same numbers as on the report's page, for a document or a slide."""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.figures.chart import MARKS, Axis, Chart, Panel, Series, columns_of, legend_series
from pipistrelle.figures.style import INK, STYLE, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = {1: 6.0, 2: 9.0, 3: 12.0}
"""Of a figure, by the number of panels beside each other [inch]."""
ROW, REST = 3.3, 0.8
"""Height of a row of panels, and of title and legend together [inch]."""
TEXT = {"grid": "#8a8a8a"}
"""Colours of text where it would be too faint in its role's own."""
PLAIN = {"text.parse_math": False}
"""Names are shown as they are, dollars included."""
LETTER = 0.065
"""Width of a letter of the legend [inch]."""
BAND = 0.15
"""Opacity of a band."""


def draw_chart(chart: Chart) -> "Figure":
    """Draw a chart.

    Returns: not known to pyplot. Raises ValueError without panels.

    Examples
    --------
    >>> draw_chart(Chart(name="", title="", caption="", panels=(), columns=("x", "y")))
    Traceback (most recent call last):
    ValueError: a chart's figure needs at least one panel
    """
    import matplotlib

    from pipistrelle.figures.picture import picture

    count = len(chart.panels)
    if count == 0:
        raise ValueError("a chart's figure needs at least one panel")
    columns = columns_of(count)
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
            fitting = max(1, int(size[0] / (0.5 + LETTER * longest)))
            ncols = min(len(handles), 6, fitting)
            figure.legend(handles=handles, loc="outside lower left", ncols=ncols)
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


def _scale(axis: Axis) -> str:
    return "log" if axis.log else "linear"


def _draw_series(axes: "Axes", series: Series, top: float, order: float) -> None:
    """Draw one series as its mark says."""
    mark = MARKS[series.style]
    colour, alpha = _colour(series.role), series.strength
    given: dict[str, Any] = {"color": colour, "alpha": alpha, "zorder": order}
    x, y = series.x, series.y
    if mark.written:
        for at, up, text in zip(x, y, series.tips, strict=True):
            axes.text(at, up, text, color=TEXT.get(series.role, colour), ha="center", va="center",
                      fontsize=8, zorder=order)  # fmt: skip
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
        else:
            below = order - 0.5  # every band under every line
            axes.fill_between(
                x, series.low, series.high, color=colour, alpha=BAND, lw=0, zorder=below
            )
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
    """Return one legend entry."""
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
