import csv
import io
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.figures.chart import (
    Axis,
    Chart,
    Panel,
    Series,
    csv_rows,
    csv_text,
    ends,
    linear_axis,
    log_axis,
    ticks,
)


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


def test_axes_of_nothing_can_be_drawn():
    for axis in (linear_axis("", []), log_axis("", [math.nan, -1.0])):
        assert axis.limits[0] < axis.limits[1]
        assert axis.ticks


def test_a_logarithmic_axis_leaves_out_what_has_no_logarithm():
    low, high = log_axis("", [0.0, -3.0, 2.0, 50.0, math.inf]).limits
    assert 1.0 < low < 2.0
    assert 50.0 < high < 60.0


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
