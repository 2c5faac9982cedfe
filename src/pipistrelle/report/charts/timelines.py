"""ANEES over time as charts, one per filter."""

import re

import numpy as np

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.consistency import anees, anees_bounds_about
from pipistrelle.figures.chart import Chart, Panel, Series, ends, linear_axis, log_axis
from pipistrelle.report.claims.contrasts import frame_time, lap_time
from pipistrelle.report.claims.published import beam_name
from pipistrelle.report.studied import Selection, Study, Way, filter_titles, kept


def anees_charts(selection: Selection) -> list[Chart]:
    """Chart each filter's ANEES over time, a panel per strategy, a line per beamwidth.

    Parameters
    ----------
    selection : Selection

    Returns
    -------
    list of Chart

    Notes
    -----
    Bradley & Abaid, Sec. V-B and Eqs. (24) and (25).
    """
    titles = filter_titles(selection.study)
    return [_anees_chart(selection, name, title) for name, title in titles.items()]


def _anees_chart(selection: Selection, name: str, title: str) -> Chart:
    """Chart one filter's ANEES over time."""
    study = selection.study
    ways = [way for way in STRATEGIES if (name, way) in study.trials]
    lines = {way: _anees_lines(selection, (name, way)) for way in ways}
    lines = {way: series for way, series in lines.items() if series}
    runs = min(
        (int(np.sum(kept(selection, [(name, way, i)])))
         for way, series in lines.items() for i in range(len(series))), default=0,
    )  # fmt: skip
    if runs:
        for way, mine in lines.items():
            mine.insert(0, _ideal(study, (name, way), runs))
    vertical = log_axis("ANEES", ends(s for mine in lines.values() for s in mine) or [1.0, 9.0])
    lap = lap_time(study)
    panels = [
        Panel(
            title=way,
            role=way,
            x=linear_axis("time [s]", [series[0].x[-1] / 1.05], floor=0.0),
            y=vertical,
            series=tuple(series),
            posts=tuple(lap * k for k in range(1, int(series[0].x[-1] / lap) + 1)),
        )
        for way, series in lines.items()
    ]
    return Chart(
        name="anees_" + re.sub(r"\W+", "_", name),
        title=f"Consistency of {title}: average NEES over time",
        caption="The stronger a line, the narrower the beam; grey: where a consistent filter's "
        f"ANEES over {runs} world{'' if runs == 1 else 's'} lies with 95 %, after a start that is "
        "exact and thought uncertain, at one beamwidth or another; dotted: the vehicle is back at "
        "its start",
        panels=tuple(panels),
        columns=("time_s", "anees"),
    )


def _ideal(study: Study, way: Way, runs: int) -> Series:
    """Return a consistent filter's ANEES over so many worlds: its mean, and all beams' bounds."""
    expected, variance = study.trials[way].consistent
    low, high = anees_bounds_about(expected, variance, runs)
    return Series(
        name="a consistent filter",
        role="ink",
        x=frame_time(study, expected.shape[1]),
        y=np.mean(expected, axis=0),
        low=np.min(low, axis=0),
        high=np.max(high, axis=0),
        dashed=True,
    )


def _anees_lines(selection: Selection, way: Way) -> list[Series]:
    """Return ANEES over time, the widest beam first and faintest."""
    study = selection.study
    nees = study.trials[way].nees
    time = frame_time(study, nees.shape[2])
    found = []
    for i in reversed(range(nees.shape[1] if len(time) else 0)):
        counts = kept(selection, [(*way, i)])
        single = way[1] == "passive"
        if counts.any():
            found.append(
                Series(
                    name="passive" if single else beam_name(study.beamwidth[i]),
                    role=way[1],
                    x=time,
                    y=anees(nees[counts, i]),
                    strength=1.0 if single else 1.0 - 0.75 * i / max(nees.shape[1] - 1, 1),
                )
            )
    return found
