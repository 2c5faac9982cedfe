"""Charts as SVG for the page, with readable points.

A ``tip`` is an element with a title, which the page's script shows on hover, tap or by the arrow
keys, and the browser by itself without scripts. The style sheet gives the colours.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from pipistrelle.figures.chart import MARKS, Axis, Panel, Series, explained, legend_series
from pipistrelle.report.variables import three_digits

WIDTH, HEIGHT = 400.0, 280.0
"""Size of a panel [px on a small screen]."""
BOX = (54.0, 392.0, 10.0, 238.0)
"""Left, right, upper and lower edges of the axes."""
SLANT = 34.0
"""Additional room for slanted words."""
MAX_READINGS = 80
"""Most positions along a panel at which its numbers can be read."""


def panel_svg(panel: Panel) -> Markup:
    """Draw a panel of a chart as an ``svg`` element with escaped texts.

    Examples
    --------
    >>> axis = Axis(label="", limits=(0.0, 1.0), ticks=())
    >>> str(panel_svg(Panel(title="<EKF>", x=axis, y=axis, series=())))[25:61]
    'img" tabindex="0" viewBox="0 0 400 2'
    """
    _, _, top, bottom = _box(panel)
    svg = Element("svg", {"class": "panel", "role": "img", "tabindex": "0"})
    svg.set("viewBox", f"0 0 {WIDTH:g} {bottom if panel.equal else HEIGHT:g}")
    title = panel.title or panel.y.label or "chart"
    svg.set("aria-label", f"{title}. Arrow keys read the numbers.")
    if not panel.equal:
        _draw_grid(svg, panel)
    for series in panel.series:  # every band under every line
        if MARKS[series.style].spread == "band":
            _draw_spread(svg, series, panel)
    for series in panel.series:
        _draw_series(svg, series, panel)
    for text, left, right in [] if panel.equal else _columns(panel):
        place = {"x": f"{left:.1f}", "width": f"{right - left:.1f}"}
        place |= {"y": f"{top:g}", "height": f"{bottom - top:.1f}"}
        _add(svg, "rect", "tip column", title=text, **place)
    return Markup(tostring(svg, encoding="unicode"))


def _add(
    svg: Element, name: str, kind: str = "", text: str = "", title: str = "", **attributes: str
) -> None:
    """Append an element to an SVG image, with a tooltip if `title` is given."""
    given = {key.replace("_", "-"): value for key, value in attributes.items()}
    element = SubElement(svg, name, ({"class": kind} if kind else {}) | given)
    element.text = text
    if title:
        SubElement(element, "title").text = title


def readings(panel: Panel) -> list[tuple[float, str, list[tuple[str, str]]]]:
    """Return a panel's numbers to read out: for each position its name and all series' values."""
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
    """Return the value of each series at a named position, if its nearest point belongs there."""
    places = np.array([value for value, _ in axis.named])
    texts = []
    for series in named:
        away = np.abs(_share(axis, series.x) - _share(axis, place))
        nearest = np.abs(_share(axis, series.x)[:, None] - _share(axis, places)).min(axis=1)
        i = int(np.argmin(away))
        if away[i] <= nearest[i] and math.isfinite(series.y[i]):
            texts.append((series.name, _number(series, i)))
    return texts


def _box(panel: Panel) -> tuple[float, float, float, float]:
    """Return the left, right, upper and lower edges [px] of a panel's axes."""
    if not panel.equal:
        left, right, top, bottom = BOX
        longest = max((len(text) for _, text in panel.y.ticks), default=0)
        return max(left, 28.0 + 7.5 * longest), right, top, bottom - SLANT * panel.x.slanted
    (left, right), (low, high) = panel.x.limits, panel.y.limits
    return 0.0, WIDTH, 0.0, WIDTH * (high - low) / (right - left)


