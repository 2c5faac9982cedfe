"""An estimator at work: it is carried by controls, and corrected by scans as they come.

Beliefs are never changed, so an association may change its mind: the session remembers the last
`REMEMBERED` scans with the beliefs before them, goes back and hears them again.
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
from pipistrelle.estimation.association import (
    Assignment,
    Association,
    edited,
    how_many_among,
    is_among,
)
from pipistrelle.estimation.beliefs import (
    AcceptsMap,
    B,
    Belief,
    Estimator,
    Gaussian,
    Landmarks,
    some_of,
)
from pipistrelle.estimation.checking import usable_scan

REMEMBERED = 40
"""How many scans an association may think of again."""
MOST_STEPS = 64
"""How many steps are predicted at once: an EKF's last bits hang on it."""
Leg = tuple[Float[np.ndarray, "k c"], Float[np.ndarray, " k"]]
"""Control steps and how long they take [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Heard:
    """A scan that an association may think of again."""

    number: int
    legs: Sequence[Leg]
    """The way since the scan before."""
    belief: Any
    """Before the scan, after the way."""
    memory: Any
    """The association's, before the scan."""
    came: Scan
    scan: Scan
    """As the association stated it (`Assignment.scan`)."""
    label: Int[np.ndarray, " m"]
    merge: tuple[tuple[int, int], ...]


class SessionState(NamedTuple):
    """All that a session knows."""

    belief: Any
    draws: Mapping[str, Any]
    """State of the random generator."""
    memory: Any
    """The association's."""
    past: Sequence[_Heard]
    legs: Sequence[Leg]
    open: Any
    """Belief and random state before the last leg, while steps may still join it."""
    dropped: Collection[int]
    labels: Sequence[Int[np.ndarray, " m"]]
    first: int
    """Number of the scan whose labels are the first of `labels`."""


