"""Session: runs an estimator over control steps and scans, with optional data association.

Beliefs are immutable, so data association may revise its decisions: the session stores the last
`REMEMBERED` scans with the beliefs before them, returns to these beliefs and repeats the scans.
"""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.noise import ConstantNoise
from pipistrelle.detection.scans import NO_CALLERS, UNLABELLED, Scan, labelled
from pipistrelle.estimation.association import Assignment, Association, is_among
from pipistrelle.estimation.beliefs import (
    AcceptsMap,
    B,
    Belief,
    Completed,
    Estimator,
    Gaussian,
    Landmarks,
    completed,
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


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredScan:
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
    merge: tuple[tuple[int, int], ...]


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
    dropped: Collection[int]
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
        self._association = completed(association, Association) if association else None
        self._memory, self._noise = association.start() if association else None, noise
        self._past: deque[StoredScan] = deque(maxlen=REMEMBERED)
        self._legs: list[Leg] = []
        self._dropped: set[int] = set()
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
        memory, assignment = self._associate(scan)
        if assignment.again is not None and self._past:
            self._associate_again(self._association, assignment.again)
            memory, assignment = self._associate(scan)
        return self._store(scan, memory, assignment)

    def landmarks(self) -> Landmarks:
        """Return the map, without landmarks that data association considers uncertain."""
        landmarks: Landmarks = completed(self.belief, Belief).landmarks()
        if self._association is None:
            return landmarks
        tentative = np.array([*self._association.tentative(self._memory)], np.int64)
        return some_of(landmarks, ~is_among(landmarks.landmark, tentative))

    def state(self) -> SessionState:
        """Return a snapshot of the session, to continue it later."""
        return SessionState(
            belief=self.belief,
            draws=self._rng.bit_generator.state,
            memory=self._memory,
            past=tuple(self._past),
            legs=tuple(self._legs),
            open=self._open,
            dropped=frozenset(self._dropped),
            labels=tuple(self.labels),
            first=self._first,
        )

    def go_on_from(self, state: SessionState) -> None:
        """Restore a session from a snapshot (`state`) of a session with the same settings."""
        self.belief, self._memory, self._first = state.belief, state.memory, state.first
        self._rng.bit_generator.state = state.draws
        self._past = deque(state.past, maxlen=REMEMBERED)
        self._legs, self._open, self._dropped = [*state.legs], state.open, {*state.dropped}
        self.labels = [*state.labels]

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
            steps = [_with_columns(part, width) for part in (before, controls)]
            self._legs.append((np.concatenate(steps), np.concatenate((took, dt))))
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

    def _associate(self, scan: Scan) -> tuple[Any, Assignment]:
        """Run data association on a scan; return its new memory and the assignment of labels."""
        assert self._association is not None, "hear asks only where there is one"
        stated = self._noise(scan) if self._noise else scan
        found = self._association.associate(self._memory, self.belief, stated)
        if not (isinstance(found, tuple) and len(found) == 2 and type(found[1]) is Assignment):
            raise _wrong_return(
                self._association, "associate", found, "the memory and an Assignment"
            )
        return found

    def _store(self, scan: Scan, memory: Any, assignment: Assignment) -> Scan:
        """Update the belief with a scan and its assigned labels, and store it for revision."""
        if assignment.remove:
            self._remove(assignment.remove)
        past = [*self._past]
        if changed := [n for n, one in enumerate(past) if one.number in assignment.earlier]:
            for n in changed:
                stated, label = assignment.earlier[past[n].number], past[n].label
                label = np.where(label == UNLABELLED, stated.landmark, label)
                past[n] = replace(past[n], scan=stated, label=label)
            self._repeat(past, changed[0])
        stored = StoredScan(
            number=self._first + len(self.labels),
            legs=self._legs,
            belief=self.belief,
            memory=self._memory,
            original=scan,
            scan=assignment.scan or scan,
            label=assignment.label,
            merge=assignment.merge,
        )
        self._past.append(stored)
        self._memory, self._legs = memory, []
        used = self._use(stored)
        if self._live and (old := len(self.labels) - REMEMBERED) > 0:
            del self.labels[:old]
            self._first += old
        return used

    def _use(self, stored: StoredScan, since: int = 0) -> Scan:
        """Update the belief with a stored scan; merges change the labels from scan ``since`` on."""
        self.labels[stored.number - self._first :] = [stored.label]
        for kept, gone in stored.merge:
            labels = self.labels[since:]
            self.labels[since:] = [np.where(label == gone, kept, label) for label in labels]
        self.belief = _edited(self.belief, merge=stored.merge)
        scan = self._noise.hidden(stored.original, stored.scan) if self._noise else stored.scan
        merged = labelled(scan, stored.label)
        return self._update(self._noise(merged) if self._noise else merged)

    def _remove(self, labels: tuple[int, ...]) -> None:
        """Remove landmarks from the belief and the stored scans, repeating scans if necessary."""
        past = [*self._past]
        labels = (*labels, *(gone for one in past for kept, gone in one.merge if kept in labels))
        named = np.array(labels)
        rows = [int(is_among(one.label, named).sum()) for one in past]
        heard = [
            n for n, one in enumerate(past) if rows[n] or is_among(one.scan.callers, named).any()
        ]
        self._dropped.update(labels)
        for n in heard:
            label, callers = (
                np.where(is_among(of, named), UNLABELLED, of)
                for of in (past[n].label, past[n].scan.callers)
            )
            past[n] = replace(past[n], label=label, scan=replace(past[n].scan, callers=callers))
        once = sum(rows) == len(labels) and len(heard) == 1
        if heard and not (once and not _present(past[heard[0]].belief, labels)):
            self._repeat(past, heard[0])
            return
        # An object measured only once has not affected anything else.
        self.belief = _without(self.belief, labels)
        for n in heard:
            self.labels[past[n].number - self._first] = past[n].label
        self._past = deque(past, maxlen=REMEMBERED)

    def _repeat(self, past: list[StoredScan], first: int) -> None:
        """Restore the belief before a stored scan, and repeat all scans from it on, as changed."""
        self.belief = _without(past[first].belief, [*self._dropped])
        since = past[first].number - self._first
        for n in range(first, len(past)):
            if n > first:
                self._move_again(past[n].legs)
            merge = past[n].merge  # without absent landmarks
            if merge:
                held = {*_present(self.belief, [label for pair in merge for label in pair])}
                merge = tuple(pair for pair in merge if {*pair} <= held)
            past[n] = replace(past[n], belief=self.belief, merge=merge)
            self._use(past[n], since)
        self._move_again(self._legs)
        self._past = deque(past, maxlen=REMEMBERED)

    def _associate_again(self, association: Association[Any], news: Any) -> None:
        """Repeat data association and updates for all stored scans, given new information."""
        past, legs = list(self._past), self._legs
        memory = association.informed(past[0].memory, news)
        self._past.clear()
        del self.labels[past[0].number - self._first :]
        self.belief = _without(past[0].belief, [*self._dropped])
        self._dropped, self._memory = set(), memory  # labels may be reused
        for one in past:
            if one is not past[0]:
                self._move_again(one.legs)
            self._legs = list(one.legs)
            self._store(one.original, *self._associate(one.original))
        self._move_again(legs)
        self._legs = legs

    def _move_again(self, legs: Sequence[Leg]) -> None:
        """Predict the belief again through control steps between stored scans."""
        for controls, dt in legs:
            self._move(controls, dt)


def _with_columns(controls: Controls, width: int) -> Float[np.ndarray, "k w"]:
    """Return control steps widened to a number of columns, with NaN for unknown covariances."""
    missing = np.full((len(controls), width - controls.shape[1]), np.nan)
    return np.hstack((controls, missing))


def _present(belief: Any, labels: Sequence[int]) -> list[int]:
    """Return which of the given labels a belief contains; all, if it does not list labels."""
    held = completed(belief, Belief).labels()
    return [label for label in labels if held is None or label in held]


def _without(belief: B, labels: Sequence[int]) -> B:
    """Return a belief without landmarks of given labels; ignore labels that it does not contain."""
    return _edited(belief, remove=_present(belief, labels))


def _edited(belief: B, remove: Sequence[int] = (), merge: Sequence[tuple[int, int]] = ()) -> B:
    """Return a belief with landmarks removed and pairs of duplicates merged."""
    editable: Any = completed(belief, Belief)
    return editable.edited(remove, merge) if remove or merge else belief


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