def _across(panel: Panel, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    left, right, _, _ = _box(panel)
    return np.asarray(left + _share(panel.x, values) * (right - left))


def _down(panel: Panel, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    _, _, top, bottom = _box(panel)
    share = np.clip(_share(panel.y, values), 0.0, 1.0)
    return np.asarray(bottom - share * (bottom - top))


def _share(axis: Axis, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Convert values to fractions of an axis's length; NaN stays NaN."""
    low, high = axis.limits
    numbers = np.asarray(values, dtype=np.float64)
    if axis.log:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(numbers / low) / math.log(high / low))
    return np.asarray((numbers - low) / (high - low))


def _draw_grid(svg: Element, panel: Panel) -> None:
    """Draw a panel's background: expected band, grid, ticks, labels and thin lines."""
    left, right, top, bottom = _box(panel)
    if panel.span:
        low, high, name = panel.span
        upper, lower = float(_down(panel, high)), float(_down(panel, low))
        size = {"width": f"{right - left:.1f}", "height": f"{lower - upper:.1f}"}
        _add(svg, "rect", "span", title=name, x=f"{left}", y=f"{upper:.1f}", **size)
    for value, text in panel.y.ticks:
        y = float(_down(panel, value))
        _add(svg, "path", "grid", d=f"M{left:g} {y:.1f}H{right:g}")
        _write(svg, text, left - 6, y + 4, "end")
    for value, text in panel.x.ticks:
        x = float(_across(panel, value))
        _add(svg, "path", "grid", d=f"M{x:.1f} {top:g}V{bottom:g}")
        if panel.x.slanted:
            turn = f"translate({x + 4.0:.1f} {bottom + 14.0:.1f}) rotate(-35)"
            _add(svg, "text", text=text, text_anchor="end", transform=turn)
        else:
            _write(svg, text, x, bottom + 16, "middle")
    for value in panel.rules:
        _add(svg, "path", "rule", d=f"M{left:g} {float(_down(panel, value)):.1f}H{right:g}")
    for value in panel.posts:
        _add(svg, "path", "post", d=f"M{float(_across(panel, value)):.1f} {top:g}V{bottom:g}")
    _write(svg, panel.x.label, (left + right) / 2.0, HEIGHT - 6, "middle")
    turn = f"translate(12 {(top + bottom) / 2.0:.1f}) rotate(-90)"
    _add(svg, "text", "label", text=panel.y.label, text_anchor="middle", transform=turn)


def _write(svg: Element, text: str, x: float, y: float, anchor: str) -> None:
    """Add a text to an SVG image at a position [px]."""
    _add(svg, "text", text=text, x=f"{x:.1f}", y=f"{y:.1f}", text_anchor=anchor)


def _draw_series(svg: Element, series: Series, panel: Panel) -> None:
    """Draw a data series in its style into an SVG image, without its band."""
    mark = MARKS[series.style]
    x, y = _across(panel, series.x), _down(panel, series.y)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y)).tolist()
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    if mark.written:
        for i in known:
            _write(svg, series.tips[i], x[i], y[i] + 4.0, "middle")
        return
    if mark.pinned and not series.tips:  # single worlds, or triangles if beyond the panel
        beyond = series.y > panel.y.limits[1]
        dots = "".join(f"M{points[i][0]:.1f} {points[i][1]:.1f}h0" for i in np.flatnonzero(~beyond))
        tops = "".join(
            f"M{points[i][0]:.1f} {points[i][1] + 1.0:.1f}l2.6 5h-5.2z"
            for i in np.flatnonzero(beyond)
        )
        _stroke(svg, "marks", series, dots)
        _stroke(svg, "tops", series, tops)
        return
    if mark.spread == "bars":
        _draw_spread(svg, series, panel)
    if mark.joined:
        gaps = np.diff(known, prepend=-2) > 1  # where a number is not finite
        points = zip(gaps, known, strict=True)
        line = (f"{'LM'[int(gap)]}{x[i]:.1f} {y[i]:.1f}" for gap, i in points)
        _stroke(svg, "line" + " dashed" * series.dashed, series, "".join(line))
    for i in known if mark.symbol else ():
        filled = series.filled is None or bool(series.filled[i])
        kind = f"dot c-{series.role}" + " hollow" * (not filled)
        look = {"kind": f"tip {kind}" if series.tips else kind}
        look |= {"title": series.tips[i]} if series.tips else {}
        if mark.corners:
            corners = (f"{x[i] + right:.1f} {y[i] + down:.1f}" for right, down in mark.corners)
            _add(svg, "path", **look, d=f"M{'L'.join(corners)}z")
        else:
            _add(svg, "circle", **look, cx=f"{x[i]:.1f}", cy=f"{y[i]:.1f}", r=f"{mark.radius:g}")


