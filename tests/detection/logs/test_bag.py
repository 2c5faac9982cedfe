"""ROS bags: each message type, frames, clocks, and what is no bag; written by rosbags."""

import math
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.__main__ import main
from pipistrelle.config import BagConfig, Config, InputError
from pipistrelle.detection.logs.bag import bounded_unpacking, opened
from pipistrelle.detection.logs.folder import read_log
from pipistrelle.detection.logs.poses import poses_along
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.runs.replay import load, replay
from reference.bags import (
    DETECTIONS,
    LABELLED,
    ODOMETRY,
    RANGE,
    RANGES,
    TRANSFORMS,
    as_poses,
    header,
    labelled,
    odometry,
    of_log,
    quaternion,
    static,
    with_ranges,
    write_bag,
)
from reference.refused import refusal_of

DATA = Path(__file__).parents[2] / "data"
POST = np.array([4.0, 3.0])
"""Where a post stands."""
PLAIN = BagConfig()
KINDS = ("walk.mcap", "walk.db3", "walk.bag", "walk")


def drive(count=5):
    """Tell a drive straight ahead along x, 1 m/s, ten poses a second."""
    return [
        ("/odom", ODOMETRY, 0.1 * i, odometry(0.1 * i, 0.1 * i, 0.0, 0.0, 1.0))
        for i in range(count)
    ]


def pinged(time=0.2, frame="base_link", **told):
    """Tell what a ping of a sonar begins with."""
    return {"header": header(time, frame)} | told


def written(path, *messages, **options):
    """Write a bag of messages in the order of their times."""
    return write_bag(path, sorted(messages, key=lambda one: one[2]), **options)


def read(path, *messages, count=5, **settings):
    """Write a bag of a drive and these messages, and read it."""
    path = written(path, *drive(count), *messages)
    return load(path, bag=BagConfig(step=0.0, **settings))[0]


def only(log):
    """Return the only row of a log."""
    (scan,) = log.scans
    assert scan.landmark.size == 1
    return scan


def refused(path, *parts, bag=PLAIN):
    """Check that a bag is refused in words that hold these."""
    refusal_of(lambda: load(Path(path), bag=bag), str(path), *parts)


# A saved log again


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("kind", ["unicycle", "poses"])
def test_a_log_written_as_a_bag_is_solved_as_the_log_is(tmp_path, kind, name):
    log = with_ranges(read_log(DATA / f"{kind}_log"))
    log = replace(log, controls=log.controls[:, :3], noise_at_rest=True, initial_pose=(0.0,) * 3)
    poses = poses_along(log.controls) if kind == "poses" else None
    assert len(log.scans) > 3
    check_bag_of(log, poses, tmp_path / name)


@pytest.mark.parametrize(
    "seconds", [pytest.param(8, id="short"), pytest.param(187.5, marks=pytest.mark.slow)]
)
def test_a_bag_of_the_papers_mission_is_solved_as_its_log_is(tmp_path, seconds):
    line = ["run", "--settings", "paper", "--strategy", "active", "--quiet", "-o"]
    more = ["--save-log", str(tmp_path / "log"), "--duration", str(seconds)]
    assert main([*line, str(tmp_path / "out"), *more]) == 0
    log, poses = as_poses(with_ranges(read_log(tmp_path / "log")), (0.01, 0.01, 0.01))
    assert len(log.dt) == 8 * seconds
    check_bag_of(replace(log, initial_pose=(0.0,) * 3), poses, tmp_path / "walk.mcap")


def check_bag_of(log, poses, path):
    """Write a log as a bag, and check that its track and map are those of the log."""
    kind = "unicycle" if poses is None else "poses"
    stds = dict(zip(STDS[kind], log.control_std, strict=True)) | {
        name: getattr(log, name)
        for name in ("initial_pose_std", "range_std", "bearing_std", "range_bounds")
    }
    bag = BagConfig(step=0.0, motion="twist" if poses is None else "poses", **stds)
    again = load(write_bag(path, of_log(log, poses=poses)), bag=bag)[0]
    tracks = [
        replay(one, Truth(time=one.time), ["fused"], ["smoother"], None, Config()).trials[0].track
        for one in (log, again)
    ]
    np.testing.assert_allclose(tracks[1].time, tracks[0].time, rtol=0, atol=1e-12)
    np.testing.assert_allclose(tracks[1].pose.mean, tracks[0].pose.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        tracks[1].landmarks.mean, tracks[0].landmarks.mean, rtol=0, atol=1e-9
    )


STDS = {
    "unicycle": ("velocity_std", "angular_rate_std"),
    "poses": ("forward_std", "sideways_std", "turn_std"),
}


# Echoes


