"""The figure of a mission: the map of each strategy and filter, and its errors over time."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller
from pipistrelle.estimation.beliefs import Landmarks, no_landmarks, placed
from pipistrelle.evaluation.accuracy import heaviest, pose_error, position_error
from pipistrelle.evaluation.consistency import anees_bounds, track_nees
from pipistrelle.experiments.drives import NO_TRUTH, LabelledPoints, Truth
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.figures.maps import (
    MapPanel,
    add_closeups,
    callers_shown,
    cells,
    draw_truth,
    head,
    legend,
    view,
)
from pipistrelle.figures.recorder import (
    Snapshot,
    callers_believed,
    callers_marked,
    drawn_excess_paths,
    resolved,
)
from pipistrelle.figures.style import INK, STYLE, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEFT, RIGHT, TOP, GAP, LEGEND = 0.76, 0.16, 0.58, 0.2, 0.56
"""Margins, the space between panels and the height of two rows of legend [inch]."""
ERRORS = (0.95, 0.95, 0.7)
"""Heights of the error rows: position, heading, NEES [inch]."""
LABELS = ("y [m]", "position error\nand 3σ [m]", "heading error\nand 3σ [°]", "NEES\nand 95 %")
"""Labels of the rows' vertical axes."""
VEHICLE = 0.045
"""Length of the vehicle as a share of the map's width."""


def draw_mission(
    trials: Sequence[TrialResult],
    *,
    truth: Truth = NO_TRUTH,
    callers: Sequence[Caller] = (),
    beamwidth: float | None = None,
    names: Mapping[str, str] = MappingProxyType({}),
) -> "Figure":
    """Draw the final maps of a world side by side, and below each its errors over time.

    A map shows the true and the estimated path, true landmarks (open circles) with a line to their
    estimates (dots in their 95 % ellipses), the unresolved rays (members at their standard
    deviation, the heavier the darker), the callers, and the vehicle at the end with its beam and,
    enlarged in a corner, its particles if it has any. Excess paths of a landmark in the last
    scan are ellipses around vehicle and caller. The error rows show position and heading errors
    with three standard deviations of the filter (in position, the root of the trace) and the NEES
    with the 95 % band of one run. All panels share their scales.

    `trials`: in the frame of the truth; each strategy and filter once. Several of both make a
    column for each strategy and a row for each filter. `truth`: at the times of the tracks; without
    a path there are no error rows. Callers may be among the landmarks. `callers`: without the
    vehicle; a fixed caller is a star, with its name unless it is the only beacon, a moving caller
    is a line. `beamwidth` [rad]: of the vehicle's call, for the strategies that use it; by default
    no beam is drawn. `names`: headings of strategies, by default their names.
    Returns: a figure unknown to pyplot. Raises ValueError without trials.

    Bradley & Abaid, Eqs. (23) and (26), over the time of one run.

    Examples
    --------
    >>> draw_mission([])
    Traceback (most recent call last):
    ValueError: a mission's figure needs at least one trial
    """
    import matplotlib

    if not trials:
        raise ValueError("a mission's figure needs at least one trial")
    paths = [trial.track.pose.mean for trial in trials]
    maps = [trial.track.landmarks for trial in trials]
    limits = view(truth, callers, paths, maps)
    places = cells([(trial.strategy, trial.filter) for trial in trials])
    symbols = _symbols(trials, truth, callers, beamwidth)
    with matplotlib.rc_context(STYLE):
        figure, axes = _panels(places, limits, len(symbols), errors=truth.path is not None)
        panels = []
        for trial, (on_map, *rows) in zip(trials, axes, strict=True):
            draw_truth(on_map, truth.landmarks, callers)
            own_beam = None if trial.strategy == "passive" else beamwidth
            panels.append(MapPanel(on_map, trial.strategy, VEHICLE, own_beam))
            name = names.get(trial.strategy, trial.strategy)
            head(on_map, trial.strategy, trial.filter, name).set_text(outcome(trial, truth))
            if truth.path is not None:
                _draw_errors(rows, trial, truth.path)
        add_closeups(
            panels,
            [[] if trial.track.cloud is None else [trial.track.cloud] for trial in trials],
            paths,
            [rows.mean for rows in maps],
            truth.landmarks,
        )
        for panel, trial in zip(panels, trials, strict=True):
            _draw_estimate(panel, trial, truth)
        if truth.path is not None:
            _scale_errors([rows for _, *rows in axes])
        legend(figure, symbols, 4 if figure.get_figwidth() > 8.0 else 2, LEFT, RIGHT)
    return figure


