"""The paper's figures of results as charts of a selection of worlds.

`CHARTS` is the only list of them. To add a figure, write a function from a selection to its charts
and name it there: page, PNG, PDF and CSV follow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.figures.chart import MARKS, Axis, Chart, Panel, Series, ends, linear_axis
from pipistrelle.report.charts.timelines import anees_charts
from pipistrelle.report.claims.published import FILTERS, TABLE_II, beam_name, cell_of, row_name
from pipistrelle.report.studied import (
    COMMON,
    HEADING,
    HEADING_BOUND,
    MAP_ALIGNED,
    POSITION,
    POSITION_ALIGNED,
    POSITION_BOUND,
    Cell,
    Selection,
    Study,
    Way,
    filter_titles,
    mean_std,
    samples,
)

ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Where the single worlds of a strategy stand beside their beamwidth, as a share of it."""
EDGE = 1.08
"""Where those of passive sensing stand, as a share of the widest beam."""
DIFFERENCE = "active minus fused; open: not significant"


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorChart:
    """What makes the chart of an RMSE.

    Attributes
    ----------
    name, title : str
        Of the chart.
    score : one of `studied.SCORES`, or `studied.COMMON`
    label : str
        Of the axis.
    column : str
        Of the CSV.
    scale : float
        From the score to the axis.
    more : str
        Of the caption, at its end.
    bound : one of `studied.SCORES`, or nothing
        The least that any estimator has.
    """

    name: str
    title: str
    score: str
    label: str
    column: str
    scale: float = 1.0
    more: str = ""
    bound: str = ""


BOUND = "; dashed: the bound, the least that any estimator has, the noise as the signal tells it"
"""What the caption says of it."""
ERRORS = (
    ErrorChart(
        name="position_rmse",
        title="Vehicle position RMSE",
        score=POSITION,
        label="position RMSE [m]",
        column="position_rmse_m",
        more=BOUND,
        bound=POSITION_BOUND,
    ),
    ErrorChart(
        name="position_rmse_aligned",
        title="Vehicle position RMSE after alignment",
        score=POSITION_ALIGNED,
        label="aligned position RMSE [m]",
        column="position_rmse_aligned_m",
        more=". Each path after the rigid motion that fits it best: without the one turn of "
        "everything that is most of the raw error",
    ),
    ErrorChart(
        name="heading_rmse",
        title="Vehicle heading RMSE",
        score=HEADING,
        label="heading RMSE [°]",
        column="heading_rmse_deg",
        scale=180.0 / np.pi,
        more=BOUND,
        bound=HEADING_BOUND,
    ),
    ErrorChart(
        name="map_rmse",
        title="Map RMSE of the landmarks that every strategy has placed",
        score=COMMON,
        label="map RMSE [m]",
        column="map_rmse_m",
    ),
    ErrorChart(
        name="map_rmse_aligned",
        title="Map RMSE of each strategy's own landmarks after alignment",
        score=MAP_ALIGNED,
        label="aligned map RMSE [m]",
        column="map_rmse_aligned_m",
        more=". Each map after the rigid motion that fits it best; strategies place different "
        "landmarks",
    ),
)


def gain_charts(selection: Selection) -> list[Chart]:
    """Chart how much better fused is than active, paired over worlds.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of Chart
    """
    study = selection.study
    panels = []
    for what, score in (("position", POSITION), ("map", COMMON)):
        found = {}
        for name, title in filter_titles(study).items():
            findings = selection.gains[name, score]
            if not findings:
                continue
            mean = np.array([finding.mean for finding in findings])
            alone = np.array([finding.alone for finding in findings])
            alone[~np.isfinite(alone)] = np.nan
            found[title] = _about(DIFFERENCE, "fused", study.beamwidth, mean, alone,
                                  [finding.holds is not None for finding in findings])  # fmt: skip
        axis = linear_axis(f"{what} gain [m]", [0.0, *ends(found.values())])
        panels += [
            Panel(
                title=f"{what}, {title}",
                x=_beam_axis(study),
                y=axis,
                series=(series,),
                rules=(0.0,),
            )
            for title, series in found.items()
        ]
    chart = Chart(
        name="gain",
        title="What listening to the beacon adds to one's own calls",
        caption="RMSE of active minus that of fused in the same world, mean and its 95 % interval; "
        "above the line fused is better. Full: significant after Holm's correction over the "
        "panel. Map: landmarks that every strategy has placed",
        panels=tuple(panels),
        columns=("beamwidth_deg", "gain_m"),
    )
    return [chart]


