"""Session: runs an estimator over control steps and scans, with optional data association.

Beliefs are immutable, so data association may revise its decisions: the session stores the last
`REMEMBERED` scans with the beliefs before them, returns to the first that is revised, and repeats
it and all later scans, with their labels or with data association.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple

import numpy as np
from jaxtyping import Int

from pipistrelle.config import InputError
from pipistrelle.detection.noise import ConstantNoise
from pipistrelle.detection.scans import NO_CALLERS, UNLABELLED, Scan, labelled
from pipistrelle.estimation.beliefs import (
    AcceptsMap,
    Assignment,
    Association,
    B,
    Belief,
    Completed,
    Estimator,
    Gaussian,
    Landmarks,
    completed,
    is_among,
    some_of,
)
from pipistrelle.estimation.checking import usable_scan
from pipistrelle.estimation.motion import Controls, Durations

REMEMBERED = 40
"""Number of scans that data association may revise."""
MOST_STEPS = 64
"""Most steps of a prediction, fixed as the EKF's rounding depends on it."""
Leg = tuple[Controls, Durations]
"""Control steps and their durations [s]."""


class StoredScan(NamedTuple):
    """A scan that data association may still revise, with the belief and memory before it."""

    number: int
    legs: Sequence[Leg]
    """Control steps since the scan before."""
    belief: Any
    """Belief before the scan, after these steps."""
    memory: Any
    """The association's memory before the scan."""
    original: Scan
    scan: Scan
    """The scan as changed by the association (`Assignment.scan`)."""
    label: Int[np.ndarray, " m"]
    merge: tuple[tuple[int, int], ...] = ()
    remove: tuple[int, ...] = ()
    """Landmarks that are on no map from this scan on; beliefs before may still contain them."""


class SessionState(NamedTuple):
    """Snapshot of a session, with everything that it needs to continue."""

    belief: Any
    draws: Mapping[str, Any]
    """State of the random generator."""
    memory: Any
    """Memory of the association."""
    past: Sequence[StoredScan]
    legs: Sequence[Leg]
    open: Any
    """Belief and random state before the last control steps, if further steps may join them."""
    labels: Sequence[Int[np.ndarray, " m"]]
    first: int
    """Number of the scan with the first entry of `labels`."""


