"""One mission at a glance: what each strategy made of the same world, and how far it was off."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.paths import Caller
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.evaluation.accuracy import heaviest, pose_error, position_error
from pipistrelle.evaluation.consistency import anees_bounds, track_nees
from pipistrelle.experiments.drives import NO_TRUTH, LabelledPoints, Truth
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.figures.closeup import add_closeups
from pipistrelle.figures.excess_paths import (
    callers_believed,
    callers_marked,
    drawn_excess_paths,
    resolved,
)
from pipistrelle.figures.maps import (
    callers_shown,
    cells,
    draw_truth,
    head,
    legend,
    shades,
    view,
)
from pipistrelle.figures.outlines import PLACED, RAY, beam, ellipses, vehicle
from pipistrelle.figures.recorder import Snapshot
from pipistrelle.figures.style import INK, STYLE, TRUTH, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEFT, RIGHT, TOP, GAP, LEGEND = 0.76, 0.16, 0.58, 0.2, 0.56
"""Margins, the space between panels and the height of two rows of legend [inch]."""
ERRORS = (0.95, 0.95, 0.7)
"""Heights of the error rows: position, heading, NEES [inch]."""
LABELS = ("y [m]", "position error\nand 3σ [m]", "heading error\nand 3σ [°]", "NEES\nand 95 %")
"""Of the rows' vertical axes."""