def error_charts(selection: Selection) -> list[Chart]:
    """Chart each RMSE over the beamwidth, a panel per filter, a colour per strategy.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of Chart
        Worlds more than σ above the mean as single marks.

    Notes
    -----
    Bradley & Abaid, Secs. V-C and V-D and Appendix A.
    """
    return [_error_chart(selection, what) for what in ERRORS]


def landmark_charts(selection: Selection) -> list[Chart]:
    """Chart how many landmarks are initialised, over the beamwidth.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of Chart

    Notes
    -----
    Bradley & Abaid, Sec. V-E.
    """
    study = selection.study
    found: dict[str, list[Series]] = {}
    for way in study.trials:
        full = _per_beam(selection, way, "landmarks_full")
        total = [mean_std(s)[0] for s in _per_beam(selection, way, "landmarks_total")]
        line = Series(
            name=f"{way[1]}, total", role=way[1], x=study.beamwidth, y=np.array(total), dashed=True
        )
        found.setdefault(way[0], []).extend(
            [_mean_line(study, way, full, flat=way[1] == "passive"), line]
        )
    vertical = linear_axis("landmarks", ends(s for mine in found.values() for s in mine), floor=0.0)
    chart = Chart(
        name="landmarks",
        title="Landmarks initialised",
        caption="Fully initialised landmarks at the end, mean ± σ over worlds; dashed: fully and "
        "partially initialised, mean",
        panels=_by_filter(study, found, vertical),
        columns=("beamwidth_deg", "landmarks"),
    )
    return [chart]


def table_ii_charts(selection: Selection) -> list[Chart]:
    """Chart Table II, ours beside the paper's.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of Chart

    Notes
    -----
    Bradley & Abaid, Table II.
    """
    panels = []
    for kind, score in (("fully initialised", "landmarks_full"), ("total", "landmarks_total")):
        found = {title: _beside(selection, name, score) for name, title in FILTERS.items()}
        axis = linear_axis("landmarks", ends(s for _, mine in found.values() for s in mine))
        for title, (rows, series) in found.items():
            names = tuple((float(i), text) for i, text in enumerate(rows))
            limits = (-0.6, len(rows) - 0.4)
            if rows:
                panels.append(
                    Panel(
                        title=f"{kind}, {title}",
                        x=Axis(label="", limits=limits, ticks=names),
                        y=axis,
                        series=series,
                    )
                )
    chart = Chart(
        name="table_ii",
        title="Landmarks as in Table II",
        caption="Mean ± σ over worlds; fused sensing at three beamwidths, and passive",
        panels=tuple(panels),
        columns=("row", "landmarks"),
    )
    return [chart]


CHARTS: tuple[Callable[[Selection], list[Chart]], ...] = (
    gain_charts, anees_charts, error_charts, landmark_charts, table_ii_charts,
)  # fmt: skip
"""What is charted of a selection, in the page's order."""


def study_charts(
    selection: Selection, charts: Sequence[Callable[[Selection], list[Chart]]] = CHARTS
) -> list[Chart]:
    """Charts of what the study found.

    Parameters
    ----------
    selection : Selection
    charts : sequence of functions of a Selection
        Each gives the charts of a figure.

    Returns
    -------
    list of Chart
        Without those that the study has nothing for.
    """
    return [chart for drawn in charts for chart in drawn(selection) if chart.panels]


def _error_chart(selection: Selection, what: ErrorChart) -> Chart:
    """Chart one RMSE; of passive sensing, what does not change with the beam is a flat line."""
    study = selection.study
    found: dict[str, list[Series]] = {}
    for way in study.trials:
        flat = way[1] == "passive" and what.score != COMMON
        per_beam = [what.scale * sample for sample in _per_beam(selection, way, what.score)]
        line = _mean_line(study, way, per_beam, flat=flat)
        worlds = _worlds_above(study, way, line, per_beam, flat=flat)
        found.setdefault(way[0], []).extend([line, worlds])
        if what.bound:
            found[way[0]].append(_bound_line(selection, way, what))
    lines = [s for mine in found.values() for s in mine if not MARKS[s.style].pinned]
    vertical = linear_axis(what.label, [1.07 * end for end in ends(lines)], floor=0.0)
    return Chart(
        name=what.name,
        title=what.title,
        caption="Mean ± σ over worlds; dots: single worlds above that (passive's at the right "
        "edge, where they do not depend on the beam), triangles: those beyond the panel"
        + what.more,
        panels=_by_filter(study, found, vertical),
        columns=("beamwidth_deg", what.column),
    )


