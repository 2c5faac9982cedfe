"""Charts: axes, CSV, and the same content in matplotlib and on the page."""

import csv
import io
import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.figures.chart import (
    MARKS,
    Axis,
    Chart,
    Mark,
    Panel,
    Series,
    csv_rows,
    csv_text,
    draw_chart,
    ends,
    linear_axis,
    log_axis,
    ticks,
)
from pipistrelle.figures.style import save_figure, strategy_colour
from pipistrelle.report.svg import legend, panel_svg

X = np.array([11.0, 33.0, 180.0])


def panel_of(*series, title="EKF", **given):
    beams = Axis(label="beamwidth [°]", limits=(10.0, 200.0), log=True, ticks=((33.0, "33"),))
    vertical = linear_axis("RMSE [m]", [0.0, 2.0], floor=0.0)
    return Panel(**({"title": title, "x": beams, "y": vertical, "series": series} | given))


def chart_of(*panels):
    return Chart(name="c", title="Title", caption="", panels=panels, columns=("x", "y"))


def fused(**given):
    y = np.array([0.5, 0.6, 0.7])
    plain = {"name": "fused", "role": "fused", "x": X, "y": y}
    return Series(**(plain | given))


def test_lines_and_bands_have_the_values_of_the_series():
    series = fused(low=np.full(3, 0.1), high=np.full(3, 0.9), style="dots")
    (axes,) = draw_chart(chart_of(panel_of(series))).axes
    line = axes.lines[0]
    np.testing.assert_array_equal(line.get_xdata(), X)
    np.testing.assert_array_equal(line.get_ydata(), series.y)
    assert line.get_color() == strategy_colour("fused")
    box = axes.collections[0].get_datalim(axes.transData)
    assert (box.ymin, box.ymax) == pytest.approx((0.1, 0.9))


def test_every_band_is_below_every_line():
    edges = {"low": np.full(3, 0.1), "high": np.full(3, 0.9)}
    series = [fused(), *(fused(name=str(i), style="dots", **edges) for i in range(40))]
    (axes,) = draw_chart(chart_of(panel_of(*series))).axes
    bands = [band.get_zorder() for band in axes.collections]
    assert len(bands) == 40
    assert max(bands) < min(line.get_zorder() for line in axes.lines)
    assert min(bands) > 1.0, "over the grid and the rules"


def test_axes_have_the_charts_scales_limits_and_ticks():
    (axes,) = draw_chart(chart_of(panel_of(fused()))).axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "linear")
    assert axes.get_xlim() == pytest.approx((10.0, 200.0))
    assert [text.get_text() for text in axes.get_xticklabels()] == ["33"]
    assert axes.get_title(loc="left") == "EKF"


def test_single_worlds_beyond_the_panel_are_pinned_at_its_top():
    marks = fused(style="marks", y=np.array([1.0, 1.5, 40.0]))
    (axes,) = draw_chart(chart_of(panel_of(marks))).axes
    inside, above = axes.lines
    assert inside.get_ydata().tolist() == [1.0, 1.5]
    assert axes.get_ylim()[0] < above.get_ydata()[0] < axes.get_ylim()[1]


def test_points_that_are_not_filled_are_open():
    series = fused(style="points", filled=np.array([True, False, True]), low=X * 0, high=X * 0 + 1)
    (axes,) = draw_chart(chart_of(panel_of(series))).axes
    full, hollow = axes.lines
    assert (len(full.get_xdata()), len(hollow.get_xdata())) == (2, 1)
    assert hollow.get_markerfacecolor() == "white"


def test_a_legend_of_long_names_takes_more_rows_and_stays_within_the_figure(tmp_path):
    names = [f"rays.exponent = {k}, air.spreading = bistatic, and more" for k in range(4)]
    figure = draw_chart(chart_of(panel_of(*(fused(name=name, strength=0.5) for name in names))))
    save_figure(figure, tmp_path, "c")
    (legend_drawn,) = figure.legends
    box = legend_drawn.get_window_extent()
    assert box.x1 <= figure.bbox.x1
    assert {handle.get_alpha() for handle in legend_drawn.legend_handles} == {0.5}


