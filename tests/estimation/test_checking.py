"""What filters refuse of what they are handed, step by step, and what they take as it is meant."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import Config, FastSlamConfig, InputError
from pipistrelle.detection.scans import NO_CALLERS, make_scan, with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.catalogue import CATALOGUE, entry
from pipistrelle.estimation.motion import Motion
from reference.missions import BICYCLE, START, scan_of

UNICYCLE = Motion(model="unicycle", control_std=(0.1, 0.1))
POSES = Motion(model="poses", control_std=(0.005, 0.003, 0.006))
SCAN = scan_of((3, 5.0, 0.3), (8, np.nan, 1.0))
TIMED = make_scan(
    0.5, np.array([3, 8]), np.array([0.3, np.nan]), caller=np.array([1, 2]), bearing_std=0.1,
    excess_path=np.array([3.0, 5.0]), excess_path_std=0.1,
)  # fmt: skip


def answers(belief):
    pose, rows = belief.pose(), belief.landmarks()
    parts = (pose.mean, pose.covariance, rows.landmark, rows.mean, rows.covariance, rows.weight)
    return [part.copy() for part in parts]


@pytest.fixture(params=CATALOGUE)
def build(request):
    """Return the filter of a motion model."""
    config = Config(fastslam=FastSlamConfig(particles=20))
    return lambda motion: entry(request.param).build(config, motion)


@pytest.fixture
def refused(build):
    """Have a filter refuse what is done with it and its belief, which must not change."""

    def refused(action, said, motion=BICYCLE):
        slam, rng = build(motion), np.random.default_rng(7)
        belief = slam.update(slam.init(START), SCAN, rng)
        before = answers(belief)
        with pytest.raises(InputError, match=said):
            action(slam, belief, rng)
        for now, then in zip(answers(belief), before, strict=True):
            np.testing.assert_array_equal(now, then)

    return refused


FULL = [0.1, 0.0, 0.0, 1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]


def poses(place, value):
    """Return a motion of which a number is another."""
    return [[value if k == place else number for k, number in enumerate(FULL)]]


@pytest.mark.parametrize(
    ("motion", "controls", "dt", "said"),
    [
        (POSES, np.full((30, 3), 0.1), np.ones(1), r"controls of float64 \(30, 3\) and times of f"),
        (POSES, [[0.1, 0.02]], np.ones(1), "a row of 3 or 9 controls for each step of a poses mod"),
        (POSES, [[0.1, 0.02, 0.0]], np.ones(5), r"times of float64 \(5,\)"),
        (BICYCLE, [0.1, 0.02], 0.2, r"float64 \(2,\) and times of float64 \(\), expected numbers"),
        (BICYCLE, [[0.1, 0.02], [0.1]], [0.2, 0.2], "found controls of rows of unlike lengths"),
        (BICYCLE, [["0.1", "0.2"]], [0.2], "expected numbers: a row of 2 controls"),
        (BICYCLE, None, None, "found controls of object"),
        (BICYCLE, [[0.1, np.nan]], [0.2], r"found the controls \[\[0.1, nan\]\] during \[0.2\] s"),
        (BICYCLE, [[2e4, 0.0]], [0.2], "a speed up to 10000 m/s, an angle up to 10000 rad"),
        (BICYCLE, [[0.1, -2e4]], [0.2], "a speed up to 10000 m/s, an angle up to 10000 rad"),
        (UNICYCLE, [[0.1, 2e4]], [0.2], "a rate up to 10000 rad/s"),
        (POSES, poses(0, 2e6), [0.2], r"moves up to 1e\+06 m and a turn up to 10000 rad"),
        (POSES, poses(2, 2e4), [0.2], "a turn up to 10000 rad"),
        (BICYCLE, [[0.1, 0.0]], [1e9], "times above 0, up to 100000 s"),
        (BICYCLE, [[0.1, 0.0]], [0.0], "times above 0"),
        (BICYCLE, [[0.1, 0.0]], [np.inf], "times above 0"),
        (POSES, poses(3, np.nan), [0.2], "perhaps with a covariance: all six numbers, or NaN"),
        (POSES, poses(3, -1e-4), [0.2], "with a covariance"),
        (POSES, poses(4, 2e-4), [0.2], "with a covariance"),
        (POSES, [[*FULL[:3], 1, 0.9, 0.9, 1, -0.9, 1]], [0.2], "with a covariance"),
    ],
)
def test_controls_that_are_none_of_the_model_are_refused(refused, motion, controls, dt, said):
    refused(lambda slam, belief, rng: slam.predict(belief, controls, dt, rng), said, motion)


def raw(**columns):
    """Return a scan of columns that nobody looked at."""
    return replace(SCAN, time=0.5, **columns)


@pytest.mark.parametrize(
    ("scan", "said"),
    [
        ([1, 2], r"update: found \[1, 2\], expected a Scan"),
        (
            partial(raw, numbers=SCAN.numbers[:6]),
            r"numbers float64 \(6, 2\); expected whole numbers \(m\)",
        ),
        (partial(raw, caller=np.zeros(3, int)), r"caller int64 \(3,\)"),
        (
            partial(raw, landmark=np.array([3.0, 8.0])),
            r"scan at 0.5 s: found landmark float64 \(2,\)",
        ),
        (partial(raw, landmark=np.array([[3, 8]])), r"landmark int64 \(1, 2\)"),
        (partial(raw, callers=None), "callers object"),
        (partial(raw, callers=np.array([-1, -7])), r"the callers' labels \[-1, -7\]"),
        (partial(raw, moving=np.array([-1])), r"and \[-1\] for who moves"),
        (partial(raw, caller=np.array([0, -1])), r"callers below 0 for the landmarks \[8\]"),
        (
            partial(raw, landmark=np.array([3, -2])),
            r"the labels \[-2\]; expected whole numbers from 0 on",
        ),
        (partial(raw, landmark=np.array([3, 2**53])), "the labels"),
        (
            partial(raw, landmark=np.array([8, 8])),
            r"two bearings by one call for the landmarks \[8\]",
        ),
        (with_columns(SCAN, bearing=np.nan, range=np.nan), r"can use, for the landmarks \[3, 8\]"),
        (with_columns(SCAN, bearing=np.array([np.inf, 1.0])), "numbers that no filter can use"),
        (with_columns(SCAN, range=0.0), r"can use, for the landmarks \[3, 8\]"),
        (with_columns(SCAN, range=2e6), "numbers that no filter can use"),
        (with_columns(TIMED, excess_path=np.nan), r"can use, for the landmarks \[8\]"),
        (with_columns(SCAN, bearing_std=np.nan), r"no standard deviations .* \[3, 8\]"),
        (with_columns(SCAN, range_std=1e-13), r"deviations above 0 for .* \[3\]"),
        (with_columns(SCAN, bearing_std=2e4), "bearing_std up to 10000 rad"),
        (with_columns(SCAN, range_std=2e6), r"excess_path_std up to 1e\+06 m"),
        (with_columns(TIMED, excess_path_std=np.inf), "no standard deviations"),
    ],
)
def test_scans_that_no_filter_can_use_are_refused(refused, scan, said):
    scan = scan() if callable(scan) else scan
    refused(lambda slam, belief, rng: slam.update(belief, scan, rng), said)


@pytest.mark.parametrize(
    ("mean", "covariance", "said"),
    [
        (np.zeros(2), np.eye(3), r"init: found float64 \(2,\) and float64 \(3, 3\)"),
        (np.zeros(3), np.eye(2), "its covariance, 3 by 3"),
        ([0.0, np.nan, 0.0], np.eye(3), r"found the pose \[0.0, nan, 0.0\]"),
        (np.zeros(3), np.diag([1.0, -1.0, 1.0]), "a symmetric covariance"),
        (np.zeros(3), np.eye(3) + np.eye(3, k=1) / 2, "a symmetric covariance"),
        (np.zeros(3), np.eye(3) + 2 * (np.eye(3, k=1) + np.eye(3, k=-1)), "correlations between"),
    ],
)
def test_a_first_pose_that_is_none_is_refused(build, mean, covariance, said):
    with pytest.raises(InputError, match=said):
        build(BICYCLE).init(Gaussian(mean=mean, covariance=covariance))


def test_objects_of_a_wrong_type_are_refused(build):
    slam = build(BICYCLE)
    belief, rng = slam.init(START), np.random.default_rng(7)
    with pytest.raises(InputError, match=r"init: found .* expected a Gaussian of a pose"):
        slam.init(np.zeros(3))
    with pytest.raises(InputError, match="knowing: found None, expected Landmarks"):
        slam.knowing(belief, None)
    for other in (None, START, "belief"):
        with pytest.raises(InputError, match=f"of this filter, {type(belief).__name__};"):
            slam.predict(other, [[0.1, 0.0]], [0.1], rng)
        with pytest.raises(InputError, match=r"belief: found .* init returns the first"):
            slam.update(other, SCAN, rng)


@pytest.mark.parametrize("gate", [-1.0, 0.0, 2.0, np.nan, "auto", None, True])
def test_a_gate_that_is_no_share_is_refused_when_a_filter_is_made(build, gate):
    with pytest.raises(InputError, match=r"gate: found .* expected above 0 and up to 1"):
        replace(build(BICYCLE), gate=gate)


def test_lists_and_other_array_types_are_accepted(build):
    slam = build(BICYCLE)
    started = slam.init(START)
    controls, dt = np.array([[0.75, 0.25], [0.5, 0.0]]), np.array([0.25, 0.5])
    expected = slam.predict(started, controls, dt)[0]
    frozen = controls.copy()
    frozen.setflags(write=False)
    for other in (controls.tolist(), controls.astype(np.float32), np.asfortranarray(controls)):
        moved = slam.predict(started, other, dt.tolist())[0]
        np.testing.assert_array_equal(moved.pose().mean, expected.pose().mean)
    assert slam.predict(started, frozen, dt)[1].mean.shape == (2, 3)
    rows = {name: getattr(SCAN, name).tolist() for name in ("landmark", "caller", "numbers")}
    wide = np.repeat(SCAN.numbers, 2, axis=1)[:, ::2]
    heard = slam.update(started, SCAN, np.random.default_rng(7))
    for scan in (raw(**rows, callers=[], moving=[]), raw(numbers=wide, callers=NO_CALLERS)):
        other = slam.update(started, scan, np.random.default_rng(7))
        for one, two in zip(answers(other), answers(heard), strict=True):
            np.testing.assert_array_equal(one, two)


def test_clutter_is_ignored_and_rows_of_a_landmark_are_merged(build):
    slam = build(BICYCLE)
    started = slam.init(START)
    both = make_scan(
        0.5, np.array([-1, 3, 3]), np.array([2.0, 0.2, 0.4]), caller=np.array([1, 0, 1]),
        range=np.array([np.nan, 5.0, np.nan]), range_std=0.2, bearing_std=0.1,
    )  # fmt: skip
    merged = scan_of((3, 5.0, 0.3))
    merged = with_columns(merged, bearing_std=0.1 / np.sqrt(2), range_std=0.2)
    found, expected = (
        answers(slam.update(started, scan, np.random.default_rng(7))) for scan in (both, merged)
    )
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12)


def test_a_filter_copies_its_inputs(build):
    slam, start = build(BICYCLE), Gaussian(mean=np.zeros(3), covariance=np.eye(3) * 1e-4)
    belief = slam.init(start)
    before = answers(belief)
    start.mean[:], start.covariance[:] = 7.0, 7.0
    for now, then in zip(answers(belief), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_fastslam_requires_a_generator():
    slam = entry("fastslam").build(Config(), BICYCLE)
    with pytest.raises(InputError, match="found no generator"):
        slam.update(slam.init(START), replace(SCAN), None)


@pytest.mark.parametrize(
    "flaw",
    [
        {"mean": np.array([[np.nan, 1.0], [2.0, 3.0]])},
        {"mean": np.zeros(2)},
        {"covariance": -np.tile(np.eye(2), (2, 1, 1))},
        {"covariance": np.eye(2)},
        {"landmark": np.array([3, -1])},
        {"landmark": np.array([3, 3])},
        {"landmark": np.array([3.5, 4.0])},
    ],
)
def test_landmarks_known_beforehand_that_are_none_are_refused(refused, flaw):
    sound = {"landmark": np.array([3, 8]), "mean": np.ones((2, 2)), "weight": np.ones(2),
             "covariance": np.tile(np.eye(2), (2, 1, 1))}  # fmt: skip
    known = SimpleNamespace(**sound | flaw)
    refused(lambda slam, belief, rng: slam.knowing(belief, known), "knowing: found")