class Session(Generic[B]):
    """Online estimation of a vehicle's pose and map from control steps and scans.

    Parameters
    ----------
    estimator : Estimator
    start : Gaussian
        Initial pose, (3) and (3, 3).
    rng : Generator
        Random generator of the estimator.
    known : Landmarks, optional
        Known landmarks of the initial map, for an estimator that accepts them (`AcceptsMap`).
    callers : (c), optional
        Label of each caller as a landmark, by its number, for callers on the initial map.
    association : Association, optional
        Labels the measurements of scans; by default they are labelled already.
    noise : ConstantNoise, optional
        Default noise of measurements; with ``instead``, the estimator gets it for all.
    live : bool
        Whether steps arrive singly, with the results of joint prediction between scans. Only the
        labels of the last `REMEMBERED` scans are kept.

    Examples
    --------
    >>> from pipistrelle.config import Config
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.catalogue import entry
    >>> from pipistrelle.estimation.motion import Motion
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    >>> session = Session(entry("iekf").build(Config(), motion), start, np.random.default_rng(7))
    >>> session.move(np.array([[1.0, 0.0]]), np.array([1.0])).mean
    array([[1., 0., 0.]])
    >>> ahead = {"range": np.array([2.0]), "range_std": 0.1, "bearing_std": 0.1}
    >>> used = session.hear(make_scan(1.0, np.array([7]), np.zeros(1), **ahead))
    >>> session.belief.landmarks().mean
    array([[3., 0.]])
    """

    belief: B
    """Current belief of the estimator."""
    labels: list[Int[np.ndarray, " m"]]
    """Current labels of the measurements of each kept scan by data association."""

    def __init__(
        self,
        estimator: Estimator[B],
        start: Gaussian,
        rng: np.random.Generator,
        *,
        known: Landmarks | None = None,
        callers: Int[np.ndarray, " c"] = NO_CALLERS,
        association: Association | None = None,
        noise: ConstantNoise | None = None,
        live: bool = False,
    ) -> None:
        self._estimator, self._rng = estimator, rng
        self._association: Any = completed(association, Association) if association else None
        self._memory, self._noise = association.start() if association else None, noise
        self._past: list[StoredScan] = []
        self._legs: list[Leg] = []
        self.labels: list[Int[np.ndarray, " m"]] = []
        self._live, self._first = live, 0
        self._open: tuple[B, Mapping[str, Any]] | None = None
        self.belief = estimator.init(start)
        if known is not None and known.landmark.size and isinstance(estimator, AcceptsMap):
            self.belief = estimator.knowing(self.belief, known)
            if self._association:
                self._memory = self._association.knowing(self._memory, known, callers)

    def move(self, controls: Controls, dt: Durations) -> Gaussian:
        """Predict the belief through control steps; return the vehicle's pose after each step."""
        if not self._live and len(dt) <= MOST_STEPS:
            if self._association:
                self._legs.append((controls, dt))
            return self._move(controls, dt)
        poses, done = [], 0
        while done < len(dt):
            size = MOST_STEPS - (len(self._legs[-1][1]) if self._open else 0)
            poses.append(self._extend(controls[done : done + size], dt[done : done + size]))
            done += size
        mean, covariance = (
            np.concatenate([getattr(part, name) for part in poses])
            for name in ("mean", "covariance")
        )
        return replace(poses[0], mean=mean, covariance=covariance)

    def hear(self, scan: Scan) -> Scan:
        """Label a scan by data association and update the belief with it; return the used scan."""
        self._open = None
        if self._association is None:
            self._legs = []
            return self._update(scan)
        new = StoredScan(
            number=self._first + len(self.labels),
            legs=self._legs,
            belief=self.belief,
            memory=self._memory,
            original=scan,
            scan=scan,
            label=scan.landmark,
        )
        used = self._associated([*self._past, new])
        self._legs = []
        if self._live and (old := len(self.labels) - REMEMBERED) > 0:
            del self.labels[:old]
            self._first += old
        return used

    def landmarks(self) -> Landmarks:
        """Return the map, without landmarks that data association considers uncertain."""
        landmarks: Landmarks = completed(self.belief, Belief).landmarks()
        if self._association is None:
            return landmarks
        tentative = np.array([*self._association.tentative(self._memory)], np.int64)
        return some_of(landmarks, ~is_among(landmarks.landmark, tentative))

    def report(self) -> Mapping[str, Any]:
        """Return further results of data association, by name."""
        return self._association.report(self._memory) if self._association else {}

    def state(self) -> SessionState:
        """Return a snapshot of the session, to continue it later."""
        return SessionState(
            belief=self.belief,
            draws=self._rng.bit_generator.state,
            memory=self._memory,
            past=tuple(self._past),
            legs=tuple(self._legs),
            open=self._open,
            labels=tuple(self.labels),
            first=self._first,
        )

    def go_on_from(self, state: SessionState) -> None:
        """Restore a session from a snapshot (`state`) of a session with the same settings."""
        self.belief, self._memory, self._first = state.belief, state.memory, state.first
        self._rng.bit_generator.state = state.draws
        self._past, self._legs = [*state.past], [*state.legs]
        self._open, self.labels = state.open, [*state.labels]

    def _move(self, controls: Controls, dt: Durations) -> Gaussian:
        """Predict the belief through control steps by the estimator; return the poses."""
        predicted = self._estimator.predict(self.belief, controls, dt, self._rng)
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            expected = "the belief and the pose of each step"
            raise _wrong_return(self._estimator, "predict", predicted, expected)
        self.belief, poses = predicted
        check_poses("predict", poses, len(dt))
        return poses

    def _extend(self, controls: Controls, dt: Durations) -> Gaussian:
        """Append control steps to the last prediction and repeat it; return the new poses."""
        if self._open:
            self.belief, self._rng.bit_generator.state = self._open
            before, took = self._legs.pop()
            width = max(before.shape[1], controls.shape[1])
            steps = np.full((len(took) + len(dt), width), np.nan)  # NaN: unknown covariances
            steps[: len(took), : before.shape[1]] = before
            steps[len(took) :, : controls.shape[1]] = controls
            self._legs.append((steps, np.concatenate((took, dt))))
        else:
            self._open = self.belief, self._rng.bit_generator.state
            self._legs.append((controls, dt))
        poses, new = self._move(*self._legs[-1]), slice(-len(dt), None)
        if len(self._legs[-1][1]) == MOST_STEPS:
            self._open = None
        return replace(poses, mean=poses.mean[new], covariance=poses.covariance[new])

    def _update(self, scan: Scan) -> Scan:
        """Update the belief by the estimator with a labelled scan; return the scan as used."""
        used = usable_scan(scan)
        belief = self._estimator.update(self.belief, used, self._rng)
        if not hasattr(belief, "pose"):
            raise _wrong_return(self._estimator, "update", belief, "the belief after the scan")
        self.belief = belief
        return used

    def _associated(self, past: list[StoredScan]) -> Scan:
        """Associate the last of these scans, repeat the scans that it revises, and use it.

        A repeated scan may extend the repetition, once.
        """
        n = first = undecided = len(past) - 1
        asked: set[int] = set()
        while True:
            if n == undecided:
                back, undecided = self._decided(past, n, asked)
                if (back, undecided) != (n, n + 1):
                    removed = {label for one in past[back : n + 1] for label in one.remove}
                    self.belief = _edited(past[back].belief, remove=[*removed])
                    n = first = back
                    continue
            merge, since = past[n].merge, 0
            if n + 1 < undecided:  # a repetition, without absent landmarks
                before = past[n].belief
                merge = tuple(
                    pair for pair in merge if _present(self.belief, pair) == _present(before, pair)
                )
                since = past[first].number - self._first
            past[n] = past[n]._replace(belief=self.belief, merge=merge)
            used, n = self._use(past[n], since), n + 1
            if n == len(past):
                self._past = past[-REMEMBERED:]
                return used
            for controls, dt in past[n].legs:
                self._move(controls, dt)

    def _decided(self, past: list[StoredScan], n: int, asked: set[int]) -> tuple[int, int]:
        """Associate a scan; return the first scans to be repeated and to be associated next."""
        scan, association = past[n].original, self._association
        past[n] = past[n]._replace(belief=self.belief, memory=self._memory)
        stated = self._noise(scan) if self._noise else scan
        answer = association.associate(self._memory, self.belief, stated)
        if not (isinstance(answer, tuple) and len(answer) == 2 and type(answer[1]) is Assignment):
            raise _wrong_return(association, "associate", answer, "the memory and an Assignment")
        self._memory, found = answer
        again = [number for number, scan in found.revised.items() if scan is None]
        if not again or n in asked:
            return self._revised(past, n, found), n + 1
        asked.add(n)
        back = min(max(min(again) - past[0].number, 0), n)
        self._memory = association.carried(past[back].memory, self._memory)
        removed = tuple({label for one in past[back:n] for label in one.remove})
        past[back : n + 1] = [one._replace(remove=()) for one in past[back : n + 1]]
        past[back] = past[back]._replace(remove=removed)  # other labels may be issued again
        return back, back

    def _revised(self, past: list[StoredScan], n: int, found: Assignment) -> int:
        """Apply an assignment to its scan and to earlier scans; return the first to be repeated."""
        merges = [pair for one in past[:n] for pair in one.merge]
        remove = (*found.remove, *(gone for kept, gone in merges if kept in found.remove))
        past[n] = past[n]._replace(
            scan=found.scan or past[n].original,
            label=found.label,
            merge=found.merge,
            remove=(*past[n].remove, *remove),
        )
        named, repeated = np.array(remove, np.int64), [n]
        for m, one in enumerate(past[:n] if remove or found.revised else ()):
            scan, label = found.revised.get(one.number) or one.scan, one.label
            if scan is not one.scan:
                label = np.where(label == UNLABELLED, scan.landmark, label)
            if (gone := is_among(label, named)).any() or scan is not one.scan:
                once, counts = np.unique(label[gone], return_counts=True)
                # A landmark's first measurement has not affected anything else.
                affected = (counts > 1).any() or _present(one.belief, once.tolist())
                if affected or scan is not one.scan:
                    repeated.append(m)
                past[m] = one._replace(label=np.where(gone, UNLABELLED, label), scan=scan)
                at, label = one.number - self._first, self.labels[one.number - self._first]
                self.labels[at] = np.where(is_among(label, named), UNLABELLED, label)
        if len(repeated) == 1:
            self.belief = _edited(self.belief, remove=remove)
        return min(repeated)

    def _use(self, stored: StoredScan, since: int) -> Scan:
        """Update the belief with a stored scan; merges change the labels from scan ``since`` on."""
        self.labels[stored.number - self._first :] = [stored.label]
        for kept, gone in stored.merge:
            labels = self.labels[since:]
            self.labels[since:] = [np.where(label == gone, kept, label) for label in labels]
        self.belief = _edited(self.belief, merge=stored.merge)
        scan = self._noise.hidden(stored.original, stored.scan) if self._noise else stored.scan
        merged = labelled(scan, stored.label)
        return self._update(self._noise(merged) if self._noise else merged)


