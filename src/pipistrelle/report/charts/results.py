"""The paper's figures of results as charts, under one exclusion rule."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.comparison import judge
from pipistrelle.figures.chart import Axis, Chart, Panel, Series, ends, linear_axis
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.charts.timelines import consistency
from pipistrelle.report.claims.contrasts import differences
from pipistrelle.report.claims.published import TABLE_II, beam_name, cell_of, row_name
from pipistrelle.report.studied import COMMON, Cell, Rule, Study, samples

ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Where the single worlds of a strategy stand beside their beamwidth, as a share of it."""
EDGE = 1.08
"""Where those of passive sensing stand, as a share of the widest beam."""
POSITION = ("position_rmse_m", "Vehicle position RMSE", "position RMSE [m]", 1.0)
HEADING = ("heading_rmse_rad", "Vehicle heading RMSE", "heading RMSE [°]", 180.0 / np.pi)
MAP = (COMMON, "Map RMSE of the landmarks that every strategy has placed", "map RMSE [m]", 1.0)
ERRORS = {"position_rmse_m": POSITION, "heading_rmse_deg": HEADING, "map_rmse_m": MAP}
"""Score, title, axis and scale from the score to the axis, by the column of the CSV."""
DIFFERENCE = "active minus fused; open: not significant"


def study_charts(study: Study, rule: Rule) -> list[Chart]:
    """Charts of what the study found.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    list of Chart
        Without those that the study has nothing for.
    """
    charts = [
        gains(study, rule),
        *(consistency(study, rule, name) for name in FILTER_NAMES),
        *(errors(study, rule, column) for column in ERRORS),
        landmarks(study, rule),
        counts(study, rule),
    ]
    return [chart for chart in charts if chart.panels]


def gains(study: Study, rule: Rule) -> Chart:
    """Chart how much better fused is than active, paired over worlds.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    Chart
    """
    panels = []
    for what, score in (("position", "position_rmse_m"), ("map", COMMON)):
        found = {}
        for name in FILTER_NAMES:
            pair = (name, "active"), (name, "fused")
            findings = judge(differences(study, rule, score, *pair, name=name))
            if not findings:
                continue
            mean = np.array([finding.mean for finding in findings])
            alone = np.array([finding.alone for finding in findings])
            alone[~np.isfinite(alone)] = np.nan
            found[name] = _about(DIFFERENCE, "fused", study.beamwidth, mean, alone,
                                 [finding.holds is not None for finding in findings])  # fmt: skip
        axis = linear_axis(f"{what} gain [m]", [0.0, *ends(found.values())])
        panels += [
            Panel(
                title=f"{what}, {FILTER_NAMES[name]}",
                x=_beam_axis(study),
                y=axis,
                series=(series,),
                rules=(0.0,),
            )
            for name, series in found.items()
        ]
    return Chart(
        name="gain",
        title="What listening to the beacon adds to one's own calls",
        caption="RMSE of active minus that of fused in the same world, mean and its 95 % interval; "
        "above the line fused is better. Full: significant after Holm's correction over the "
        "panel. Map: landmarks that every strategy has placed",
        panels=tuple(panels),
        columns=("beamwidth_deg", "gain_m"),
    )


def errors(study: Study, rule: Rule, column: str) -> Chart:
    """Chart an RMSE over the beamwidth, a panel per filter, a colour per strategy.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`
    column : str
        Of `ERRORS`.

    Returns
    -------
    Chart
        Worlds more than σ above the mean as single marks.

    Notes
    -----
    Bradley & Abaid, Secs. V-C and V-D and Appendix A.
    """
    score, title, label, scale = ERRORS[column]
    found: dict[str, list[Series]] = {}
    for way in study.outcomes:
        per_beam = [scale * sample for sample in _per_beam(study, rule, way, score)]
        line = _moment_line(study, way, score, per_beam)
        found.setdefault(way[0], []).extend([line, _outliers(study, way, line, per_beam)])
    lines = [series for mine in found.values() for series in mine if series.style != "marks"]
    vertical = linear_axis(label, [1.07 * end for end in ends(lines)], floor=0.0)
    return Chart(
        name=column.rsplit("_", 1)[0],
        title=title,
        caption="Mean ± σ over worlds; dots: single worlds above that (passive's at the right "
        "edge, where they do not depend on the beam), triangles: those beyond the panel",
        panels=_by_filter(study, found, vertical),
        columns=("beamwidth_deg", column),
    )


