"""Incremental smoother: the whole trajectory is re-estimated with each frame.

The smoother keeps every measurement, and eliminates the normal equations along the chain of poses
(`elimination`): a frame adds a node, and unknowns that moved are relinearised (`chain`). Nodes are
the times of scans (`preintegration` has the control steps between). Landmarks and callers are
initialised by a range, a precise excess path, or crossing bearings (`initialization`), with all
their measurements so far; until then they are partially initialised. An excess path counts once its
landmark and its caller are initialised. A moving caller has a position and a velocity at each node,
and is no landmark.

``robust`` uses Huber's loss. With a gate, measurements outside a share of their predicted
distribution are discarded: bearing and range jointly, an excess path separately, as an error such
as a wrong direct call affects only it. The belief at a frame is the solution there; trajectory,
caller tracks and map are the optimum of all measurements so far (`belief`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

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
from pipistrelle.estimation.measurement import HUBER_K, observe
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.rays import gate_bounds
from pipistrelle.estimation.recovery import recovering
from pipistrelle.estimation.smoother.belief import SmootherBelief
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
from pipistrelle.estimation.smoother.initialization import entering_places
from pipistrelle.estimation.smoother.observations import (
    Point,
    View,
    bearing_of,
    point_of,
    view_of,
    write_bearing,
    write_excess_path,
    write_range,
)
from pipistrelle.estimation.smoother.preintegration import (
    NOTHING,
    SMALLEST_STD,
    Calibration,
    extended,
    no_odometry,
)
from pipistrelle.estimation.smoother.records import (
    Arrays,
    Front,
    NoiseModel,
    Places,
    PointArrays,
    Rows,
    Stack,
    Work,
    work_of,
)
from pipistrelle.estimation.smoother.solution import joint
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
from pipistrelle.jit import Whole, kernel, no_alloc


@kernel
def drop_outside(
    rows: Arrays,
    span: tuple[Whole, Whole, Whole],
    places: Arrays,
    estimate: PointArrays,
    front: Arrays,
    R: Float[np.ndarray, "n n"],
    bounds: tuple[float, float],
) -> tuple[Whole, float, float]:
    """Replace gated bearings and ranges by NaN, and gated excess paths by no caller, in place.

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
        if math.isnan(numbers[BEARING]):
            continue
        off, size = _surprise_of_direction(work, numbers, view, point, front, R)
        if off > bounds[size - 1]:
            numbers[BEARING] = numbers[RANGE] = np.nan
            dropped += 1
        else:
            squared += off
            degrees += size
    return dropped, squared, degrees


@no_alloc
def _part(
    work: Work,
    written: tuple[Whole, Whole],
    by_chain: Float[np.ndarray, " d"],
    by_border: Float[np.ndarray, " n"],
) -> None:
    """Split a Jacobian row into derivatives by the chain and by the separator."""
    chain, size = written
    for e in range(chain):
        by_chain[work.at[e]] += work.slope[e]
    for e in range(chain, size):
        by_border[work.at[e]] += work.slope[e]


