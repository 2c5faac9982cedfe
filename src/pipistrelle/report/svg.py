"""Charts as SVG for the page, with readable points.

A ``tip`` is an element with a title, which the page's script shows on hover, tap or by the arrow
keys, and the browser by itself without scripts. The style sheet gives the colours.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from pipistrelle.figures.chart import MARKS, Axis, Panel, Series, explained, legend_series
from pipistrelle.report.variables import three_digits

WIDTH, HEIGHT = 400.0, 280.0
"""Size of a panel [px on a small screen]."""
LEFT, RIGHT, TOP, BOTTOM = 54.0, 8.0, 10.0, 42.0
"""Margins."""
SLANT = 34.0
"""Additional room for slanted words."""
MAX_READINGS = 80
"""Most positions along a panel at which its numbers can be read."""


def panel_svg(panel: Panel) -> Markup:
    """Return a panel as an ``svg`` element with escaped texts.

    Examples
    --------
    >>> axis = Axis(label="", limits=(0.0, 1.0), ticks=())
    >>> str(panel_svg(Panel(title="<EKF>", x=axis, y=axis, series=())))[:77]
    '<svg class="panel" viewBox="0 0 400 280" role="img" tabindex="0" aria-label="'
    >>> "<EKF>" in panel_svg(Panel(title="<EKF>", x=axis, y=axis, series=()))
    False
    """
    frame = _frame(panel)
    parts = [*_grid(panel, frame)]
    for series in panel.series:  # every band under every line
        if MARKS[series.style].spread == "band":
            parts += _spread(series, frame)
    for series in panel.series:
        parts += _series(series, frame)
    if not panel.equal:
        parts += [
            _tip("rect", text, f'x="{x0:.1f}" y="{TOP:g}" width="{x1 - x0:.1f}" '
                 f'height="{frame.bottom - TOP:.1f}"')
            for text, x0, x1 in _columns(panel, frame)
        ]  # fmt: skip
    return Markup(
        '<svg class="panel" viewBox="0 0 {} {}" role="img" tabindex="0" '
        'aria-label="{}. Arrow keys read the numbers.">{}</svg>'
    ).format(f"{WIDTH:g}", f"{frame.height:g}", panel.title or panel.y.label or "chart",
             Markup("").join(parts))  # fmt: skip


def readings(panel: Panel) -> list[tuple[float, str, list[tuple[str, str]]]]:
    """Return the numbers of a panel at each position: position, its name, series and texts.

    Examples
    --------
    >>> axis = Axis(label="", limits=(0.0, 90.0), ticks=((33.0, "33"),))
    >>> one, tenth = np.ones(1), np.full(1, 0.1)
    >>> about = {"low": one - tenth, "high": one + tenth}
    >>> dot = Series(name="fused", role="fused", x=33 * one, y=one, **about)
    >>> readings(Panel(title="", x=axis, y=axis, series=(dot,)))
    [(33.0, '33', [('fused', '1 ± 0.1')])]
    """
    named = [s for s in panel.series if s.listed and explained(s) and len(s.x)]
    if not named or panel.equal:
        return []
    if panel.x.named:
        return [(place, name, _texts_at(named, panel.x, place)) for place, name in panel.x.named]
    span = panel.x.limits[1] - panel.x.limits[0]
    ticks = np.array([value for value, _ in panel.x.ticks])
    every = np.unique(np.concatenate([s.x for s in named]))
    near = np.abs(every[:, None] - ticks).min(axis=1, initial=math.inf) if len(ticks) else every + 1
    at_ticks = bool(np.all(near <= 0.03 * span)) and len(every) > 0
    places = ticks if at_ticks else every[:: -(-len(every) // MAX_READINGS)]
    names = [t for _, t in panel.x.ticks] if at_ticks else [f"{value:g}" for value in places]
    rows = []
    for place, name in zip(places, names, strict=True):
        texts = []
        for series in named:
            i = int(np.argmin(np.abs(series.x - place)))
            if abs(series.x[i] - place) <= 0.03 * span and math.isfinite(series.y[i]):
                texts.append((series.name, _number(series, i)))
        rows.append((float(place), name, texts))
    return rows


def _texts_at(named: Sequence[Series], axis: Axis, place: float) -> list[tuple[str, str]]:
    """Return the point of each series that is nearest to a named position and to no other."""
    places = np.array([value for value, _ in axis.named])
    texts = []
    for series in named:
        away = np.abs(_share(axis, series.x) - _share(axis, place))
        nearest = np.abs(_share(axis, series.x)[:, None] - _share(axis, places)).min(axis=1)
        i = int(np.argmin(away))
        if away[i] <= nearest[i] and math.isfinite(series.y[i]):
            texts.append((series.name, _number(series, i)))
    return texts


class _Frame(NamedTuple):
    """A panel and the position of its axes in the drawing."""

    panel: Panel
    left: float
    right: float
    top: float
    bottom: float
    height: float


def _frame(panel: Panel) -> _Frame:
    """Return the frame of a panel; equal axes have no margins."""
    if not panel.equal:
        bottom = HEIGHT - BOTTOM - (SLANT if panel.x.slanted else 0.0)
        return _Frame(panel, LEFT, WIDTH - RIGHT, TOP, bottom, HEIGHT)
    (left, right), (low, high) = panel.x.limits, panel.y.limits
    height = WIDTH * (high - low) / (right - left)
    return _Frame(panel, 0.0, WIDTH, 0.0, height, height)


def _across(frame: _Frame, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    return np.asarray(frame.left + _share(frame.panel.x, values) * (frame.right - frame.left))


def _down(frame: _Frame, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    share = np.clip(_share(frame.panel.y, values), 0.0, 1.0)
    return np.asarray(frame.bottom - share * (frame.bottom - frame.top))


def _share(axis: Axis, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return the positions of values as fractions of an axis; NaN stays NaN."""
    low, high = axis.limits
    numbers = np.asarray(values, dtype=np.float64)
    if axis.log:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(numbers / low) / math.log(high / low))
    return np.asarray((numbers - low) / (high - low))


