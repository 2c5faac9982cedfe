"""Data association scan by scan, with new, deleted and merged landmarks and a search for callers.

The measurements of each caller are matched with landmarks by the joint covariance of pose and map
(`pairs`). A precise measurement near no landmark begins a new landmark at once, so that the first
scans are used in full; repeated detection confirms it (`existence`). Landmarks of low odds are
deleted with their measurements, duplicates merged. A caller is identified by its direct call and
located by excess paths (`caller_search`). Until then its measurements are tracked, but not used;
afterwards the session repeats all scans in its memory.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    OWN,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
    with_callers,
)
from pipistrelle.estimation.beliefs import (
    KNOWN,
    Assignment,
    Association,
    Belief,
    Gaussian,
    JointGaussian,
    Landmarks,
    is_among,
)
from pipistrelle.estimation.catalogue import ASSOCIATION, build, class_of, names_class
from pipistrelle.estimation.data_association import caller_search, existence, watch
from pipistrelle.estimation.data_association.existence import WINDOW, Known
from pipistrelle.estimation.data_association.pairs import (
    BARELY,
    OWN_CALL,
    UNPLACED,
    Chances,
    Match,
    PlainChances,
    Rows,
    marginal,
    nearest,
    pair_costs,
    with_points,
)
from pipistrelle.estimation.data_association.rows import (
    CallerPlace,
    CallerState,
    Memory,
    Model,
    Tracks,
    compared,
    drift_of,
    followed,
    label_matched,
    part_of,
    place_of,
    places_of,
    rows_of_scan,
)
from pipistrelle.estimation.data_association.watch import Watched


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Largest standard deviations of measurements to be used, and to begin landmarks."""

    bearing_std: float = 0.05
    """Bearing [rad]."""
    way_std: float = 0.35
    """Range or excess path [m]."""
    birth_way_std: float = 0.25
    """Range or excess path of a measurement that begins a landmark [m]."""
    assumed: tuple[float, ...] = ()
    """Default standard deviations, exempt from all limits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sequential(Association[Memory]):
    """Data association that labels each scan when it arrives, by a matching method.

    Two measurements on an empty map become two landmarks, which the next scans match.

    >>> from pipistrelle.config import Config
    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.beliefs import Gaussian
    >>> from pipistrelle.estimation.catalogue import entry
    >>> from pipistrelle.estimation.data_association.pairs import nearest
    >>> from pipistrelle.estimation.motion import Motion
    >>> from pipistrelle.estimation.session import Session
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    >>> session = Session(
    ...     entry("iekf").build(Config(), motion), start, np.random.default_rng(7),
    ...     association=Sequential(match=nearest, chances=(25.0, 0.06, 1.3, 0.8, 0.02)))
    >>> stds = {"bearing_std": 0.01, "range_std": 0.02}
    >>> heard = make_scan(0.0, np.full(2, -1), np.array([0.1, 1.0]), range=np.ones(2), **stds)
    >>> for _ in range(3):
    ...     used = session.hear(heard)
    >>> [label.tolist() for label in session.labels]
    [[1, 2], [1, 2], [1, 2]]
    """

    match: Match
    """Matching method, from `METHODS`."""
    chances: PlainChances
    """`pairs.Chances` as a tuple."""
    limits: Limits = Limits()
    motion: tuple[float, float] = (1.0, 0.2)
    """Stds of a moving caller's initial velocity [m/s] and of its change in a second [m/s]."""
    labels: int = 0
    """Largest label that scans may state; new landmarks have larger labels."""

    def start(self) -> Memory:
        """Return the empty memory of data association before the first scan."""
        return Memory(labels=self.labels)

    def carried(self, memory: Memory, later: Memory) -> Memory:
        """Return an earlier memory with callers' positions and failures that a later one adds."""
        stated, watched = later.known.label[np.isinf(later.known.odds)], memory.watch
        known, labels = dict(memory.callers), max(memory.labels, int(stated.max(initial=0)))
        failed = lost = later.watch.lost == 1 and len(later.watch.alarms) > len(watched.alarms)
        for number, caller in sorted(later.callers.items()):
            label = caller.label if caller.label <= self.labels else labels + 1
            before = known.get(number, CallerState(label=label))
            if before.failed < caller.failed <= memory.scan:
                before, failed = replace(caller, label=labels + 1), True
            elif caller.place in (None, before.place) or before.failed != caller.failed:
                continue
            labels = max(labels, before.label)
            known[number] = replace(before, place=caller.place, told=False, tracks=Tracks())
        if failed:
            watched = watched._replace(alarms=later.watch.alarms, lost=int(lost) or watched.lost)
        return replace(memory, callers=known, labels=labels, watch=watched)

    def knowing(self, memory: Memory, known: Landmarks, callers: Int[np.ndarray, " c"]) -> Memory:
        """Return the memory with the initial map: callers need no search, landmarks stay."""
        numbers = {label: number for number, label in enumerate(callers.tolist())}
        rows = zip(known.landmark.tolist(), known.mean.tolist(), strict=True)
        found = dict(memory.callers) | {
            numbers[label]: CallerState(label=label, place=CallerPlace(x, y), told=True)
            for label, (x, y) in rows
            if label in numbers
        }
        others = known.landmark[~is_among(known.landmark, callers)]
        records = existence.with_new(memory.known, others.tolist(), memory.scan, 1)
        labels = max(memory.labels, int(others.max(initial=0)))
        stated = existence.stated(records, others)
        return replace(memory, callers=found, known=stated, labels=labels)

    def tentative(self, memory: Memory) -> list[int]:
        """Return the labels of unconfirmed landmarks, and of callers' former positions."""
        former = [label for caller in memory.callers.values() for label in caller.former]
        return memory.known.label[~memory.known.confirmed].tolist() + former

    def report(self, memory: Memory) -> Mapping[str, Any]:
        """Return each call's share of detected old landmarks, and the alarms about it."""
        return watch.reported(memory.watch)

    def associate(self, memory: Memory, belief: Belief, scan: Scan) -> tuple[Memory, Assignment]:
        """Label a scan's measurements; return the new memory and the assignment."""
        work = _Work(self, memory, belief, scan)
        work.search_callers()
        work.match_all()
        work.watch_calls()
        return work.finished()