class Session(Generic[B]):
    """A vehicle's estimate while it drives and listens.

    Parameters
    ----------
    estimator : Estimator
    start : Gaussian
        The first pose, (3) and (3, 3).
    rng : Generator
        Of what the estimator draws.
    known : Landmarks, optional
        What is on the map beforehand, for an estimator that accepts it (`AcceptsMap`).
    callers : (c), optional
        The label of each caller as a landmark, by its number: those on the map beforehand are known
        to an association that has ``knowing``, too.
    association : Association, optional
        Labels the rows of scans; without one they bear labels already.
    noise : ConstantNoise, optional
        The noise of rows that state none, or for the estimator of all that an association has
        merged.
    live : bool
        Steps come one by one, to the same bits as all of them since a scan at once; labels are kept
        of the last `REMEMBERED` scans alone.

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
    """The present belief of the estimator."""
    labels: list[Int[np.ndarray, " m"]]
    """Of each scan that is kept the labels of its rows, as an association has them now."""

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
        self._association, self._noise = association, noise
        self._memory = association.start() if association else None
        self._past: deque[_Heard] = deque(maxlen=REMEMBERED)
        self._legs: list[Leg] = []
        self._dropped: set[int] = set()
        self.labels: list[Int[np.ndarray, " m"]] = []
        self._live, self._first = live, 0
        self._open: tuple[B, Mapping[str, Any]] | None = None
        self.belief = estimator.init(start)
        if known is not None and known.landmark.size and isinstance(estimator, AcceptsMap):
            self.belief = estimator.knowing(self.belief, known)
            if hasattr(association, "knowing"):
                self._memory = association.knowing(self._memory, known, callers)

    def move(self, controls: Float[np.ndarray, "k c"], dt: Float[np.ndarray, " k"]) -> Gaussian:
        """Predict through control steps and return the pose after each, (k, 3) and (k, 3, 3).

        `controls`: as the estimator's motion model has them; `dt` [s].
        """
        if not self._live and len(dt) <= MOST_STEPS:
            if self._association:
                self._legs.append((controls, dt))
            return self._move(controls, dt)
        poses, done = [], 0
        while done < len(dt):
            size = MOST_STEPS - (len(self._legs[-1][1]) if self._open else 0)
            poses.append(self._go_on(controls[done : done + size], dt[done : done + size]))
            done += size
        return joined_poses(poses)

    def hear(self, scan: Scan) -> Scan:
        """Associate a scan's rows and correct the belief; return the scan as it was used."""
        self._open = None
        if self._association is None:
            self._legs = []
            return self._correct(scan)
        memory, assignment = self._associate(scan)
        if assignment.again is not None and self._past:
            self._hear_again(assignment.again)
            memory, assignment = self._associate(scan)
        return self._hear(scan, memory, assignment)

    def landmarks(self) -> Landmarks:
        """Return the map, without what the association holds for tentative."""
        landmarks = self.belief.landmarks()
        if not hasattr(self._association, "tentative"):
            return landmarks
        tentative = np.array([*self._association.tentative(self._memory)], np.int64)
        return some_of(landmarks, ~is_among(landmarks.landmark, tentative))

    def state(self) -> SessionState:
        """Return all that the session knows now; what it hears later does not change it."""
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
        """Know what a session of the same settings knew."""
        self.belief, self._memory, self._first = state.belief, state.memory, state.first
        self._rng.bit_generator.state = state.draws
        self._past = deque(state.past, maxlen=REMEMBERED)
        self._legs, self._open, self._dropped = [*state.legs], state.open, {*state.dropped}
        self.labels = [*state.labels]

    def _move(self, controls: Float[np.ndarray, "k c"], dt: Float[np.ndarray, " k"]) -> Gaussian:
        """Predict through control steps."""
        predicted = self._estimator.predict(self.belief, controls, dt, self._rng)
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            expected = "the belief and the pose of each step"
            raise _wrong_return(self._estimator, "predict", predicted, expected)
        self.belief, poses = predicted
        check_poses("predict", poses, len(dt))
        return poses

    def _go_on(self, controls: Float[np.ndarray, "k c"], dt: Float[np.ndarray, " k"]) -> Gaussian:
        """Predict through a leg once more that has become longer; return its last k poses."""
        if self._open:
            self.belief, self._rng.bit_generator.state = self._open
            before, took = self._legs.pop()
            self._legs.append((_joined_steps(before, controls), np.concatenate((took, dt))))
        else:
            self._open = self.belief, self._rng.bit_generator.state
            self._legs.append((controls, dt))
        poses, new = self._move(*self._legs[-1]), slice(-len(dt), None)
        if len(self._legs[-1][1]) == MOST_STEPS:
            self._open = None
        return replace(poses, mean=poses.mean[new], covariance=poses.covariance[new])

    def _correct(self, scan: Scan) -> Scan:
        """Correct the belief with a scan that is labelled."""
        used = usable_scan(scan)
        belief = self._estimator.update(self.belief, used, self._rng)
        if not hasattr(belief, "pose"):
            raise _wrong_return(self._estimator, "update", belief, "the belief after the scan")
        self.belief = belief
        return used

    def _associate(self, scan: Scan) -> tuple[Any, Assignment]:
        """Return the association's memory after a scan, and what it decides."""
        assert self._association is not None, "hear asks only where there is one"
        stated = self._noise(scan) if self._noise else scan
        answer = self._association.associate(self._memory, self.belief, stated)
        if not (isinstance(answer, tuple) and len(answer) == 2 and type(answer[1]) is Assignment):
            raise _wrong_return(
                self._association, "associate", answer, "the memory and an Assignment"
            )
        return answer

    def _hear(self, scan: Scan, memory: Any, assignment: Assignment) -> Scan:
        """Correct the belief with a scan, as an association labels it."""
        if assignment.remove:
            self._take_back(assignment.remove)
        if assignment.earlier:
            self._state_again(assignment.earlier)
        heard = _Heard(
            number=self._first + len(self.labels),
            legs=self._legs,
            belief=self.belief,
            memory=self._memory,
            came=scan,
            scan=assignment.scan or scan,
            label=assignment.label,
            merge=assignment.merge,
        )
        self._past.append(heard)
        self._memory, self._legs = memory, []
        used = self._use(heard)
        if self._live and (old := len(self.labels) - REMEMBERED) > 0:
            del self.labels[:old]
            self._first += old
        return used

    def _use(self, heard: _Heard, since: int = 0) -> Scan:
        """Correct the belief with a scan that an association has labelled.

        ``since``: from which scan on its merging has not changed labels yet.
        """
        self.labels[heard.number - self._first :] = [heard.label]
        for kept, gone in heard.merge:
            labels = self.labels[since:]
            self.labels[since:] = [np.where(label == gone, kept, label) for label in labels]
        self.belief = edited(self.belief, merge=heard.merge)
        scan = self._noise.hidden(heard.came, heard.scan) if self._noise else heard.scan
        merged = labelled(scan, heard.label)
        return self._correct(self._noise(merged) if self._noise else merged)

    def _take_back(self, labels: tuple[int, ...]) -> None:
        """Remove landmarks, with all of their rows that are remembered."""
        past = [*self._past]
        labels = (*labels, *(gone for one in past for kept, gone in one.merge if kept in labels))
        named = np.array(labels)
        rows = [how_many_among(one.label, named) for one in past]
        callers = [how_many_among(one.scan.callers, named) for one in past]
        heard = [n for n in range(len(past)) if rows[n] or callers[n]]
        self._dropped.update(labels)
        for n in heard:
            past[n] = _without(past[n], named)
        once = sum(rows) == len(labels) and len(heard) == 1
        if heard and not (once and not _held(past[heard[0]].belief, labels)):
            self._go_again(past, heard[0])
        else:  # What was heard once has told nothing of anything else.
            self.belief = edited(self.belief, remove=_held(self.belief, labels))
            for n in heard:
                self.labels[past[n].number - self._first] = past[n].label
        self._past = deque(past, maxlen=REMEMBERED)

    def _state_again(self, earlier: Mapping[int, Scan]) -> None:
        """Hear scans that are remembered as an association states them now."""
        past = [*self._past]
        changed = [n for n, one in enumerate(past) if one.number in earlier]
        if not changed:
            return
        for n in changed:
            scan, label = earlier[past[n].number], past[n].label
            label = np.where(label == UNLABELLED, scan.landmark, label)
            past[n] = replace(past[n], scan=scan, label=label)
        self._go_again(past, changed[0])
        self._past = deque(past, maxlen=REMEMBERED)

    def _go_again(self, past: list[_Heard], first: int) -> None:
        """Go back to before one of the scans that are remembered, and hear what came since."""
        before = past[first].belief
        self.belief = edited(before, remove=_held(before, [*self._dropped]))
        since = past[first].number - self._first
        for n in range(first, len(past)):
            if n > first:
                self._go(past[n].legs)
            past[n] = self._as_held(past[n])
            self._use(past[n], since)
        self._go(self._legs)

    def _as_held(self, heard: _Heard) -> _Heard:
        """Return a scan to be heard after the present belief; what that lacks is not merged."""
        merge = heard.merge
        if merge:
            held = _held(self.belief, [label for pair in merge for label in pair])
            merge = tuple(pair for pair in merge if {*pair} <= {*held})
        return replace(heard, belief=self.belief, merge=merge)

    def _hear_again(self, news: Any) -> None:
        """Associate all scans that are remembered anew, by what has become known."""
        informed = getattr(self._association, "informed", None)
        if informed is None:
            raise InputError(
                f"association: found scans to be associated again, but a "
                f"{type(self._association).__name__} has no informed(memory, news)"
            )
        past, legs = list(self._past), self._legs
        self._past.clear()
        del self.labels[past[0].number - self._first :]
        dropped = _held(past[0].belief, [*self._dropped])
        self.belief = edited(past[0].belief, remove=dropped)
        self._dropped = set()  # a label may be given again
        self._memory = informed(past[0].memory, news)
        for one in past:
            if one is not past[0]:
                self._go(one.legs)
            self._legs = list(one.legs)
            self._hear(one.came, *self._associate(one.came))
        self._go(legs)
        self._legs = legs

    def _go(self, legs: Sequence[Leg]) -> None:
        """Predict through what was gone already."""
        for controls, dt in legs:
            self._move(controls, dt)


