"""Adapters of public data sets, on files of their formats that are made up here."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from pipistrelle.config import InputError
from pipistrelle.detection.logs.folder import read_log
from pipistrelle.estimation.motion import Motion, motion_step

ADAPTERS = Path(__file__).resolve().parents[1] / "examples" / "adapters"


sys.path.append(str(ADAPTERS))  # of modules that adapters share


def functions(name):
    return runpy.run_path(str(ADAPTERS / f"{name}.py"), run_name="adapter")


@pytest.fixture
def park(tmp_path):
    """A car on a circle that sees one trunk 10 m ahead of its lidar, and a fix for each scan."""
    files = tmp_path / "files"
    files.mkdir()
    car = Motion(model="ackermann", control_std=(0, 0), wheelbase=2.83, speed_offset=0.76)
    told, pose = np.array([3.0, 0.1]), np.zeros(3)
    rows, fixes, path = [], [], []
    for k in range(200):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        eye = pose[:2] + np.array([3.78 * c - 0.5 * s, 3.78 * s + 0.5 * c])
        rows.append((0.1 * k, 10.0, np.pi / 2, 0.3))
        fixes.append((0.1 * k, *(np.array([[0.6, -0.8], [0.8, 0.6]]) @ eye + [40.0, -7.0])))
        path.append((0.1 * k, *pose[:2], 0, 0, 0, np.sin(pose[2] / 2), np.cos(pose[2] / 2)))
        pose = motion_step(car, pose, told, 0.1)
    rows.append((19.95, 60.0, 1.0, 0.3))
    np.savetxt(files / "inputs.dat", [(0.1 * k, *told) for k in range(201)])
    np.savetxt(files / "measurements.dat", rows)
    np.savetxt(files / "gps.dat", fixes)
    return files, np.array(path)


def test_victoria_park_is_a_log_of_a_car_with_a_lidar_ahead(park, tmp_path):
    files, _ = park
    functions("victoria_park")["log"](files, tmp_path / "log")
    log = read_log(tmp_path / "log")
    assert (log.motion, log.wheelbase, log.speed_offset) == ("ackermann", 2.83, 0.76)
    assert log.sensor_pose == (3.78, 0.5, 0.0)
    assert len(log.scans) == 200, "the trunk that is too far is left out"
    assert {scan.bearing[0] for scan in log.scans} == {0.0}, "theirs is from the right"
    assert log.association["detection_rate"] == 0.9


def test_the_score_is_of_the_lidar_after_alignment(park, tmp_path, capsys):
    files, path = park
    result = tmp_path / "result"
    result.mkdir()
    np.savetxt(result / "track_fused_iekf.tum", path)
    (result / "track_fused_iekf_online.tum").write_text("a smoother's\n")
    (result / "map_fused_iekf.csv").write_text("landmark,x,y\n1,2.0,3.0\n2,4.0,5.0\n")
    functions("victoria_park")["score"](files, result, tmp_path / "picture.png")
    said = capsys.readouterr().out
    assert said.count("RMSE 0.00 m") == 2
    assert "2 landmarks" in said
    assert (tmp_path / "picture.png").stat().st_size > 1000
    path[:, 1] *= 1.2
    np.savetxt(result / "track_fused_iekf.tum", path)
    functions("victoria_park")["score"](files, result)
    assert "RMSE 0.00" not in capsys.readouterr().out


def test_invalid_victoria_park_files_are_refused_by_line(park, tmp_path):
    files, _ = park
    (files / "inputs.dat").write_text("0.0 1.0 0.0\n0.1 fast 0.0\n")
    with pytest.raises(InputError, match=r"inputs\.dat, line 2: found speed 'fast'"):
        functions("victoria_park")["log"](files, tmp_path / "log")


@pytest.fixture
def world(tmp_path):
    """The files of a small world of three posts."""
    files = tmp_path / "files"
    files.mkdir()
    path = np.column_stack((np.arange(6.0), np.zeros(6), np.zeros(6)))
    posts = np.array([[1, 20.0, 5.0, 0, 0], [2, 30.0, -9.0, 0, 0], [3, -50.0, 0.0, 0, 0]])
    told = np.array([np.ones(6), np.zeros(6)])
    seen = np.empty((1, 6), object)
    for k in range(6):
        way = (posts[:2, 1:3] - path[k, :2]) @ [1, 1j]
        seen[0, k] = np.array([np.abs(way), np.angle(way)])
    savemat(
        files / "Environment_SLAM.mat",
        {
            "Robot_Groundtruth": path.T,
            "Landmark_Groundtruth": posts,
            "Robot_Odometry": told,
            "Robot_Control": told,
        },
    )
    savemat(files / "Robot_Measurement.mat", {"Robot_Measurement": seen})
    return files, path, posts


def test_the_published_draw_is_used_and_a_seed_draws_another(world, tmp_path):
    files, path, posts = world
    write = functions("phd_slam")["log"]
    write(files, tmp_path / "log")
    log = read_log(tmp_path / "log")
    assert [len(scan.bearing) for scan in log.scans] == [2] * 6
    assert log.initial_pose == (0.0, 0.0, 0.0)
    for scan in log.scans:
        x = path[int(scan.time), 0]
        found = x + scan.range * np.exp(1j * scan.bearing)
        np.testing.assert_allclose(np.column_stack((found.real, found.imag)), posts[:2, 1:3])
    write(files, tmp_path / "other", Path("3"))
    other = read_log(tmp_path / "other")
    rows = sum(len(scan.bearing) for scan in other.scans)
    # Two posts in sight and five false rows are detected to 0.95: 39.9 of them, deviation 5.5.
    assert abs(rows - 6 * 7 * 0.95) < 25
    assert not np.array_equal(other.controls, log.controls)


def test_gospa_matches_the_authors_formula(world, tmp_path, capsys):
    # One post is 3 m off, one missed, one false: 9 + 2 * 20^2 / 2.
    files, path, _ = world
    result = tmp_path / "result"
    result.mkdir()
    zeros = np.zeros((6, 5))
    np.savetxt(result / "track_x.tum", np.column_stack((path[:, 0], path[:, :2] + [0, 2], zeros)))
    (result / "map_x.csv").write_text("landmark,x,y\n1,23.0,5.0\n2,30.0,-9.0\n7,90.0,90.0\n")
    functions("phd_slam")["score"](files, result)
    assert capsys.readouterr().out == "position 2.00 m, GOSPA 20.22 m, 1 missed, 1 false\n"


def test_plaza_steps_end_at_ranges(tmp_path, capsys):
    # 1 m/s along x; the second range is heard between two rows of odometry, and out of order.
    path = np.column_stack((np.arange(4.0), np.arange(4.0), np.zeros(4), np.zeros(4)))
    turned = path + np.array([0, 0, 0, np.pi])  # as Plaza 2 has it
    odometry = np.column_stack((path[1:, 0], np.ones(3), np.zeros(3)))
    ranges = [[1.5, 2, 6, 8.5], [1.0, 2, 6, 9.0], [9.0, 2, 6, 1.0]]
    beacon = [[6, 10.0, 0.0]]
    file = tmp_path / "Plaza2_.mat"
    savemat(file, {"GT": turned, "DRp": path, "DR": odometry, "TD": ranges, "TL": beacon})
    plaza, log, result = functions("plaza"), tmp_path / "log", tmp_path / "result"
    plaza["log"](file, log)
    rows = (log / "measurements.csv").read_text()
    assert rows == "time,landmark,bearing,range\n1.0,6,,9.0\n1.5,6,,8.5\n"
    assert "\n1.5,1.0,0.0\n2.0,1.0,0.0\n" in (log / "odometry.csv").read_text()
    assert "\n3.0,3.0,0.0,0.0\n" in (log / "truth.csv").read_text()
    result.mkdir()
    np.savetxt(result / "track_x.tum", np.hstack((path[:, [0, 2, 1]], np.zeros((4, 5)))))
    (result / "map_x.csv").write_text("landmark,x,y\n6,0.0,10.5\n")
    plaza["score"](file, result)
    trajectory, landmarks = capsys.readouterr().out.splitlines()
    assert "RMSE 0.000 m at 4 times" in trajectory, "a turned track is aligned"
    assert landmarks == "landmarks: RMSE 0.500 m, 1 of 1 mapped: 6 0.50 m"


def test_labyrinth_wheels_are_left_and_right(tmp_path):
    rows = [f"odom2diff {k} 0.9 1.1 0 0.1 0.0001 0.0001 0.0001" for k in range(3)]
    rows += ["range2 1 2.0 0.01 2.0 0.0 105 0", "range2 2 -1.0 0.01 2.0 0.0 105 0"]
    (file := tmp_path / "Indoor_UWB_Input.txt").write_text("\n".join(rows))
    truth = "\n".join(f"point2 {k} 0.0 {k} 0 0 0 0" for k in range(3))
    (tmp_path / "Indoor_UWB_GT.txt").write_text(truth)
    functions("librsf")["log"](file, tmp_path / "log")
    rows = np.loadtxt(tmp_path / "log" / "odometry.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:2, 1:], [[1.0, 1.0]] * 2)
    assert (tmp_path / "log" / "measurements.csv").read_text().endswith("range\n1.0,105,,2.0\n")
