"""A chart as data: what is drawn, without how. The printed figure, the page and the CSV agree.

A `Chart` holds panels, a `Panel` holds series over common axes. `paper` draws charts with
matplotlib, `report` draws the same ones as vectors on its page, `csv_text` writes their numbers.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Points that belong together.

    Attributes
    ----------
    name : str
    role : str
        What colours it: a strategy, "ink", "truth" or "grid".
    x, y : (n)
        Not finite: a gap.
    low, high : (n), optional
        Ends of a band, or of bars, about y.
    style : "line", "dots" (a line with markers), "points" (with bars), "marks" (small, for single
        worlds), "stars" or "text" (what `tips` say)
    filled : (n), optional
        Which points are full; all of them if not said.
    strength : 0 to 1
        Opacity.
    dashed : bool
    tips : tuple of str
        What to say of each point, where the axes alone do not.
    listed : bool
        Whether the legend and the CSV name it.
    """

    name: str
    role: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"] | None = None
    high: Float[np.ndarray, " n"] | None = None
    style: Literal["line", "dots", "points", "marks", "stars", "text"] = "line"
    filled: np.ndarray | None = None
    strength: float = 1.0
    dashed: bool = False
    tips: tuple[str, ...] = ()
    listed: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One direction of a panel.

    Attributes
    ----------
    label : str
    limits : low, high
    log : bool
    ticks : tuple of value and text
    """

    label: str
    limits: tuple[float, float]
    log: bool = False
    ticks: tuple[tuple[float, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Series over two axes.

    Attributes
    ----------
    title : str
    role : str
        Colours the title.
    x, y : Axis
    series : tuple of Series
    span : low, high, name; optional
        A band across the panel: where y should be.
    rules : tuple of float
        Where a thin line crosses the panel from left to right.
    posts : tuple of float
        Where one crosses it from bottom to top.
    equal : bool
        One unit is as long on both axes, which are not drawn.
    """

    title: str
    role: str = "ink"
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    span: tuple[float, float, str] | None = None
    rules: tuple[float, ...] = ()
    posts: tuple[float, ...] = ()
    equal: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Panels that make one figure.

    Attributes
    ----------
    name : str
        Of its files.
    title, caption : str
    panels : tuple of Panel
    columns : names of x and y in the CSV, with their units
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: tuple[str, str]


def ticks(low: float, high: float, log: bool = False) -> tuple[tuple[float, str], ...]:
    """Round numbers along an axis, about five of them.

    Parameters
    ----------
    low, high : float
        low below high; above 0 where the axis is logarithmic.
    log : bool
        Powers of ten, with 3 in between where there are fewer than three.

    Returns
    -------
    tuple of value and text

    Examples
    --------
    >>> [text for _, text in ticks(0.0, 0.93)], [text for _, text in ticks(0.8, 250.0, log=True)]
    (['0', '0.2', '0.4', '0.6', '0.8'], ['1', '10', '100'])
    """
    if log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        found = [10.0**k for k in powers]
        if len([value for value in found if low <= value <= high]) < 3:
            found = sorted([*found, *(3.0 * value for value in found)])
        return tuple((value, f"{value:g}") for value in found if low <= value <= high)
    rough = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1.0, 2.0, 5.0, 10.0) if power * m >= 0.999 * rough)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return tuple((k * step, f"{k * step:.10g}") for k in range(first, last + 1))


def linear_axis(label: str, values: Iterable[float], *, floor: float | None = None) -> Axis:
    """Axis that holds some values, with a little room.

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
    """Logarithmic axis that holds some values.

    Parameters
    ----------
    label : str
    values : iterable of float
        Those that are not finite and above 0 are left out.

    Returns
    -------
    Axis

    Examples
    --------
    >>> log_axis("NEES", [1.0, 100.0]).ticks
    ((1.0, '1'), (10.0, '10'), (100.0, '100'))
    """
    finite = [value for value in values if math.isfinite(value) and value > 0.0] or [1.0, 10.0]
    limits = (0.9 * min(finite), 1.12 * max(finite))
    return Axis(label=label, limits=limits, log=True, ticks=ticks(*limits, log=True))


def ends(found: Iterable[Series]) -> list[float]:
    """Numbers that an axis has to hold to show some series.

    Parameters
    ----------
    found : iterable of Series

    Returns
    -------
    list of float

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


def csv_rows(chart: Chart, **constant: str) -> list[list[str]]:
    """Lay the numbers of a chart out, one row per point, to nine digits.

    Parameters
    ----------
    chart : Chart
    constant : str
        Further columns, the same in each row, put first.

    Returns
    -------
    list of rows, the header first

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
            for point in zip(series.x, series.y, low, high, strict=True):
                rows.append([*head, *("" if math.isnan(v) else f"{v:.9g}" for v in point)])
    return rows


def csv_text(rows: Sequence[Sequence[str]]) -> str:
    r"""Write rows as CSV.

    Parameters
    ----------
    rows : sequence of sequences of str

    Returns
    -------
    str
        Fields with a comma, a quote or a line break are quoted.

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