def _joined_steps(
    one: Float[np.ndarray, "k c"], other: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "k+n e"]:
    """Return steps one after the other; those that say no covariance have NaN where others do."""
    width = max(one.shape[1], other.shape[1])
    parts = [
        np.pad(part, ((0, 0), (0, width - part.shape[1])), constant_values=np.nan)
        if part.shape[1] < width
        else part
        for part in (one, other)
    ]
    return np.concatenate(parts)


def joined_poses(parts: Sequence[Gaussian]) -> Gaussian:
    """Return poses one after the other."""
    if len(parts) == 1:
        return parts[0]
    mean = np.concatenate([poses.mean for poses in parts])
    return replace(
        parts[0], mean=mean, covariance=np.concatenate([poses.covariance for poses in parts])
    )


def _held(belief: Belief, labels: Sequence[int]) -> list[int]:
    """Return which of some landmarks a belief holds; all, where it does not say."""
    held = {*belief.labels()} if hasattr(belief, "labels") else {*labels}
    return [label for label in labels if label in held]


def _without(heard: _Heard, labels: Int[np.ndarray, " n"]) -> _Heard:
    """Return a scan without some labels, of its rows and of its callers."""
    label, callers = (
        np.where(is_among(of, labels), UNLABELLED, of) for of in (heard.label, heard.scan.callers)
    )
    return replace(heard, label=label, scan=replace(heard.scan, callers=callers))


def check_poses(method: str, poses: Gaussian, size: int) -> None:
    """Refuse poses of an estimator's method that are not so many, or lack their covariances."""
    found = np.shape(poses.mean), np.shape(poses.covariance)
    expected = (size, 3), (size, 3, 3)
    if found != expected:
        which = "the start and every control step" if method == "path" else "one after each step"
        raise InputError(
            f"{method}: found arrays of {found[0]} and {found[1]}, expected {expected[0]} and "
            f"{expected[1]}: {which}"
        )


def _wrong_return(part: object, method: str, found: object, expected: str) -> InputError:
    """Say what a method from outside returned in place of what is expected."""
    name = f"{type(part).__module__}.{type(part).__qualname__}.{method}"
    fix = "does it lack its return?" if found is None else "correct it"
    return InputError(f"{name}: found {type(found).__name__} returned, expected {expected}; {fix}")