@pytest.mark.parametrize("definitions", [True, False])
def test_detections_are_travel_times_by_angles_to_starboard(tmp_path, definitions):
    told = pinged(
        ping_info={"sound_speed": 1500.0, "rx_beamwidths": [0.12]},
        flags=[{"flag": 0}, {"flag": 1}, {"flag": 0}],
        two_way_travel_times=[0.01, 0.01, math.nan],
        tx_delays=[0.05, 0.0, 0.0],
        rx_angles=[0.3, 0.1, 0.2],
    )
    ping = ("/sonar", DETECTIONS, 0.2, told)
    path = written(tmp_path / "walk.mcap", *drive(), ping, definitions=definitions)
    log = load(path, bag=BagConfig(step=0.0))[0]
    row = only(log)
    assert row.bearing[0] == pytest.approx(-0.3, abs=1e-6)
    assert row.range[0] == pytest.approx(7.5, rel=1e-6)
    assert row.bearing_std[0] == pytest.approx(0.12 / math.sqrt(12.0), rel=1e-6)
    assert row.time == pytest.approx(0.25)
    assert log.ignored_rows == {"flagged": 1, "nothing_heard": 1}
    assert any("starboard" in note for note in log.notes)
    assert any("delays, up to 0.05 s" in note for note in log.notes)


def test_a_travel_time_needs_a_speed_of_sound(tmp_path):
    told = pinged(two_way_travel_times=[0.02], rx_angles=[0.0])
    log = read(tmp_path / "one.mcap", ("/sonar", DETECTIONS, 0.2, told), speed_of_sound=340.0)
    assert only(log).range[0] == pytest.approx(3.4, rel=1e-6)
    refused(tmp_path / "one.mcap", "topic /sonar, message 1", "--bag.speed-of-sound")