def _grid(panel: Panel, frame: _Frame) -> list[Markup]:
    """Draw the background: span, grid, ticks, labels, rules and posts."""
    if panel.equal:
        return []
    right, bottom, parts = WIDTH - RIGHT, frame.bottom, []
    if panel.span:
        low, high, name = panel.span
        top = float(_down(frame, high))
        shape = 'class="span" x="{}" y="{:.1f}" width="{:.1f}" height="{:.1f}"'
        shape = shape.format(LEFT, top, right - LEFT, float(_down(frame, low)) - top)
        parts.append(Markup("<rect {}><title>{}</title></rect>").format(Markup(shape), name))
    for value, text in panel.y.ticks:
        y = float(_down(frame, value))
        parts.append(Markup(f'<path class="grid" d="M{LEFT:g} {y:.1f}H{right:g}"/>'))
        parts.append(_text(text, LEFT - 6, y + 4, "end"))
    for value, text in panel.x.ticks:
        x = float(_across(frame, value))
        parts.append(Markup(f'<path class="grid" d="M{x:.1f} {TOP:g}V{bottom:g}"/>'))
        if panel.x.slanted:
            place = f"translate({x + 4.0:.1f} {bottom + 14.0:.1f}) rotate(-35)"
            words = Markup('<text text-anchor="end" transform="{}">{}</text>')
            parts.append(words.format(place, text))
        else:
            parts.append(_text(text, x, bottom + 16, "middle"))
    for value in panel.rules:
        y = float(_down(frame, value))
        parts.append(Markup(f'<path class="rule" d="M{LEFT:g} {y:.1f}H{right:g}"/>'))
    for value in panel.posts:
        x = float(_across(frame, value))
        parts.append(Markup(f'<path class="post" d="M{x:.1f} {TOP:g}V{bottom:g}"/>'))
    parts.append(_text(panel.x.label, (LEFT + right) / 2.0, HEIGHT - 6, "middle"))
    middle = (TOP + bottom) / 2.0
    parts.append(
        Markup('<text class="label" text-anchor="middle" transform="translate(12 {:.1f}) '
               'rotate(-90)">{}</text>').format(middle, panel.y.label)
    )  # fmt: skip
    return parts


def _series(series: Series, frame: _Frame) -> list[Markup]:
    """Draw a series by its mark, without its band."""
    mark = MARKS[series.style]
    x, y = _across(frame, series.x), _down(frame, series.y)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y)).tolist()
    if mark.written:
        return [_text(series.tips[i], x[i], y[i] + 4.0, "middle") for i in known]
    if mark.pinned and not series.tips:
        return _pinned(series, x, y, frame.panel.y.limits[1])
    parts = _spread(series, frame) if mark.spread == "bars" else []
    if mark.joined:
        parts.append(_stroke("line dashed" if series.dashed else "line", series, _path(x, y)))
    if mark.symbol:
        parts += [_point(series, i, float(x[i]), float(y[i])) for i in known]
    return parts


def _stroke(kind: str, series: Series, d: str) -> Markup:
    """Draw a path in a series' colour."""
    faint = f' style="opacity:{series.strength:.2f}"' if series.strength < 1.0 else ""
    return Markup('<path class="{} c-{}"{} d="{}"/>').format(kind, series.role, Markup(faint), d)


