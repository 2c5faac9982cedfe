from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config, InputError, RayConfig
from pipistrelle.detection.scans import UNLABELLED, labelled, make_scan
from pipistrelle.estimation.beliefs import Belief, Gaussian, completed
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.ekf.filter import EkfSlam
from pipistrelle.estimation.ekf.gaussian import INVARIANT, LINEAR
from pipistrelle.estimation.motion import Motion
from pipistrelle.geometry import wrap
from reference.missions import scan_of, scan_with

NAN, RNG = np.nan, np.random.default_rng


def test_labels_of_a_scan_are_taken_without_a_copy():
    scan = scan_of((3, 5.0, 0.3), (8, NAN, 1.0))
    assert labelled(scan, scan.landmark) is scan


def test_a_row_without_a_label_never_reaches_a_filter():
    scan = scan_of((3, 5.0, 0.3), (UNLABELLED, NAN, 1.0), (UNLABELLED, 2.0, 2.0))
    assert labelled(scan, scan.landmark).landmark.tolist() == [3]


def test_rows_of_one_label_become_one_whatever_their_order():
    rows = [(7, 4.0, 0.2), (7, NAN, 0.5), (7, NAN, -0.1), (2, 3.0, 1.0)]
    for order in permutations(rows):
        label, distance, bearing = zip(*order, strict=True)
        one = labelled(scan_with(np.full(4, UNLABELLED), bearing, distance), np.array(label))
        assert sorted(one.landmark.tolist()) == [2, 7]
        at = one.landmark.tolist().index(7)
        assert one.bearing[at] == pytest.approx(0.2, abs=1e-12)
        assert one.range[at] == 4.0


def test_rows_without_a_bearing_come_last_in_any_order():
    rows = [(4, 0.3, 3.0, 1), (4, NAN, 3.0, 2), (5, 0.9, 2.0, 1)]
    for order in permutations(rows):
        label, bearing, excess_path, caller = map(np.array, zip(*order, strict=True))
        scan = make_scan(0.0, label, bearing, caller=caller, excess_path=excess_path)
        one = labelled(scan, scan.landmark)
        assert np.isnan(one.bearing).tolist() == [False, False, True]
        assert (one.landmark[2], one.caller[2]) == (4, 2)
        assert labelled(one, one.landmark) is one


def test_the_mean_of_directions_is_taken_across_the_cut_behind():
    scan = scan_with([5, 5], [np.pi - 0.1, -np.pi + 0.3], [NAN, NAN])
    (bearing,) = labelled(scan, scan.landmark).bearing
    assert bearing == pytest.approx(-np.pi + 0.1, abs=1e-12)


def test_rows_with_deviations_merge_by_inverse_variance():
    rng, stds = np.random.default_rng(5), np.array([0.01, 0.03, 0.02])
    drawn = rng.normal(0.0, stds, (4000, 3))
    scans = [make_scan(0.0, np.full(3, 4), row, bearing_std=stds) for row in drawn]
    merged = [labelled(scan, scan.landmark) for scan in scans]
    error = np.array([scan.bearing[0] for scan in merged])
    claimed = merged[0].bearing_std[0]
    assert claimed == pytest.approx(np.sum(stds**-2.0) ** -0.5, rel=1e-12)
    assert np.std(error) == pytest.approx(claimed, rel=4.9 / np.sqrt(2 * error.size))


def test_a_row_without_deviation_makes_the_merged_mean_plain():
    scan = make_scan(0.0, np.full(2, 4), np.array([0.1, 0.3]), bearing_std=np.array([0.01, NAN]))
    merged = labelled(scan, scan.landmark)
    assert merged.bearing[0] == pytest.approx(0.2, abs=1e-12)
    assert np.isnan(merged.bearing_std[0])


@pytest.mark.parametrize(
    "label", [[1], [1, 2, 3, 4], [1.0, 2.0, 3.0], [1, NAN, 2], [1, 2, -2], [[1], [2], [3]], "abc"]
)
def test_invalid_labels_are_refused(label):
    scan = scan_of((UNLABELLED, 5.0, 0.3), (UNLABELLED, NAN, 1.0), (UNLABELLED, NAN, 2.0))
    message = r"association at 0\.0 s: found labels .* expected 3 whole"
    with pytest.raises(InputError, match=message):
        labelled(scan, label)
    assert labelled(scan, [4, UNLABELLED, 4]).landmark.tolist() == [4]


