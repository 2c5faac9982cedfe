"""The paper's figures as charts: models first, then what the study found, under one exclusion."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.emitter import HALF_POWER, piston_directivity, piston_radius
from pipistrelle.arrays.noise import stream_key
from pipistrelle.evaluation.comparison import judge
from pipistrelle.evaluation.consistency import anees, anees_bounds
from pipistrelle.experiments.scenario import draw_scenario
from pipistrelle.figures.chart import Axis, Chart, Panel, Series, linear_axis, log_axis
from pipistrelle.figures.style import FILTER_NAMES
from pipistrelle.report.contrasts import differences, frame_time, lap_time
from pipistrelle.report.published import TABLE_II, beam_name, cell_of, row_name
from pipistrelle.report.tables import COMMON, Cell, Rule, Study, kept, samples

STRATEGIES = ("active", "fused", "passive")
RAD_TO_DEG = 180.0 / np.pi
ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Where the single worlds of a strategy stand beside their beamwidth."""
EDGE = 1.08
"""Where those of passive sensing stand, as a share of the widest beam."""


def study_charts(study: Study, rule: Rule) -> list[Chart]:
    """Charts of what the study found.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    list of Chart
        Without those that the study has nothing for.
    """
    rmse = "mean ± σ over worlds; dots are single worlds above that, triangles lie outside"
    charts = [
        gains(study, rule),
        *(consistency(study, rule, name) for name in FILTER_NAMES),
        by_beamwidth(
            study, rule, "position_rmse", "Vehicle position RMSE",
            "RMSE of the vehicle's position, " + rmse, ("position_rmse_m",), "position RMSE [m]",
        ),
        by_beamwidth(
            study, rule, "heading_rmse", "Vehicle heading RMSE",
            "RMSE of the vehicle's heading, " + rmse, ("heading_rmse_rad",), "heading RMSE [°]",
            scale=RAD_TO_DEG,
        ),
        by_beamwidth(
            study, rule, "map_rmse", "Map RMSE, landmarks that every strategy has placed",
            "RMSE of the final map over the landmarks that active, fused and passive sensing have "
            "all fully initialised in that world at that beamwidth, " + rmse, (COMMON,),
            "map RMSE [m]",
        ),
        by_beamwidth(
            study, rule, "landmarks", "Landmarks initialised",
            "Fully initialised landmarks at the end, mean ± σ over worlds; dashed: fully and "
            "partially", ("landmarks_full", "landmarks_total"), "landmarks", marks=False,
        ),
        counts(study, rule),
    ]  # fmt: skip
    return [chart for chart in charts if chart.panels]


def by_beamwidth(
    study: Study,
    rule: Rule,
    name: str,
    title: str,
    caption: str,
    scores: Sequence[str],
    label: str,
    *,
    scale: float = 1.0,
    marks: bool = True,
) -> Chart:
    """Chart a score over the beamwidth, a panel per filter, a colour per strategy.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`
    name, title, caption : of the chart
    scores : sequence of str
        The first with its σ; a second, dashed, without.
    label : str
        Of the vertical axis.
    scale : float
        From the score's unit to the label's.
    marks : bool
        Show single worlds more than σ above the mean.

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Secs. V-C to V-E.
    """
    found: dict[str, list[Series]] = {}
    for way in sorted(study.outcomes):
        series = found.setdefault(way[0], [])
        series += _beam_series(study, rule, way, scores, scale, marks)
    tops = [s.high.max(initial=0.0) for mine in found.values() for s in mine if s.high is not None]
    widest = [s.y.max(initial=0.0) for mine in found.values() for s in mine if s.style != "marks"]
    top = 1.12 * max([*_finite(tops), *_finite(widest)], default=1.0)
    vertical = linear_axis(label, [top], floor=0.0)
    panels = [
        Panel(title=FILTER_NAMES[key], x=_beam_axis(study), y=vertical, series=tuple(found[key]))
        for key in FILTER_NAMES
        if key in found
    ]
    columns = ("beamwidth_deg", f"{name}_{'deg' if scale != 1.0 else 'm'}" if marks else name)
    return Chart(name=name, title=title, caption=caption, panels=tuple(panels), columns=columns)


