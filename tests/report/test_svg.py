"""Panels as vectors: where things stand, what is said, what is escaped."""

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.figures.chart import Axis, Panel, Series
from pipistrelle.report.svg import legend, panel_svg, readings
from pipistrelle.report.variables import three_digits


def panel_of(*series, log=False, limits=(0.0, 10.0), ticks=(), **given):
    x = Axis(label="time [s]", limits=(1.0, 100.0) if log else (0.0, 100.0), log=log, ticks=ticks)
    return Panel(
        title="EKF", x=x, y=Axis(label="y", limits=limits, ticks=()), series=series, **given
    )


def line(y, x=None, **given):
    y = np.asarray(y, dtype=float)
    x = np.linspace(0.0, 100.0, len(y)) if x is None else np.asarray(x, dtype=float)
    return Series(name=given.pop("name", "fused"), role="fused", x=x, y=y, **given)


def drawn(panel):
    return ElementTree.fromstring(str(panel_svg(panel)))


def paths(panel, kind):
    return [e.get("d") for e in drawn(panel).iter("path") if kind in e.get("class").split()]


def test_points_are_at_the_positions_of_the_axes():
    (d,) = paths(panel_of(line([0.0, 5.0, 10.0])), "line")
    points = [tuple(map(float, pair.split())) for pair in re.findall(r"[ML]([\d. ]+)", d)]
    (x0, y0), (x1, y1), (x2, y2) = points
    assert (x1 - x0, y0 - y1) == pytest.approx((x2 - x1, y1 - y2), abs=0.11)
    assert x0 < x2
    assert y0 > y2, "up is up"


def test_a_logarithmic_axis_gives_equal_steps_to_equal_ratios():
    (d,) = paths(panel_of(line([1.0, 1.0, 1.0], x=[1.0, 10.0, 100.0]), log=True), "line")
    x = [float(text) for text in re.findall(r"[ML]([\d.]+)", d)]
    assert x[1] - x[0] == pytest.approx(x[2] - x[1], abs=0.11)


def test_a_line_is_broken_where_a_number_is_missing():
    (d,) = paths(panel_of(line([1.0, 2.0, np.nan, 3.0, np.inf])), "line")
    assert d.count("M") == 2
    assert "nan" not in d
    assert "inf" not in d


def test_bands_end_and_worlds_are_pinned_at_the_edge_of_the_panel():
    marks = line([5.0, 50.0], style="marks")
    panel = panel_of(marks, line([5.0, 5.0], low=np.array([-9.0, 4.0]), high=np.array([6.0, 99.0])))
    assert len(paths(panel, "tops")) == 1
    for d in paths(panel, "band"):
        y = [float(text) for text in re.findall(r"[ML][\d.]+ ([\d.]+)", d)]
        assert 0.0 < min(y) < max(y) < 280.0


def test_every_band_is_drawn_before_every_line_and_symbol():
    edges = {"low": np.full(2, 2.0), "high": np.full(2, 8.0)}
    panel = panel_of(line([5, 5]), line([4, 4], style="dots"), line([6, 6], **edges),
                     line([7, 7], style="points", **edges))  # fmt: skip
    order = [e.get("class").split()[0] for e in drawn(panel) if e.get("class")]
    kinds = [kind for kind in order if kind in ("band", "line", "dot", "bars")]
    assert kinds == ["band", "line", "line", "dot", "dot", "line", "bars", "dot", "dot"]


def test_texts_are_escaped():
    bad = '<img src=x onerror="alert(1)">'
    series = line([1.0, 2.0], name=bad)
    spots = Series(name=bad, role="ink", x=np.ones(1), y=np.ones(1), style="points", tips=(bad,))
    axis = Axis(label=bad, limits=(0.0, 2.0), ticks=((1.0, bad),))
    panel = Panel(title=bad, x=axis, y=axis, series=(series, spots), span=(0.0, 1.0, bad))
    text = str(panel_svg(panel))
    assert "<img" not in text
    assert ElementTree.fromstring(text).get("aria-label").startswith(bad)


def test_each_place_is_read_out_once_and_all_columns_fill_the_panel():
    ticks = ((10.0, "10"), (50.0, "50"), (90.0, "90"))
    panel = panel_of(line([1.0, 2.0, 3.0], x=[10, 50, 90], style="dots"), ticks=ticks)
    tips = [e for e in drawn(panel).iter("rect") if "tip" in e.get("class").split()]
    assert [tip.find("title").text for tip in tips] == [
        "10 s\nfused: 1", "50 s\nfused: 2", "90 s\nfused: 3",
    ]  # fmt: skip
    starts = [float(tip.get("x")) for tip in tips]
    ends = [float(tip.get("x")) + float(tip.get("width")) for tip in tips]
    assert ends[:-1] == pytest.approx(starts[1:], abs=0.11)


def test_named_positions_are_read_by_name_with_the_nearest_points():
    named = ((10.0, "level = 10"), (50.0, "level = 50"), (90.0, "level = 90"))
    x = Axis(label="level [°]", limits=(0.0, 100.0), ticks=named[:1], named=named)
    panel = panel_of(
        line([1.0, 2.0, 3.0], x=[9.0, 49.0, 89.0], style="points"),
        line([4.0, 5.0], x=[11.0, 91.0], style="points", name="passive"),
    )
    panel = replace(panel, x=x)
    tips = [e for e in drawn(panel).iter("rect") if "tip" in e.get("class").split()]
    assert [tip.find("title").text for tip in tips] == [
        "level = 10\nfused: 1\npassive: 4", "level = 50\nfused: 2",
        "level = 90\nfused: 3\npassive: 5",
    ]  # fmt: skip


def test_long_series_are_read_out_at_some_eighty_places():
    said = readings(panel_of(line(np.arange(375.0)), limits=(0.0, 400.0)))
    assert 60 <= len(said) <= 80
    assert said[1][2] == [("fused", "5")]


def test_spreads_are_read_with_their_means():
    about = {"x": [50.0], "style": "points"}
    panel = panel_of(
        line([2.0], low=np.array([1.5]), high=np.array([2.5]), name="even", **about),
        line([2.0], low=np.array([1.5]), high=np.array([4.0]), name="odd", **about),
        line([2.0], low=np.array([np.nan]), high=np.array([np.nan]), name="lone", **about),
    )
    assert readings(panel)[0][2] == [("even", "2 ± 0.5"), ("odd", "2 (1.5 to 4)"), ("lone", "2")]


@given(st.floats(-1e300, 1e300))
def test_three_digits_are_near_the_number(value):
    text = three_digits(value).replace("−", "-")
    assert float(text) == pytest.approx(value, rel=0.006, abs=6e-5)


def test_values_that_are_not_finite_are_read_as_such():
    assert [three_digits(v) for v in (math.inf, -math.inf, math.nan, 0.0, -0.0, 1e-9)] == [
        "∞", "−∞", "no number", "0", "0", "0",
    ]  # fmt: skip


def test_the_legend_names_each_series_once_and_nothing_where_there_are_many():
    few = [panel_of(line([1.0]), line([2.0], name="passive", dashed=True))] * 2
    assert legend(few) == [("fused", "fused", "line", 1.0), ("passive", "fused", "dashed", 1.0)]
    faint = [panel_of(line([1.0], strength=0.25))]
    assert legend(faint) == [("fused", "fused", "line", 0.25)]
    assert legend([panel_of(*(line([1.0], name=str(i)) for i in range(12)))]) == []