def test_names_with_dollars_are_names_and_no_formulae(tmp_path):
    words = Axis(label="$x_1^", limits=(-1.0, 1.0), ticks=((0.0, "a$b$c"),))
    figure = draw_chart(chart_of(panel_of(fused(name="$\\frac{"), title="$", x=words)))
    save_figure(figure, tmp_path, "c")
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["a$b$c"]


def test_a_level_is_a_dash_on_paper_and_page():
    series = fused(style="levels")
    (axes,) = draw_chart(chart_of(panel_of(series))).axes
    assert axes.lines[0].get_marker() == "_"
    assert legend([panel_of(series)]) == [("fused", "fused", "dashed", 1.0)]
    drawn = ElementTree.fromstring(str(panel_svg(panel_of(series))))
    assert len([e for e in drawn.iter("path") if "dot" in e.get("class").split()]) == 3


def test_the_csv_has_the_nearest_word_of_an_axis_of_words():
    named = ((0.0, "plain"), (1.0, "measured"))
    axis = Axis(label="noise", limits=(-0.6, 1.6), ticks=named, named=named, words=True)
    points = fused(x=np.array([0.1, 0.9]), y=np.array([1.0, 2.0]), style="points")
    rows = csv_rows(chart_of(panel_of(points, x=axis)))
    assert [row[3] for row in rows[1:]] == ["plain", "measured"]


def test_a_legend_lists_names_once_and_is_omitted_for_many():
    figure = draw_chart(chart_of(panel_of(fused()), panel_of(fused(), title="FastSLAM 2.0")))
    assert [text.get_text() for text in figure.legends[0].texts] == ["fused"]
    many = [fused(name=f"{i}°") for i in range(12)]
    assert draw_chart(chart_of(panel_of(*many))).legends == []


@pytest.mark.parametrize(
    ("count", "grid"), [(1, (1, 1)), (2, (1, 2)), (3, (1, 3)), (4, (2, 2)), (6, (2, 3))]
)
def test_panels_are_arranged_in_columns(count, grid):
    figure = draw_chart(chart_of(*[panel_of(fused())] * count))
    spec = figure.axes[0].get_subplotspec().get_gridspec()
    assert (spec.nrows, spec.ncols) == grid


def test_every_style_can_be_saved_twice_to_the_same_bytes(tmp_path):
    styles = [
        fused(style=style, tips=("a", "b", "c"), dashed=style == "line")
        for style in ("line", "dots", "points", "marks", "stars", "text")
    ]
    plane = Axis(label="", limits=(0.0, 200.0), ticks=())
    panels = [
        panel_of(*styles, span=(0.2, 0.4, "band"), rules=(0.0,), posts=(33.0,)),
        panel_of(*styles, x=plane, y=plane, equal=True),
    ]
    for folder in ("one", "two"):
        save_figure(draw_chart(chart_of(*panels)), tmp_path / folder, "c")
    for kind in ("png", "pdf"):
        one, two = (tmp_path / folder / f"c.{kind}" for folder in ("one", "two"))
        assert one.read_bytes() == two.read_bytes()