def draw_mission(
    trials: Sequence[TrialResult],
    *,
    truth: Truth = NO_TRUTH,
    callers: Sequence[Caller] = (),
    beamwidth: float | None = None,
    names: Mapping[str, str] = MappingProxyType({}),
) -> "Figure":
    """Draw the final maps of one world side by side, and below each its errors over time.

    A map shows the true and the estimated path, true landmarks (open circles) tied to their
    estimates (dots in their 95 % ellipses), the rays that are still unresolved (members at one
    standard deviation, the heavier the darker), who else calls, and the vehicle at the end with
    its beam and, enlarged in a corner, its particles if it has any. Where excess paths were heard,
    those of one landmark in the last scan are ellipses about the vehicle and who called. Below,
    position and heading errors stand against three standard deviations of the filter's own (in
    position, of the root of the trace) and the NEES against the 95 % band of one run. All panels
    share their scales.

    `trials`: in the frame of the truth; each strategy and filter once. Several of both make a
    column for each strategy and a row for each filter. `truth`: at the times of the tracks; without
    a path there are no errors to show. Callers may be among the landmarks. `callers`: without the
    vehicle: a star where one stands, by its name where it is not the one beacon, a line where one
    moves. `beamwidth` [rad]: of the vehicle's call, for the strategies that use it; without it no
    beam is drawn. `names`: headings for strategies that have others than their names.
    Returns: not known to pyplot: it is freed when it is let go. Raises ValueError:
    without trials.

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
        figure, panels = _panels(places, limits, len(symbols), errors=truth.path is not None)
        for trial, (axes, *rows) in zip(trials, panels, strict=True):
            draw_truth(axes, truth.landmarks, callers)
            if truth.path is not None:
                axes.plot(*truth.path[:, :2].T, color=TRUTH, lw=3.2, alpha=0.45, zorder=2)
                _draw_errors(rows, trial, truth.path)
            _draw_estimate(axes, trial, truth.landmarks)
            _draw_vehicle(axes, trial, beamwidth)
            name = names.get(trial.strategy, trial.strategy)
            head(axes, trial.strategy, trial.filter, name).set_text(outcome(trial, truth))
        _draw_clouds([axes for axes, *_ in panels], trials, truth)
        if truth.path is not None:
            _scale_errors([rows for _, *rows in panels])
        legend(figure, symbols, 4 if figure.get_figwidth() > 8.0 else 2, LEFT, RIGHT)
    return figure


def _symbols(
    trials: Sequence[TrialResult],
    truth: Truth,
    callers: Sequence[Caller],
    beamwidth: float | None,
) -> list[str]:
    """Name what is drawn in any of the maps, in the order of the legend."""
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
    return [name for name, there in drawn.items() if there]


def _panels(
    places: Sequence[tuple[int, int]],
    limits: tuple[tuple[float, float], tuple[float, float]],
    names: int,
    *,
    errors: bool,
) -> tuple["Figure", list[list["Axes"]]]:
    """Lay out one map per trial, with its error rows below, in inches."""
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
            box = (x / total, y / page, width / total, tall / page)
            axes = _axes(figure, box, panel, panels)
            if (row, column - 1) in places:
                axes.tick_params(labelleft=False)
            else:
                axes.set_ylabel(label, multialignment="center")
                axes.yaxis.set_label_coords(-0.42 / width, 0.5)
            panel.append(axes)
        panel[0].set(xlim=limits[0], ylim=limits[1], xlabel="x [m]", aspect="equal")
        panels.append(panel)
    return figure, panels


def _axes(
    figure: "Figure",
    box: tuple[float, float, float, float],
    panel: list["Axes"],
    panels: list[list["Axes"]],
) -> "Axes":
    """Add a row of a panel: error rows share their time, and each row its scale with the first."""
    first = panels[0][len(panel)] if panels else None
    time = panel[1] if len(panel) > 1 else first
    axes = figure.add_axes(box, sharex=time, sharey=first)
    axes.grid(True)
    axes.set_axisbelow(True)
    return axes


def _draw_estimate(axes: "Axes", trial: TrialResult, true_landmarks: LabelledPoints | None) -> None:
    """Draw the estimated path and the map as it stands at the end."""
    from matplotlib.collections import LineCollection, PolyCollection

    colour, track = strategy_colour(trial.strategy), trial.track
    axes.plot(*track.pose.mean[:, :2].T, color=colour, lw=1.2, zorder=6)
    rows, full = track.landmarks, placed(track.landmarks)
    x, y = rows.mean[full].T
    axes.plot(x, y, "o", ms=2.6, mfc=colour, mec="none", zorder=5)
    outline = ellipses(rows.mean[full], rows.covariance[full], PLACED)
    style = {"fc": shades(colour, np.full(len(outline), 0.2)), "ec": colour, "lw": 0.8}
    axes.add_collection(PolyCollection(list(outline), **style, zorder=4))
    ties = _ties(trial, true_landmarks)
    axes.add_collection(LineCollection(ties, colors=INK, lw=0.7, zorder=4.5))
    if len(callers := _callers(trial)):
        x, y = callers.T
        axes.plot(x, y, "*", ms=12, mfc="none", mec=colour, mew=1.1, zorder=5.5)
    _draw_followed(axes, trial)
    _draw_excess_paths(axes, trial)
    outline = ellipses(rows.mean[~full], rows.covariance[~full], RAY)
    weight = rows.weight[~full]
    style = {"fc": shades(colour, weight), "ec": shades(colour, weight, most=1.0), "lw": 0.8}
    axes.add_collection(PolyCollection(list(outline), **style, zorder=1))
    labels = np.unique(rows.landmark[~full])
    rays = [rows.mean[rows.landmark == label] for label in labels]
    axes.add_collection(LineCollection(rays, colors=colour, lw=0.6, alpha=0.45, zorder=1.5))


def _draw_followed(axes: "Axes", trial: TrialResult) -> None:
    """Draw the tracks of callers that move, and where they are at the end, as they are believed."""
    from matplotlib.collections import PolyCollection

    colour = strategy_colour(trial.strategy)
    for track in trial.track.callers.values():
        known = np.isfinite(track.mean).all(axis=1)
        mean, covariance = track.mean[known], track.covariance[known]
        axes.plot(*mean.T, color=colour, lw=1.2, ls=":", zorder=5.5)
        if trial.track.time[known][-1] < trial.scans[-1].time:
            continue  # out of sight at the end
        axes.plot(*mean[-1:].T, "*", ms=12, mfc="none", mec=colour, mew=1.1, zorder=5.5)
        outline = list(ellipses(mean[-1:], covariance[-1:], PLACED))
        fill = shades(colour, np.full(1, 0.2))
        axes.add_collection(PolyCollection(outline, fc=fill, ec=colour, lw=0.8, zorder=4))


def _callers(trial: TrialResult) -> Float[np.ndarray, "c 2"]:
    """Return where the callers are believed to be at the end that a picture marks."""
    if not callers_marked(trial.scans):
        return np.empty((0, 2))
    mean = callers_believed(trial.track.landmarks, trial.scans[-1].callers).mean
    return mean[np.isfinite(mean).all(axis=1)]


def _draw_excess_paths(axes: "Axes", trial: TrialResult) -> None:
    """Draw the ellipses of a landmark's excess paths, and the ways of its sound."""
    from matplotlib.collections import LineCollection, PolyCollection

    outlines, ways = _excess_paths(trial)
    if outlines:
        style = {"lw": 0.9, "alpha": 0.7, "zorder": 3.5}
        axes.add_collection(PolyCollection(outlines, fc="none", ec=INK, **style))
        axes.add_collection(LineCollection(ways, colors=INK, **style))