def consistency(study: Study, rule: Rule, name: str) -> Chart:
    """Chart a filter's ANEES over time, a panel per strategy, a line per beamwidth.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`
    name : str
        The filter.

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Sec. V-B and Eqs. (24) and (25).
    """
    lines: dict[str, list[Series]] = {}
    runs = []
    for strategy in STRATEGIES:
        if (name, strategy) not in study.outcomes:
            continue
        nees = study.outcomes[name, strategy].nees
        time = frame_time(study, nees.shape[2])
        for i in reversed(range(nees.shape[1])):
            counts = kept(study, rule, [(name, strategy, i)])
            if not counts.any() or not time.size:
                continue
            runs.append(int(counts.sum()))
            alone = nees.shape[1] == 1
            lines.setdefault(strategy, []).append(
                Series(
                    name="passive" if alone else beam_name(study.beamwidth[i]),
                    role=strategy,
                    x=time,
                    y=anees(nees[counts, i]),
                    strength=1.0 if alone else 1.0 - 0.75 * i / max(nees.shape[1] - 1, 1),
                )
            )
    span = anees_bounds(min(runs)) if runs else (0.0, 1.0)
    shown = [value for mine in lines.values() for s in mine for value in s.y] + list(span)
    lap = lap_time(study)
    panels = []
    for strategy, series in lines.items():
        end = series[0].x[-1]
        horizontal = linear_axis("time [s]", [0.0, end / 1.05], floor=0.0)
        panels.append(
            Panel(
                title=strategy,
                role=strategy,
                x=horizontal,
                y=log_axis("ANEES", shown),
                series=tuple(series),
                span=(*span, "95 % of a consistent filter"),
                posts=tuple(lap * k for k in range(1, int(end / lap) + 1)),
            )
        )
    return Chart(
        name=f"anees_{name}",
        title=f"Consistency of {FILTER_NAMES[name]}: average NEES over time",
        caption="The stronger a line, the narrower the beam; grey: where 95 % of a consistent "
        f"filter's ANEES lie over {min(runs, default=0)} worlds; dotted posts: the vehicle is "
        "back at its start",
        panels=tuple(panels),
        columns=("time_s", "anees"),
    )


def gains(study: Study, rule: Rule) -> Chart:
    """Chart how much better fused is than active, paired over worlds.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

    Returns
    -------
    Chart
    """
    panels = []
    shown = (("position", "position_rmse_m"), ("map", COMMON))
    found: dict[tuple[str, str], Series] = {}
    for what, score in shown:
        for name, label in FILTER_NAMES.items():
            pair = (name, "active"), (name, "fused")
            findings = judge(differences(study, rule, score, *pair, name=label))
            if not findings:
                continue
            alone = np.array([finding.alone for finding in findings])
            found[what, name] = Series(
                name="active minus fused",
                role="fused",
                x=study.beamwidth,
                y=np.array([finding.mean for finding in findings]),
                low=_bounded(alone[:, 0]),
                high=_bounded(alone[:, 1]),
                style="points",
                filled=np.array([finding.holds is not None for finding in findings]),
            )
    for (what, name), series in found.items():
        alike = [s for (other, _), s in found.items() if other == what]
        ends = [end for s in alike for part in (s.y, s.low, s.high) for end in part]
        panels.append(
            Panel(
                title=f"{what}, {FILTER_NAMES[name]}",
                x=_beam_axis(study),
                y=linear_axis(f"{what} gain [m]", [0.0, *ends]),
                series=(series,),
                rules=(0.0,),
            )
        )
    return Chart(
        name="gain",
        title="What listening to the beacon adds to one's own calls",
        caption="RMSE of active minus that of fused in the same world, mean and its 95 % interval; "
        "above the line fused is better. Full: significant after Holm's correction over the "
        "panel. Map: landmarks that every strategy has placed",
        panels=tuple(panels),
        columns=("beamwidth_deg", "gain_m"),
    )