def _pinned(series: Series, x: np.ndarray, y: np.ndarray, top: float) -> list[Markup]:
    """Draw single worlds as dots, or as triangles at the top if beyond the panel."""
    above = series.y > top
    points = list(zip(x.tolist(), y.tolist(), above.tolist(), strict=True))
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b, over in points if not over)
    tops = "".join(f"M{a:.1f} {b + 1.0:.1f}l2.6 5h-5.2z" for a, b, over in points if over)
    return [_stroke(kind, series, d) for kind, d in (("marks", dots), ("tops", tops)) if d]


def _spread(series: Series, frame: _Frame) -> list[Markup]:
    """Draw the band of a line or the bars of points, if any."""
    if series.low is None or series.high is None:
        return []
    x = _across(frame, series.x)
    low, high = _down(frame, series.low), _down(frame, series.high)
    both = np.isfinite(low) & np.isfinite(high)
    ends = list(zip(x[both].tolist(), low[both].tolist(), high[both].tolist(), strict=True))
    if MARKS[series.style].spread == "bars":
        kind, d = "bars", "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in ends)
    else:
        edge = [f"{a:.1f} {c:.1f}" for a, _, c in ends]
        edge += [f"{a:.1f} {b:.1f}" for a, b, _ in reversed(ends)]
        kind, d = "band", "M" + "L".join(edge) + "z" if edge else ""
    return [Markup('<path class="{} c-{}" d="{}"/>').format(kind, series.role, d)]


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Return the path data of a line with gaps at points that are not finite."""
    text, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if math.isfinite(a) and math.isfinite(b):
            text.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(text)


def _point(series: Series, i: int, x: float, y: float) -> Markup:
    """Draw a symbol, as a tip if the series has texts."""
    mark = MARKS[series.style]
    filled = series.filled is None or bool(series.filled[i])
    kind = f"dot c-{series.role}{'' if filled else ' hollow'}"
    name, shape = "circle", f'cx="{x:.1f}" cy="{y:.1f}" r="{mark.radius:g}"'
    if mark.corners:
        corners = "L".join(f"{x + right:.1f} {y + down:.1f}" for right, down in mark.corners)
        name, shape = "path", f'd="M{corners}z"'
    if series.tips:
        return _tip(name, series.tips[i], shape, kind)
    return Markup('<{} class="{}" {}/>').format(name, kind, Markup(shape))


def _tip(name: str, text: str, shape: str, kind: str = "column") -> Markup:
    """Return an element with a title that can be read."""
    return Markup('<{} class="tip {}" {}><title>{}</title></{}>').format(
        name, kind, Markup(shape), text, name
    )


def _text(text: str, x: float, y: float, anchor: str) -> Markup:
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(
        x, y, anchor, text
    )


def _columns(panel: Panel, frame: _Frame) -> list[tuple[str, float, float]]:
    """Return text and edges of the columns around the readable positions of a panel."""
    read = readings(panel)
    if not read:
        return []
    unit = "°" if "[°]" in panel.x.label else (" s" if "[s]" in panel.x.label else "")
    unit = "" if panel.x.named else unit
    at = [float(_across(frame, place)) for place, _, _ in read]
    edges = [LEFT, *((a + b) / 2.0 for a, b in pairwise(at)), WIDTH - RIGHT]
    texts = [
        "\n".join([f"{name}{unit}", *(f"{series}: {number}" for series, number in rows)])
        for _, name, rows in read
    ]
    return list(zip(texts, edges[:-1], edges[1:], strict=True))


def _number(series: Series, i: int) -> str:
    """Format a point with its interval."""
    value = series.y[i]
    if series.low is None or series.high is None or not math.isfinite(series.low[i]):
        return three_digits(value)
    below, above = value - series.low[i], series.high[i] - value
    if abs(below - above) <= 1e-9 * max(abs(below), abs(above), 1e-300):
        return f"{three_digits(value)} ± {three_digits(above)}"
    return (
        f"{three_digits(value)} ({three_digits(series.low[i])} to {three_digits(series.high[i])})"
    )


def legend(panels: Sequence[Panel]) -> list[tuple[str, str, str, float]]:
    """Return name, role, swatch and strength of each entry of the panels' legend.

    Returns: empty if there are many names, which the caption then explains.
    """
    entries = []
    for name, series in legend_series(panels).items():
        kind = "dashed" if series.dashed else MARKS[series.style].swatch
        if series.filled is not None and not series.filled.any() and not series.dashed:
            kind = "hollow"
        entries.append((name, series.role, kind, series.strength))
    return entries