def test_the_first_range_is_kept_and_excess_paths_are_not_merged():
    scan = make_scan(
        0.0, np.full(4, 4), np.full(4, 0.1), bearing_std=0.01, caller=np.array([3, 0, 1, 2]),
        range=np.array([NAN, 5.0, 9.0, NAN]), range_std=np.array([0.9, 0.2, 0.3, 0.4]),
        excess_path=np.array([NAN, NAN, 7.0, 6.0]), excess_path_std=np.array([0.8, 0.7, 0.5, 0.6]),
    )  # fmt: skip
    merged = labelled(scan, scan.landmark)
    assert merged.landmark.tolist() == [4, 4]
    assert (merged.range[0], merged.range_std[0], merged.bearing[0]) == (5.0, 0.2, 0.1)
    assert np.isnan([merged.range[1], merged.bearing[1]]).all()
    assert merged.excess_path.tolist() == [7.0, 6.0]
    assert merged.excess_path_std.tolist() == [0.5, 0.6]
    assert merged.caller.tolist() == [1, 2]
    assert labelled(merged, merged.landmark) is merged


def test_merged_rows_are_of_the_call_of_the_first_of_them():
    scan = make_scan(0.0, np.array([4, 6, 4, 6]), np.zeros(4), caller=np.array([2, 1, 0, 3]))
    merged = labelled(scan, scan.landmark)
    assert (merged.landmark.tolist(), merged.caller.tolist()) == ([4, 6], [2, 1])


def test_the_level_of_merged_rows_is_the_highest_that_is_known():
    for level in ([20.0, NAN], [NAN, 20.0], [20.0, 3.0], [3.0, 20.0]):
        scan = scan_with([4, 4], [0.1, 0.1], level_db=np.array(level))
        assert labelled(scan, scan.landmark).level_db.tolist() == [20.0]


def test_an_empty_or_unlabelled_scan_gives_an_empty_scan():
    empty = scan_of()
    assert labelled(empty, empty.landmark).landmark.size == 0
    nobody = scan_of((UNLABELLED, 2.0, 0.1))
    assert labelled(nobody, nobody.landmark).landmark.size == 0


def mapped(error, seed=5):
    """Return an EKF's belief of a drive past three landmarks and a caller, all placed."""
    motion = Motion(model="unicycle", control_std=(0.1, 0.05))
    slam = EkfSlam(motion=motion, rays=RayConfig(), error=error)
    start = Gaussian(mean=np.array([3.0, -2.0, 0.4]), covariance=1e-4 * np.eye(3))
    points, rng = {2: (7.0, 1.0), 4: (7.03, 1.02), 7: (6.0, -5.0), 9: (12.0, 3.0)}, RNG(seed)
    belief = slam.init(start)
    pose = start.mean
    for _ in range(4):
        belief, poses = slam.predict(belief, np.array([[1.0, 0.2]]), np.array([0.5]))
        pose = poses.mean[-1]
        seen = [measured(pose, points[label]) for label in points]
        bearing, distance = np.array(seen).T + rng.normal(0.0, 0.01, (2, len(seen)))
        stds = {"bearing_std": 0.05, "range_std": 0.1}
        scan = make_scan(0.0, np.array([*points]), bearing, range=distance, **stds)
        belief = slam.update(belief, scan)
    return slam, belief


def measured(pose, point):
    """Return bearing and range of a point."""
    east, north = np.subtract(point, pose[:2])
    return wrap(np.arctan2(north, east) - pose[2]), np.hypot(east, north)


