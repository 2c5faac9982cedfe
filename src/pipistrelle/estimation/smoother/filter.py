"""Incremental smoother: the whole trajectory is re-estimated with each frame.

The smoother keeps every measurement, and eliminates the normal equations along the chain of poses
(`elimination`): a frame adds a node, and unknowns that moved are relinearised (`chain`). Nodes are
the times of scans (`preintegration` has the control steps between). Landmarks and callers are
initialised by a range, a precise excess path, crossing bearings, or ranges that leave a
place (`entering_places`), with all their measurements so far; until then they are partially
initialised. An excess path counts once its landmark and its caller are initialised. A moving caller
has a position and a velocity at each node, and is no landmark.

``robust`` names the loss. With a gate, measurements outside a share of their predicted distribution
are discarded: bearing and range jointly, an excess path separately, as an error such as a wrong
direct call affects only it. The belief at a frame is the solution there; trajectory, caller tracks
and map are the optimum of all measurements so far (`belief`).

**Initialisation** is delayed until the range is certain. A measured range initialises at once.
Otherwise an excess path gives the range along the bearing: of a landmark if the caller is
initialised, of a caller if the landmark is (`observations.excess_path`). It is strongly nonlinear
near the line from vehicle to caller, so its uncertainty is an unscented transform of offset,
bearing and excess path (eight sigma points at two standard deviations; Julier & Uhlmann 1997),
unknown if a sigma point has no range. Without it, a landmark is initialised where its newest
bearing clearly crosses an earlier bearing; the standard deviation along the newest combines both
lines over the sine of their angle. Moving callers' bearings are not crossed.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    SLOPE,
    Scan,
)
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.checking import (
    check_belief,
    check_gate,
    usable_controls,
    usable_known,
    usable_pose,
    usable_scan,
)
from pipistrelle.estimation.motion import SMALLEST_STD, Controls, Durations, Motion
from pipistrelle.estimation.observations.bearing import MIN_CROSSING_SINE, observe
from pipistrelle.estimation.observations.excess_path import unscented_range
from pipistrelle.estimation.observations.range import is_certain
from pipistrelle.estimation.observations.rows import LOSSES
from pipistrelle.estimation.rays import gate_bounds
from pipistrelle.estimation.recovery import correction, recovering
from pipistrelle.estimation.smoother.belief import SmootherBelief
from pipistrelle.estimation.smoother.elimination import joint
from pipistrelle.estimation.smoother.history import (
    NEVER,
    STRETCH,
    History,
    begun,
    heard_more,
    slots_heard,
    with_caller,
    with_leaving,
    with_places,
)
from pipistrelle.estimation.smoother.observations import (
    View,
    bearing_of,
    direction_of,
    distance_of,
    places_left,
    point_of,
    range_of,
    view_of,
    write_bearing,
    write_excess_path,
    write_range,
)
from pipistrelle.estimation.smoother.preintegration import (
    NOTHING,
    Calibration,
    extended,
    no_odometry,
)
from pipistrelle.estimation.smoother.records import (
    Arrays,
    Border,
    ChainState,
    Factor,
    Front,
    NoiseModel,
    Places,
    PointArrays,
    Rows,
    Span,
    Stack,
    Work,
    work_of,
)
from pipistrelle.estimation.smoother.sweep import (
    Points,
    Solution,
    Sweep,
    eliminated,
    off_line,
    relinearised,
    stepped,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc, optimised_once


@kernel
def excess_path_range(
    rows: Rows,
    heard: Span,
    view: View,
    k: Whole,
    places: Places,
    estimate: PointArrays,
    front: Front,
    R: Factor,
) -> float:
    """Return the range [m] of a landmark or caller from its most precise excess path, or NaN."""
    m, first, last = heard
    slot, angle = rows.ends[m, 0], direction_of(view, rows.numbers[m])
    across = rows.numbers[m, BEARING_STD] ** 2
    least, found, other = math.inf, -1, (0, 0.0, 0.0)
    for e in range(first, last):
        of_caller, ends = rows.ends[e, 1] == slot, (rows.ends[e, 0], rows.ends[e, 1])
        if ends[1] < 0 or not (of_caller or ends[0] == slot):
            continue
        end = point_of(ends[0] if of_caller else ends[1], k, places, estimate)
        if end[0] == 0:
            continue
        clue = end[1] - view.x, end[2] - view.y, angle, view.scale * rows.numbers[e, EXCESS_PATH]
        spread = 0.0, 0.0, 0.0, 0.0, 0.0, across, rows.numbers[e, EXCESS_PATH_STD] ** 2
        away, variance = unscented_range(clue, spread, of_caller)
        if is_certain(away, variance) and variance < least * away * away:
            least, found, other = variance / (away * away), e, end
    if found < 0:
        return math.nan
    # The covariance of the offset to the other end (2) and of the heading.
    by_chain, by_border = np.zeros((3, front.P.shape[0])), np.zeros((3, R.shape[0]))
    for a in range(2):
        by_chain[a, a] = -1.0
        if other[0] > 0:
            by_border[a, other[0] + a] = 1.0
        else:
            by_chain[a, a - other[0]] = 1.0
    by_chain[2, 2] = 1.0
    P = joint(front, R, R.shape[0], by_chain, by_border)
    clue = (
        other[1] - view.x,
        other[2] - view.y,
        angle,
        view.scale * rows.numbers[found, EXCESS_PATH],
    )
    variances = P[2, 2] + across, rows.numbers[found, EXCESS_PATH_STD] ** 2
    spread = P[0, 0], P[1, 0], P[1, 1], P[2, 0], P[2, 1], variances[0], variances[1]
    away, variance = unscented_range(clue, spread, rows.ends[found, 1] == slot)
    return away if is_certain(away, variance) else math.nan


@optimised_once
def entering_places(
    rows: Arrays,
    span: Span,
    moves: Int[np.ndarray, " s"],
    places: Arrays,
    estimate: PointArrays,
    front: Arrays,
    R: Factor,
    driven: tuple[Float[np.ndarray, "k 3 3"], Whole],
) -> Float[np.ndarray, "m 2"]:
    """Return initial positions for new landmarks and callers in a scan; NaN if too uncertain.

    ``driven``: covariances of the motion between nodes, and the code of the robust loss.
    """
    rows, places, front = Rows(*rows), Places(*places), Front(*front)
    (noise, loss), (k, first, last) = driven, span
    found = np.full((last - first, 2), np.nan)
    view = view_of(estimate[0][k], estimate[1], places, k)
    for m in range(first, last):
        slot, numbers = rows.ends[m, 0], rows.numbers[m]
        if places.index[slot] != 0:
            continue
        if math.isnan(numbers[BEARING]):
            if not (math.isnan(numbers[RANGE]) or moves[slot]):
                count, place, _ = places_left(rows, m, estimate, places, noise, loss)
                if count == 1:
                    found[m - first, 0], found[m - first, 1] = place[0], place[1]
            continue
        away = distance_of(view, numbers[RANGE])
        if math.isnan(away):
            heard = m, first, last
            away = excess_path_range(rows, heard, view, k, places, estimate, front, R)
        if math.isnan(away) and not moves[slot]:
            away = range_by_crossing(rows, m, estimate, places)
        angle = direction_of(view, numbers)
        found[m - first, 0] = view.x + away * math.cos(angle)
        found[m - first, 1] = view.y + away * math.sin(angle)
    return found


@no_alloc
def range_by_crossing(rows: Rows, m: Whole, estimate: PointArrays, places: Places) -> float:
    """Return the range [m] to the clear crossing of a bearing with an earlier bearing, or NaN."""
    numbers, (poses, border) = rows.numbers[m], estimate
    k = rows.ends[m, 2]
    view = view_of(poses[k], border, places, k)
    angle, best, found = direction_of(view, numbers), MIN_CROSSING_SINE, math.nan
    earlier = rows.ends[m, 3]
    while earlier >= 0:
        k = rows.ends[earlier, 2]
        there = view_of(poses[k], border, places, k)
        other = direction_of(there, rows.numbers[earlier])
        sine = math.sin(other - angle)
        if abs(sine) >= best:
            dx, dy = there.x - view.x, there.y - view.y
            near = (dx * math.sin(other) - dy * math.cos(other)) / sine
            far = (dx * math.sin(angle) - dy * math.cos(angle)) / sine
            along = far * rows.numbers[earlier, BEARING_STD]
            across = near * numbers[BEARING_STD]
            variance = (along * along + across * across) / (sine * sine)
            if near > 0.0 and far > 0.0 and is_certain(near, variance):
                best, found = abs(sine), near
        earlier = rows.ends[earlier, 3]
    return found


@kernel
def drop_outside(
    rows: Arrays,
    span: Span,
    places: Arrays,
    estimate: PointArrays,
    front: Arrays,
    R: Factor,
    bounds: tuple[float, float],
) -> tuple[Whole, float, float]:
    """Discard bearings, ranges and excess paths of a scan that are outside the gate, in place.

    Returns their number, and the passed directions' sum of squared normalised innovations and
    degrees.
    """
    rows, places, front = Rows(*rows), Places(*places), Front(*front)
    (k, first, last), (dropped, squared, degrees) = span, (0, 0.0, 0.0)
    d, n = front.P.shape[0], R.shape[0]
    work, view = work_of(d, 1, 0), view_of(estimate[0][k], estimate[1], places, k)
    for m in range(first, last):
        point = point_of(rows.ends[m, 0], k, places, estimate)
        if point[0] == 0:
            continue
        numbers = rows.numbers[m]
        if rows.ends[m, 1] >= 0:
            caller = point_of(rows.ends[m, 1], k, places, estimate)
            if caller[0] != 0:
                by_chain, by_border = np.zeros((1, d)), np.zeros((1, n))
                path, chain, size = write_excess_path(work, view, (point, caller))
                _part(work, (chain, size), by_chain[0], by_border[0])
                S = joint(front, R, n, by_chain, by_border)[0, 0] + numbers[EXCESS_PATH_STD] ** 2
                if (numbers[EXCESS_PATH] - path) ** 2 / S > bounds[0]:
                    rows.ends[m, 1] = -1
                    dropped += 1
        aimed, ranged = not math.isnan(numbers[BEARING]), not math.isnan(numbers[RANGE])
        (i, px, py), size = point, int(aimed) + int(ranged)
        if size == 0:
            continue
        seen = observe(view.x, view.y, view.heading, px, py)
        by_chain, by_border = np.zeros((size, d)), np.zeros((size, n))
        if aimed:
            row = write_bearing(work, view, seen, numbers[SLOPE], i)
            _part(work, row, by_chain[0], by_border[0])
        if ranged:
            row = write_range(work, view, seen, i)
            _part(work, row, by_chain[size - 1], by_border[size - 1])
        S = joint(front, R, n, by_chain, by_border)
        turn = wrap_angle(numbers[BEARING] - bearing_of(view, seen, numbers[SLOPE]))
        far = numbers[RANGE] - range_of(view, seen[0])
        bb = S[0, 0] + numbers[BEARING_STD] * numbers[BEARING_STD]
        rr = S[size - 1, size - 1] + numbers[RANGE_STD] ** 2
        if size == 1:
            off = turn * turn / bb if aimed else far * far / rr
        else:
            off = rr * turn * turn - 2.0 * S[1, 0] * turn * far + bb * far * far
            off /= bb * rr - S[1, 0] * S[1, 0]
        if off > bounds[size - 1]:
            numbers[BEARING] = numbers[RANGE] = np.nan
            dropped += 1
        else:
            squared += off
            degrees += size
    return dropped, squared, degrees


@no_alloc
def _part(
    work: Work, written: tuple[Whole, Whole], by_chain: ChainState, by_border: Border
) -> None:
    """Split a measurement's derivatives into a part by the state and a part by the map."""
    chain, size = written
    for e in range(chain):
        by_chain[work.at[e]] += work.slope[e]
    for e in range(chain, size):
        by_border[work.at[e]] += work.slope[e]