def test_a_mark_is_one_row_for_paper_and_page(monkeypatch):
    corners = ((0.0, -4.0), (4.0, 0.0), (0.0, 4.0), (-4.0, 0.0))
    monkeypatch.setitem(MARKS, "diamonds", Mark(symbol="D", corners=corners, swatch="dot"))
    panel = panel_of(fused(style="diamonds"))
    (axes,) = draw_chart(chart_of(panel)).axes
    assert [line.get_marker() for line in axes.lines] == ["D", "D"]
    drawn = ElementTree.fromstring(str(panel_svg(panel)))
    shapes = [e.get("d") for e in drawn.iter("path") if "dot" in e.get("class").split()]
    assert len(shapes) == len(X)
    assert [shape.count("L") for shape in shapes] == [3, 3, 3]
    assert legend([panel]) == [("fused", "fused", "dot", 1.0)]
    assert csv_rows(chart_of(panel))[1][2] == "diamonds"


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_round_even_and_inside(low, share):
    width = share * max(abs(low), 1.0)
    found = ticks(low, low + width)
    values = [value for value, _ in found]
    assert 2 <= len(values) <= 6
    assert all(low - 1e-6 * width <= value <= low + 1.000001 * width for value in values)
    assert np.allclose(np.diff(values), values[1] - values[0])
    assert all(float(text) == pytest.approx(value, abs=1e-9 * width) for value, text in found)


@given(st.floats(1e-3, 1e3), st.floats(10.0, 1e6))
def test_ticks_of_a_logarithmic_axis_are_powers_of_ten_or_three_times_that(low, ratio):
    found = [value for value, _ in ticks(low, low * ratio, log=True)]
    assert len(found) >= 2
    assert all(low <= value <= low * ratio for value in found)
    for value in found:
        digit = value / 10.0 ** math.floor(math.log10(value) + 1e-9)
        assert digit == pytest.approx(1.0) or digit == pytest.approx(3.0)


@given(st.floats(1e-3, 1e3), st.floats(1.2, 10.0))
def test_less_than_a_decade_has_ticks_too(low, ratio):
    found = [value for value, _ in ticks(low, low * ratio, log=True)]
    assert len(found) >= 2
    assert all(0.999999 * low <= value <= 1.000001 * low * ratio for value in found)


def test_many_decades_have_few_ticks():
    assert 3 <= len(ticks(1.0, 1e200, log=True)) <= 10


@given(st.lists(st.floats(-1e6, 1e6), min_size=1))
def test_an_axis_holds_its_values(values):
    low, high = linear_axis("", [*values, math.nan, math.inf]).limits
    assert low < min(values)
    assert max(values) < high


def test_a_logarithmic_axis_ignores_values_without_logarithm():
    low, high = log_axis("", [0.0, -3.0, 2.0, 50.0, math.inf]).limits
    assert 1.0 < low < 2.0
    assert 50.0 < high < 60.0
    for axis in (linear_axis("", []), log_axis("", [math.nan, -1.0])):
        assert axis.limits[0] < axis.limits[1]
        assert axis.ticks


def test_an_axis_holds_bands_too():
    x = np.arange(2.0)
    series = Series(name="", role="ink", x=x, y=x + 5.0, low=x - 1.0, high=x + 9.0)
    assert (min(ends([series])), max(ends([series]))) == (-1.0, 10.0)


def test_numbers_survive_the_csv_to_nine_digits_and_gaps_stay_gaps():
    axis = Axis(label="", limits=(0.0, 1.0), ticks=())
    x, y = np.array([1 / 3, 2.0]), np.array([np.nan, -1e-12 / 7])
    panels = (Panel(title='a "b", c', x=axis, y=axis, series=(
        Series(name="s", role="ink", x=x, y=y, low=y - 1.0),
        Series(name="grid", role="grid", x=x, y=y, listed=False),
    )),)  # fmt: skip
    chart = Chart(name="", title="", caption="", panels=panels, columns=("x_m", "y_m"))
    rows = list(csv.reader(io.StringIO(csv_text(csv_rows(chart, exclusion="none")))))
    assert rows[0] == ["exclusion", "panel", "series", "kind", "x_m", "y_m", "y_m_low", "y_m_high"]
    assert [row[:4] for row in rows[1:]] == [["none", 'a "b", c', "s", "line"]] * 2
    assert float(rows[1][4]) == pytest.approx(1 / 3, rel=1e-8)
    assert (rows[1][5], rows[1][6], rows[1][7]) == ("", "", "")
    assert float(rows[2][5]) == pytest.approx(-1e-12 / 7, rel=1e-8)
