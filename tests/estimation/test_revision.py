"""A session goes back: landmarks that were none leave no trace, and scans are associated again."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.detection.scans import RANGE, UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import Assignment, Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, entry
from pipistrelle.estimation.data_association.pairs import nearest
from pipistrelle.estimation.data_association.rows import CallerPlace, CallerState, Memory
from pipistrelle.estimation.data_association.sequential import Sequential
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.session import REMEMBERED, Session
from pipistrelle.estimation.smoother.history import STRETCH
from pipistrelle.estimation.smoother.sweep import eliminated

MOTION = Motion(model="unicycle", control_std=(0.05, 0.02))
PLACES = np.array([[4.0, 1.0], [5.0, -3.0], [2.0, 5.0]])
GHOST, GONE_AT = 9, 6


@dataclass(frozen=True)
class Script:
    """Labels rows as the scan's number says, and at one scan asks for more."""

    labels: dict
    remove: dict = field(default_factory=dict)
    merge: dict = field(default_factory=dict)
    revised: dict = field(default_factory=dict)

    def start(self):
        return 0

    def associate(self, number, belief, scan):
        label = np.array(self.labels.get(number, [1, 2, 3])[: scan.landmark.size])
        more = {key: getattr(self, key).get(number, ()) for key in ("remove", "merge")}
        return number + 1, Assignment(label=label, revised=self.revised.get(number, {}), **more)


def driven(name, script, scans=10, ghosts=()):
    """Return a session that has driven and heard, with rows of a ghost in some scans."""
    config = Config.model_validate({"fastslam": {"particles": 8}})
    start = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
    slam = entry(name).build(config, MOTION)
    session = Session(slam, start, np.random.default_rng(7), association=script)
    rng = np.random.default_rng(4)
    for k in range(scans):
        session.move(np.array([[0.4, 0.05]]), np.array([0.5]))
        places = np.vstack([PLACES, [-3.0 + 0.3 * k, 2.0]]) if k in ghosts else PLACES
        off = places - [0.2 * (k + 1), 0.0]
        noise, stds = rng.normal(0.0, 0.02, (2, 4)), {"bearing_std": 0.02, "range_std": 0.05}
        bearing, far = (np.arctan2(off[:, 1], off[:, 0]), np.hypot(*off.T)) + noise[:, : len(off)]
        unknown = np.full(len(off), UNLABELLED)
        session.hear(make_scan(float(k), unknown, bearing, range=far, **stds))
    return session


def assert_same(session, other):
    one, other = session.belief.joint(), other.belief.joint()
    assert one.landmark.tolist() == other.landmark.tolist()
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-7)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-8)


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
@pytest.mark.parametrize("ghosts", [(2,), (2, 3, 4)])
def test_a_removed_ghost_landmark_leaves_no_trace(name, ghosts):
    labels = {k: [1, 2, 3, GHOST if k < 4 else 8] for k in ghosts}
    merge = {5: ((GHOST, 8),)} if 4 in ghosts else {}
    haunted = driven(name, Script(labels, {GONE_AT: (GHOST,)}, merge), ghosts=ghosts)
    plain = driven(name, Script({}))
    assert_same(haunted, plain)
    assert haunted.labels[2].tolist() == [1, 2, 3, UNLABELLED]


@pytest.mark.parametrize(
    ("ghosts", "updates"), [({2: GHOST, 3: 8}, 10), ({1: 8, 2: GHOST, 4: GHOST}, 12)]
)
def test_scans_repeat_from_a_ghosts_second_measurement(ghosts, updates, monkeypatch):
    update, used = Session._update, []
    monkeypatch.setattr(Session, "_update", lambda *told: used.append(told) or update(*told))
    script = Script({k: [1, 2, 3, label] for k, label in ghosts.items()}, {GONE_AT: (GHOST, 8)})
    haunted = driven("iekf", script, ghosts=ghosts)
    assert len(used) == updates
    assert_same(haunted, driven("iekf", Script({})))


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_landmark_from_before_all_that_is_remembered_is_removed_too(name):
    ghosts = STRETCH + 2, STRETCH + 5
    late = ghosts[1] + STRETCH + REMEMBERED
    script = Script({k: [1, 2, 3, GHOST] for k in ghosts}, {late: (GHOST,)})
    session = driven(name, script, scans=late + 3, ghosts=ghosts)
    belief = session.belief
    assert GHOST not in belief.labels()
    assert {*belief.landmarks().landmark.tolist()} == {1, 2, 3}
    if name == "smoother":
        whole = eliminated(belief.history, belief.noise, belief.solution.points)
        np.testing.assert_allclose(belief.solution.state, whole.state, rtol=1e-9)
        np.testing.assert_allclose(belief.solution.covariance, whole.covariance, rtol=1e-9)