def _symbols(
    trials: Sequence[TrialResult],
    truth: Truth,
    callers: Sequence[Caller],
    beamwidth: float | None,
) -> list[str]:
    """Return the names of all symbols in the maps, in the order of the legend."""
    tied = any(_ties(trial, truth.landmarks) for trial in trials)
    full = [placed(trial.track.landmarks) for trial in trials]
    ending = [trial for trial in trials if np.isfinite(trial.track.pose.mean[-1]).all()]
    calling = [trial for trial in ending if trial.strategy != "passive"]
    shown = callers_shown(callers)
    drawn = {
        "true path": truth.path is not None,
        "estimated path": True,
        "true landmark": truth.landmarks is not None and len(truth.landmarks[0]) > 0,
        "placed landmark, 95 %, and its error": tied,
        "placed landmark, 95 %": not tied and any(rows.any() for rows in full),
        "unresolved ray, 1σ, darker: likelier": any(not rows.all() for rows in full),
        **{name: name in shown for name in ("beacon", "caller", "moving caller")},
        "caller as estimated": any(len(_callers(t)) or t.track.callers for t in trials),
        "its estimated track": any(trial.track.callers for trial in trials),
        "excess-path ellipse and its way": any(_excess_paths(trial)[0] for trial in trials),
        "vehicle at the end": bool(ending),
        "its beam": beamwidth is not None and bool(calling),
        "particles": any(trial.track.cloud is not None for trial in ending),
    }
    return [name for name, is_drawn in drawn.items() if is_drawn]