def counts(study: Study, rule: Rule) -> Chart:
    """Chart Table II, ours beside the paper's.

    Parameters
    ----------
    study : Study
    rule : one of `tables.RULES`

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
        ends = [end for mine in found.values() for s in mine[1] for end in (*s.low, *s.high)]
        for name, (rows, series) in found.items():
            if not rows:
                continue
            names = tuple((float(i), text) for i, text in enumerate(rows))
            panels.append(
                Panel(
                    title=f"{kind}, {FILTER_NAMES[name]}",
                    x=Axis(label="", limits=(-0.6, len(rows) - 0.4), ticks=names),
                    y=linear_axis("landmarks", ends),
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


def piston(study: Study) -> Chart:
    """Chart the beam patterns of the study's emitters.

    Parameters
    ----------
    study : Study

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Eq. (1) and Appendix B.
    """
    config = study.config
    tone = {"frequency": config.emitter.frequency, "speed_of_sound": config.air.speed_of_sound}
    angle = np.radians(np.linspace(-90.0, 90.0, 361))
    series = _protractor(angle)
    for i, width in reversed(list(enumerate(study.beamwidth))):
        radius = float(piston_radius(np.radians(width), **tone))
        pressure = piston_directivity(angle, radius=radius, **tone)
        strength = 1.0 - 0.75 * i / max(len(study.beamwidth) - 1, 1)
        x, y = pressure * np.sin(angle), pressure * np.cos(angle)
        name = beam_name(width)
        series.append(Series(name=name, role="active", x=x, y=y, strength=strength))
        half = np.radians(width) / 2.0
        level = float(piston_directivity(np.array([half]), radius=radius, **tone)[0])
        ka = HALF_POWER / np.sin(half)
        series.append(
            Series(
                name=name, role="active", x=level * np.sin([half]), y=level * np.cos([half]),
                style="marks", strength=strength, listed=False,
                tips=(f"{name}: radius {1e3 * radius:.1f} mm, ka {ka:.1f}; half power at the dot",),
            )
        )  # fmt: skip
    across = Axis(label="", limits=(-1.15, 1.15), ticks=())
    return Chart(
        name="piston",
        title="Beams of the vehicle's emitter",
        caption="Pressure of a back-baffled piston over the angle off its axis, relative to the "
        "axis (up); rings at 0.5, 0.71 (half power) and 1; the stronger a line, the narrower",
        panels=(
            Panel(
                title="",
                x=across,
                y=Axis(label="", limits=(-0.12, 1.15), ticks=()),
                series=tuple(series),
                equal=True,
            ),
        ),
        columns=("across", "along"),
    )


def example_map(study: Study) -> Chart:
    """Chart the first world of the study, drawn anew from its seed.

    Parameters
    ----------
    study : Study

    Returns
    -------
    Chart

    Notes
    -----
    Bradley & Abaid, Sec. IV.
    """
    config, number = study.config, int(study.worlds[0])
    key = stream_key(config.seed, number, "scenario")
    world = draw_scenario(config, np.random.default_rng(key))
    places, (x, y) = world.landmarks, world.beacon
    circle = np.linspace(0.0, 2.0 * np.pi, 181)
    radius = config.scenario.radius
    reach = 1.04 * max(
        radius, float(np.abs(world.path[:, :2]).max()), config.scenario.beacon_distance
    )
    told = tuple(f"landmark {i}: {x:.1f} m, {y:.1f} m" for i, (x, y) in enumerate(places, start=1))
    start = f"start: {world.path[0, 0]:.1f} m, {world.path[0, 1]:.1f} m"
    series = (
        Series(name="edge", role="grid", x=radius * np.cos(circle), y=radius * np.sin(circle),
               dashed=True, listed=False),
        Series(name="true path", role="truth", x=world.path[:, 0], y=world.path[:, 1]),
        Series(name="start", role="truth", x=world.path[:1, 0], y=world.path[:1, 1],
               style="points", tips=(start,)),
        Series(name="landmark", role="ink", x=places[:, 0], y=places[:, 1], style="points",
               filled=np.zeros(len(places), bool), tips=told),
        Series(name="beacon", role="fused", x=np.array([x]), y=np.array([y]), style="stars",
               tips=(f"beacon: {x:.1f} m, {y:.1f} m",)),
    )  # fmt: skip
    axis = Axis(label="", limits=(-reach, reach), ticks=())
    return Chart(
        name="example_map",
        title="A world of the study",
        caption=f"World {number}: {len(places)} landmarks, the beacon and the vehicle's true path of "
        f"{world.time[-1]:g} s; the dashed circle has a radius of {radius:g} m",
        panels=(Panel(title="", x=axis, y=axis, series=series, equal=True),),
        columns=("x_m", "y_m"),
    )


def _protractor(angle: Float[np.ndarray, " n"]) -> list[Series]:
    """Return the rings of a beam pattern, its spokes and their names."""
    found = [
        Series(
            name="ring",
            role="grid",
            x=ring * np.sin(angle),
            y=ring * np.cos(angle),
            dashed=ring < 1.0,
            listed=False,
        )
        for ring in (0.5, np.sqrt(0.5), 1.0)
    ]
    spokes = np.radians(np.arange(-90.0, 91.0, 30.0))
    for spoke in spokes:
        end = np.array([0.0, 1.0])
        found.append(
            Series(
                name="spoke", role="grid", x=end * np.sin(spoke), y=end * np.cos(spoke),
                listed=False,
            )
        )  # fmt: skip
    names = [f"{abs(value):.0f}°" for value in np.degrees(spokes)] + ["0.5", "0.71", "1"]
    x = np.append(1.08 * np.sin(spokes), [0.5, 0.71, 1.0])
    y = np.append(1.08 * np.cos(spokes), [-0.05, -0.05, -0.05])
    found.append(
        Series(name="names", role="grid", x=x, y=y, style="text", tips=tuple(names), listed=False)
    )
    return found


def _beam_series(
    study: Study, rule: Rule, way: tuple[str, str], scores: Sequence[str], scale: float, marks: bool
) -> list[Series]:
    """Return mean, σ and outliers of one way over the beamwidth."""
    cells: list[Cell] = [(*way, i) for i in range(len(study.beamwidth))]
    main = [scale * samples(study, rule, scores[0], [cell])[0] for cell in cells]
    moments = np.array([_mean_std(sample) for sample in main])
    constant = way[1] == "passive" and scores[0] != COMMON
    line = _bars(way[1], way[1], study.beamwidth, moments, style="line" if constant else "dots")
    found = [line]
    if marks:
        above = [s[s > mean + std] for s, (mean, std) in zip(main, moments, strict=True)]
        at = study.beamwidth * ASIDE[way[1]]
        if constant:
            above, at = above[:1], EDGE * study.beamwidth[-1:]
        found.append(
            Series(
                name=f"{way[1]}, worlds above σ",
                role=way[1],
                x=np.repeat(at, [len(s) for s in above]),
                y=np.concatenate(above) if above else np.empty(0),
                style="marks",
                strength=0.55,
            )
        )
    for score in scores[1:]:
        means = [_mean_std(samples(study, rule, score, [cell])[0])[0] for cell in cells]
        found.append(
            Series(
                name=f"{way[1]}, total",
                role=way[1],
                x=study.beamwidth,
                y=scale * np.array(means),
                dashed=True,
            )
        )
    return found


def _beside(
    study: Study, rule: Rule, name: str, score: str
) -> tuple[list[str], tuple[Series, Series]]:
    """Return the paper's counts and ours, row by row, and the names of the rows."""
    rows, printed, ours = [], [], []
    for row in TABLE_II:
        cell = cell_of(study, row) if row.filter == name else None
        if cell is None:
            continue
        rows.append(row_name(row).split()[0])
        printed.append(row.full if score == "landmarks_full" else row.total)
        ours.append(_mean_std(samples(study, rule, score, [cell])[0]))
    at = np.arange(len(rows), dtype=np.float64)
    theirs, mine = (np.array(part).reshape(-1, 2) for part in (printed, ours))
    return rows, (
        _bars("the paper", "truth", at - 0.12, theirs),
        _bars("this study", "fused", at + 0.12, mine),
    )


def _bars(
    name: str,
    role: str,
    x: Float[np.ndarray, " n"],
    moments: Float[np.ndarray, "n 2"],
    style: str = "points",
) -> Series:
    """Return means with σ to both sides."""
    mean, std = moments.T
    return Series(name=name, role=role, x=x, y=mean, low=mean - std, high=mean + std, style=style)


def _mean_std(sample: Float[np.ndarray, " n"]) -> tuple[float, float]:
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


def _bounded(ends: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Leave infinite ends out."""
    return np.where(np.isfinite(ends), ends, np.nan)


def _finite(numbers: Sequence[float]) -> list[float]:
    return [float(value) for value in numbers if np.isfinite(value)]
