"""A chart as data: what is drawn, without how. The printed figure, the page and the CSV agree.

A `Chart` holds panels, a `Panel` holds series over common axes. `chart_plot` draws charts with
matplotlib, `report` draws the same ones as vectors on its page, `csv_text` writes their numbers.
What a series can look like stands in `MARKS`, for both; another look is another row there.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.figures.style import MAX_COLUMNS

if TYPE_CHECKING:
    from matplotlib.ticker import Locator


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """How the points of a series are shown."""

    joined: bool = False
    """By a line."""
    spread: Literal["band", "bars"] = "band"
    """What `low` and `high` are drawn as."""
    symbol: str = ""
    """At each point, as matplotlib names it; none if empty."""
    size: float = 5.0
    edge: float = 0.0
    """0: it has none."""
    corners: tuple[tuple[float, float], ...] = ()
    """Of the symbol on the page, about the point, y down; if there are none, it is a circle."""
    radius: float = 3.2
    pinned: bool = False
    """Small and many, for single worlds: those above the panel stand at its edge."""
    written: bool = False
    """No symbol: what `tips` say stands at the points."""
    swatch: Literal["line", "dashed", "dot", "star"] = "line"
    """Its sign in the page's legend."""


def _star(outer: float, inner: float) -> tuple[tuple[float, float], ...]:
    """Return the corners of a star of five points, one of them up."""
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
"""What a series can look like, by the name that the CSV gives it."""
MOST_NAMES = 6
"""Most names of a legend."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Points that belong together."""

    name: str
    role: str
    """What colours it: a strategy, "ink", "truth" or "grid"."""
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    """Not finite: a gap."""
    low: Float[np.ndarray, " n"] | None = None
    high: Float[np.ndarray, " n"] | None = None
    """Ends of a band, or of bars, about y."""
    style: str = "line"
    """One of `MARKS`."""
    filled: np.ndarray | None = None
    """Which points are full; all of them if not said."""
    strength: float = 1.0
    """Opacity."""
    dashed: bool = False
    tips: tuple[str, ...] = ()
    """What to say of each point, where the axes alone do not."""
    listed: bool = True
    """Whether the legend and the CSV name it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One direction of a panel."""

    label: str
    limits: tuple[float, float]
    log: bool = False
    ticks: tuple[tuple[float, str], ...]
    named: tuple[tuple[float, str], ...] = ()
    """The places at which there is something to read out, as the page calls them; where there are
    none, it takes the ticks."""
    words: bool = False
    """The numbers are no more than the order of those names: the CSV has the names."""
    slanted: bool = False
    """The ticks' words are written upwards, for they are too long to stand side by side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Series over two axes."""

    title: str
    role: str = "ink"
    """Colours the title."""
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    span: tuple[float, float, str] | None = None
    """A band across the panel: where y should be."""
    rules: tuple[float, ...] = ()
    """Where a thin line crosses the panel from left to right."""
    posts: tuple[float, ...] = ()
    """Where one crosses it from bottom to top."""
    equal: bool = False
    """One unit is as long on both axes, which are not drawn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Panels that make one figure."""

    name: str
    """Of its files."""
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: tuple[str, str]


def ticks(low: float, high: float, log: bool = False) -> tuple[tuple[float, str], ...]:
    """Round numbers along an axis, about five of them.

    `low` and `high`: low below high; above 0 where the axis is logarithmic. `log`: powers of ten,
    with 3 in between where there are fewer than three; numbers as along a linear axis where that
    would leave one or none.

    Examples
    --------
    >>> [text for _, text in ticks(0.0, 0.93)], [text for _, text in ticks(0.8, 250.0, log=True)]
    (['0', '0.2', '0.4', '0.6', '0.8'], ['1', '10', '100'])
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
    """Return an axis that holds some values, with a little room.

    Parameters
    ----------
    label : str
    values : iterable of float
        Those that are not finite are left out.
    floor : float, optional
        Where the axis begins, else below the smallest value.

    Returns
    -------
    Axis

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
    """Return a logarithmic axis that holds some values.

    `values`: those that are not finite and above 0 are left out.

    Examples
    --------
    >>> log_axis("NEES", [1.0, 100.0]).ticks
    ((1.0, '1'), (10.0, '10'), (100.0, '100'))
    """
    finite = [value for value in values if math.isfinite(value) and value > 0.0] or [1.0, 10.0]
    limits = (0.9 * min(finite), 1.12 * max(finite))
    return Axis(label=label, limits=limits, log=True, ticks=ticks(*limits, log=True))


def ends(found: Iterable[Series]) -> list[float]:
    """Return the numbers that an axis has to hold to show some series.

    Examples
    --------
    >>> ends([Series(name="", role="ink", x=np.zeros(1), y=np.ones(1), high=np.full(1, 2.0))])
    [1.0, 2.0]
    """
    return [
        float(value)
        for series in found
        for part in (series.y, series.low, series.high)
        if part is not None
        for value in part
    ]


def columns_of(count: int) -> int:
    """Tell how many panels stand beside each other.

    `count`: panels of the chart. Returns: all, up to `style.MAX_COLUMNS`; of more, as many
    as that if they fill their rows, else two.

    Examples
    --------
    >>> [columns_of(count) for count in (1, 3, 4, 6)]
    [1, 3, 2, 3]
    """
    if count <= MAX_COLUMNS:
        return count
    return 2 if count % MAX_COLUMNS else MAX_COLUMNS


def legend_series(panels: Iterable[Panel]) -> dict[str, Series]:
    """List what a legend over some panels explains.

    Returns: by name, the last of each; empty where the names are many: there the caption tells.

    Examples
    --------
    >>> axis = Axis(label="", limits=(0.0, 1.0), ticks=())
    >>> dot = Series(name="fused", role="fused", x=np.ones(1), y=np.ones(1), style="points")
    >>> list(legend_series([Panel(title="", x=axis, y=axis, series=(dot,))] * 2))
    ['fused']
    """
    named = {s.name: s for panel in panels for s in panel.series if s.listed and explained(s)}
    return named if len(named) <= MOST_NAMES else {}


def explained(series: Series) -> bool:
    """Tell whether a series has a sign in the legend, and is read out by its name.

    Returns: not of single worlds, nor of what is written out.
    """
    mark = MARKS[series.style]
    return not (mark.pinned or mark.written)


def csv_rows(chart: Chart, **constant: str) -> list[list[str]]:
    """Lay the numbers of a chart out, one row per point, to nine digits.

    `constant`: further columns, the same in each row, put first.

    Examples
    --------
    >>> axis = Axis(label="", limits=(0.0, 1.0), ticks=())
    >>> dot = Series(name="fused", role="fused", x=np.array([33.0]), y=np.array([0.25]))
    >>> panel = Panel(title="EKF", x=axis, y=axis, series=(dot,))
    >>> chart = Chart(name="", title="", caption="", panels=(panel,), columns=("deg", "m"))
    >>> csv_rows(chart)[1]
    ['EKF', 'fused', 'line', '33', '0.25', '', '']
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
    """Write where a point stands: the name that is nearest, or the number."""
    if axis.words:
        return min(axis.named, key=lambda name: abs(name[0] - value))[1]
    return "" if math.isnan(value) else f"{value:.9g}"


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    r"""Write rows as CSV.

    Returns: fields with a comma, a quote or a line break are quoted.

    Examples
    --------
    >>> csv_text([["a", "b"], ["1,5", "2"]])
    'a,b\n"1,5",2\n'
    """
    import csv
    import io

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