def test_ranges_are_measured_along_their_unit_vectors(tmp_path):
    vectors = [{"x": 0.6, "y": 0.8}, {"x": 0.48, "y": 0.64, "z": 0.6}, {"z": 1.0}]
    told = pinged(beam_unit_vec=vectors, ranges=[5.0, 5.0, 3.0])
    log = read(tmp_path / "one.db3", ("/beams", RANGES, 0.2, told))
    (scan,) = log.scans
    np.testing.assert_allclose(scan.range, [5.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(scan.bearing, math.atan2(0.8, 0.6), rtol=1e-6)
    assert np.isnan(scan.range_std).all()
    assert log.ignored_rows == {"steep": 1}


@pytest.mark.parametrize("name", KINDS[:3])
def test_a_cone_is_a_bearing_anywhere_in_its_width(tmp_path, name):
    cone = {"field_of_view": 0.26, "min_range": 0.1, "max_range": 6.0}
    messages = [
        ("/front", RANGE, 0.1 * i, pinged(0.1 * i, "front", **cone, range=far))
        for i, far in enumerate([2.5, math.inf, math.nan, 7.0, 0.05])
    ]
    tie = ("/tf_static", TRANSFORMS, 0.0, static("base_link", "front", 0.3, 0.2, math.pi / 2.0))
    log = read(tmp_path / name, *messages, tie)
    row = only(log)
    assert row.bearing[0] == pytest.approx(math.atan2(2.7, 0.3), abs=1e-6)
    assert row.range[0] == pytest.approx(math.hypot(2.7, 0.3), rel=1e-6)
    assert row.bearing_std[0] == pytest.approx(0.26 / math.sqrt(12.0), rel=1e-6)
    assert log.ignored_rows == {"nothing_heard": 4}


def cones(*ranges, far=6.0, **more):
    """Tell what a sonar in front says, ten times a second."""
    about = {"field_of_view": 0.15, "min_range": 0.1, "max_range": far} | more
    return [
        ("/front", RANGE, 0.1 * i, pinged(0.1 * i, **about, range=one))
        for i, one in enumerate(ranges)
    ]


@pytest.mark.parametrize("far", [6.0, 4.1, 0.3, 25.599999, math.inf])
def test_a_range_at_the_sensors_maximum_counts_as_no_echo(tmp_path, far):
    single = np.float32(far)
    below = float(np.nextafter(single, np.float32(0.0)))
    nothing = [far, float(single), below, math.inf, -math.inf, math.nan, 0.0, -1.0]
    heard = [0.99 * far, 0.99999 * far] if far < math.inf else [2.0, 5000.0]
    log = read(tmp_path / "one.mcap", *cones(*nothing, *heard, far=far), count=11)
    assert log.ignored_rows == {"nothing_heard": len(nothing)}
    np.testing.assert_allclose([scan.range[0] for scan in log.scans], heard, rtol=1e-6)


def test_a_range_repeated_in_over_a_fifth_of_messages_is_doubted(tmp_path):
    def doubts(name, ranges):
        return read(tmp_path / name, *cones(*ranges), count=31).doubts

    far = np.linspace(1.0, 3.0, 30)
    assert doubts("all.mcap", far) == ()
    assert doubts("few.mcap", [*far[:24], *[5.9] * 6]) == ()
    (odd,) = doubts("many.mcap", [*far[:23], *[5.9] * 7])
    assert "/front: 7 of 30 messages hold the range 5.9 m; is it how the sensor says" in odd
    assert doubts("short.mcap", [5.9] * 20) == ()


def test_a_range_repeated_in_each_scan_is_doubted_for_any_beam(tmp_path):
    def ping(i):
        ways = [{"x": math.cos(0.1 * i), "y": math.sin(0.1 * i)}, {"x": 0.6, "y": -0.8}]
        told = pinged(0.1 * i, beam_unit_vec=ways, ranges=[7.3, 2.0 + 0.01 * i])
        return ("/beams", RANGES, 0.1 * i, told)

    log = read(tmp_path / "one.mcap", *map(ping, range(30)), count=31)
    assert "30 of 30 messages hold the range 7.3 m" in log.doubts[0]


def test_ranges_and_bearings_keep_labels_and_deviations_and_are_of_where_the_sensor_is(tmp_path):
    told = labelled(0.2, [(7, 0.5, 3.0), (-1, 0.1, 2.0)], at=(0.2, 0.0, 0.1), stds=(0.05, 0.01))
    row = only(read(tmp_path / "one.bag", ("/seen", LABELLED, 0.2, told)))
    x, y = 0.2 + 3.0 * math.cos(0.6), 3.0 * math.sin(0.6)
    assert row.landmark[0] == 7
    assert row.bearing[0] == pytest.approx(math.atan2(y, x), abs=1e-12)
    assert row.range[0] == pytest.approx(math.hypot(x, y), abs=1e-12)
    assert (row.range_std[0], row.bearing_std[0]) == (0.05, 0.01)


def test_the_sensor_sees_the_same_post_wherever_it_is_mounted(tmp_path):
    def seen(name, at, **more):
        x, y, heading = at
        far = POST - [0.2 + x, y]
        yaw = math.atan2(far[1], far[0]) - heading
        told = pinged(
            0.2, "sonar", beam_unit_vec=[{"x": math.cos(yaw), "y": math.sin(yaw)}],
            ranges=[float(np.hypot(*far))],
        )  # fmt: skip
        return read(tmp_path / name, ("/beams", RANGES, 0.2, told), **more)

    there = (0.4, -0.3, 1.2)
    row = only(seen("set.mcap", there, sensor_pose=there))
    want = POST - [0.2, 0.0]
    assert row.bearing[0] == pytest.approx(math.atan2(want[1], want[0]), abs=1e-6)
    assert row.range[0] == pytest.approx(np.hypot(*want), rel=1e-6)
    refused(tmp_path / "set.mcap", "topic /beams", "'sonar'", "'base_link'", "--bag.sensor-pose")


def test_transforms_are_followed_from_frame_to_frame_either_way(tmp_path):
    told = pinged(0.2, "/sonar", beam_unit_vec=[{"x": 1.0}], ranges=[2.0])
    ties = [
        ("/tf_static", TRANSFORMS, 0.0, static("mast", "base_link", -0.5, 0.0)),
        ("/tf_static", TRANSFORMS, 0.01, static("mast", "sonar", 0.0, 0.25)),
    ]
    row = only(read(tmp_path / "one.mcap", ("/beams", RANGES, 0.2, told), *ties))
    assert row.range[0] == pytest.approx(math.hypot(2.5, 0.25), rel=1e-6)
    assert row.bearing[0] == pytest.approx(math.atan2(0.25, 2.5), abs=1e-6)


@pytest.mark.parametrize("profiling", [True, False])
def test_angles_are_about_the_axis_of_either_convention(tmp_path, profiling):
    half = math.sqrt(0.5)  # x up, y to starboard, z ahead, or x ahead, y left, z up
    q = {"x": half, "y": 0.0, "z": half, "w": 0.0} if profiling else {"w": 1.0}
    tie = ("/tf_static", TRANSFORMS, 0.0, static("base_link", "sonar", 0.0, 0.0, q=q))
    told = pinged(
        0.2, "sonar", ping_info={"sound_speed": 1500.0},
        two_way_travel_times=[0.01], rx_angles=[0.3],
    )  # fmt: skip
    row = only(read(tmp_path / "one.mcap", ("/sonar", DETECTIONS, 0.2, told), tie))
    assert row.bearing[0] == pytest.approx(-0.3, abs=1e-6)


# Odometry and clocks


def seen(time, far=3.0):
    """Tell a post that is seen."""
    return ("/seen", LABELLED, time, labelled(time, [(7, 0.0, far)]))


def test_a_twist_covariance_is_scaled_to_the_motion_since_the_last_row(tmp_path):
    covariance = np.zeros(36)
    covariance[[0, 7, 35]] = 0.04, 0.01, 0.09
    rows = [
        ("/odom", ODOMETRY, t, odometry(t, t, 0.0, 0.0, covariance=covariance)) for t in (0.0, 0.5)
    ]
    path = write_bag(tmp_path / "one.mcap", [*rows, seen(0.5)])
    (controls,) = load(path, bag=BagConfig(step=0.0))[0].controls
    np.testing.assert_allclose(controls[[3, 6, 8]], np.array([0.04, 0.01, 0.09]) * 0.25)
    assert load(path, bag=BagConfig(step=0.0, covariances=False))[0].controls.shape == (1, 3)


def test_steps_merge_more_frequent_odometry(tmp_path):
    assert len(read(tmp_path / "one.mcap", seen(0.2), count=21).dt) == 20
    assert len(load(tmp_path / "one.mcap", bag=BagConfig(step=0.5))[0].dt) == 4


def test_messages_are_timed_by_their_headers_unless_reception_is_asked_for(tmp_path):
    path = written(tmp_path / "one.mcap", *drive(), seen(0.2), late=0.25)
    log = load(path, bag=BagConfig(step=0.0))[0]
    assert log.time[0] == 0.0
    assert any("/odom" in note and "received 0.25 s after" in note for note in log.notes)
    assert load(path, bag=BagConfig(step=0.0, stamps="received"))[0].time[0] == 0.25


@pytest.mark.parametrize(
    "name", ["Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"]
)
def test_the_truth_is_a_topic_that_is_named_and_the_log_begins_there(tmp_path, name):
    def truth(time):
        place = {"x": 5.0 + time, "y": -1.0}
        pose = {"position": place, "orientation": quaternion(0.25)}
        told = {
            "Odometry": {"pose": {"pose": pose}},
            "PoseStamped": {"pose": pose},
            "PoseWithCovarianceStamped": {"pose": {"pose": pose}},
            "TransformStamped": {
                "transform": {"translation": place, "rotation": pose["orientation"]}
            },
        }[name]
        package = "nav_msgs" if name == "Odometry" else "geometry_msgs"
        return ("/true", f"{package}/msg/{name}", time, {"header": header(time)} | told)

    truths = (truth(0.15 + 0.1 * i) for i in range(4))
    path = written(tmp_path / "one.mcap", *drive(), *truths, seen(0.3))
    log, true = load(path, bag=BagConfig(step=0.0, truth="/true"))
    assert log.time[0] == pytest.approx(0.15)
    np.testing.assert_allclose(log.initial_pose, [5.15, -1.0, 0.25])
    np.testing.assert_allclose(true.path[:3, 0], 5.0 + true.time[:3])
    assert load(path, bag=BagConfig(odometry="/odom", step=0.0))[1].path is None


def test_one_of_two_odometry_topics_is_chosen_by_name(tmp_path):
    other = [("/visual", *row[1:]) for row in drive()]
    path = written(tmp_path / "one.mcap", *drive(), *other, seen(0.2))
    refused(path, "several topics of odometry: /odom, /visual", "--bag.odometry")
    log, truth = load(path, bag=BagConfig(truth="/visual"))
    assert truth.path is not None
    assert "/odom is the odometry" in log.notes[0]
    refused(path, "no topic '/odm'", "did you mean /odom?", bag=BagConfig(odometry="/odm"))
    refused(path, "/seen of the type mrpt", "nav_msgs", bag=BagConfig(odometry="/seen"))


# Orientations


def turned(topic, time, heading, q):
    """Tell a pose at a time, by another quaternion where one is given."""
    told = odometry(time, time, 0.1 * time, heading)
    told["pose"]["pose"]["orientation"] = q if q is not None else quaternion(heading)
    return (topic, ODOMETRY, time, told)


def wrong(kind, heading):
    """Return a quaternion as a wrong driver fills it in."""
    z, w = math.sin(heading / 2.0), math.cos(heading / 2.0)
    return {
        "no w": {"z": z},
        "empty": {},
        "no number": {"z": z, "w": math.nan},
        "scaled": {"z": 512.0 * z, "w": 512.0 * w},
        "a little long": {"z": 1.011 * z, "w": 1.011 * w},
        "w first": {"x": w, "w": z},
        "upside down": {"x": z, "y": w},
    }[kind]


ODD = ("no w", "empty", "no number", "scaled", "a little long", "w first", "upside down")


@pytest.mark.parametrize("topic", ["/odom", "/true"])
@pytest.mark.parametrize("kind", ODD)
def test_invalid_orientations_are_refused_or_left_out(tmp_path, kind, topic):
    def bag(name, odd):
        rows = []
        for i in range(12):
            time, heading = round(0.1 * i, 1), 0.5 + 0.02 * i
            for one in ("/odom", "/true"):
                q = wrong(kind, heading) if one == topic and i in odd else None
                rows.append(turned(one, time, heading, q))
        return written(tmp_path / name, *rows, seen(1.0))

    settings = BagConfig(odometry="/odom", truth="/true", step=0.0)
    for odd in (range(12), range(7)):
        part = "upside down" if kind in ("w first", "upside down") else "of length "
        parts = f"topic {topic}, message 1: found the quaternion (", part, "expected"
        path = bag("all.mcap", {*odd})
        refused(path, *parts, f"; {len(odd)} of 12 messages are like it", bag=settings)
    log, truth = load(bag("some.mcap", {3, 7}), bag=settings)
    assert log.ignored_rows == {"odd_orientation": 2}
    (doubt,) = log.doubts
    assert f"{topic}: 2 left out: message 4: found the quaternion (" in doubt
    whole, right = load(bag("good.mcap", set()), bag=settings)
    kept = np.isin(whole.time, log.time)
    assert kept.sum() == len(log.time) == 12 - 2 * (topic == "/odom")
    np.testing.assert_allclose(
        poses_along(log.controls), poses_along(whole.controls)[kept], atol=1e-9
    )
    np.testing.assert_allclose(truth.path, right.path[kept], atol=1e-3)


@pytest.mark.parametrize("steps", [2**14, 2**30, 127])
def test_quaternions_of_fixed_point_are_turns(tmp_path, steps):
    rows = []
    for i in range(12):
        q = {name: round(v * steps) / steps for name, v in quaternion(0.3 * i).items()}
        rows.append(turned("/odom", 0.1 * i, 0.0, q))
    log, _ = load(written(tmp_path / "one.mcap", *rows, seen(1.0)), bag=BagConfig(step=0.0))
    assert not log.ignored_rows
    np.testing.assert_allclose(log.controls[:, 2], 0.3, atol=4.0 / steps)


def test_invalid_transforms_are_left_out_or_refused(tmp_path):
    good = ("/tf_static", TRANSFORMS, 0.0, static("base_link", "front", 0.3, 0.2))
    camera = static("base_link", "camera", 0.1, 0.0, q={"z": 0.2})
    bad = ("/tf_static", TRANSFORMS, 0.01, camera)
    log = read(tmp_path / "one.mcap", *cones(2.0, 2.1), good, bad)
    assert log.ignored_rows == {"odd_orientation": 1}
    words = "/tf_static: 1 left out: from 'base_link' to 'camera': found the quaternion (0, 0, 0.2"
    assert words in log.doubts[0]
    with pytest.raises(InputError, match=r"topic /tf_static, from .* of length 0.2, expected"):
        read(tmp_path / "two.mcap", *cones(2.0, 2.1), bad)
    under = static("base_link", "under", 0.0, 0.0, q={"x": 1.0})  # a sensor may hang so
    read(tmp_path / "three.mcap", *cones(2.0), ("/tf_static", TRANSFORMS, 0.0, under))


# Clocks that had not begun


def stamped(path, count=20, start=1000.0, early=3, truth=False, heard=False):
    """Write a bag of a simulation that began its clock late; reception is right."""
    told = []
    for i in range(count):
        time, stamp = start + 0.1 * i, start + 0.1 * i if i >= early else 0.0
        for topic in ("/odom", "/true") if truth else ("/odom",):
            told.append((topic, ODOMETRY, time, odometry(stamp, 0.1 * i, 0.0, 0.0, 1.0)))
        told.append(("/seen", LABELLED, time, labelled(stamp if heard else time, [(7, 0.3, 3.0)])))
    return write_bag(path, told)


@pytest.mark.parametrize("start", [1.5, 1000.0, 1e5, 1.78e9])
@pytest.mark.parametrize("more", [{}, {"heard": True}, {"truth": True}])
def test_stamps_of_zero_before_the_clock_begins_are_left_out(tmp_path, start, more):
    path = stamped(tmp_path / "one.mcap", start=start, **more)
    named = {"odometry": "/odom", "truth": "/true"} if more.get("truth") else {}
    log, _ = load(path, bag=BagConfig(step=0.1, **named))
    assert log.ignored_rows["before_clock"] == 3 * (1 + bool(more))
    assert log.time[0] == pytest.approx(start + 0.3, abs=1e-6)
    assert len(log.dt) <= 17
    words = "/odom: 3 left out: their stamp is 0, from before the clock began; others are"
    assert words in " ".join(log.doubts)
    assert log.initial_pose[0] == pytest.approx(0.3)


def test_a_clock_that_begins_with_the_drive_has_a_time_zero(tmp_path):
    log = read(tmp_path / "one.mcap", seen(0.0), seen(0.2))
    assert log.time[0] == 0.0
    assert (log.ignored_rows, log.doubts) == ({}, ())
    assert len(log.scans) == 2


def test_zero_stamps_are_refused_with_the_option_that_helps(tmp_path):
    path = stamped(tmp_path / "one.mcap", early=20)
    refused(path, "topic /odom: found the stamp 0 in all 20 messages", "--bag.stamps received")
    assert len(load(path, bag=BagConfig(stamps="received", step=0.0))[0].dt) == 19
    rows = [odometry(5.0 + 0.1 * i, 0.1 * i, 0.0, 0.0) for i in range(5)]
    told = [("/odom", ODOMETRY, 5.0 + 0.1 * i, row) for i, row in enumerate(rows)]
    unset = [("/seen", LABELLED, row[2], labelled(0.0, [(7, 0.3, 3.0)])) for row in told]
    path = write_bag(tmp_path / "two.mcap", [*told, *unset])
    refused(path, "topic /seen: found the stamp 0 in all 5 messages", "--bag.stamps received")


def test_a_stamp_of_zero_in_between_is_left_out(tmp_path):
    rows = [odometry(1000.0 + 0.1 * i if i != 7 else 0.0, 0.1 * i, 0.0, 0.0) for i in range(20)]
    told = [("/odom", ODOMETRY, 1000.0 + 0.1 * i, row) for i, row in enumerate(rows)]
    path = write_bag(tmp_path / "one.mcap", [*told, seen(1001.0)])
    log, _ = load(path, bag=BagConfig(step=0.0))
    assert log.ignored_rows == {"before_clock": 1}
    np.testing.assert_allclose(log.controls[:, 0].sum(), 1.9)


@pytest.mark.parametrize(("pause", "asked"), [(90.0, False), (110.0, True)])
def test_a_long_silence_of_the_odometry_is_doubted(tmp_path, pause, asked):
    times = [round(0.1 * i + pause * (i >= 20), 1) for i in range(40)]
    told = [("/odom", ODOMETRY, t, odometry(t, 0.1 * i, 0.0, 0.0)) for i, t in enumerate(times)]
    log, _ = load(write_bag(tmp_path / "one.mcap", [*told, seen(times[-1])]))
    assert bool(log.doubts) == asked
    if asked:
        assert "silent for 110.1 s, from 1.9 s to 112.0 s, which is 1101 steps" in log.doubts[0]
        assert "was its clock set" in log.doubts[0]


def test_too_many_steps_are_refused_by_the_gap_that_makes_them(tmp_path):
    times = [5.0 + round(0.1 * i, 1) + 1.78e9 * (i >= 20) for i in range(40)]
    told = [("/odom", ODOMETRY, t, odometry(t, 0.1 * i, 0.0, 0.0)) for i, t in enumerate(times)]
    path = write_bag(tmp_path / "one.mcap", [*told, seen(times[-1])])
    refused(path, "topic /odom", "without a row, from 6.9 s to 1780000007.0 s", "the clock was set")


# What is wrong in a bag


def test_a_damaged_or_missing_bag_is_refused_by_name(tmp_path):
    for name in KINDS[:3]:
        whole = written(tmp_path / name, *drive(), seen(0.2)).read_bytes()
        for i, data in enumerate((b"", whole[: len(whole) // 2], b"\0" * 200, whole[1:])):
            path = tmp_path / f"{i}{name}"
            path.write_bytes(data)
            refused(path)
    refused(tmp_path / "gone.mcap", "no such file")
    (tmp_path / "link.mcap").symlink_to(tmp_path / "nowhere.mcap")
    refused(tmp_path / "link.mcap", "a link to no file")
    (tmp_path / "there.mcap").symlink_to(tmp_path / "walk.mcap")
    assert load(tmp_path / "there.mcap")[0].scans
    os.mkfifo(tmp_path / "pipe.mcap")
    refused(tmp_path / "pipe.mcap", "a pipe or a device")
    (tmp_path / "folder.mcap").mkdir()
    refused(tmp_path / "folder.mcap", "log.toml")
    (tmp_path / "bare").mkdir()
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / "bare" / name).touch()
    refused(tmp_path / "bare", "2 files without metadata.yaml", "reindex")


@pytest.mark.parametrize(
    ("told", "parts"),
    [
        ([seen(0.2)], ("no odometry",)),
        (drive(), ("no echoes",)),
        ([], ("no odometry",)),
        ([*drive(), seen(0.2, math.nan)], ("topic /seen, message 1", "the range nan")),
        ([*drive(), seen(0.2, 2e6)], ("topic /seen, message 1", "range 2000000.0")),
        ([*drive(), ("/odom", ODOMETRY, 0.5, odometry(0.5, math.nan, 0.0, 0.0)), seen(0.2)],
         ("topic /odom, message 6", "x nan")),
        ([*drive(), ("/odom", ODOMETRY, 0.5, odometry(0.2, 0.0, 0.0, 0.0)), seen(0.2)],
         ("topic /odom, message 6", "run backwards", "--bag.stamps received")),
        ([*drive(), seen(0.2), ("/seen", LABELLED, 0.3, labelled(0.1, [(7, 0.0, 1.0)]))],
         ("topic /seen, message 2", "run backwards")),
        ([*drive(), ("/seen", LABELLED, 0.2, labelled(0.2, [(7, 0.0, 1.0), (7, 0.2, 1.0)]))],
         ("topic /seen, message 1", "landmark 7")),
        ([*drive(), seen(9.0)], ("topic /seen", "1 outside odometry")),
    ],
)  # fmt: skip
def test_unusable_messages_are_refused_by_topic_and_number(tmp_path, told, parts):
    refused(written(tmp_path / "one.mcap", *told), *parts)


def test_messages_missing_from_a_bags_file_are_reported(tmp_path):
    path = written(tmp_path / "walk", *drive(), seen(0.2))
    told = (path / "metadata.yaml").read_text()
    assert told.count("message_count: 5") == 1
    (path / "metadata.yaml").write_text(told.replace("message_count: 5", "message_count: 9"))
    refused(path, "topic /odom", "found 5 messages, expected the 9")


def records(data):
    """Return the records of MCAP: opcodes and contents."""
    found, at = [], 0
    while at < len(data):
        size = int.from_bytes(data[at + 1 : at + 9], "little")
        found.append((data[at], data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def indexed(path, *, messages=True, chunks=None, statistics=True):
    """Write an MCAP file again with only some of its index."""
    magic, out, moved, kept = b"\x89MCAP0\r\n", b"\x89MCAP0\r\n", {}, b""
    whole, at = path.read_bytes(), len(magic)
    parts = records(whole[len(magic) : -len(magic)])
    for op, content in parts:
        record = bytes([op]) + len(content).to_bytes(8, "little") + content
        if op in (3, 4) or (op == 11 and statistics):
            kept += record
        if op == 8:
            entry = content if messages else content[:32] + bytes(4) + bytes(8)
            if not messages:
                size = int.from_bytes(content[32:36], "little")
                entry += content[36 + size + 8 :]
            start = moved[int.from_bytes(content[16:24], "little")]
            entry = entry[:16] + start.to_bytes(8, "little") + entry[24:]
            if chunks is None or (len(moved) and list(moved.values()).index(start) in chunks):
                kept += bytes([op]) + len(entry).to_bytes(8, "little") + entry
        if op in (1, 6, 15) or (op == 7 and messages):
            if op == 6:
                moved[at] = len(out)
            out += record
        at += len(record)
    footer = len(out).to_bytes(8, "little") + bytes(12)
    path.write_bytes(out + kept + b"\x02" + (20).to_bytes(8, "little") + footer + magic)
    return path


@pytest.mark.parametrize("statistics", [True, False])
@pytest.mark.parametrize(
    "index",
    [
        {},
        {"messages": False},
        {"chunks": (0,)},
        {"chunks": (1,)},
        {"messages": False, "chunks": (1,)},
    ],
    ids=str,
)
@pytest.mark.parametrize("how", [None, "STORAGE"])
def test_an_mcap_is_read_whatever_its_index_lacks(tmp_path, how, index, statistics):
    big = [
        ("/big", "std_msgs/msg/String", 0.05 + 0.1 * i, {"data": "x" * 600_000}) for i in range(4)
    ]
    messages = (*drive(), *big, seen(0.2), seen(0.3))
    path = written(tmp_path / "one.mcap", *messages, compression=how)
    whole, _ = load(path, bag=BagConfig(step=0.0))
    indexed(path, statistics=statistics, **index)
    if index.get("chunks") and not statistics:
        return  # nothing in the file says that there is more
    log, _ = load(path, bag=BagConfig(step=0.0))
    np.testing.assert_array_equal(log.time, whole.time)
    assert [scan.time for scan in log.scans] == [scan.time for scan in whole.scans]
    with opened(path) as bag:
        assert [topic.count for topic in bag.seen()] == [4, 5, 2]


def test_an_mcap_with_missing_messages_is_refused_with_its_remedy(tmp_path):
    path = written(tmp_path / "one.mcap", *drive(), seen(0.2))
    data = path.read_bytes()
    count = (1).to_bytes(2, "little") + (5).to_bytes(8, "little")
    assert data.count(count) == 1
    path.write_bytes(data.replace(count, count[:2] + (9).to_bytes(8, "little")))
    with pytest.raises(InputError, match="topic /odom: found 5 messages, expected the 9") as error:
        load(path)
    assert "folder" not in str(error.value)
    assert "mcap recover" in str(error.value)


def test_metadata_that_would_take_minutes_to_read_are_refused(tmp_path):
    path = written(tmp_path / "walk", *drive(), seen(0.2))
    told = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(told + "\n#" * 600_000)
    refused(path, "metadata.yaml", "expected at most 1000000")


def test_a_bag_without_labels_is_refused_by_its_file(tmp_path):
    cone = pinged(0.2, field_of_view=0.26, min_range=0.1, max_range=6.0, range=2.0)
    log = read(tmp_path / "one.mcap", ("/front", RANGE, 0.2, cone))
    with pytest.raises(InputError, match=r"one\.mcap: found rows without labels"):
        replay(log, Truth(time=log.time), ["fused"], ["ekf"], None, Config())


def test_a_truncated_message_is_refused_by_its_topic(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    from reference.bags import made, store_of

    store = store_of()
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/odom", ODOMETRY, typestore=store)
        seen_topic = writer.add_connection("/seen", LABELLED, typestore=store)
        data = store.serialize_cdr(made(store, ODOMETRY, odometry(0.0, 0.0, 0.0, 0.0)), ODOMETRY)
        writer.write(topic, 0, data)
        writer.write(topic, 1, bytes(data)[:60])
        writer.write(seen_topic, 2, b"")
    refused(tmp_path / "bag", "topic /odom, message 2")


@pytest.mark.parametrize(
    ("name", "how"),
    [("walk", "FILE"), ("walk", "MESSAGE"), ("walk.mcap", "STORAGE"), ("walk.bag", "LZ4")],
)
def test_compressed_bags_are_read(tmp_path, name, how):
    path = written(tmp_path / name, *drive(), seen(0.2), compression=how)
    assert only(load(path)[0]).landmark[0] == 7


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("walk", "FILE"),
        ("walk", "MESSAGE"),
        ("walk.mcap", "STORAGE"),
        ("walk.bag", "LZ4"),
        ("walk.bag", "BZ2"),
    ],
)
def test_compressed_parts_that_unpack_to_too_much_are_refused(tmp_path, monkeypatch, name, how):
    path = written(tmp_path / name, *drive(), seen(0.2), compression=how)
    with monkeypatch.context() as patch:
        patch.setattr("pipistrelle.detection.logs.bag.MOST_UNPACKED", 90)
        patch.setattr("pipistrelle.detection.logs.bag.ROOM", 0.0)
        words = "of the room in" if how == "FILE" else "that unpack to more than 90"
        refused(path, words)
    assert only(load(path)[0]).landmark[0] == 7


@pytest.mark.parametrize("form", ["zstd", "lz4"])
def test_a_small_chunk_that_unpacks_beyond_the_limit_is_refused(form):
    from importlib import import_module

    from rosbags.rosbag2 import reader
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

    pack = reader.zstd if form == "zstd" else import_module("lz4.frame")
    bomb, sound = pack.compress(bytes(2**28)), pack.compress(b"sound")
    with bounded_unpacking():
        unpack = DECOMPRESSORS[form]
        with pytest.raises(ValueError, match="unpack to more than 128000000"):
            unpack(bomb, 5)
        assert unpack(sound * 100, 500) == b"sound" * 100
        for odd, said in ((sound * 101, "100 frames"), (sound[:-1], "cut"), (b"", "cut")):
            with pytest.raises(ValueError, match=said):
                unpack(odd, 5)
    assert unpack is not DECOMPRESSORS[form]


def ending(path):
    """Tell how reading a bag ends."""
    try:
        load(path)
    except InputError as error:
        return "refused" if str(path) in str(error) else f"refused without its name: {error}"
    return "read"


@pytest.mark.parametrize("times", [15, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", KINDS[:3])
def test_bytes_that_are_changed_at_random_end_in_a_log_or_a_refusal(tmp_path, name, times):
    whole = written(tmp_path / name, *drive(), seen(0.2)).read_bytes()
    rng, ends = np.random.default_rng(5), set()
    path = tmp_path / f"odd{Path(name).suffix}"
    for _ in range(times):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=int(rng.integers(1, 6))):
            data[at] = int(rng.integers(256))
        path.write_bytes(data)
        ends.add(ending(path))
    assert ends == {"read", "refused"}


def test_a_bag_without_rosbags_is_refused_with_the_install_command(tmp_path, monkeypatch):
    path = written(tmp_path / "one.mcap", *drive(), seen(0.2))
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(path, "needs rosbags", "pip install rosbags")
