"""The node for ROS 2 finds what `slam` finds of the same log, and nothing that it hears ends it."""

import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pipistrelle
from pipistrelle.__main__ import main
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.logs.poses import poses_along
from reference.bags import (
    DETECTIONS,
    LABELLED,
    ODOMETRY,
    TRANSFORMS,
    as_poses,
    header,
    labelled,
    odometry,
    of_log,
    static,
    with_ranges,
)
from reference.robot import Message, filled, install

EXAMPLE = Path(__file__).parents[1] / "examples" / "ros2"
DATA = Path(__file__).parent / "data"


@pytest.fixture
def started(monkeypatch):
    """Start a node with parameters."""

    def start(vehicle, **parameters):
        install(monkeypatch, vehicle=str(vehicle), echoes="/seen", **parameters)
        return runpy.run_path(str(EXAMPLE / "slam_node.py"))["SlamNode"]()

    return start


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return folders of logs, by name, and the poses of their odometry; None where it is twists."""
    place = tmp_path_factory.mktemp("logs")
    line = ["run", "--settings", "paper", "--strategy", "active", "--quiet", "--duration", "8"]
    assert main([*line, "-o", str(place / "out"), "--save-log", str(place / "run")]) == 0
    mission, along = as_poses(with_ranges(read_log(place / "run")), (0.01, 0.01, 0.01))
    unicycle, poses = (
        with_ranges(read_log(DATA / f"{kind}_log")) for kind in ("unicycle", "poses")
    )
    poses = replace(poses, controls=poses.controls[:, :3])
    made = {
        "mission": (mission, along),
        "unicycle": (unicycle, None),
        "poses": (poses, poses_along(poses.controls)),
    }
    for name, (log, _) in made.items():
        write_log(place / name, log)
    return {name: (place / name, poses) for name, (_, poses) in made.items()}


def hand(node, topic, kind, fields):
    """Hand a message to a node."""
    node.takes[topic](filled(Message(kind), fields))


def driven(node, folder, poses):
    """Hand a log's odometry and scans to a node, in order of time."""
    for topic, kind, _, fields in of_log(read_log(folder), poses=poses):
        hand(node, topic, kind, fields)
    return node


def poses_told(node):
    """Return time and pose of the last message of each time."""
    found = {}
    for message in node.told["~/pose"]:
        stamp, pose = message.header.stamp, message.pose.pose
        heading = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        found[stamp.sec + stamp.nanosec / 1e9] = (pose.position.x, pose.position.y, heading)
    return np.array([*found]), np.array([*found.values()])


def off(found, expected):
    """Return by how much poses differ at most."""
    turn = np.angle(np.exp(1j * (found[:, 2] - expected[:, 2])))
    return max(np.abs(found[:, :2] - expected[:, :2]).max(), np.abs(turn).max())