def _present(belief: Any, labels: Sequence[int]) -> list[int]:
    """Return which of the given labels a belief contains; all, if it does not list labels."""
    held = completed(belief, Belief).labels() if labels else None
    return [label for label in labels if held is None or label in held]


def _edited(belief: B, remove: Sequence[int] = (), merge: Sequence[tuple[int, int]] = ()) -> B:
    """Return a belief with landmarks removed, if it has them, and pairs of duplicates merged."""
    if not (remove := _present(belief, remove)) and not merge:
        return belief
    editable: Any = completed(belief, Belief)
    return editable.edited(remove, merge)


def check_poses(method: str, poses: Gaussian, size: int) -> None:
    """Raise InputError unless an estimator method's poses and covariances have the right shapes."""
    found = np.shape(poses.mean), np.shape(poses.covariance)
    expected = (size, 3), (size, 3, 3)
    if found != expected:
        which = "the start and every control step" if method == "path" else "one after each step"
        raise InputError(
            f"{method}: found arrays of {found[0]} and {found[1]}, expected {expected[0]} and "
            f"{expected[1]}: {which}"
        )


def _wrong_return(part: object, method: str, found: object, expected: str) -> InputError:
    """Return an InputError for a wrong return value of an external class's method."""
    kind = type(part.part if isinstance(part, Completed) else part)
    name = f"{kind.__module__}.{kind.__qualname__}.{method}"
    fix = "does it lack its return?" if found is None else "correct it"
    return InputError(f"{name}: found {type(found).__name__} returned, expected {expected}; {fix}")
