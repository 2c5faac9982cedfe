"""A session goes back: landmarks that were none leave no trace, and scans are associated again."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.detection.scans import RANGE, UNLABELLED, make_scan
from pipistrelle.estimation.association import Assignment
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, entry
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
    again: dict = field(default_factory=dict)
    earlier: dict = field(default_factory=dict)

    def start(self):
        return 0

    def associate(self, number, belief, scan):
        label = np.array(self.labels.get(number, [1, 2, 3])[: scan.landmark.size])
        return number + 1, Assignment(
            label=label, remove=self.remove.get(number, ()), merge=self.merge.get(number, ()),
            again=self.again.get(number), earlier=self.earlier.get(number, {}),
        )  # fmt: skip


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
        noise = rng.normal(0.0, 0.02, (2, 4))[:, : len(off)]
        heard = {"range": np.hypot(*off.T) + noise[1], "bearing_std": 0.02, "range_std": 0.05}
        bearing = np.arctan2(off[:, 1], off[:, 0]) + noise[0]
        session.hear(make_scan(float(k), np.full(len(off), UNLABELLED), bearing, **heard))
    return session


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
@pytest.mark.parametrize("ghosts", [(2,), (2, 3, 4)])
def test_a_removed_ghost_landmark_leaves_no_trace(name, ghosts):
    labels = {k: [1, 2, 3, GHOST] for k in ghosts}
    haunted = driven(name, Script(labels, remove={GONE_AT: (GHOST,)}), ghosts=ghosts)
    plain = driven(name, Script({}))
    for one, other in (
        (haunted.belief.pose(), plain.belief.pose()),
        (haunted.belief.landmarks(), plain.belief.landmarks()),
    ):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-7)
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-8)
    assert GHOST not in haunted.belief.labels()
    assert haunted.labels[2].tolist() == [1, 2, 3, UNLABELLED]


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_landmark_from_before_all_that_is_remembered_is_removed_too(name):
    ghosts = STRETCH + 2, STRETCH + 5
    late = ghosts[1] + STRETCH + REMEMBERED
    script = Script({k: [1, 2, 3, GHOST] for k in ghosts}, remove={late: (GHOST,)})
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
    labels = {k: [1, 2, 7] for k in range(4)}
    session = driven(name, Script(labels, merge={7: ((3, 7),)}))
    assert sorted(session.belief.labels()) == [1, 2, 3]
    plain = driven(name, Script({}))
    np.testing.assert_allclose(session.belief.pose().mean, plain.belief.pose().mean, atol=0.1)
    found = session.belief.landmarks()
    place = found.mean[found.landmark.tolist().index(3)]
    assert np.hypot(*(place - PLACES[2])) < 0.3


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_joint_gaussian_contains_the_pose_and_map_of_the_belief(name):
    session = driven(name, Script({}))
    joint, pose = session.belief.joint(), session.belief.pose()
    assert sorted(joint.landmark.tolist()) == [1, 2, 3]
    np.testing.assert_allclose(joint.mean[:3], pose.mean, atol=1e-9)
    np.testing.assert_allclose(joint.covariance[:3, :3], pose.covariance, atol=1e-6)
    np.testing.assert_allclose(joint.covariance, joint.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(joint.covariance).min() > -1e-12
    error = joint.mean[3:].reshape(-1, 2) - PLACES[joint.landmark - 1]
    assert np.abs(error).max() < 0.5


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
def test_a_scan_revised_later_equals_a_scan_revised_at_once(name):
    heard = driven(name, Script({})).state().past[1].original
    stated = replace(
        heard, landmark=np.array([7, 2, UNLABELLED]), numbers=heard.numbers + np.zeros((8, 1))
    )
    stated.numbers[RANGE, 0] += 0.03
    first = {1: [1, UNLABELLED, UNLABELLED]}
    late = driven(name, Script(first, earlier={GONE_AT: {1: stated, -40: stated}}))
    at_once = driven(name, Script(first, earlier={2: {1: stated}}))
    assert late.labels[1].tolist() == [1, 2, UNLABELLED], "a row that has a label keeps it"
    plain = driven(name, Script(first))
    assert np.abs(plain.belief.pose().mean - late.belief.pose().mean).max() > 1e-5
    for one, other in (
        (late.belief.pose(), at_once.belief.pose()),
        (late.belief.landmarks(), at_once.belief.landmarks()),
    ):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-7)
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-8)


class Informed(Script):
    """Calls the second landmark another name once that is known."""

    def start(self):
        return (0, 2)

    def informed(self, memory, news):
        return (memory[0], news)

    def associate(self, memory, belief, scan):
        number, name = memory
        again = 5 if number == GONE_AT and name == 2 else None
        return (number + 1, name), Assignment(label=np.array([1, name, 3]), again=again)


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
def test_remembered_scans_are_associated_again_with_new_information(name):
    session = driven(name, Informed({}))
    assert all(label.tolist() == [1, 5, 3] for label in session.labels)
    assert len(session.labels) == 10
    plain = driven(name, Script({k: [1, 5, 3] for k in range(10)}))
    np.testing.assert_allclose(session.belief.pose().mean, plain.belief.pose().mean, atol=1e-12)


def test_an_association_that_cannot_be_informed_is_refused():
    with pytest.raises(InputError, match=r"a Script has no informed\(memory, news\)"):
        driven("ekf", Script({}, again={GONE_AT: 5}))


class Renamed(Informed):
    """Removes a landmark, then is informed, and gives its label to another."""

    def associate(self, memory, belief, scan):
        number, name = memory
        if name == 5:
            return (number + 1, name), Assignment(label=np.array([1, GHOST, 3]))
        ghost = [1, 2, 3, GHOST][: scan.landmark.size]
        remove = (GHOST,) if number == 4 else ()
        again = 5 if number == GONE_AT else None
        return (number + 1, name), Assignment(label=np.array(ghost), remove=remove, again=again)


def test_a_removed_label_may_be_assigned_again():
    session = driven("iekf", Renamed({}), ghosts=())
    assert sorted(session.belief.labels()) == [1, 3, GHOST]
    haunted = driven("iekf", Renamed({}), scans=6, ghosts=(2,))
    assert sorted(haunted.belief.labels()) == [1, 2, 3]
    last = session.labels[-1].copy()
    session._remove((3,))
    assert sorted(session.belief.labels()) == [1, GHOST], "and no more goes than is asked for"
    assert last.tolist() == [1, GHOST, 3]