@pytest.mark.filterwarnings("ignore::UserWarning")  # what looks odd in a log that was made odd
@pytest.mark.parametrize("estimator", ["iekf", "ekf", "smoother"])
@pytest.mark.parametrize("name", ["mission", "unicycle", "poses"])
def test_the_nodes_messages_equal_slam_on_the_log(started, logs, name, estimator):
    folder, poses = logs[name]
    node = driven(started(folder / "log.toml", estimator=estimator), folder, poses)
    done = pipistrelle.slam(folder, filters=estimator)
    track = done.mission.trials[0].track
    time, found = poses_told(node)
    assert not node.warned
    np.testing.assert_allclose(time, track.time, rtol=0, atol=1e-9)
    assert off(found, (track.online or track.pose).mean) < 1e-9
    revised = node.slam.path.select("x_m", "y_m", "heading_rad").to_numpy()
    assert off(revised, track.pose.mean) < 1e-9
    places = done.landmarks.select("x_m", "y_m").to_numpy()
    markers = [marker.pose.position for marker in node.told["~/map"][-1].markers[1:]]
    assert len(markers) >= 3
    np.testing.assert_allclose([(p.x, p.y) for p in markers], places, rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_bearings_the_wrong_way_round_are_another_track(started, logs):
    folder, poses = logs["mission"]
    node = started(folder / "log.toml")
    for topic, kind, _, fields in of_log(read_log(folder), poses=poses):
        for row in fields.get("sensed_data", ()):
            row["yaw"] = -row["yaw"]
        hand(node, topic, kind, fields)
    track = pipistrelle.slam(folder, filters="iekf").mission.trials[0].track
    assert off(poses_told(node)[1], track.pose.mean) > 1e-3


def test_the_transform_leads_from_the_odometry_to_the_map(started, logs):
    folder, poses = logs["mission"]
    node = driven(started(folder / "log.toml"), folder, poses)
    told, pose = node.told["/tf"][-1], node.slam.pose
    turn = 2.0 * math.atan2(told.transform.rotation.z, told.transform.rotation.w)
    shift = complex(told.transform.translation.x, told.transform.translation.y)
    there = shift + complex(*poses[-1, :2]) * np.exp(1j * turn)
    assert there == pytest.approx(complex(pose.x, pose.y), abs=1e-9)
    assert np.exp(1j * (turn + poses[-1, 2])) == pytest.approx(np.exp(1j * pose.heading))
    assert (told.header.frame_id, told.child_frame_id) == ("map", "odom")


def walk(node, count=5):
    """Drive straight ahead along x, 1 m/s, ten messages a second."""
    for i in range(count):
        hand(node, "/odom", ODOMETRY, odometry(0.1 * i, 0.1 * i, 0.0, 0.0, 1.0))


def test_pings_without_labels_go_through_frames_and_to_starboard(started, logs):
    node = started(
        logs["mission"][0] / "log.toml",
        echoes_type=DETECTIONS, association="nearest", speed_of_sound=340.0,
    )  # fmt: skip
    ping = {"rx_angles": [0.5], "two_way_travel_times": [0.02]}
    walk(node, 1)
    hand(node, "/seen", DETECTIONS, ping | {"header": header(0.0, "sonar")})
    assert "'sonar', which /tf_static does not tie to 'base_link'" in node.warned.pop()
    hand(node, "/tf_static", TRANSFORMS, static("base_link", "sonar", 0.4, 0.0))
    for i in range(1, 10):
        hand(node, "/odom", ODOMETRY, odometry(0.1 * i, 0.0, 0.0, 0.0))
        hand(node, "/seen", DETECTIONS, ping | {"header": header(0.1 * i, "sonar")})
    assert not node.warned
    (marker,) = node.told["~/map"][-1].markers[1:]
    here, pose = complex(marker.pose.position.x, marker.pose.position.y), node.slam.pose
    seen = (here - complex(pose.x, pose.y)) * np.exp(-1j * pose.heading)
    assert seen == pytest.approx(0.4 + 3.4 * np.exp(-0.5j), abs=1e-6)


ODD = {
    "odometry that is late": ("/odom", odometry(0.1, 0.1, 0.0, 0.0), "leave out what comes late"),
    "odometry that came": ("/odom", odometry(0.4, 0.4, 0.0, 0.0), "leave out what comes late"),
    "a place that is none": ("/odom", odometry(0.5, math.nan, 0.0, 0.0), "x nan"),
    "a jump": ("/odom", odometry(0.5, 1e12, 0.0, 0.0), "found"),
    "no turn": ("/odom", {"header": header(0.5)}, "quaternion"),
    "a scan that is late": ("/seen", labelled(0.2, [(9, 0.1, 2.0)]), "the vehicle has moved on"),
    "a scan before all": ("/seen", labelled(-9.0, [(9, 0.1, 2.0)]), "the vehicle has moved on"),
    "a range that is none": ("/seen", labelled(0.4, [(9, 0.1, math.nan)]), "the range nan"),
    "a bearing that is none": ("/seen", labelled(0.4, [(9, math.nan, 2.0)]), "no number"),
    "a label twice": ("/seen", labelled(0.4, [(9, 0.1, 2.0), (9, 0.3, 2.0)]), "landmark 9"),
    "no labels": ("/seen", labelled(0.4, [(-1, 0.1, 2.0)]), "association__method"),
    "a frame nowhere": ("/tf_static", static("a", "b", math.inf, 0.0), "translation"),
}
KINDS = {"/odom": ODOMETRY, "/seen": LABELLED, "/tf_static": TRANSFORMS}


@pytest.mark.parametrize("what", ODD)
def test_late_or_odd_messages_are_reported_and_ignored(started, logs, what):
    topic, fields, words = ODD[what]
    node, other = (started(logs["mission"][0] / "log.toml") for _ in range(2))
    for one in (node, other):
        walk(one)
        hand(one, "/seen", LABELLED, labelled(0.4, [(7, 0.1, 2.0)]))
    hand(node, topic, KINDS[topic], fields)
    (said,) = node.warned
    assert words in said
    for one in (node, other):
        hand(one, "/odom", ODOMETRY, odometry(0.6, 0.6, 0.0, 0.0))
        hand(one, "/seen", LABELLED, labelled(0.6, [(7, 0.1, 1.8)]))
    assert node.slam.path.equals(other.slam.path)
    assert node.slam.map.equals(other.slam.map)


def test_echoes_wait_for_the_odometry_and_not_without_end(started, logs):
    node = started(logs["mission"][0] / "log.toml")
    hand(node, "/seen", LABELLED, labelled(0.0, [(7, 0.1, 2.0)]))
    assert "without odometry" in node.warned.pop()
    walk(node, 1)
    hand(node, "/seen", LABELLED, labelled(0.05, [(7, 0.1, 2.0)]))
    assert not node.told["~/map"]
    walk_on = odometry(0.1, 0.1, 0.0, 0.0)
    hand(node, "/odom", ODOMETRY, walk_on)
    assert len(node.told["~/map"][-1].markers) == 2
    for k in range(1002):
        hand(node, "/seen", LABELLED, labelled(1.0 + k, [(7, 0.1, 2.0)]))
    assert len(node.waiting) == 1000
    assert len(node.warned) == 2


def test_a_log_without_usable_odometry_is_refused_at_the_start(started, tmp_path):
    with pytest.raises(pipistrelle.InputError, match=r"nowhere\.toml: found no such file"):
        started(tmp_path / "nowhere.toml")
    with pytest.raises(pipistrelle.InputError, match="'bicycle', expected 'poses' or 'unicycle'"):
        started(DATA / "bicycle_log" / "log.toml")

    with pytest.raises(SystemExit, match=r"slam_node: .*found 'bicycle'"):
        runpy.run_path(str(EXAMPLE / "slam_node.py"), run_name="__main__")


NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e9, -1e9, 1e300, 1e-300, 5e-324, 7.0)