def _excess_paths(trial: TrialResult) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return ellipses and ways of a landmark's excess paths in the last scan, as in the film."""
    track, scan = trial.track, trial.scans[-1] if trial.scans else None
    if scan is None or not np.isfinite(scan.excess_path).any():
        return [], []
    k = int(np.searchsorted(track.time, scan.time))
    seen = {n: one for n, one in track.callers.items() if np.isfinite(one.mean[k]).all()}
    moving = Landmarks(
        landmark=np.array(list(seen), dtype=np.int64),
        mean=np.array([one.mean[k] for one in seen.values()]).reshape(-1, 2),
        covariance=np.array([one.covariance[k] for one in seen.values()]).reshape(-1, 2, 2),
        weight=np.ones(len(seen)),
    )
    end = Snapshot(
        scan=scan,
        pose=track.pose.mean[k],
        covariance=track.pose.covariance[k],
        landmarks=track.landmarks,
        moving=moving,
    )
    return drawn_excess_paths(end, resolved([end])[0])


def _ties(trial: TrialResult, true_landmarks: LabelledPoints | None) -> list[np.ndarray]:
    """Return a line from each landmark that is fully initialised to where it truly is."""
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


def _draw_vehicle(axes: "Axes", trial: TrialResult, beamwidth: float | None) -> None:
    """Draw the vehicle where it believes to be at the end, and the beam of its call."""
    from matplotlib.patches import Polygon

    pose = trial.track.pose.mean[-1]
    if not np.all(np.isfinite(pose)):
        return
    size = axes.get_xlim()[1] - axes.get_xlim()[0]
    if beamwidth is not None and trial.strategy != "passive":
        wedge = beam(pose, beamwidth, 0.25 * size)
        axes.add_patch(Polygon(wedge, fc=INK, alpha=0.13, lw=0, zorder=1.8))
    shape = vehicle(pose, 0.045 * size)
    axes.add_patch(Polygon(shape, fc=INK, ec="white", lw=0.8, zorder=8))


def _draw_clouds(maps: Sequence["Axes"], trials: Sequence[TrialResult], truth: Truth) -> None:
    """Draw the particles at the end, where there are any."""
    tracks = [trial.track for trial in trials]
    clouds = [[] if track.cloud is None else [track.cloud] for track in tracks]
    landmarks, paths = [t.landmarks.mean for t in tracks], [t.pose.mean for t in tracks]
    colours = [strategy_colour(trial.strategy) for trial in trials]
    closeups = add_closeups(maps, colours, clouds, paths, landmarks, truth.landmarks)
    for closeup, cloud, path in zip(closeups, clouds, paths, strict=True):
        if closeup:
            closeup.show(cloud[0], path, truth.path)


def outcome(trial: TrialResult, truth: Truth) -> str:
    """Describe an estimate in a line: its error, if known, and its number of landmarks."""
    scores = trial.scores
    there = scores.landmarks_total if truth.landmarks is None else len(truth.landmarks[0])
    parts = [f"{scores.landmarks_full} of {there} landmarks placed"]
    if (rmse := scores.position_rmse_m) is not None:
        parts.insert(0, f"RMSE {rmse:.2f} m" if rmse < 100.0 else f"RMSE {rmse:.3g} m")
    if scores.diverged:
        parts = ["diverged", *parts[:-1]]
    return " · ".join(parts)


def _draw_errors(rows: Sequence["Axes"], trial: TrialResult, true_path: np.ndarray) -> None:
    """Draw position error, heading error and NEES over time, with the bounds that should hold."""
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
    """Scale the error rows and their time, common to all; a bound far above the errors is cut."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    def highest(row: int) -> float:
        errors = np.concatenate([np.abs(panel[row].lines[0].get_ydata()) for panel in panels])
        error = errors[np.isfinite(errors)].max(initial=1e-3)
        bound = max(panel[row].dataLim.ymax for panel in panels)
        return float(np.clip(1.05 * bound, 1.2 * error, 3.0 * error))

    position, heading, consistency = panels[0]
    # A label at the end of the time would touch the 0 of the panel beside.
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
