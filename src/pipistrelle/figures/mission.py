"""The figure of a mission: the map of each strategy and filter, and its errors over time."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pipistrelle.acoustics.paths import Caller
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.evaluation.accuracy import alignment, heaviest, moved, pose_error, position_error
from pipistrelle.evaluation.consistency import anees_bounds, track_nees
from pipistrelle.experiments.drives import NO_TRUTH, LabelledPoints, Truth
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.figures.maps import TIED, MapPanel, draw_maps
from pipistrelle.figures.recorder import Snapshot, callers_marked
from pipistrelle.figures.style import INK, STYLE, strategy_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERRORS = {
    "position error\nand 3σ [m]": 0.95,
    "heading error\nand 3σ [°]": 0.95,
    "NEES\nand 95 %": 0.7,
}
"""Labels of the rows of errors, and their heights [inch]."""


def draw_mission(
    trials: Sequence[TrialResult],
    *,
    truth: Truth = NO_TRUTH,
    callers: Sequence[Caller] = (),
    beamwidth: float | None = None,
    names: Mapping[str, str] = MappingProxyType({}),
) -> "Figure":
    """Draw the final map of each trial and, below it, its errors over time.

    A map shows the true and the estimated path, true landmarks (open circles) with a line to their
    estimates (dots in their 95 % ellipses), the unresolved rays (members at their standard
    deviation, the heavier the darker), the callers, and the vehicle at the end with its beam and,
    enlarged in a corner, its particles if it has any. Excess paths of a landmark in the last
    scan are ellipses around vehicle and caller. The error rows show position and heading errors
    with three standard deviations of the filter (in position, the root of the trace) and the NEES
    with the 95 % band of one run. All panels share their scales.

    `trials`: in the frame of the truth; each strategy and filter once. Several of both make a
    column for each strategy and a row for each filter, or the reverse with more filters; more than
    two rows have only the position error. `truth`: at the times of the tracks; without a path there
    are no error rows. Callers may be among the landmarks. `callers`: without the vehicle; a fixed
    caller is a star, with its name unless it is the only beacon, a moving caller is a line.
    `beamwidth` [rad]: of the vehicle's call, for the strategies that use it; by default no beam is
    drawn. `names`: headings of strategies, by default their names.
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
    panels = [_EndPanel(trial, truth, beamwidth) for trial in trials]
    rows = ERRORS if truth.path is not None else {}
    with matplotlib.rc_context(STYLE):
        figure, below = draw_maps(panels, truth, callers, names=names, rows=rows)
        lines = [outcome(trial, truth) for trial in trials]
        wide = 72.0 * panels[0].axes.bbox.width / figure.dpi
        size = min(9.5, wide / (0.55 * max(map(len, lines))))
        for panel, line in zip(panels, lines, strict=True):
            panel.show_end()
            panel.line.set(text=line, fontsize=size)
        if truth.path is not None:
            for axes, trial in zip(below, trials, strict=True):
                _draw_errors(axes, trial, truth.path)
            _scale_errors(below)
    return figure


class _EndPanel(MapPanel):
    """The map at the end of a trial, with lines from landmarks to their true positions."""

    def __init__(self, trial: TrialResult, truth: Truth, beamwidth: float | None) -> None:
        track = trial.track
        nothing = make_scan(track.time[-1], np.empty(0), np.empty(0))
        scan = trial.scans[-1] if trial.scans else nothing
        k = min(int(np.searchsorted(track.time, scan.time)), len(track.time) - 1)
        tracks, ends = [], []
        for label, caller in track.callers.items():
            known = np.flatnonzero(np.isfinite(caller.mean).all(axis=1))
            tracks.append(caller.mean[known])
            if track.time[known[-1]] >= scan.time:
                ends.append((label, caller.mean[known[-1]], caller.covariance[known[-1]]))
        moving = Landmarks(
            landmark=np.array([label for label, _, _ in ends], int),
            mean=np.reshape([mean for _, mean, _ in ends], (-1, 2)),
            covariance=np.reshape([covariance for _, _, covariance in ends], (-1, 2, 2)),
            weight=np.ones(len(ends)),
        )
        end = Snapshot(
            scan=scan,
            pose=track.pose.mean[k],
            covariance=track.pose.covariance[k],
            landmarks=track.landmarks,
            moving=moving,
            cloud=track.cloud,
        )
        super().__init__((trial.strategy, trial.filter), [end], beamwidth)
        self.path, self.tracks, self.marked = track.pose.mean, tracks, callers_marked(trial.scans)
        self.truth, self.ties = truth, _ties(trial, truth.landmarks)

    def symbols(self) -> set[str]:
        """Return the names of the legend symbols that the map needs."""
        ends, truth = bool(np.isfinite(self.path[-1]).all()), self.truth
        drawn = {
            "true path": truth.path is not None,
            "estimated path": True,
            "true landmark": truth.landmarks is not None and len(truth.landmarks[0]) > 0,
            TIED: bool(self.ties),
            "vehicle at the end": ends,
            "its beam": ends and self.beamwidth is not None,
            "particles": ends and self.frames[0].cloud is not None,
        }
        return super().symbols() | {name for name, is_drawn in drawn.items() if is_drawn}

    def show_end(self) -> None:
        """Show the final estimate with lines to the true landmarks and along partial landmarks."""
        from matplotlib.collections import LineCollection

        self.show(0, self.path, self.truth.path, self.tracks)
        self.add(LineCollection(self.ties, colors=INK, lw=0.7, zorder=4.5))
        rows = self.frames[0].landmarks
        rays = [rows.mean[rows.landmark == n] for n in np.unique(rows.landmark[~placed(rows)])]
        self.add(LineCollection(rays, colors=self.colour, lw=0.6, alpha=0.45, zorder=1.5))