@pytest.mark.parametrize("name", CATALOGUE)
def test_two_labels_of_one_landmark_become_one(name):
    labels = {key: [1, 2, 7, GHOST] for key in range(4)}
    session = driven(name, Script(labels, {8: (GHOST,)}, {7: ((3, 7),)}), ghosts=(2,))
    assert sorted(session.belief.labels()) == [1, 2, 3]
    assert session.labels[2].tolist() == [1, 2, 3, UNLABELLED]
    pose, found = driven(name, Script({})).belief.pose().mean, session.belief.landmarks()
    np.testing.assert_allclose(session.belief.pose().mean, pose, atol=0.1)
    assert np.hypot(*(found.mean[found.landmark == 3][0] - PLACES[2])) < 0.3


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_joint_gaussian_contains_the_pose_and_map_of_the_belief(name):
    session = driven(name, Script({}))
    joint, pose = session.belief.joint(), session.belief.pose()
    assert sorted(joint.landmark.tolist()) == [1, 2, 3]
    np.testing.assert_allclose(joint.mean[:3], pose.mean, atol=1e-9)
    np.testing.assert_allclose(joint.covariance[:3, :3], pose.covariance, atol=1e-6)
    np.testing.assert_allclose(joint.covariance, joint.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(joint.covariance).min() > -1e-12
    assert np.abs(joint.mean[3:].reshape(-1, 2) - PLACES[joint.landmark - 1]).max() < 0.5


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
def test_a_scan_revised_later_equals_a_scan_revised_at_once(name):
    heard = driven(name, Script({})).state().past[1].original
    numbers = heard.numbers + 0.03 * (np.arange(8)[:, np.newaxis] == RANGE) * [1, 0, 0]
    stated = replace(heard, landmark=np.array([7, 2, UNLABELLED]), numbers=numbers)
    first = {1: [1, UNLABELLED, UNLABELLED]}
    late = driven(name, Script(first, revised={GONE_AT: {1: stated, -40: stated}}))
    at_once = driven(name, Script(first, revised={2: {1: stated}}))
    assert late.labels[1].tolist() == [1, 2, UNLABELLED], "a row that has a label keeps it"
    plain = driven(name, Script(first))
    assert np.abs(plain.belief.pose().mean - late.belief.pose().mean).max() > 1e-5
    assert_same(late, at_once)


@dataclass(frozen=True)
class Finder:
    """Finds facts one after the other, each at one scan, and names landmarks by their number."""

    found: tuple
    since: int = 0

    def start(self):
        return 0, 0

    def carried(self, memory, later):
        return memory[0], later[1]

    def associate(self, memory, belief, scan):
        number, facts = memory
        new = number in self.found[facts : facts + 1]
        label = np.arange(1, 4) + 10 * (facts + new)
        revised = {self.since: None} if new else {}
        return (number + 1, facts + new), Assignment(label=label, revised=revised)


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
@pytest.mark.parametrize(
    ("found", "since", "facts"),
    [
        ((6,), 3, [0] * 3 + [1] * 7),
        ((0,), 0, [1] * 10),
        ((6, 4), 0, [2] * 10),
        ((6, 6), 0, [1] * 6 + [2] * 4),
    ],
    ids=["later", "first", "within a repetition", "once by a scan"],
)
def test_remembered_scans_are_associated_again_with_later_facts(name, found, since, facts):
    session = driven(name, Finder(found, since))
    labels = [[1 + 10 * number, 2 + 10 * number, 3 + 10 * number] for number in facts]
    assert [label.tolist() for label in session.labels] == labels
    assert session.state().memory == (10, len(found))
    assert_same(session, driven(name, Script(dict(enumerate(labels)))))


class Renamed(Finder):
    """Removes a landmark, finds a fact, gives the label to another, and removes two more."""

    def associate(self, memory, belief, scan):
        number, facts = memory
        after, assignment = super().associate(memory, belief, scan)
        third = UNLABELLED if number < 3 else 8 if number in (6, 7) and after[1] else 3
        label = [1, GHOST, third] if after[1] else [1, 2, third, GHOST]
        remove = {(6, 0): (GHOST,), (9, 1): (3,), (10, 1): (8,)}.get((number, facts), ())
        label = np.array(label[: scan.landmark.size])
        return after, replace(assignment, label=label, remove=remove)


def test_a_removed_label_may_be_assigned_again():
    session = driven("iekf", Renamed((7,), 5), scans=12, ghosts=(2,))
    labels = [[1, 2, -1]] * 5 + [[1, GHOST, -1]] * 4 + [[1, GHOST, 3]] * 3
    plain = driven("iekf", Script(dict(enumerate(labels))), scans=12)
    assert [label[:3].tolist() for label in session.labels] == labels
    assert_same(session, plain)


def test_a_place_is_carried_once():
    place = CallerPlace(3.0, 4.0)
    told = CallerState(label=5, place=place, told=True)
    later = replace(told, failed=True)
    others = {2: CallerState(label=9, place=place), 3: CallerState(label=11)}
    stage = Sequential(match=nearest, chances=(25.0, 0.06, 1.3, 0.8, 0.02))
    after = stage.carried(Memory(labels=7, callers={1: told}), Memory(callers={1: later} | others))
    assert {*after.callers} == {1, 2}
    assert (after.callers[1], after.callers[2].place) == (told, place)
    assert (after.callers[2].label, after.labels) == (8, 8)