def _stroke(svg: Element, kind: str, series: Series, d: str) -> None:
    """Add a path in the colour of a data series to an SVG image, unless the path is empty."""
    faint = {"style": f"opacity:{series.strength:.2f}"} if series.strength < 1.0 else {}
    if d:
        _add(svg, "path", f"{kind} c-{series.role}", **faint, d=d)


def _draw_spread(svg: Element, series: Series, panel: Panel) -> None:
    """Draw the band or the error bars of a data series into an SVG image, if it has any."""
    if series.low is None or series.high is None:
        return
    x = _across(panel, series.x)
    low, high = _down(panel, series.low), _down(panel, series.high)
    both = np.isfinite(low) & np.isfinite(high)
    ends = list(zip(x[both].tolist(), low[both].tolist(), high[both].tolist(), strict=True))
    kind = MARKS[series.style].spread
    if kind == "bars":
        d = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in ends)
    else:
        edge = [f"{a:.1f} {c:.1f}" for a, _, c in ends]
        edge += [f"{a:.1f} {b:.1f}" for a, b, _ in reversed(ends)]
        d = f"M{'L'.join(edge)}z" if edge else ""
    if d:
        _add(svg, "path", f"{kind} c-{series.role}", d=d)


def _columns(panel: Panel) -> list[tuple[str, float, float]]:
    """Return the tooltip columns of a panel: text, left and right edge around each position."""
    read = readings(panel)
    if not read:
        return []
    unit = "°" if "[°]" in panel.x.label else (" s" if "[s]" in panel.x.label else "")
    unit = "" if panel.x.named else unit
    left, right, _, _ = _box(panel)
    at = [float(_across(panel, place)) for place, _, _ in read]
    edges = [left, *((a + b) / 2.0 for a, b in pairwise(at)), right]
    texts = [
        "\n".join([f"{name}{unit}", *(f"{series}: {number}" for series, number in rows)])
        for _, name, rows in read
    ]
    return list(zip(texts, edges[:-1], edges[1:], strict=True))


def _number(series: Series, i: int) -> str:
    """Format a point of a data series with its interval: ± if symmetric, else both ends."""
    value = series.y[i]
    if series.low is None or series.high is None or not math.isfinite(series.low[i]):
        return three_digits(value)
    below, above = value - series.low[i], series.high[i] - value
    if abs(below - above) <= 1e-9 * max(abs(below), abs(above), 1e-300):
        return f"{three_digits(value)} ± {three_digits(above)}"
    ends = f"{three_digits(series.low[i])} to {three_digits(series.high[i])}"
    return f"{three_digits(value)} ({ends})"


def legend(panels: Sequence[Panel]) -> list[tuple[str, str, str, float]]:
    """Return name, colour role, symbol and opacity of each entry in the panels' legend.

    Returns: empty if there are many names, which the caption then explains.
    """
    entries = []
    for name, series in legend_series(panels).items():
        kind = "dashed" if series.dashed else MARKS[series.style].swatch
        if series.filled is not None and not series.filled.any() and not series.dashed:
            kind = "hollow"
        entries.append((name, series.role, kind, series.strength))
    return entries