PRIOR_STD, PRIOR_SHARE = 20.0, 0.1
"""Std of a new landmark's weak prior: absolute [m], or relative to the travelled distance if
larger, so that dead-reckoning errors do not bind the map."""
RELINEARISE_ABOVE = 0.1
"""Linearisation error of a frame's measurements [std] above which the chain is relinearised."""
ENTERING_PASSES = 5
"""Most relinearisations where past measurements of new landmarks enter, which correct many poses.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Smoother:
    """Incremental smoother for SLAM: each scan updates all poses and the map by elimination.

    >>> from pipistrelle.detection.scans import make_scan
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> slam = Smoother(motion=motion, rays=RayConfig())
    >>> belief = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4))
    >>> known = {"range": np.array([2.0, np.nan]), "range_std": 0.2, "bearing_std": 0.15}
    >>> scan = make_scan(0.0, np.array([4, 9]), np.array([0.1, 0.2]), **known)
    >>> slam.update(belief, scan).landmarks().landmark.tolist()
    [4, 9, 9, 9, 9]
    """

    motion: Motion
    rays: RayConfig  # ranges of an uninitialised landmark
    gate: float = 1.0  # this and the fields below as in `EkfSlam`
    robust: str = "none"
    speed_std: float = 1.0
    walk_std: float = 0.2
    calibration: Calibration = NOTHING
    window: float = math.inf
    """Time without measurements after which a landmark leaves the separator [s]."""

    def __post_init__(self) -> None:
        """Raise InputError for an unknown loss, or a gate that is no probability in (0, 1]."""
        check_gate(self.gate, self.robust)

    @property
    def noise(self) -> NoiseModel:
        """Noise parameters of measurements and moving callers, from the settings."""
        loss = LOSSES.index(self.robust)
        return NoiseModel(loss, PRIOR_STD, float(self.speed_std), float(self.walk_std))

    def init(self, pose: Gaussian) -> SmootherBelief:
        """Return the initial belief at a start pose with its covariance, without landmarks."""
        pose = usable_pose(pose)
        history, parameters = begun(pose, self.calibration), np.zeros(self.calibration.stds.size)
        at = Stack((pose.mean[None].copy(),), 1, [1])
        points = Points(at=at, spots=np.empty((0, 2)), parameters=parameters)
        return SmootherBelief(
            at=pose,
            ahead=pose,
            odometry=no_odometry(self.calibration.odometry.size),
            history=history,
            solution=eliminated(history, self.noise, points),
            rays=self.rays,
            noise=self.noise,
        )

    def knowing(self, belief: SmootherBelief, known: Landmarks) -> SmootherBelief:
        """Return the initial belief ``belief`` with the landmarks of a known map added."""
        check_belief(belief, SmootherBelief)
        known = usable_known(known)
        C = known.covariance + SMALLEST_STD**2 * np.eye(2)
        det = C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] ** 2
        information = np.stack([C[:, 1, 1], -C[:, 0, 1], C[:, 0, 0]], axis=1) / det[:, None]
        labels = known.landmark.tolist()
        history = with_places(belief.history, labels, known.mean, information)
        points = replace(belief.solution.points, spots=known.mean.copy())
        return replace(belief, history=history, solution=eliminated(history, self.noise, points))

    def predict(
        self,
        belief: SmootherBelief,
        controls: Controls,
        dt: Durations,
        rng: np.random.Generator | None = None,
    ) -> tuple[SmootherBelief, Gaussian]:
        """Predict the belief through control steps; return it, and the pose after each step."""
        check_belief(belief, SmootherBelief)
        controls, dt = usable_controls(self.motion, controls, dt)
        parameters = belief.history.calibration.odometry
        odometry = extended(belief.odometry, self.motion, controls, dt, parameters)
        poses, ahead = belief.placed(odometry, len(belief.odometry.mean)), belief.ahead
        if len(dt):
            ahead = Gaussian(mean=poses.mean[-1], covariance=poses.covariance[-1])
        return replace(belief, odometry=odometry, ahead=ahead), poses

    def update(
        self, belief: SmootherBelief, scan: Scan, rng: np.random.Generator | None = None
    ) -> SmootherBelief:
        """Update the belief with a scan, initialising new landmarks that it locates."""
        check_belief(belief, SmootherBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        return recovering(self._corrected, belief, scan, self.gate, self.rays.range_bounds[1])

    def _corrected(self, belief: SmootherBelief, scan: Scan) -> SmootherBelief:
        """Extend the belief by a scan: gate it, initialise new landmarks, solve and relinearise."""
        history, solution = self._awake(
            heard_more(belief.history, belief.odometry, scan), belief.history, belief.solution
        )
        history = self._forgetting(history, solution)
        here = stepped(solution, history, self.noise, belief.guess())
        gated, innovations = belief.gated, belief.innovations
        if self.gate < 1.0:
            bounds = gate_bounds(self.gate)
            dropped, squared, degrees = drop_outside(*_frame(history, here, solution), bounds)
            gated, innovations = gated + dropped, innovations.plus(squared, degrees)
        history, solution = self._heard(history, here, solution)
        pose = Gaussian(mean=solution.state[:3], covariance=solution.covariance[:3, :3])
        ahead = belief.ahead
        further = correction(ahead.mean, ahead.covariance, pose.mean, pose.covariance, 1.0)
        return replace(
            belief,
            at=pose,
            ahead=pose,
            odometry=no_odometry(history.calibration.odometry.size),
            history=history,
            solution=solution,
            gated=gated,
            innovations=innovations,
            corrections=belief.corrections.plus(*further),
        )

    def _awake(
        self, history: History, before: History, solution: Solution
    ) -> tuple[History, Solution]:
        """Restore eliminated landmarks that the last scan measured; return history and solution."""
        if math.isinf(self.window):
            return history, solution
        number = history.index[slots_heard(history)] - 1
        again = np.zeros(len(history.placed), np.bool_)
        again[number[number >= 0]] = True
        again &= history.leaves != NEVER
        if not again.any():
            return history, solution
        first = int(history.entering[again].min())
        history, before = with_leaving(history, again, NEVER), with_leaving(before, again, NEVER)
        kept = solution.stretches
        return history, eliminated(before, self.noise, solution.points, kept, first)

    def _forgetting(self, history: History, solution: Solution) -> History:
        """Schedule landmarks unmeasured for a time window for elimination; return the history."""
        k = history.nodes - 1
        if k % STRETCH or math.isinf(self.window):
            return history
        time = np.cumsum(history.legs.entries(2))
        since = time[-1] - time[np.maximum(history.silent, 0)]
        leaving = (since > self.window) & (solution.columns > 0)
        return with_leaving(history, leaving, k // STRETCH - 1) if leaving.any() else history

    def _heard(self, before: History, here: Sweep, estimate: Solution) -> tuple[History, Solution]:
        """Solve with the last scan and its new landmarks; return the new history and solution."""
        history = before
        if (here.places[0][slots_heard(before)] == 0).any():
            history = _placed(before, here, estimate)
        if history is not before:
            here.admit(history)
        new = np.arange(len(before.placed), len(history.placed))
        late = bool((history.met[new] < history.nodes - 1).any()) if new.size else False
        if late:
            first = int(history.entering[new].min())
            solution = eliminated(history, self.noise, here.points, here.stretches, first)
        else:
            here.join(new)
            here.hear()
            solution = here.solved()
        if history is not before and not late:
            history, solution = self._by_new_callers(before, history, here, solution)
        for _ in range(ENTERING_PASSES if late else 1):
            if off_line(solution, history) <= RELINEARISE_ABOVE:
                break
            solution = relinearised(solution, history, self.noise)
        return history, solution

    def _by_new_callers(
        self, before: History, history: History, here: Sweep, solution: Solution
    ) -> tuple[History, Solution]:
        """Add the landmarks that the last scan locates by callers that it has located itself."""
        first, last = history.span[1:]
        callers = np.unique(history.rows.arrays[0][first:last, 1])
        found = (history.index != 0) & (before.index == 0)
        if not found[callers[callers >= 0]].any():
            return history, solution
        more = _placed(history, here, solution)
        if len(more.placed) == len(history.placed):
            return history, solution
        here.admit(more)
        first = int(more.entering[len(history.placed) :].min())
        return more, eliminated(more, self.noise, here.points, here.stretches, first)


def _frame(
    history: History, here: Sweep, estimate: Solution
) -> tuple[Arrays, tuple[int, int, int], Arrays, tuple[np.ndarray, np.ndarray], Arrays, np.ndarray]:
    """Return the last scan and the current estimate as arguments for compiled functions."""
    border = here.border.copy()
    border[1 : estimate.beta.size] += estimate.beta[1:]
    points = here.points.at.arrays[0], border
    return history.rows.arrays, history.span, here.places, points, here.front, estimate.factor


def _placed(history: History, here: Sweep, estimate: Solution) -> History:
    """Initialise landmarks and callers that the last scan locates; return the extended history."""
    rows, span, places, points, front, factor = _frame(history, here, estimate)
    driven = history.legs.arrays[1], here.noise.loss
    found = entering_places(rows, span, history.moves, places, points, front, factor, driven)
    ends = rows[0][span[1] : span[2], 0]
    label_of, new = list(history.slots), {}
    for slot, place in zip(ends.tolist(), found, strict=True):
        if not math.isnan(place[0]):
            new.setdefault(label_of[slot], place)
    for (label, moves), place in new.items():
        if moves:
            history = with_caller(history, label, place)
    standing = {label: place for (label, moves), place in new.items() if not moves}
    if not standing:
        return history
    known = max(PRIOR_STD, PRIOR_SHARE * history.way) ** -2
    weak = np.tile([known, 0.0, known], (len(standing), 1))
    return with_places(history, [*standing], np.array([*standing.values()]), weak)