def _ties(trial: TrialResult, true_landmarks: LabelledPoints | None) -> list[np.ndarray]:
    """Return a line from each fully initialised landmark's estimate to its true position."""
    if true_landmarks is None or (trial.track.labels and trial.mapped is None):
        return []
    true = dict(zip(true_landmarks[0].tolist(), true_landmarks[1], strict=True))
    estimate = heaviest(trial.mapped or trial.track.landmarks)
    full = zip(estimate.landmark[estimate.full].tolist(), estimate.mean[estimate.full], strict=True)
    return [np.stack([mean, true[label]]) for label, mean in full if label in true]


def outcome(trial: TrialResult, truth: Truth) -> str:
    """Return a line of text on a trial: position RMSE, if known, and number of landmarks.

    If two of at least twelve landmarks make three quarters of the squared error of the aligned map,
    its RMSE and its median follow.
    """
    scores = trial.scores
    total = scores.landmarks_total if truth.landmarks is None else len(truth.landmarks[0])
    parts = [f"{scores.landmarks_full} of {total} landmarks placed"]
    if len(ties := _ties(trial, truth.landmarks)) > 11:
        mapped, true = np.stack(ties, axis=1)
        errors = np.sort(position_error(moved(mapped, alignment(mapped, true)), true))
        if 4.0 * np.sum(errors[:-2] ** 2) < np.sum(errors**2):
            error = f"{np.sqrt(np.mean(errors**2)):.2f} m, median {np.median(errors):.2f} m"
            parts = [f"aligned map {error}", parts[0].replace("landmarks ", "")]
    if (off := scores.position_rmse_m) is not None:
        parts.insert(0, f"RMSE {off:.2f} m" if off < 100.0 else f"RMSE {off:.3g} m")
    if scores.diverged:
        parts = ["diverged", *parts[:-1]]
    return " · ".join(parts)


def _draw_errors(rows: Sequence["Axes"], trial: TrialResult, true_path: np.ndarray) -> None:
    """Draw a trial's position error, heading error and NEES over time, with their bounds."""
    colour, track = strategy_colour(trial.strategy), trial.track
    elapsed, covariance = track.time - track.time[0], track.pose.covariance
    variance = np.stack([covariance[:, 0, 0] + covariance[:, 1, 1], covariance[:, 2, 2]])
    far, wide = 3.0 * np.sqrt(np.maximum(variance, 0.0))
    wide = np.rad2deg(wide)
    distance = position_error(track.pose.mean, true_path)
    turn = np.rad2deg(pose_error(track.pose.mean, true_path)[:, 2])
    bands = (far, 0.0, distance), (-wide, wide, turn)
    for axes, (low, high, error) in zip(rows[:2], bands, strict=False):
        axes.fill_between(elapsed, low, high, color=colour, alpha=0.16, lw=0)
        axes.plot(elapsed, error, color=colour, lw=1.1)
        axes.tick_params(labelbottom=axes is rows[-1])
    for consistency in rows[2:]:
        consistency.axhspan(*anees_bounds(1), color="#d9d9d9", alpha=0.6, lw=0)
        consistency.plot(elapsed, track_nees(track.pose, true_path), color=colour, lw=0.9)
        consistency.set(yscale="log")
    rows[-1].set(xlabel="time [s]", xlim=(0.0, elapsed[-1]))


def _scale_errors(panels: Sequence[Sequence["Axes"]]) -> None:
    """Give the error axes of all trials common scales; bounds far above the errors are cut."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    def highest(row: int) -> float:
        errors = np.concatenate([np.abs(panel[row].lines[0].get_ydata()) for panel in panels])
        error = errors[np.isfinite(errors)].max(initial=1e-3)
        bound = max(panel[row].dataLim.ymax for panel in panels)
        return float(np.clip(1.05 * bound, 1.2 * error, 3.0 * error))

    position, *others = panels[0]
    # A label at the end of the time would touch the 0 of the next panel.
    position.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], prune="upper"))
    position.xaxis.set_major_formatter("{x:g}")
    position.set_ylim(0.0, highest(0))
    if not others:
        return
    heading, consistency = others
    heading.set_ylim(-highest(1), highest(1))
    largest = max(panel[2].dataLim.ymax for panel in panels)
    consistency.set_ylim(0.05, max(100.0, 2.0 * largest))
    consistency.yaxis.set_major_locator(LogLocator(subs=(1.0,), numticks=5))
    consistency.yaxis.set_major_formatter(
        lambda x, _: f"{x:g}" if x < 1e4 else f"$10^{{{np.log10(x):.0f}}}$"
    )
