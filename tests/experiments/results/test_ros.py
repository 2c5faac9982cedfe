"""A bag of results holds tracks and maps as the tables do, and is read by rosbags and by `slam`."""

import itertools
import math
import sys

import numpy as np
import polars as pl
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from pipistrelle.__main__ import main
from pipistrelle.config import BagConfig, InputError
from pipistrelle.detection.logs.bag import opened
from pipistrelle.detection.logs.bag_log import read_poses
from pipistrelle.experiments.results.ros import (
    POSE,
    correction_fields,
    header,
    map_fields,
    pose_fields,
    write_bag,
)
from pipistrelle.geometry import wrap
from reference.pictures import without_picture

MISSION = ("--settings", "paper", "--duration", "10", "--landmarks", "10", "--quiet")
PLANE = np.ix_((0, 1, 5), (0, 1, 5))
SIDES = [*itertools.product(("active", "fused", "passive"), ("ekf", "smoother"))]


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    """Return a result folder that has a bag."""
    folder = tmp_path_factory.mktemp("mission") / "out"
    ways = ["--strategy", "all", "--filter", "ekf,smoother"]
    with without_picture():
        assert main(["run", *MISSION, *ways, "--save-bag", "-o", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def messages(mission):
    """Return the messages of the bag, by topic: when each was written, and what it says."""
    store, found = get_typestore(Stores.ROS2_HUMBLE), {}
    with Reader(mission / "mission.mcap") as reader:
        for connection, stamp, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def heading_of(q):
    return 2.0 * math.atan2(q.z, q.w)


def table_of(folder, name, side):
    both = pl.read_parquet(folder / f"{name}.parquet")
    return both.filter(strategy=side[0], filter=side[1])


@pytest.mark.parametrize("side", SIDES)
def test_a_track_in_the_bag_equals_the_table(mission, messages, side):
    rows = table_of(mission, "steps", side)
    told = messages[f"/{side[0]}/{side[1]}/pose"]
    assert len(told) == rows.height > 50
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec / 1e9 for _, m in told]
    np.testing.assert_allclose(stamps, rows["time_s"], rtol=0, atol=1e-9)
    assert [stamp for stamp, _ in told] == [round(1e9 * time) for time in stamps]
    place = [(m.pose.pose.position.x, m.pose.pose.position.y) for _, m in told]
    np.testing.assert_allclose(place, rows.select("x_m", "y_m"), rtol=0, atol=1e-9)
    heading = np.array([heading_of(m.pose.pose.orientation) for _, m in told])
    np.testing.assert_allclose(wrap(heading - rows["heading_rad"].to_numpy()), 0.0, atol=1e-9)
    covariance = np.array([m.pose.covariance.reshape(6, 6)[PLANE] for _, m in told])
    stds = rows.select("x_std_m", "y_std_m", "heading_std_rad").to_numpy()
    np.testing.assert_allclose(np.einsum("kii->ki", covariance), stds**2, rtol=0, atol=1e-9)
    assert {m.header.frame_id for _, m in told} == {"map"}


@pytest.mark.parametrize("side", SIDES)
def test_a_map_in_the_bag_is_every_hypothesis_of_the_table(mission, messages, side):
    rows = table_of(mission, "landmarks", side).filter(pl.col("status") != "unseen")
    ((_, told),) = messages[f"/{side[0]}/{side[1]}/map"]
    first, *markers = told.markers
    assert first.action == first.DELETEALL
    assert len(markers) == rows.height > 0
    for marker, row in zip(markers, rows.iter_rows(named=True), strict=True):
        assert (marker.ns, marker.text) == (f"landmark {row['landmark']}", row["status"])
        place = marker.pose.position
        assert (place.x, place.y) == pytest.approx((row["x_m"], row["y_m"]), abs=1e-9)
        angle = heading_of(marker.pose.orientation)
        c, s = math.cos(angle), math.sin(angle)
        axes = np.array([[c, -s], [s, c]]) * [marker.scale.x / 2.0, marker.scale.y / 2.0]
        covariance = [[row["xx_m2"], row["xy_m2"]], [row["xy_m2"], row["yy_m2"]]]
        np.testing.assert_allclose(axes @ axes.T, covariance, rtol=0, atol=1e-9)
        assert marker.color.a == pytest.approx(row["weight"], abs=1e-6)
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)