def _bound_line(selection: Selection, way: Way, what: ErrorChart) -> Series:
    """Return the mean of the least errors over the worlds that count."""
    least = [what.scale * mean_std(one)[0] for one in _per_beam(selection, way, what.bound)]
    return Series(
        name=f"{way[1]}, bound",
        role=way[1],
        x=selection.study.beamwidth,
        y=np.array(least),
        dashed=True,
    )


def _per_beam(selection: Selection, way: Way, score: str) -> list[Float[np.ndarray, " m"]]:
    """Return a score's values over the worlds, at each beamwidth."""
    cells: list[Cell] = [(*way, i) for i in range(len(selection.study.beamwidth))]
    return [samples(selection, score, [cell])[0] for cell in cells]


def _mean_line(
    study: Study, way: Way, per_beam: Sequence[Float[np.ndarray, " m"]], *, flat: bool
) -> Series:
    """Return mean ± σ over the beamwidth; with dots where it depends on it."""
    mean, std = np.array([mean_std(sample) for sample in per_beam]).T
    return Series(
        name=way[1],
        role=way[1],
        x=study.beamwidth,
        y=mean,
        low=mean - std,
        high=mean + std,
        style="line" if flat else "dots",
    )


def _worlds_above(
    study: Study,
    way: Way,
    line: Series,
    per_beam: Sequence[Float[np.ndarray, " m"]],
    *,
    flat: bool,
) -> Series:
    """Return the worlds above the band of a line."""
    top = np.array([np.nan]) if line.high is None else line.high
    above = [sample[sample > end] for sample, end in zip(per_beam, top, strict=True)]
    at = study.beamwidth * ASIDE[way[1]]
    if flat:
        above, at = above[:1], EDGE * study.beamwidth[-1:]
    return Series(
        name=f"{way[1]}, worlds above σ",
        role=way[1],
        x=np.repeat(at, [len(values) for values in above]),
        y=np.concatenate(above),
        style="marks",
        strength=0.55,
    )


def _by_filter(study: Study, found: dict[str, list[Series]], vertical: Axis) -> tuple[Panel, ...]:
    """Return a panel per filter, all with the same axes."""
    return tuple(
        Panel(title=title, x=_beam_axis(study), y=vertical, series=tuple(found[name]))
        for name, title in filter_titles(study).items()
    )


def _beside(selection: Selection, name: str, score: str) -> tuple[list[str], tuple[Series, Series]]:
    """Return the names of Table II's rows, the paper's counts and ours."""
    rows, printed, ours = [], [], []
    for row in TABLE_II:
        cell = cell_of(selection.study, row) if row.filter == name else None
        if cell is not None:
            rows.append(row_name(row).split()[0])
            printed.append(row.full if score == "landmarks_full" else row.total)
            ours.append(mean_std(samples(selection, score, [cell])[0]))
    at = np.arange(len(rows), dtype=np.float64)
    series = []
    for title, role, aside, pairs in (
        ("the paper", "truth", -0.12, printed), ("this study", "fused", 0.12, ours),
    ):  # fmt: skip
        mean, std = np.array(pairs).reshape(-1, 2).T
        ends = np.column_stack([mean - std, mean + std])
        series.append(_about(title, role, at + aside, mean, ends, [True] * len(rows)))
    return rows, (series[0], series[1])


def _about(
    name: str,
    role: str,
    x: Float[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    ends: Float[np.ndarray, "n 2"],
    filled: Sequence[bool],
) -> Series:
    """Return points with bars."""
    return Series(
        name=name,
        role=role,
        x=x,
        y=mean,
        low=ends[:, 0],
        high=ends[:, 1],
        style="points",
        filled=np.array(filled, dtype=bool),
    )


def _beam_axis(study: Study) -> Axis:
    """Return the axis of beamwidths, logarithmic, a tick at each."""
    width = study.beamwidth
    names = tuple((float(value), beam_name(value).removesuffix("°")) for value in width)
    limits = (float(0.9 * width[0]), float(1.12 * width[-1]))
    return Axis(label="half-power beamwidth [°]", limits=limits, log=True, ticks=names)
