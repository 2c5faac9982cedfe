"""Messages one at a time say what a bag of them says."""

from itertools import pairwise

import numpy as np
import pytest

from pipistrelle.config import BagConfig, InputError
from pipistrelle.detection.logs.bag_log import (
    Frames,
    clock_began,
    learn_transforms,
    scans_in,
    stamp_and_pose,
    step_between,
)
from pipistrelle.experiments.runs.replay import load
from reference.bags import (
    DETECTIONS,
    LABELLED,
    ODOMETRY,
    RANGE,
    TRANSFORMS,
    header,
    labelled,
    odometry,
    static,
    write_bag,
)
from reference.robot import Message, filled


def message(kind, fields):
    return filled(Message(kind), fields)


def winding(covariance=None):
    """Tell a drive that turns and slips, a covariance of its twist in every other message."""
    rng = np.random.default_rng(7)
    for i, (x, y, heading) in enumerate(np.cumsum(rng.normal(0.1, 0.1, (9, 3)), axis=0)):
        stated = covariance if i % 2 else None
        yield odometry(0.1 * i + 0.01 * (i % 3), x, y, heading, 0.5, 0.2, stated, 0.0)


@pytest.mark.parametrize("motion", ["poses", "twist"])
@pytest.mark.parametrize("sure", [False, True])
def test_steps_of_live_messages_equal_the_bags(tmp_path, motion, sure):
    covariance = np.zeros(36)
    covariance[[0, 7, 35, 5, 30]] = 0.04, 0.01, 0.09, 0.01, 0.01
    told = [*winding(covariance if sure else None)]
    stamps = [0.1 * i + 0.01 * (i % 3) for i in range(len(told))]
    rows = [("/odom", ODOMETRY, t, one) for t, one in zip(stamps, told, strict=True)]
    rows.append(("/seen", LABELLED, stamps[-1], labelled(stamps[-1], [(7, 0.1, 2.0)])))
    settings = BagConfig(step=0.0, motion=motion)
    log, _ = load(write_bag(tmp_path / "one.mcap", rows), bag=settings)
    made = [message(ODOMETRY, one) for one in told]
    steps = [step_between(*pair, settings) for pair in pairwise(made)]
    np.testing.assert_array_equal([end for _, end in steps], log.time[1:])
    width = log.controls.shape[1]
    assert width == (2 if motion == "twist" else 9 if sure else 3)
    found = np.full(log.controls.shape, np.nan)
    for row, (controls, _) in zip(found, steps, strict=True):
        row[: controls.shape[1]] = controls[0]
    np.testing.assert_allclose(found, log.controls, rtol=0, atol=1e-12)
    assert stamp_and_pose(made[0])[1] == pytest.approx(log.initial_pose, abs=1e-12)


def test_scans_of_live_messages_equal_the_bags(tmp_path):
    tie = static("base_link", "sonar", 0.4, -0.2, 0.3)
    ping = {
        "header": header(0.1, "sonar"),
        "ping_info": {"sound_speed": 340.0, "rx_beamwidths": [0.1]},
        "rx_angles": [0.5, -0.2, 0.9],
        "two_way_travel_times": [0.02, 0.01, 0.03],
        "tx_delays": [0.0, 0.1, 0.1],
    }
    rows = [("/odom", ODOMETRY, 0.1 * i, odometry(0.1 * i, 0.1 * i, 0.0, 0.0)) for i in range(5)]
    rows += [("/tf_static", TRANSFORMS, 0.0, tie), ("/ping", DETECTIONS, 0.1, ping)]
    path = write_bag(tmp_path / "one.mcap", sorted(rows, key=lambda one: one[2]))
    log, _ = load(path, bag=BagConfig(step=0.0))
    frames = Frames()
    learn_transforms(frames, message(TRANSFORMS, tie))
    scans = scans_in(
        DETECTIONS, message(DETECTIONS, ping), "/base_link", frames, BagConfig()
    )  # fmt: skip
    assert [len(columns["bearing"]) for _, columns in scans] == [1, 2]
    assert [time for time, _ in scans] == pytest.approx([0.1, 0.2])
    for (_, columns), expected in zip(scans, log.scans, strict=True):
        assert "landmark" not in columns
        for name in ("bearing", "range", "bearing_std"):
            np.testing.assert_allclose(columns[name], getattr(expected, name), atol=1e-12)


@pytest.mark.parametrize("far", [4.1, 6.0, np.inf, -np.inf, np.nan, 0.05])
def test_a_range_that_is_nothing_heard_in_a_bag_is_no_scan(far):
    about = {"field_of_view": 0.15, "min_range": 0.1, "header": header(0.1, "base_link")}
    about["max_range"] = far if 0.1 < far < 10.0 else 6.0
    found = [
        scans_in(RANGE, message(RANGE, about | {"range": one}), "base_link", Frames(), BagConfig())
        for one in (far, 2.0)
    ]
    assert found[0] == []
    assert found[1][0][1]["range"] == pytest.approx([2.0])


@pytest.mark.parametrize("q", [{"z": 0.2}, {}, {"x": 1.0}, {"z": 512.0, "w": 512.0}])
def test_an_invalid_orientation_is_refused_as_in_a_bag(q):
    told = odometry(0.5, 1.0, 0.0, 0.0)
    told["pose"]["pose"]["orientation"] = q
    odd = message(ODOMETRY, told)
    with pytest.raises(InputError, match=r"ROS, odometry: found the quaternion .*, expected"):
        stamp_and_pose(odd)
    with pytest.raises(InputError, match=r"ROS, odometry: found the quaternion .*, expected"):
        step_between(message(ODOMETRY, odometry(0.0, 0.0, 0.0, 0.0)), odd, BagConfig())


def test_a_transform_that_is_no_turn_is_refused_when_the_others_are_learnt():
    frames, tie = Frames(), static("base_link", "camera", 0.0, 0.0, q={"z": 0.2})
    tie["transforms"] += static("base_link", "sonar", 0.4, 0.0)["transforms"]
    with pytest.raises(InputError, match=r"/tf_static: from 'base_link' to 'camera': found"):
        learn_transforms(frames, message(TRANSFORMS, tie))
    assert frames.pose("sonar", "base_link")[1][0] == 0.4
    assert frames.pose("camera", "base_link") is None


@pytest.mark.parametrize(
    ("times", "began"), [((0.0, 1000.0), True), ((0.0, 0.1), False), ((0.5, 1000.0), False)]
)
def test_a_clock_begins_where_a_stamp_of_zero_ends(times, began):
    pair = [message(ODOMETRY, odometry(time, 0.0, 0.0, 0.0)) for time in times]
    assert clock_began(*pair) == began


def test_a_message_that_comes_again_is_refused():
    one = message(ODOMETRY, odometry(0.5, 1.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"the time 0\.5 s, expected one after 0\.5 s"):
        step_between(one, one, BagConfig())