def test_a_map_is_latched_and_a_track_is_not(mission):
    with Reader(mission / "mission.mcap") as reader:
        latched = {
            one.topic: [qos.durability.name for qos in one.ext.offered_qos_profiles]
            for one in reader.connections
        }
    assert {topic for topic, said in latched.items() if said == ["TRANSIENT_LOCAL"]} == {
        f"/{strategy}/{name}/map" for strategy, name in SIDES
    }


def test_slam_reads_a_track_of_results_as_a_truth(mission):
    time, path = read_poses(
        mission / "mission.mcap", BagConfig(truth="/fused/smoother/pose")
    )  # fmt: skip
    rows = table_of(mission, "steps", ("fused", "smoother"))
    np.testing.assert_allclose(time, rows["time_s"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(path[:, :2], rows.select("x_m", "y_m"), rtol=0, atol=1e-9)


def test_a_solved_log_has_a_bag_and_without_the_option_none_is_written(tmp_path, undrawn):
    log, out = tmp_path / "log", tmp_path / "out"
    assert main(["run", *MISSION, "--save-log", str(log), "-o", str(out)]) == 0
    assert not (out / "mission.mcap").exists()
    line = ["slam", str(log), "--quiet", "-o", str(out), "--overwrite"]
    assert main([*line, "--save-bag"]) == 0
    with opened(out / "mission.mcap") as bag:
        assert list(bag.topics) == ["/fused/smoother/map", "/fused/smoother/pose"]
    assert "mission.mcap" in (out / "SHA256SUMS").read_text()
    assert main(line) == 0, "what was written is replaced"
    assert not (out / "mission.mcap").exists()


def test_without_rosbags_nothing_is_begun(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    assert main(["run", *MISSION, "--save-bag", "-o", str(tmp_path / "out")]) == 2
    assert "--save-bag: needs rosbags" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("time", [-0.5, 2.0**31, math.nan, math.inf])
def test_a_time_that_no_stamp_represents_is_refused(time):
    with pytest.raises(InputError, match="as a stamp can tell"):
        header(time, "map")


def test_the_last_half_nanosecond_of_a_second_is_the_next_second():
    assert header(math.nextafter(7.0, 0.0), "")["stamp"] == {"sec": 7, "nanosec": 0}


def test_a_point_of_the_odometry_is_corrected_onto_the_map():
    told = correction_fields(1.0, ("map", "odom"), (3.0, -2.0, 2.5), (1.0, 4.0, -0.5))
    move, turn = told["transform"]["translation"], heading_of(_Named(told["transform"]["rotation"]))
    here = complex(move["x"], move["y"]) + complex(1.0, 4.0) * np.exp(1j * turn)
    assert here == pytest.approx(complex(3.0, -2.0))
    assert wrap(turn - 3.0) == pytest.approx(0.0, abs=1e-12)
    assert (told["header"]["frame_id"], told["child_frame_id"]) == ("map", "odom")


class _Named:
    """A dictionary's values, as attributes."""

    def __init__(self, values):
        self.__dict__.update(values)


def test_non_finite_landmarks_are_left_out_of_a_map():
    row = {"landmark": 7, "status": "full", "weight": 1.0, "x_m": math.nan, "y_m": 0.0}
    table = pl.DataFrame(row | {"xx_m2": 1.0, "xy_m2": 0.0, "yy_m2": 1.0})
    assert len(map_fields(0.0, "map", table)["markers"]) == 1


def test_a_field_that_no_message_has_is_refused(tmp_path):
    fields = pose_fields(0.0, "map", np.zeros(3), np.eye(3)) | {"twist": {}}
    with pytest.raises(ValueError, match="has no field twist"):
        write_bag(tmp_path / "one.mcap", [("/pose", POSE, 0.0, fields)])
    assert list(tmp_path.iterdir()) == []