def spoil(rng, message):
    """Put an odd number or name into one of a message's fields, however deep."""
    while True:
        name = rng.choice([name for name in vars(message) if name != "_kind"])
        value = getattr(message, name)
        if isinstance(value, list) and value:
            value = value[rng.integers(len(value))]
        if not isinstance(value, Message):
            break
        message = value
    if isinstance(value, np.ndarray) and value.size:
        value[rng.integers(value.size)] = rng.choice(NUMBERS[:6])
    elif isinstance(value, float):
        setattr(message, name, float(rng.choice(NUMBERS)))
    elif isinstance(value, int):
        setattr(message, name, int(rng.choice([-(2**31), -1, 0, 3, 10**9, 2**31 - 1])))
    elif isinstance(value, str):
        setattr(message, name, str(rng.choice(["", "odom", "/base_link", "no\0where"])))


@pytest.mark.parametrize("drives", [3, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("motion", ["mission", "unicycle"])
@pytest.mark.parametrize("kind", [LABELLED, DETECTIONS])
def test_no_message_ends_the_node_or_leaves_it_without_a_number(
    started, logs, motion, kind, drives
):
    rng, words = np.random.default_rng(7), {"echoes_type": kind, "association": "nearest"}
    for _ in range(drives):
        node = started(logs[motion][0] / "log.toml", **words, speed_of_sound=340.0)
        for i in range(12):
            time, x = 0.1 * i, 0.05 * i
            ping = {"rx_angles": [0.5, -0.2], "two_way_travel_times": [0.02, 0.01]}
            seen = {
                LABELLED: labelled(time, [(-1, 0.5 - 0.1 * x, 3.0 - x), (-1, -0.7, 2.0 - x)]),
                DETECTIONS: ping | {"header": header(time, "base_link"), "flags": [{}, {}]},
            }
            for topic, name, fields in (
                ("/odom", ODOMETRY, odometry(time, x, 0.0, 0.0, 0.5)),
                ("/seen", kind, seen[kind]),
                ("/tf_static", TRANSFORMS, static("base_link", "mast", 0.1, 0.0)),
            ):
                message = filled(Message(name), fields)
                if rng.random() < 0.3:
                    spoil(rng, message)
                node.takes[topic](message)
        pose = node.slam.pose
        assert np.isfinite([*pose[1:4], *pose.covariance.ravel()]).all()
        assert node.told["~/pose"] or node.warned


def test_the_launch_file_hands_over_every_parameter(monkeypatch):
    install(monkeypatch)
    described = runpy.run_path(str(EXAMPLE / "slam.launch.py"))["generate_launch_description"]()
    parameters = runpy.run_path(str(EXAMPLE / "slam_node.py"))["PARAMETERS"]
    *declared, process = described
    assert {words[0]: given["default_value"] for _, words, given in declared} == {
        name: str(value) for name, value in parameters.items()
    }
    command = process[2]["cmd"]
    assert Path(command[1]) == EXAMPLE / "slam_node.py"
    assert [word for word in command if isinstance(word, list)] == [
        [f"{name}:=", f"<{name}>"] for name in parameters
    ]


def test_messages_from_before_the_clock_began_are_forgotten(started, logs):
    node = started(logs["poses"][0] / "log.toml")
    for i in range(6):
        time = 0.0 if i == 0 else 1000.0 + 0.1 * i
        hand(node, "/odom", ODOMETRY, odometry(time, 0.1 * i, 0.0, 0.0))
    assert not node.warned
    assert node.slam.time == pytest.approx(1000.5)
    x, y = node.slam.path.select("x_m", "y_m").to_numpy()[0]
    assert math.hypot(node.slam.pose.x - x, node.slam.pose.y - y) == pytest.approx(0.4)
    hand(node, "/odom", ODOMETRY, {"header": header(1000.6)})
    assert "found the quaternion (0, 0, 0, 0) of length 0" in node.warned.pop()
    hand(node, "/odom", ODOMETRY, odometry(1000.7, 0.7, 0.0, 0.0))
    assert node.slam.time == pytest.approx(1000.7)
