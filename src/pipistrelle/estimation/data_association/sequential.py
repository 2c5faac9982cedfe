"""The package's association: scan by scan, with births, deaths, callers and changes of mind.

A row is held against the landmarks of the map with the joint covariance of pose and map (`pairs`),
the rows of each caller by themselves, and is given to one of them or to none (`matching`). A sure
row that is near none begins a landmark at once, with all that it says, so that nothing of the first
scans is lost; whether there is one is told later, by how often it is heard (`existence`). What was
none is removed, and its rows are taken back; what turns out to be on the map twice is merged
(`doubles`).

A caller is known by its direct call, and its place is found by the excess paths themselves
(`caller_search`). Until then its rows are followed, and not used; then the session hears again all
that it remembers.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import (
    OWN,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
    with_callers,
)
from pipistrelle.estimation.association import Assignment
from pipistrelle.estimation.beliefs import Belief, JointGaussian
from pipistrelle.estimation.data_association.caller_search import (
    find_caller,
    find_moving_caller,
)
from pipistrelle.estimation.data_association.doubles import doubles
from pipistrelle.estimation.data_association.existence import (
    GONE,
    Known,
    judged,
    merged,
    some,
    with_new,
)
from pipistrelle.estimation.data_association.matching import Innovate, Match
from pipistrelle.estimation.data_association.memory import Caller, CallerPlace, Memory
from pipistrelle.estimation.data_association.pairs import (
    OWN_CALL,
    UNPLACED,
    Rows,
    pair_costs,
    pair_innovations,
    with_point,
)
from pipistrelle.estimation.data_association.tracks import Tracks, followed
from pipistrelle.estimation.data_association.turns import turned
from pipistrelle.geometry import wrap

FIRST_SEARCH, FIRST_SEARCH_MOVING = 8, 10
"""Scans of a caller that stands, and of one that moves, after which its place is searched for, at
every second one."""
PLACE_SHARE, MOVING_SHARE = 0.12, 0.2
"""Deviation of the range at which a caller that stands was found, and one that moves, as a share of
it."""
REFINED_AFTER, REFINED_SHARE = 24, 0.06
"""Scans after which the place on the map is taken instead, once, and the least share of its range
that it may be off."""
DIRECT_GATE = 9.0
"""Largest squared distance of a caller's direct call."""
PROBATION = 40
"""Scans in which a caller may turn out not to be where it was found."""
TRIAL, SETTLING, LEAST_SHARE, LEAST_ROWS = 9, 3, 0.4, 10
"""A caller is where it was found if of the sure rows of so many scans, the first left out, this
share is of landmarks, new ones not counted; at least so many rows must tell."""
BESIDE, ASIDE = 0.96, 0.5
"""A row begins no landmark beside a louder one, within such a way [m] and bearing [rad]."""
OVERLAP_STD, OVERLAP_GATE = 0.7, 9.0
"""Deviation of the way of an echo that overlaps with another [m], and largest squared distance."""
ASKED = frozenset((4, 6, 8, 12, 16, 24, 32, 64))
"""In how many scans a landmark was heard when it is asked whether it is on the map twice."""
SURE_SHARE, ASSUMED = 0.65, 0.75
"""A row is as sure as any up to this share of the limit of its bearing's deviation; how sure one is
whose deviation is only assumed."""
BOTH = 0.1
"""Two landmarks are two if in more than this share of the scans of either both were heard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How sure a row must be to be used, and to begin a landmark."""

    bearing_std: float = 0.05
    """[rad]"""
    way_std: float = 0.35
    """Of range or excess path [m]."""
    birth_way_std: float = 0.25
    """The same of a row that begins a landmark [m]."""
    assumed: tuple[float, ...] = ()
    """Deviations that are assumed of rows which state none: no limit holds for these."""
    sight: tuple[float, float] = (0.0, 0.0)
    """`existence.Sight`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sequential:
    """An association that works scan by scan.

    Examples
    --------
    Two rows of an empty map are two landmarks; the next scan's are the same.

    >>> from pipistrelle.config import Config
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.beliefs import Gaussian
    >>> from pipistrelle.estimation.catalogue import entry
    >>> from pipistrelle.estimation.data_association.matching import nearest
    >>> from pipistrelle.estimation.motion import Motion
    >>> from pipistrelle.estimation.session import Session
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    >>> session = Session(
    ...     entry("iekf").build(Config(), motion), start, np.random.default_rng(7),
    ...     association=Sequential(match=nearest, chances=(25.0, 0.06, 1.3, 0.8)))
    >>> stds = {"bearing_std": 0.01, "range_std": 0.02}
    >>> heard = make_scan(0.0, np.full(2, -1), np.array([0.1, 1.0]), range=np.ones(2), **stds)
    >>> for _ in range(3):
    ...     used = session.hear(heard)
    >>> [label.tolist() for label in session.labels]
    [[1, 2], [1, 2], [1, 2]]
    """

    match: Match
    """How rows are matched with landmarks (`matching`, `compatibility`)."""
    chances: tuple[float, float, float, float]
    """`pairs.Chances`."""
    limits: Limits = Limits()

    def start(self) -> Memory:
        """Return the memory before the first scan."""
        return Memory()

    def informed(self, memory: Memory, news: Mapping[int, CallerPlace]) -> Memory:
        """Return a memory that knows where callers are, by their numbers."""
        known = dict(memory.callers)
        for number, place in news.items():
            label = known[number].label if number in known else memory.labels + 1
            memory = replace(memory, labels=max(memory.labels, label))
            known[number] = Caller(label=label, place=place)
        return replace(memory, callers=known)

    def tentative(self, memory: Memory) -> list[int]:
        """Return the labels of what may be no landmark."""
        return memory.known.label[~memory.known.confirmed].tolist()

    def associate(self, memory: Memory, belief: Belief, scan: Scan) -> tuple[Memory, Assignment]:
        """Return the memory after a scan, and what is decided."""
        work = _Work(self, memory, belief, scan)
        if news := work.search_callers():
            return memory, Assignment(label=work.label, again=news)
        for number in sorted({*scan.caller.tolist()}):
            work.match(number)
        return work.finished()


class _Work:
    """The association of one scan."""

    def __init__(self, stage: Sequential, memory: Memory, belief: Belief, scan: Scan) -> None:
        self.stage, self.memory, self.scan = stage, memory, scan
        self.joint: JointGaussian = belief.joint()  # pyrefly: ignore[missing-attribute]
        self.pose, there = self.joint.mean[:3], self.joint.landmark.tolist()
        self.place = {label: 3 + 2 * n for n, label in enumerate(there)}
        self.label = np.full(scan.landmark.size, UNLABELLED)
        self.labels, self.callers = memory.labels, dict(memory.callers)
        self.numbers, self.named = scan.numbers, np.full(scan.direct.size, UNLABELLED)
        self.moving = [c.label for number, c in self.callers.items() if number in scan.moving]
        own, limits = scan.caller == OWN, stage.limits
        self.way = np.where(own, scan.range, scan.excess_path)
        self.way_std = np.where(own, scan.range_std, scan.excess_path_std)
        bare, sure = np.isnan(self.way), self._within(scan.bearing_std, limits.bearing_std)
        self.usable = sure & (bare | self._within(self.way_std, limits.way_std))
        self.with_way = self.usable & ~bare
        self.sure = self._within(self.way_std, limits.birth_way_std)
        self.new: list[int] = []
        self.near: set[int] = set()

    def search_callers(self) -> dict[int, CallerPlace]:
        """Follow the rows of callers that are not found, and return where some now are."""
        news: dict[int, CallerPlace] = {}
        for number, row in enumerate(self.scan.direct.tolist()):
            if number == OWN or (row < 0 and number not in self.callers):
                continue
            caller = self.callers.get(number) or Caller(label=self._another())
            self.callers[number] = caller
            if caller.told:
                news |= self._refined(number, caller)
            elif caller.place is None:
                news |= self._searched(number, caller, row)
        return news

    def _refined(self, number: int, caller: Caller) -> dict[int, CallerPlace]:
        """Return the place of a caller on the map, once that is worth more than what was found."""
        at, done = self._where(caller.label), caller.place is not None and caller.place.refined
        moves = number in self.scan.moving
        if moves or done or self.memory.scan != caller.since + REFINED_AFTER or at < 0:
            return {}
        way, P = self.joint.mean[at : at + 2] - self.pose[:2], self.joint.covariance
        u = np.array([*-way, *way]) / float(way @ way)
        there = [0, 1, at, at + 1]
        off = math.sqrt(u @ P[np.ix_(there, there)] @ u)  # share of the range
        x, y = self.joint.mean[at : at + 2].tolist()
        return {number: CallerPlace(x, y, refined=min(max(off, REFINED_SHARE), PLACE_SHARE))}

    def _searched(self, number: int, caller: Caller, row: int) -> dict[int, CallerPlace]:
        """Follow a caller's rows, and return its place if that is found."""
        rows = self._rows(self.with_way & (self.scan.caller == number))
        direct = self.scan.bearing[row] if row >= 0 else math.nan
        tracks = followed(caller.tracks, self.scan.time, self.pose, direct, rows)
        self.callers[number] = replace(caller, tracks=tracks)
        moves = number in self.scan.moving
        first = FIRST_SEARCH_MOVING if moves else FIRST_SEARCH
        if len(tracks.poses) < first or len(tracks.poses) % 2:
            return {}
        found = find_moving_caller(tracks) if moves else find_caller(tracks)
        return {number: found.place} if found is not None and found.sure else {}

    def match(self, number: int) -> None:
        """Label the rows of one caller."""
        at = OWN_CALL if number == OWN else self._heard_from(number)
        if at is None:
            return
        rows = np.flatnonzero(self.scan.caller == number)
        rows = rows[rows != self._direct(number)]
        there = 3 + 2 * np.arange(self.joint.landmark.size)
        if number in self.scan.moving and at >= 0:
            self._follow_turn(number, rows, at)
        costs = self._costs(rows, there, at, self.stage.chances)
        if self.moving:
            costs[:, np.isin(self.joint.landmark, self.moving)] = np.inf
        usable = (self.usable if at == UNPLACED else self.with_way)[rows]
        gated = np.isfinite(costs)
        telling = self.scan.bearing_std[rows] <= 2.0 * self.stage.limits.bearing_std
        self.near |= {*self.joint.landmark[gated[telling].any(axis=0)].tolist()}
        used = rows[usable]
        found = self.stage.match(costs[usable], self._innovate(used, there, at))
        self.label[used] = np.append(self.joint.landmark, UNLABELLED)[found]
        self._judge_caller(number, used)
        if at != UNPLACED:
            self._bear(number, used[~gated[usable].any(axis=1)], at)

    def _follow_turn(self, number: int, rows: Int[np.ndarray, " r"], at: int) -> None:
        """Take a caller that moves for where its rows fit, if they do not where it was expected."""
        rows, direct = rows[self.with_way[rows]], self._direct(number)
        if direct < 0:
            return
        joint, stand = self.joint, ~np.isin(self.joint.landmark, self.moving)
        there, columns = 3 + 2 * np.flatnonzero(stand), tuple(self._rows(rows))

        def costs(mean: Float[np.ndarray, " d"]) -> Float[np.ndarray, "r n"]:
            return pair_costs(columns, mean, joint.covariance, there, at, self.stage.chances)

        self.joint = turned(joint, at, float(self.scan.bearing[direct]), costs)

    def _heard_from(self, number: int) -> int | None:
        """Return where a caller stands in the joint mean; None where its rows have to wait."""
        caller = self.callers.get(number)
        if caller is None:
            return UNPLACED
        if not caller.told:
            self._tell(number, caller)
            return None
        self.named[number] = caller.label
        at = self._where(caller.label)
        self._match_direct(number, caller.label, at)
        return UNPLACED if at < 0 else at

    def finished(self) -> tuple[Memory, Assignment]:
        """Return the memory after the scan, and the assignment."""
        memory, scan, known = self.memory, self.scan, self._judged()
        gone = {*known.label[known.odds < GONE].tolist(), *self._lost(known)}
        if gone:
            known = some(known, ~np.isin(known.label, list(gone)))
            self.label[np.isin(self.label, list(gone))] = UNLABELLED
            self.named[np.isin(self.named, list(gone))] = UNLABELLED
        merge = () if gone else self._doubles(known)
        for kept, other in merge:
            self.label[self.label == other] = kept
        after = Memory(
            scan=memory.scan + 1,
            labels=self.labels,
            known=merged(known, merge),
            callers=self.callers,
        )
        stated = with_callers(replace(scan, numbers=self.numbers), self.named)
        before = {*memory.known.label.tolist(), *(c.label for c in memory.callers.values())}
        return after, Assignment(
            label=self.label,
            remove=tuple(sorted(gone & before)),
            merge=merge,
            scan=stated if scan.direct.size else None,
        )

    def _judged(self) -> Known:
        """Return all landmarks, new ones too, after what was heard of them and what was not."""
        memory, scan = self.memory, self.scan
        size = max(1 + scan.caller.max(initial=0), scan.direct.size, memory.known.source.shape[1])
        known = with_new(memory.known, self.new, memory.scan, size)
        callers = np.full(size, UNPLACED)
        for number, caller in self.callers.items():
            callers[number] = self._where(caller.label)
        heard = self.label, scan.caller, self.way, scan.level_db, scan.bearing, self._surety()
        place = self.joint.mean, self._places(known), callers
        near = np.array([label in self.near for label in known.label.tolist()], np.bool_)
        return judged(known, heard, place, near, memory.scan, self.stage.limits.sight)

    def _doubles(self, known: Known) -> tuple[tuple[int, int], ...]:
        """Return pairs of landmarks that are one, the older first; asked now and then."""
        now = self.memory.scan
        heard = (known.heard == now) & (known.born < now)
        counted = zip(known.label[heard].tolist(), known.count[heard].tolist(), strict=True)
        due = {label for label, count in counted if count in ASKED}
        if not due:
            return ()
        known = some(known, (self._places(known) >= 0) & (known.born < now))
        label = known.label.tolist()
        asked = np.array([n for n, a in enumerate(label) if a in due], np.int64)
        rarer = np.minimum(known.count[:, np.newaxis], known.count)
        apart = (known.together > BOTH * rarer) | np.eye(len(rarer), dtype=bool)
        pairs = doubles(self.joint, self._places(known), apart, asked)
        return tuple((label[a], label[b]) for a, b in pairs)

    def _places(self, known: Known) -> Int[np.ndarray, " l"]:
        """Return where known landmarks stand in the joint mean; -1: nowhere."""
        return np.array([self._where(label) for label in known.label.tolist()], np.int64)

    def _another(self) -> int:
        """Return a new label."""
        self.labels += 1
        return self.labels

    def _where(self, label: int) -> int:
        """Return where a landmark stands in the joint mean, or -1."""
        return self.place.get(label, -1)

    def _direct(self, number: int) -> int:
        """Return the row of a caller's direct call, or -1."""
        return int(self.scan.direct[number]) if number < self.scan.direct.size else -1

    def _surety(self) -> Float[np.ndarray, " m"]:
        """Return how sure rows are, from 0 to 1."""
        std, limit = self.scan.bearing_std, self.stage.limits.bearing_std
        sure = np.fmin(SURE_SHARE * limit / std, 1.0)
        return np.where(self._is_assumed(std), ASSUMED, sure)

    def _within(self, std: Float[np.ndarray, " r"], limit: float) -> Bool[np.ndarray, " r"]:
        """Return a mask of deviations that are within a limit, or that were only assumed."""
        return (std <= limit) | self._is_assumed(std)

    def _is_assumed(self, std: Float[np.ndarray, " r"]) -> Bool[np.ndarray, " r"]:
        """Return a mask of deviations that were only assumed."""
        mask = np.zeros(std.shape, np.bool_)
        for assumed in self.stage.limits.assumed:
            mask |= std == assumed
        return mask

    def _rows(self, rows: np.ndarray) -> Rows:
        """Return some rows."""
        scan = self.scan
        return Rows(scan.bearing[rows], scan.bearing_std[rows], self.way[rows],
                    self.way_std[rows], scan.level_db[rows])  # fmt: skip

    def _costs(
        self,
        rows: Int[np.ndarray, " r"],
        there: Int[np.ndarray, " n"],
        caller: int,
        chances: tuple[float, float, float, float],
    ) -> Float[np.ndarray, "r n"]:
        """Return the costs of rows of a caller and landmarks (`pair_costs`)."""
        joint, columns = self.joint, tuple(self._rows(rows))
        return pair_costs(columns, joint.mean, joint.covariance, there, caller, chances)

    def _innovate(
        self, rows: Int[np.ndarray, " r"], there: Int[np.ndarray, " n"], caller: int
    ) -> Innovate:
        """Return what tells the innovations of pairs of these rows and landmarks."""
        joint = self.joint
        return lambda row, landmark: pair_innovations(
            tuple(self._rows(rows)), joint.mean, joint.covariance, there, caller, (row, landmark)
        )

    def _tell(self, number: int, caller: Caller) -> None:
        """State the place of a caller that was found as a range of its direct call."""
        row = self._direct(number)
        if caller.place is None or row < 0 or self.scan.time < caller.place.since:
            return
        x, y = caller.place.at(self.scan.time)
        far = math.hypot(x - self.pose[0], y - self.pose[1])
        self.numbers = self.numbers.copy()
        found = MOVING_SHARE if number in self.scan.moving else PLACE_SHARE
        share = caller.place.refined or found
        self.numbers[RANGE, row], self.numbers[RANGE_STD, row] = far, share * far
        self.label[row] = self.named[number] = caller.label
        told = replace(caller, told=True, tracks=Tracks(), since=self.memory.scan)
        self.callers[number] = told

    def _match_direct(self, number: int, label: int, at: int) -> None:
        """Label a caller's direct call, where its bearing agrees."""
        row = self._direct(number)
        if row < 0:
            return
        if at >= 0 and number not in self.scan.moving:
            chances = (DIRECT_GATE, *self.stage.chances[1:])
            cost = self._costs(np.array([row]), np.array([at]), UNPLACED, chances)
            if np.isinf(cost[0, 0]):
                return
        self.label[row] = label

    def _bear(self, number: int, rows: Int[np.ndarray, " r"], at: int) -> None:
        """Begin landmarks with rows that are sure and near no other."""
        way, scan, rows = self.way, self.scan, rows[self.sure[rows]]
        rows = rows[~self._overlapped(number, rows, at)] if rows.size else rows
        factor, same = (2.0 if number == OWN else 1.0), scan.caller == number
        for row in sorted(rows.tolist(), key=lambda row: -scan.level_db[row]):
            beside = same & (factor * np.abs(way - way[row]) < BESIDE)
            beside &= np.abs(wrap(scan.bearing - scan.bearing[row])) < ASIDE
            if np.any(beside & (scan.level_db > scan.level_db[row])):
                continue
            label = self._another()
            self.label[row] = label
            self.new.append(label)
            if number == OWN:
                stds = scan.bearing_std[row], self.way_std[row]
                self.place[label] = self.joint.mean.size
                self.joint = with_point(self.joint, label, scan.bearing[row], way[row], stds)

    def _overlapped(
        self, number: int, rows: Int[np.ndarray, " r"], at: int
    ) -> Bool[np.ndarray, " r"]:
        """Return a mask of rows that may be of a landmark which was not heard by itself.

        Of two echoes that overlap comes one row, with the bearing of one and the way of the other.
        """
        known, joint = self.memory.known, self.joint
        silent = known.label[known.confirmed & ~np.isin(known.label, self.label)].tolist()
        there = np.array([self.place[label] for label in silent if label in self.place], np.int64)
        heard = self._rows(rows)
        spread = OVERLAP_STD / (2.0 if number == OWN else 1.0)
        columns = tuple(heard._replace(way_std=np.hypot(heard.way_std, spread)))
        chances = (OVERLAP_GATE, *self.stage.chances[1:])
        costs = pair_costs(columns, joint.mean, joint.covariance, there, at, chances)
        return np.any(np.isfinite(costs), axis=1)

    def _judge_caller(self, number: int, rows: Int[np.ndarray, " r"]) -> None:
        """Count how many of a caller's sure rows are of landmarks."""
        if number not in self.callers or self._where(self.callers[number].label) < 0:
            return
        caller, sure = self.callers[number], rows[self.sure[rows]]
        told = (int(np.count_nonzero(self.label[sure] != UNLABELLED)), sure.size)
        self.callers[number] = replace(caller, trial=(*caller.trial[1 - TRIAL :], told))

    def _lost(self, known: Known) -> list[int]:
        """Return callers that are not where they were found, with what they alone have placed."""
        lost: list[int] = []
        for number, caller in [*self.callers.items()]:
            if len(caller.trial) < TRIAL or self.memory.scan > caller.since + PROBATION:
                continue
            right, rows = np.sum(caller.trial[SETTLING:], axis=0)
            if rows >= LEAST_ROWS and right < LEAST_SHARE * rows:
                alone = np.isnan(known.source[:, OWN]) & (known.born >= caller.since)
                lost += [caller.label, *known.label[alone].tolist()]
                del self.callers[number]
        return lost