def _panels(
    places: Sequence[tuple[int, int]],
    limits: tuple[tuple[float, float], tuple[float, float]],
    names: int,
    *,
    errors: bool,
) -> tuple["Figure", list[list["Axes"]]]:
    """Return a figure with a map and error rows for each trial."""
    from pipistrelle.figures.picture import picture

    (left, right), (bottom, top) = limits
    blocks, columns = (1 + max(indices) for indices in zip(*places, strict=True))
    total = {1: 6.4, 2: 9.0}.get(columns, 12.0)
    width = (total - LEFT - RIGHT - (columns - 1) * GAP) / columns
    height = width * (top - bottom) / (right - left)
    heights = (height, *ERRORS) if errors else (height,)
    gaps = [0.0, 0.5, 0.12, 0.12][: len(heights)]
    block = TOP + sum(heights) + sum(gaps) + 0.42
    entries = 4 if total > 8.0 else 2
    page = blocks * block + LEGEND * -(-names // entries) / 2
    figure = picture(total, page)
    panels: list[list[Axes]] = []
    for row, column in places:
        x, y = LEFT + column * (width + GAP), page - row * block - TOP
        panel: list[Axes] = []
        for tall, gap, label in zip(heights, gaps, LABELS, strict=False):
            y -= gap + tall
            first = panels[0][len(panel)] if panels else None
            axes = figure.add_axes(
                (x / total, y / page, width / total, tall / page),
                sharex=panel[1] if len(panel) > 1 else first,
                sharey=first,
            )
            axes.grid(True)
            axes.set_axisbelow(True)
            if (row, column - 1) in places:
                axes.tick_params(labelleft=False)
            else:
                axes.set_ylabel(label, multialignment="center")
                axes.yaxis.set_label_coords(-0.42 / width, 0.5)
            panel.append(axes)
        panel[0].set(xlim=limits[0], ylim=limits[1], xlabel="x [m]", aspect="equal")
        panels.append(panel)
    return figure, panels


def _draw_estimate(panel: MapPanel, trial: TrialResult, truth: Truth) -> None:
    """Draw an estimate at the end, the errors of its landmarks and the lines of its rays."""
    from matplotlib.collections import LineCollection

    track, colour = trial.track, panel.colour
    moving, trails = _tracked(trial)
    panel.show(
        track.pose.mean,
        track.landmarks,
        true_path=truth.path,
        cloud=track.cloud,
        excess_paths=_excess_paths(trial),
        callers=np.concatenate([_callers(trial), moving.mean]),
        moving=moving,
        trails=trails,
    )
    rows, full = track.landmarks, placed(track.landmarks)
    ties = LineCollection(_ties(trial, truth.landmarks), colors=INK, lw=0.7, zorder=4.5)
    panel.axes.add_collection(ties)
    rays = [rows.mean[rows.landmark == label] for label in np.unique(rows.landmark[~full])]
    lines = LineCollection(rays, colors=colour, lw=0.6, alpha=0.45, zorder=1.5)
    panel.axes.add_collection(lines)


def _tracked(trial: TrialResult) -> tuple[Landmarks, list[Float[np.ndarray, "_ 2"]]]:
    """Return the tracked callers in sight at the end, and the tracks of all."""
    ends, trails = {}, []
    for label, track in trial.track.callers.items():
        known = np.isfinite(track.mean).all(axis=1)
        trails.append(track.mean[known])
        if trial.track.time[known][-1] >= trial.scans[-1].time:
            ends[label] = track.mean[known][-1], track.covariance[known][-1]
    return _landmarks_of(ends), trails


def _landmarks_of(positions: Mapping[int, tuple[np.ndarray, np.ndarray]]) -> Landmarks:
    """Return Gaussians by label as fully initialised landmarks."""
    if not positions:
        return no_landmarks()
    mean, covariance = map(np.array, zip(*positions.values(), strict=True))
    weight = np.ones(len(positions))
    return Landmarks(
        landmark=np.array(list(positions)), mean=mean, covariance=covariance, weight=weight
    )


def _callers(trial: TrialResult) -> Float[np.ndarray, "c 2"]:
    """Return the estimated positions of the callers to mark at the end."""
    if not callers_marked(trial.scans):
        return np.empty((0, 2))
    mean = callers_believed(trial.track.landmarks, trial.scans[-1].callers).mean
    return mean[np.isfinite(mean).all(axis=1)]


def _excess_paths(trial: TrialResult) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return ellipses and ways of a landmark's excess paths in the last scan."""
    track, scan = trial.track, trial.scans[-1] if trial.scans else None
    if scan is None or not np.isfinite(scan.excess_path).any():
        return [], []
    k = int(np.searchsorted(track.time, scan.time))
    tracks = track.callers.items()
    end = Snapshot(
        scan=scan,
        pose=track.pose.mean[k],
        covariance=track.pose.covariance[k],
        landmarks=track.landmarks,
        moving=_landmarks_of(
            {n: (t.mean[k], t.covariance[k]) for n, t in tracks if np.isfinite(t.mean[k]).all()}
        ),
    )
    return drawn_excess_paths(end, resolved([end])[0])


def _ties(trial: TrialResult, true_landmarks: LabelledPoints | None) -> list[np.ndarray]:
    """Return a line from each fully initialised landmark to its true position."""
    if true_landmarks is None or (trial.track.labels and trial.mapped is None):
        return []
    true = dict(zip(true_landmarks[0].tolist(), true_landmarks[1], strict=True))
    estimate = heaviest(trial.mapped or trial.track.landmarks)
    return [
        np.stack([mean, true[label]])
        for label, mean, full in zip(
            estimate.landmark.tolist(), estimate.mean, estimate.full, strict=True
        )
        if full and label in true
    ]


def outcome(trial: TrialResult, truth: Truth) -> str:
    """Return a line on an estimate: its error, if known, and its number of landmarks."""
    scores = trial.scores
    total = scores.landmarks_total if truth.landmarks is None else len(truth.landmarks[0])
    parts = [f"{scores.landmarks_full} of {total} landmarks placed"]
    if (rmse := scores.position_rmse_m) is not None:
        parts.insert(0, f"RMSE {rmse:.2f} m" if rmse < 100.0 else f"RMSE {rmse:.3g} m")
    if scores.diverged:
        parts = ["diverged", *parts[:-1]]
    return " · ".join(parts)


def _draw_errors(rows: Sequence["Axes"], trial: TrialResult, true_path: np.ndarray) -> None:
    """Draw position error, heading error and NEES over time, with their bounds."""
    colour, track = strategy_colour(trial.strategy), trial.track
    covariance = track.pose.covariance
    error = pose_error(track.pose.mean, true_path)
    variance = np.stack([covariance[:, 0, 0] + covariance[:, 1, 1], covariance[:, 2, 2]])
    bounds = 3.0 * np.sqrt(np.maximum(variance, 0.0))
    position, heading, consistency = rows
    elapsed = track.time - track.time[0]
    distance = position_error(track.pose.mean, true_path)
    position.fill_between(elapsed, bounds[0], color=colour, alpha=0.16, lw=0)
    position.plot(elapsed, distance, color=colour, lw=1.1)
    turn, bound = np.rad2deg(error[:, 2]), np.rad2deg(bounds[1])
    heading.fill_between(elapsed, -bound, bound, color=colour, alpha=0.16, lw=0)
    heading.plot(elapsed, turn, color=colour, lw=1.1)
    consistency.axhspan(*anees_bounds(1), color="#d9d9d9", alpha=0.6, lw=0)
    epsilon = track_nees(track.pose, true_path)
    consistency.plot(elapsed, epsilon, color=colour, lw=0.9)
    consistency.set(yscale="log", xlabel="time [s]", xlim=(0.0, elapsed[-1]))
    for axes in (position, heading):
        axes.tick_params(labelbottom=False)


def _scale_errors(panels: Sequence[Sequence["Axes"]]) -> None:
    """Give all error rows common scales; bounds far above the errors are cut."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    def highest(row: int) -> float:
        errors = np.concatenate([np.abs(panel[row].lines[0].get_ydata()) for panel in panels])
        error = errors[np.isfinite(errors)].max(initial=1e-3)
        bound = max(panel[row].dataLim.ymax for panel in panels)
        return float(np.clip(1.05 * bound, 1.2 * error, 3.0 * error))

    position, heading, consistency = panels[0]
    # A label at the end of the time would touch the 0 of the next panel.
    consistency.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], prune="upper"))
    consistency.xaxis.set_major_formatter("{x:g}")
    position.set_ylim(0.0, highest(0))
    heading.set_ylim(-highest(1), highest(1))
    largest = max(panel[2].dataLim.ymax for panel in panels)
    consistency.set_ylim(0.05, max(100.0, 2.0 * largest))
    consistency.yaxis.set_major_locator(LogLocator(subs=(1.0,), numticks=5))
    consistency.yaxis.set_major_formatter(
        lambda x, _: f"{x:g}" if x < 1e4 else f"$10^{{{np.log10(x):.0f}}}$"
    )