class _Work:
    """Working state of the association of a single scan."""

    def __init__(self, stage: Sequential, memory: Memory, belief: Belief, scan: Scan) -> None:
        self.stage, self.memory, self.scan = stage, memory, scan
        self.joint: JointGaussian = belief.joint()
        self.pose = Gaussian(
            mean=self.joint.mean[:3].copy(), covariance=self.joint.covariance[:3, :3].copy()
        )
        drift, limits = drift_of(memory, self.pose), stage.limits
        self.model: Model = (*drift, *stage.motion, stage.chances[1] / stage.chances[3])
        self.given, self.labels = scan.landmark.copy(), memory.labels
        self.states = self.given.max(initial=UNLABELLED) > UNLABELLED
        if self.states:
            self.given[scan.direct[scan.direct >= 0]] = UNLABELLED
            self.labels = max(memory.labels, int(self.given.max()))
            issued = memory.known.label[np.isfinite(memory.known.odds)]
            if (taken := is_among(self.given, issued)).any():
                found = f"association at {scan.time} s: found the label {self.given[taken][0]}"
                expected = "expected one that is not given to another landmark already"
                raise InputError(f"{found}, {expected}; add a number to yours, such as 1000000")
        self.label, self.merge, self.fits = self.given.copy(), [], self.given == UNLABELLED
        self.callers = dict(memory.callers)
        self.numbers, self.named = scan.numbers, np.full(scan.direct.size, UNLABELLED)
        self.moves = {*scan.moving_callers.tolist()}
        moving = [self.callers[number].label for number in self.moves & self.callers.keys()]
        self.moving = np.array(moving, np.int64)
        most = limits.bearing_std, limits.way_std, limits.birth_way_std
        self.rows = rows_of_scan(scan, most, limits.assumed)
        self.new: list[int] = []
        self.doubted = self.moves | {n for n, caller in self.callers.items() if caller.failed}
        self.before, self.known = self.joint, memory.known
        self.confirmed = self.known.label[self.known.confirmed]
        self.back: int | None = None
        self.blind, self.begins = False, not memory.watch.lost

    def search_callers(self) -> None:
        """Track echoes of unlocated callers, and search for their positions."""
        for number, row in enumerate(self.scan.direct.tolist()):
            if number == OWN or (row < 0 and number not in self.callers):
                continue
            stated = self.scan.callers[number : number + 1].tolist()
            caller = self.callers.get(number) or CallerState(label=(stated or [self._another()])[0])
            if caller.place is None and (at := self._where(caller.label)) >= 0:
                place = CallerPlace(*self.joint.mean[at : at + 2].tolist())
                caller = replace(caller, place=place, told=True, tracks=Tracks())
            elif caller.place is None:
                caller = self._followed(number, caller, row)
                place = caller_search.place_caller(caller.tracks, number in self.moves, self.model)
                if place is not None:
                    caller = replace(caller, place=place)
                    if not caller.failed:  # else earlier scans are of its former position
                        self.back = 0
            self.callers[number] = caller

    def _followed(self, number: int, caller: CallerState, row: int) -> CallerState:
        """Add this scan's measurements to the tracks of an unlocated caller; return its record."""
        rows = self._some(self.rows.with_way & (self.scan.caller == number))
        numbers = self.scan.numbers[[BEARING, BEARING_STD]]
        direct = numbers[:, row] if row >= 0 else np.full(2, math.nan)
        time, pose = self.scan.time, self.pose.mean
        return replace(caller, tracks=followed(caller.tracks, time, pose, direct, rows, self.model))

    def match_all(self) -> None:
        """Match the measurements of each caller with landmarks, the vehicle's own first."""
        called, memory = sorted({*self.scan.caller.tolist()}), self.memory
        for number in called:
            self.match(number)
        size = max(self.scan.direct.size, memory.known.source.shape[1], len(memory.watch.hits))
        numbers = range(max(size, 1 + max((OWN, *called, *self.callers))))
        where = {number: self._where(caller.label) for number, caller in self.callers.items()}
        self.where = np.array([OWN_CALL, *(where.get(n, UNPLACED) for n in numbers[1:])])
        judged = {OWN, *(number for number, at in where.items() if at >= 0)} & {*called}
        masks = [[number in some for number in numbers] for some in (judged, self.moves)]
        self.judged, self.roving = np.array(masks)

    def watch_calls(self) -> None:
        """Judge each call by its measurements of old landmarks; repair a failed call or pose."""
        self.watch, ratio = self._observed()
        if self.watch.lost or ratio.max() >= watch.BOUND:
            self.watch = self._repaired(self.watch, ratio)

    def _repaired(self, watched: Watched, ratio: Float[np.ndarray, "c w"]) -> Watched:
        """Repair a failed call or pose, by the ratios of failures; return the later watch."""
        fixed = self.judged & ~self.roving
        least = np.where(fixed, 1, WINDOW + 1)
        for number in {*self.callers} & {*np.flatnonzero(fixed).tolist()}:
            row = self._direct(number)
            fits = row >= 0 and self.label[row] == self.callers[number].label
            least[number] = watch.SPOILT if fits else WINDOW // 2
        calls, since, pose = watch.failed(watched, ratio, least)
        fits = bool((ratio[fixed, -1] < 0.0).any()) and not calls
        if watched.lost and self.scan.landmark.size and not fits:
            joint, lost = self._placed_again(), watched.lost + 1
            self.blind = joint is None and lost <= watch.SETTLED
            self.begins = joint is None and not self.blind
            self.joint, self.new = joint or self.before, []
            self.fits = self.given == UNLABELLED
            self.label[:], self.named[:] = self.given, UNLABELLED
            self.match_all()
            again = self._observed()[0] if joint else self.memory.watch
            self.known.past[:] *= not self.begins
            return again._replace(times=watched.times, lost=0 if self.begins else lost)
        if calls and self.back is None:
            return self._alarmed(watched, calls, since, pose)
        if watched.lost and ratio[:, -watched.lost :].sum(axis=0).min() <= -watch.BOUND:
            pose = np.flatnonzero(watched.alarms[:, 1] == watch.POSE)[-1]
            watched = watched._replace(alarms=watched.alarms.copy(), lost=0)
            watched.alarms[pose, 2] = 1.0
            self.known.past[..., :-1] = 0.0
        return watched

    def _alarmed(self, watched: Watched, calls: list[int], since: int, pose: bool) -> Watched:
        """Report a failure of the pose or of calls; set failed callers aside, since its scan."""
        scan = self.memory.scan + 1 - WINDOW + since
        if pose:
            self.back = scan
            return watch.alarmed(watched, since, watch.POSE, repaired=False)._replace(lost=1)
        for call in calls:
            if call != OWN:
                former = (*self.callers[call].former, self.callers[call].label)
                aside = CallerState(label=self._another(), failed=scan, former=former)
                self.callers[call], self.back = aside, scan
            if call != OWN or OWN not in watched.alarms[:, 1]:
                watched = watch.alarmed(watched, since, call, repaired=call != OWN)
        return watched

    def _placed_again(self) -> JointGaussian | None:
        """Return the joint Gaussian with the pose that the scan has on the old map, if any."""
        where, rows, heard, known = self.where, self.rows, [], self.known
        for number in np.flatnonzero(self.judged & ~self.roving).tolist():
            row = self._direct(number)
            if number == OWN or (row >= 0 and where[number] < self.before.mean.size):
                used = rows.with_way & (rows.caller == number) & ~np.isnan(rows.bearing)
                used[row] &= number == OWN
                direct = np.array([rows.bearing[row], rows.bearing_std[row]])
                heard.append((number, self._some(used), direct, int(where[number])))
        watched, at = watch.of_calls(where.size, self.memory.watch), self._place(known.label)[1]
        old = known.confirmed & (at >= 0)
        placed = at[old], known.source[old], heard
        return watch.placed_again(watched, self.before, *placed, self.stage.chances)

    def _observed(self) -> tuple[Watched, Float[np.ndarray, "c w"]]:
        """Record which old landmarks each call has detected; return the watch, and its ratios."""
        memory, rows = self.memory, self.rows
        known = existence.with_new(memory.known, [], memory.scan, self.where.size)
        label = np.where(self.fits, self.label, UNLABELLED) if self.states else self.label
        heard = label, rows.caller, rows.sure, rows.usable, *rows[1:5], rows.clutter
        chances, place = (*self.stage.chances[:4], math.inf), self._place(known.label)
        placed = self.joint.covariance, place, self.judged, heard, chances, memory.scan
        hits, asked, found, expected, past, self.missed, ratio = watch.observed(
            tuple(known), memory.watch[:4], *placed
        )
        self.known, watched = known._replace(past=past), memory.watch
        times = np.append(watched.times[1:], self.scan.time)
        return Watched(hits, asked, found, expected, times, *watched[5:]), ratio

    def match(self, number: int) -> None:
        """Match a caller's measurements with landmarks; begin landmarks where none fits."""
        at = OWN_CALL if number == OWN else self._heard_from(number)
        if at is None:
            return
        caller = number, self._direct(number), at
        if number in self.moves and at >= 0:
            self._follow_turn(number, at)
        rows, chances = tuple(self.rows), self.stage.chances
        joint = self.joint.landmark, self.joint.mean, self.joint.covariance
        used, costs, near = compared(rows, joint, self.moving, caller, chances)
        stated = used[self.given[used] != UNLABELLED] if self.states else used[:0]
        wrong = stated.size > 0 and self._refuted(costs, used)
        matched, confirmed = (used, self.stage.match(costs), near), self.confirmed
        begun, count = label_matched(self.label, rows, joint, confirmed, matched, caller, chances)
        if stated.size:
            begun = begun[(self.given[begun] == UNLABELLED) & (not wrong)]
            begun = np.append(begun, self._stated(stated))
        strayed = begun.size and number in self.doubted and self._is_elsewhere(number, count)
        if begun.size and self.begins and not strayed:
            self._begin(number, begun)

    def _refuted(self, costs: Float[np.ndarray, "r n"], used: Int[np.ndarray, " r"]) -> bool:
        """Match stated rows to landmarks without stated label only; return whether most misfit."""
        landmark, given, known = self.joint.landmark, self.given[used], self.memory.known
        named = np.append(known.label[np.isinf(known.odds)], self._callers_labels())
        same = given[:, np.newaxis] == landmark
        self.fits[used] |= (same & np.isfinite(costs)).any(axis=1)
        mapped = same.any(axis=1)
        wrong = np.count_nonzero(mapped & ~self.fits[used])
        refuted = bool(2 * wrong > np.count_nonzero(mapped))  # the pose or the caller is wrong
        costs[:, same.any(axis=0) | refuted] = costs[mapped] = math.inf
        costs[np.ix_(given != UNLABELLED, is_among(landmark, named))] = math.inf
        return refuted

    def _stated(self, rows: Int[np.ndarray, " r"]) -> Int[np.ndarray, " n"]:
        """Give landmarks the labels of matched stated rows; return the rows of new landmarks."""
        former, self.label[rows] = self.label[rows], self.given[rows]
        landmark = self.joint.landmark.copy()
        new = ~is_among(self.given[rows], np.append(landmark, self.memory.known.label))
        for label, found in zip(self.given[rows].tolist(), former.tolist(), strict=True):
            if found != UNLABELLED and label not in landmark and self.begins:
                self.label[self.label == found] = landmark[landmark == found] = label
                if found in self.new:
                    self.new.remove(found)
                else:
                    self.merge.append((label, found))
        self.joint = replace(self.joint, landmark=landmark)
        return rows[new & ~is_among(self.given[rows], landmark)]

    def _is_elsewhere(self, number: int, count: tuple[int, int]) -> bool:
        """Return whether a caller's position may be wrong: too few of its echoes match."""
        known, own = self.memory.known, self.label[self.scan.caller == OWN]
        heard = known.source[:, number : number + 1]  # without column before its first landmark
        often = int((known.confirmed[:, np.newaxis] & ~np.isnan(heard)).sum()) >= count[1]
        return often and caller_search.may_have_turned(*count) and bool((own != UNLABELLED).any())

    def _follow_turn(self, number: int, at: int) -> None:
        """Move a moving caller to where its echoes match the map, if it may have turned."""
        direct, rows = self._direct(number), self.rows.with_way & (self.scan.caller == number)
        if direct < 0:
            return
        rows[direct] = False
        joint, stand = self.joint, ~is_among(self.joint.landmark, self.moving)
        there, columns = 3 + 2 * np.flatnonzero(stand), tuple(self._some(rows))

        def costs(mean: Float[np.ndarray, " d"]) -> Float[np.ndarray, "r n"]:
            return pair_costs(columns, mean, joint.covariance, there, at, self.stage.chances)

        self.joint = caller_search.turned(joint, at, float(self.scan.bearing[direct]), costs)

    def _heard_from(self, number: int) -> int | None:
        """Return a caller's index in the joint mean; None if its measurements are unusable."""
        caller = self.callers.get(number)
        if caller is None:
            return UNPLACED
        if not caller.told:
            self._tell(number, caller)
            row = self._direct(number)
            if row < 0 or self.label[row] != caller.label:
                return None
            numbers = self.numbers[[BEARING, RANGE, BEARING_STD, RANGE_STD], row][:, np.newaxis]
            self.joint = with_points(self.joint, [caller.label], tuple(numbers))
            return self._where(caller.label)
        self.named[number] = caller.label
        at = self._where(caller.label)
        fits = self._match_direct(number, caller.label, at)
        return None if not fits else UNPLACED if at < 0 else at

    def finished(self) -> tuple[Memory, Assignment]:
        """Update, delete and merge landmarks by the labelled scan; return memory and assignment."""
        memory, scan, (known, at) = self.memory, self.scan, self._judged()
        known = self.known if self.blind else known
        gone = known.label[known.odds < existence.GONE]
        merge = () if gone.size else self._doubles(known, at)
        if gone.size:
            known = existence.some(known, ~is_among(known.label, gone))
            self.label[is_among(self.label, gone)] = UNLABELLED
        for kept, other in merge:
            self.label[self.label == other] = kept
        if self.numbers is not scan.numbers:
            scan = replace(scan, numbers=self.numbers)
        if scan.direct.size:
            scan = with_callers(scan, self.named)
        after = Memory(
            scan=memory.scan + 1,
            labels=self.labels,
            known=existence.merged(known, merge),
            callers=self.callers,
            pose=self.pose,
            drift=self.model[:2],
            watch=self.watch,
        )
        remove = tuple(sorted(gone.tolist()))
        merge = (*self.merge, *merge)
        again = {} if self.back is None else {self.back: None}
        found = {"label": self.label, "remove": remove, "merge": merge, "scan": scan}
        return after, Assignment(**found, revised=again)

    def _judged(self) -> tuple[Known, Int[np.ndarray, " l"]]:
        """Return all landmark records with updated log odds, and joint-mean indices or -1."""
        scan, rows = self.memory.scan, self.rows
        known = existence.with_new(self.known, self.new, scan, self.where.size)
        missed = np.append(self.missed, np.ones(len(self.new))) if self.new else self.missed
        if self.states:
            given = {*self.given.tolist()} - {UNLABELLED, *self._callers_labels().tolist()}
            known = existence.with_new(known, sorted(given - {*known.label.tolist()}), scan, 1)
            known = existence.merged(known, self.merge)
            known = existence.stated(known, np.array([*given], np.int64))
            each = dict(zip(self.known.label.tolist(), self.missed.tolist(), strict=True))
            missed = np.array([each.get(label, 1.0) for label in known.label.tolist()])
        heard = self.label, rows.caller, rows.level_db, rows.surety
        place = self._place(known.label)
        return existence.judged(known, heard, place, missed, scan), place[1]

    def _place(self, label: Int[np.ndarray, " l"]) -> existence.Place:
        """Return the joint mean, and indices in it of landmarks and callers."""
        return self.joint.mean, places_of(label, self.joint.landmark), self.where, self.roving

    def _doubles(self, known: Known, at: Int[np.ndarray, " l"]) -> tuple[tuple[int, int], ...]:
        """Return the pairs of duplicate landmarks to merge now, as (older, newer) labels."""
        old, apart, asked = existence.asked_of(tuple(known), at, self.memory.scan)
        if not asked.size:
            return ()
        label = known.label[old].tolist()
        places = self.joint, at[old], apart, asked
        pairs, lifetimes = existence.doubles(*places), (known.born[old], known.heard[old])
        if not (pairs or self.watch.lost) and (pairs := existence.drifted(*places, lifetimes)):
            self.watch = watch.alarmed(self.watch, WINDOW - 1, watch.POSE, repaired=True)
        return tuple((label[a], label[b]) for a, b in pairs)

    def _callers_labels(self) -> Int[np.ndarray, " c"]:
        """Return the labels of all callers."""
        return np.array([caller.label for caller in self.callers.values()], np.int64)

    def _another(self) -> int:
        """Return the next unused label for a landmark or a caller."""
        taken = self._callers_labels()
        self.labels += 1
        while self.labels in taken:
            self.labels += 1
        return self.labels

    def _where(self, label: int) -> int:
        """Return the index of a landmark in the joint mean by its label, or -1 if absent."""
        return place_of(label, self.joint.landmark)

    def _direct(self, number: int) -> int:
        """Return the index of a caller's direct call in this scan, or -1 without."""
        direct = self.scan.direct
        return int(direct[number]) if number < direct.size else -1

    def _some(self, rows: Bool[np.ndarray, " m"]) -> Rows:
        """Return the measurements of this scan that a mask selects."""
        return Rows(*part_of(self.rows, np.flatnonzero(rows), 0.0))

    def _tell(self, number: int, caller: CallerState) -> None:
        """Put a caller with a found position on the map, by a range for its direct call."""
        row = self._direct(number)
        if caller.place is None or row < 0 or self.scan.time < caller.place.since:
            return
        x, y = caller.place.at(self.scan.time)
        far = math.hypot(x - self.pose.mean[0], y - self.pose.mean[1])
        self.numbers = self.numbers.copy()
        self.numbers[RANGE, row], self.numbers[RANGE_STD, row] = far, caller.place.std * far
        self.label[row] = self.named[number] = caller.label
        self.callers[number] = replace(caller, told=True, tracks=Tracks())

    def _match_direct(self, number: int, label: int, at: int) -> bool:
        """Label a caller's direct call with its label; return False if a fixed caller's misfits."""
        row = self._direct(number)
        if row < 0:
            return True
        if at >= 0 and number not in self.moves:
            part = part_of(self.rows, np.array([row]), 0.0)
            placed = self.joint.mean, self.joint.covariance, np.array([at]), UNPLACED
            if pair_costs(part, *placed, self.stage.chances)[0, 0] == math.inf:
                return False
        self.label[row] = label
        return True

    def _begin(self, number: int, begun: Int[np.ndarray, " b"]) -> None:
        """Begin a new landmark with each of the given measurements of a caller."""
        given, rows = self.given[begun].tolist(), self.rows
        labels = [self._another() if label == UNLABELLED else label for label in given]
        self.label[begun] = labels
        self.new += [label for label in labels if label not in given]
        aimed = begun[~np.isnan(rows.bearing[begun])]
        if number == OWN and aimed.size:
            numbers = (rows.bearing, rows.way, rows.bearing_std, rows.way_std)
            points = tuple(column[aimed] for column in numbers)
            self.joint = with_points(self.joint, self.label[aimed].tolist(), points)


