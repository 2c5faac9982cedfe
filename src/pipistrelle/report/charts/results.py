"""The figures of a study's results: `CHARTS` of any study, `PAPERS` of one that holds its cases.

To add a figure, write a function from a selection to its charts and name it there: page, PNG, PDF
and CSV follow.
"""

from collections.abc import Callable, Sequence

import numpy as np

from pipistrelle.figures.chart import Axis, Chart, Panel, Series, ends, linear_axis
from pipistrelle.report.charts.differences import about, effect_charts, gain_charts
from pipistrelle.report.charts.levels import (
    error_charts,
    landmark_charts,
    level_charts,
    levels,
)
from pipistrelle.report.charts.timelines import anees_charts
from pipistrelle.report.claims.published import (
    FILTERS,
    TABLE_II,
    cell_of,
    papers_cases,
    row_name,
)
from pipistrelle.report.studied import Selection, mean_std, samples


def table_ii_charts(selection: Selection) -> list[Chart]:
    """Chart Table II, ours beside the paper's.

    Bradley & Abaid, Table II.
    """
    panels = []
    for kind, score in (("fully initialised", "landmarks_full"), ("total", "landmarks_total")):
        found = {title: _beside(selection, name, score) for name, title in FILTERS.items()}
        axis = linear_axis("landmarks", ends(s for _, drawn in found.values() for s in drawn))
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


Figure = Callable[[Selection], list[Chart]]
CHARTS: tuple[Figure, ...] = (effect_charts, level_charts, gain_charts, anees_charts)
"""What is charted of a selection, in the page's order."""
PAPERS: tuple[Figure, ...] = (
    gain_charts, anees_charts, error_charts, landmark_charts, table_ii_charts,
)  # fmt: skip
"""What is charted instead where the question is the paper's."""


def answers(name: str) -> bool:
    """Return whether a figure shows a score that the answer names.

    `name`: of the chart.

    Examples
    --------
    >>> answers("gain"), answers("nees_by_rays_power"), answers("anees_ekf")
    (True, True, False)
    """
    answering = {level.name for level in levels()} - {"map_rmse_aligned"} | {"gain"}
    return name.partition("_by_")[0] in answering or name.startswith("effect_")


def study_charts(selection: Selection, charts: Sequence[Figure] | None = None) -> list[Chart]:
    """Chart what the study found.

    `charts`: each gives the charts of a figure; if not said, `PAPERS` of a study that holds the
    paper's cases, else `CHARTS`. Returns: without those that the study has nothing for.
    """
    if charts is None:
        charts = PAPERS if papers_cases(selection.study) else CHARTS
    return [chart for drawn in charts for chart in drawn(selection) if chart.panels]


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
        series.append(about(title, role, at + aside, mean, ends, [True] * len(rows)))
    return rows, (series[0], series[1])