@kernel
def _surprise_of_direction(
    work: Work,
    numbers: Float[np.ndarray, " 8"],
    view: View,
    point: Point,
    front: Front,
    R: Float[np.ndarray, "n n"],
) -> tuple[float, Whole]:
    """Return the squared innovation of a bearing, and its range if measured, and its dimension."""
    (i, px, py), d, n = point, front.P.shape[0], R.shape[0]
    seen = observe(view.x, view.y, view.heading, px, py)
    off = wrap_angle(numbers[BEARING] - bearing_of(view, seen, numbers[SLOPE]))
    size = 1 if math.isnan(numbers[RANGE]) else 2
    by_chain, by_border = np.zeros((size, d)), np.zeros((size, n))
    _part(work, write_bearing(work, view, seen, numbers[SLOPE], i), by_chain[0], by_border[0])
    if size == 2:
        _part(work, write_range(work, view, seen, i), by_chain[1], by_border[1])
    S = joint(front, R, n, by_chain, by_border)
    bb = S[0, 0] + numbers[BEARING_STD] * numbers[BEARING_STD]
    if size == 1:
        return off * off / bb, 1
    rr, far = S[1, 1] + numbers[RANGE_STD] ** 2, numbers[RANGE] - seen[0] / view.scale
    det = bb * rr - S[1, 0] * S[1, 0]
    return (rr * off * off - 2.0 * S[1, 0] * off * far + bb * far * far) / det, 2


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
    """Incremental smoothing and mapping by elimination along the chain of poses.

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
    robust: bool = False
    speed_std: float = 1.0
    walk_std: float = 0.2
    calibration: Calibration = NOTHING
    window: float = math.inf
    """Time without measurements after which a landmark leaves the separator [s]."""

    def __post_init__(self) -> None:
        """Check that the gate is a probability."""
        check_gate(self.gate)

    @property
    def noise(self) -> NoiseModel:
        """Noise of measurements and moving callers."""
        believed = HUBER_K if self.robust else math.inf
        return NoiseModel(believed, PRIOR_STD, float(self.speed_std), float(self.walk_std))

    def init(self, pose: Gaussian) -> SmootherBelief:
        """Return the initial belief at a pose, (3) and (3, 3), without landmarks."""
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
        """Return the initial belief with known landmarks; ``belief`` is the result of `init`."""
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
        controls: Float[np.ndarray, "k c"],
        dt: Float[np.ndarray, " k"],
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
        """Update the belief with a frame's measurements, initialising landmarks."""
        check_belief(belief, SmootherBelief)
        scan = usable_scan(scan)
        if scan.landmark.size == 0:
            return belief
        return recovering(self._corrected, belief, scan, self.gate, self.rays.range_bounds[1])

    def _corrected(self, belief: SmootherBelief, scan: Scan) -> SmootherBelief:
        """Update the belief with the measurements that pass the gate."""
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
        return replace(
            belief,
            at=pose,
            ahead=pose,
            odometry=no_odometry(history.calibration.odometry.size),
            history=history,
            solution=solution,
            gated=gated,
            innovations=innovations,
        )

    def _awake(
        self, history: History, before: History, solution: Solution
    ) -> tuple[History, Solution]:
        """Reactivate landmarks that had left the separator and are measured again."""
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
        """Schedule landmarks without measurements within the window to leave the separator."""
        k = history.nodes - 1
        if k % STRETCH or math.isinf(self.window):
            return history
        time = np.cumsum(history.legs.entries(2))
        since = time[-1] - time[np.maximum(history.silent, 0)]
        leaving = (since > self.window) & (solution.columns > 0)
        return with_leaving(history, leaving, k // STRETCH - 1) if leaving.any() else history

    def _heard(self, before: History, here: Sweep, estimate: Solution) -> tuple[History, Solution]:
        """Add the last frame's measurements and new landmarks; return history and solution."""
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
        for _ in range(ENTERING_PASSES if late else 1):
            if off_line(solution, history) <= RELINEARISE_ABOVE:
                break
            solution = relinearised(solution, history, self.noise)
        return history, solution


def _frame(
    history: History, here: Sweep, estimate: Solution
) -> tuple[Arrays, tuple[int, int, int], Arrays, tuple[np.ndarray, np.ndarray], Arrays, np.ndarray]:
    """Return the arguments common to `drop_outside` and `entering_places` for the last node."""
    border = here.border.copy()
    border[1 : estimate.beta.size] += estimate.beta[1:]
    points = here.points.at.arrays[0], border
    return history.rows.arrays, history.span, here.places, points, here.front, estimate.factor


def _placed(history: History, here: Sweep, estimate: Solution) -> History:
    """Initialise landmarks and callers from the last node's measurements."""
    rows, span, places, points, front, factor = _frame(history, here, estimate)
    found = entering_places(rows, span, history.moves, places, points, front, factor)
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