METHODS = {"nearest": nearest, "marginal": marginal}
"""Matching methods by the name in ``association.method``."""
GATE = 25.0
"""Gate on the squared distance of a measurement, exceeded by 0.5 to 1 % of correct matches."""

VAGUE = 0.0012
"""Most clutter expected within the uncertainty of a pair: `Chances.vague` times the clutter
density."""


def left_out(config: Config, scans: Iterable[Scan]) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the stds of the measurements that data association discards, by setting.

    Keys are ``bearing_std`` [rad] and ``way_std`` [m]; a setting that discards nothing is absent.
    """
    if config.association.method not in METHODS:
        return {}
    settings, found = config.association, {"bearing_std": [], "way_std": []}
    for scan in scans:
        for name, limits in (
            ("bearing_std", (settings.max_angle_std, math.inf, math.inf)),
            ("way_std", (math.inf, settings.max_range_std, math.inf)),
        ):
            rows = rows_of_scan(scan, limits, _assumed(config))
            found[name].append(getattr(rows, name)[~rows.usable & (scan.landmark == UNLABELLED)])
    joined = {name: np.concatenate([np.empty(0), *parts]) for name, parts in found.items()}
    return {name: stds for name, stds in joined.items() if stds.size}


def _assumed(config: Config) -> tuple[float, float, float]:
    """Return the default standard deviations of bearing, range and excess path from a config."""
    told = config.filter
    return told.bearing_std, told.range_std, told.excess_path_std


def association_of(config: Config, labels: int = 0) -> Association | None:
    """Build the data association that ``association.method`` names; None for known labels.

    ``labels``: the largest label that scans state.
    A class from outside, ``module:Class``, is built by its ``from_config(config)``, or as a
    dataclass with an optional field ``config`` for all settings. Raises InputError if it is
    missing, is no `Association` or cannot be built.
    """
    name, settings = config.association.method, config.association
    if name == KNOWN:
        return None
    if name in METHODS:
        stated, vague = config.filter, VAGUE / settings.clutter_rate
        if stated.noise == "constant":  # no landmark is known better after one detection
            vague = max(vague, BARELY * stated.bearing_std * stated.range_std)
        chances = Chances(
            gate=GATE,
            clutter=settings.clutter_rate,
            bearing_clutter=20.0 * settings.clutter_rate,
            detection=settings.detection_rate,
            vague=vague,
        )
        stds = {"bearing_std": settings.max_angle_std, "way_std": settings.max_range_std}
        return Sequential(
            match=METHODS[name],
            chances=tuple(chances),
            limits=Limits(**stds, assumed=_assumed(config)),
            motion=(stated.caller_speed_std, stated.caller_walk_std),
            labels=labels,
        )
    if not names_class(name):
        expected = ", ".join(map(repr, [KNOWN, *METHODS]))
        raise InputError(f"association.method: found {name!r}, expected {expected} or module:Class")
    return build(ASSOCIATION, name, class_of(ASSOCIATION, name), (config,), {"config": config})