def landmarks(study: Study, rule: Rule) -> Chart:
    """Chart how many landmarks are initialised, over the beamwidth.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Sec. V-E.
    """
    found: dict[str, list[Series]] = {}
    for way in study.outcomes:
        full = _per_beam(study, rule, way, "landmarks_full")
        total = [_moments(s)[0] for s in _per_beam(study, rule, way, "landmarks_total")]
        line = Series(
            name=f"{way[1]}, total", role=way[1], x=study.beamwidth, y=np.array(total), dashed=True
        )
        found.setdefault(way[0], []).extend([_moment_line(study, way, "full", full), line])
    vertical = linear_axis("landmarks", ends(s for mine in found.values() for s in mine), floor=0.0)
    return Chart(
        name="landmarks",
        title="Landmarks initialised",
        caption="Fully initialised landmarks at the end, mean ± σ over worlds; dashed: fully and "
        "partially initialised, mean",
        panels=_by_filter(study, found, vertical),
        columns=("beamwidth_deg", "landmarks"),
    )


def counts(study: Study, rule: Rule) -> Chart:
    """Chart Table II, ours beside the paper's.

    Parameters
    ----------
    study : Study
    rule : one of `outcomes.RULES`

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Table II.
    """
    panels = []
    for kind, score in (("fully initialised", "landmarks_full"), ("total", "landmarks_total")):
        found = {name: _beside(study, rule, name, score) for name in FILTER_NAMES}
        axis = linear_axis("landmarks", ends(s for _, mine in found.values() for s in mine))
        for name, (rows, series) in found.items():
            names = tuple((float(i), text) for i, text in enumerate(rows))
            limits = (-0.6, len(rows) - 0.4)
            if rows:
                panels.append(
                    Panel(
                        title=f"{kind}, {FILTER_NAMES[name]}",
                        x=Axis(label="", limits=limits, ticks=names),
                        y=axis,
                        series=series,
                    )
                )
    return Chart(
        name="table_ii",
        title="Landmarks as in Table II",
        caption="Mean ± σ over worlds; fused sensing at three beamwidths, and passive",
        panels=tuple(panels),
        columns=("row", "landmarks"),
    )


def _per_beam(
    study: Study, rule: Rule, way: tuple[str, str], score: str
) -> list[Float[np.ndarray, " m"]]:
    """Return a score's values over the worlds, at each beamwidth."""
    cells: list[Cell] = [(*way, i) for i in range(len(study.beamwidth))]
    return [samples(study, rule, score, [cell])[0] for cell in cells]


def _moment_line(
    study: Study, way: tuple[str, str], score: str, per_beam: Sequence[Float[np.ndarray, " m"]]
) -> Series:
    """Return mean ± σ over the beamwidth; with dots where it depends on it."""
    mean, std = np.array([_moments(sample) for sample in per_beam]).T
    return Series(
        name=way[1],
        role=way[1],
        x=study.beamwidth,
        y=mean,
        low=mean - std,
        high=mean + std,
        style="line" if way[1] == "passive" and score != COMMON else "dots",
    )


def _outliers(
    study: Study,
    way: tuple[str, str],
    line: Series,
    per_beam: Sequence[Float[np.ndarray, " m"]],
) -> Series:
    """Return the worlds above the band of a line."""
    top = np.array([np.nan]) if line.high is None else line.high
    above = [sample[sample > end] for sample, end in zip(per_beam, top, strict=True)]
    at = study.beamwidth * ASIDE[way[1]]
    if line.style == "line":
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
        Panel(title=label, x=_beam_axis(study), y=vertical, series=tuple(found[name]))
        for name, label in FILTER_NAMES.items()
        if name in found
    )


def _beside(
    study: Study, rule: Rule, name: str, score: str
) -> tuple[list[str], tuple[Series, Series]]:
    """Return the names of Table II's rows, the paper's counts and ours."""
    rows, printed, ours = [], [], []
    for row in TABLE_II:
        cell = cell_of(study, row) if row.filter == name else None
        if cell is not None:
            rows.append(row_name(row).split()[0])
            printed.append(row.full if score == "landmarks_full" else row.total)
            ours.append(_moments(samples(study, rule, score, [cell])[0]))
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


def _moments(sample: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return mean and standard deviation; NaN where there is none."""
    if len(sample) == 0:
        return np.nan, np.nan
    return float(np.mean(sample)), float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0


def _beam_axis(study: Study) -> Axis:
    """Return the axis of beamwidths, logarithmic, a tick at each."""
    width = study.beamwidth
    names = tuple((float(value), beam_name(value).removesuffix("°")) for value in width)
    limits = (float(0.9 * width[0]), float(1.12 * width[-1]))
    return Axis(label="half-power beamwidth [°]", limits=limits, log=True, ticks=names)