@pytest.mark.parametrize("error", [LINEAR, INVARIANT])
def test_the_joint_gaussian_contains_the_pose_and_map_of_the_belief(error):
    _, belief = mapped(error)
    joint, pose, points = belief.joint(), belief.pose(), belief.landmarks()
    assert joint.landmark.tolist() == points.landmark.tolist()
    np.testing.assert_array_equal(joint.mean, np.concatenate((pose.mean, points.mean.ravel())))
    np.testing.assert_allclose(joint.covariance[:3, :3], pose.covariance, rtol=0, atol=1e-15)
    for row, own in enumerate(points.covariance):
        block = slice(3 + 2 * row, 5 + 2 * row)
        np.testing.assert_allclose(joint.covariance[block, block], own, rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(joint.covariance)[0] > 0.0


@pytest.mark.parametrize("error", [LINEAR, INVARIANT])
def test_landmarks_that_are_one_meet_as_the_kalman_filter_has_it_and_others_are_forgotten(error):
    _, belief = mapped(error)
    joint, edited_belief = belief.joint(), belief.edited((7,), ((2, 4),))
    assert edited_belief.landmarks().landmark.tolist() == [2, 9]
    H = np.zeros((2, joint.mean.size))
    H[:, 3:5], H[:, 5:7] = np.eye(2), -np.eye(2)
    S = H @ joint.covariance @ H.T + 1e-6 * np.eye(2)
    gain = joint.covariance @ H.T @ np.linalg.inv(S)
    mean = joint.mean - gain @ (H @ joint.mean)
    covariance = joint.covariance - gain @ S @ gain.T
    kept = [0, 1, 2, 3, 4, 9, 10]
    after = edited_belief.joint()
    # The invariant error moves the map by an exponential, equal to first order.
    near = 1e-9 if error == LINEAR else 5e-4
    np.testing.assert_allclose(after.mean, mean[kept], rtol=0, atol=near)
    if error == LINEAR:
        np.testing.assert_allclose(after.covariance, covariance[np.ix_(kept, kept)], atol=1e-12)
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_a_merge_does_not_inform_the_invariant_filters_heading():
    _, belief = mapped(INVARIANT)
    far = replace(belief, covariance=belief.covariance + np.diag([0, 0, 1.0] + [0.0] * 8))
    after = far.edited((), ((2, 4),))
    assert after.covariance[2, 2] > far.covariance[2, 2] - belief.covariance[2, 2] - 1e-9


@pytest.mark.parametrize("error", [LINEAR, INVARIANT])
def test_merging_incompatible_landmarks_changes_no_other_estimate(error):
    _, belief = mapped(error)
    merged, removed = belief.edited((), ((2, 7),)).joint(), belief.edited((7,), ()).joint()
    assert merged.landmark.tolist() == removed.landmark.tolist() == [2, 4, 9]
    np.testing.assert_array_equal(merged.mean, removed.mean)
    np.testing.assert_array_equal(merged.covariance, removed.covariance)


def test_of_a_ray_and_a_placed_landmark_the_placed_one_stays_and_of_two_rays_the_first():
    slam, belief = mapped(LINEAR)
    rays = make_scan(0.0, np.array([20, 21]), np.array([0.1, 0.9]), bearing_std=0.05)
    belief = slam.update(belief, rays)
    place = belief.landmarks().mean[belief.landmarks().landmark == 2]
    for pair in ((2, 20), (20, 2)):
        points = belief.edited((), (pair,)).landmarks()
        assert sorted(points.landmark.tolist()).count(pair[0]) == 1
        assert pair[1] not in points.landmark
        np.testing.assert_array_equal(points.mean[points.landmark == pair[0]], place)
    both = belief.edited((), ((20, 21),)).landmarks()
    assert 21 not in both.landmark
    assert (both.landmark == 20).sum() == (belief.landmarks().landmark == 20).sum()


@pytest.mark.parametrize(
    ("remove", "merge"), [((5,), ()), ((), ((2, 5),)), ((), ((2, 2),)), ((-1,), ())]
)
def test_landmarks_that_cannot_be_changed_are_refused(remove, merge):
    _, belief = mapped(LINEAR)
    with pytest.raises(InputError, match="association: found"):
        belief.edited(remove, merge)


def test_a_moving_caller_goes_with_its_velocity_and_is_never_merged():
    slam, belief = mapped(LINEAR)
    heard = {"range": np.array([6.0]), "range_std": 0.1, "bearing_std": 0.05}
    scan = make_scan(0.0, np.array([51]), np.array([0.3]), **heard)
    chased = slam.update(belief, replace(scan, moving=np.array([51])))
    assert chased.mean.size == belief.mean.size + 4
    assert 51 in chased.joint().landmark
    assert chased.edited((51,), ()).mean.size == belief.mean.size
    with pytest.raises(InputError, match="51 to merge; expected two that stand"):
        chased.edited((), ((2, 51),))


def test_a_belief_that_cannot_be_edited_is_refused():
    with pytest.raises(InputError, match=r"a Gaussian cannot; expected a belief with edited"):
        completed(Gaussian(mean=np.zeros(3), covariance=np.eye(3)), Belief).edited((4,), ())
    belief = mapped(LINEAR)[1]
    assert belief.edited((), ()) is belief


@pytest.mark.parametrize("name", ["jcbb", "a:", ":B", "a b:C"])
def test_a_method_that_is_no_name_is_refused(name):
    config = Config(association=AssociationConfig(method=name))
    expected = "expected 'known', 'nearest', 'marginal' or module:Class"
    with pytest.raises(InputError, match=expected):
        association_of(config)
