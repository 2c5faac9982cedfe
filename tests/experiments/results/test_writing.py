"""The result folder: what is made, what is refused, and that numbers survive its files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian, Track
from pipistrelle.evaluation.accuracy import pose_error, position_error
from pipistrelle.evaluation.consistency import nees
from pipistrelle.experiments.results.writing import (
    landmark_table,
    map_text,
    measurement_table,
    result_folder,
    step_table,
    tum_text,
)
from pipistrelle.files import RESULTS, SUMS, OwnFiles, claim
from pipistrelle.geometry import wrap
from reference.missions import map_with, scan_with


@pytest.fixture
def earlier(tmp_path):
    names = ("track_fused_ekf.tum", "map_fused_ekf.csv", "mission.png", "config.toml")
    OwnFiles(tmp_path, RESULTS).replace(dict.fromkeys(names, "old") | {"summary.json": "{}"})
    return tmp_path


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Path("runs")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def ran(path=None, overwrite=False):
    """Fill a folder as a mission does, and return it."""
    with result_folder(path, "run", overwrite=overwrite) as own:
        own.replace({"summary.json": "{}"})
    return own.folder


def refused():
    """Begin a mission that is refused."""
    with (
        pytest.raises(InputError, match="no such world"),
        result_folder(None, "run", overwrite=False),
    ):
        raise InputError("no such world")


def test_the_folder_asked_for_is_the_result_folder(tmp_path):
    asked = tmp_path / "a" / "b"
    assert ran(asked) == asked
    assert names(asked) == [SUMS, "summary.json"]
    asked = tmp_path / "empty"
    asked.mkdir()
    assert ran(asked) == asked


def test_without_a_name_runs_latest_is_the_newest_folder_that_is_whole(here):
    first, second = ran(), ran()
    assert first != second
    assert first.parent == second.parent == here
    assert first.name.endswith("-run")
    assert (here / "latest").readlink() == Path(second.name)
    with result_folder(None, "slam", overwrite=False) as own:
        assert (here / "latest").readlink() == Path(second.name), "nothing is there yet"
        own.replace({"summary.json": "{}"})
    assert (here / "latest").readlink() == Path(own.folder.name)
    assert len(names(here)) == 4


def test_a_refused_mission_leaves_no_folder_and_latest_where_it_was(here):
    refused()
    assert not here.exists()
    first = ran()
    refused()
    assert names(here) == [first.name, "latest"]
    assert (here / "latest").readlink() == Path(first.name)


def test_a_system_without_symbolic_links_only_lacks_the_link(here, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError("no links here")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    folder = ran()
    assert names(here) == [folder.name]


@pytest.mark.parametrize("kind", ["file", "folder", "link of another tool", "link to nothing"])
def test_a_foreign_file_named_latest_is_not_touched(here, kind):
    here.mkdir()
    mine = here / "latest"
    if kind == "file":
        mine.write_text("notes")
    elif kind == "folder":
        mine.mkdir()
    else:
        mine.symlink_to("checkpoint-7" if kind == "link to nothing" else "../notes")
    before = mine.lstat()
    folder = ran()
    assert names(here) == [folder.name, "latest"]
    after = mine.lstat()
    for name in ("st_ino", "st_mode", "st_size", "st_mtime_ns"):  # a link may be read
        assert getattr(after, name) == getattr(before, name)


def test_a_link_of_ours_to_a_folder_that_was_removed_is_replaced(here):
    here.mkdir()
    (here / "latest").symlink_to("20260101-120000-slam-2")
    assert (here / ran().name).samefile(here / "latest")


def test_a_folder_with_results_is_refused_unless_overwriting(earlier):
    before = names(earlier)
    with pytest.raises(InputError, match=r"not empty.*--overwrite") as refusal:
        ran(earlier)
    assert str(earlier) in str(refusal.value)
    assert names(earlier) == before
    with result_folder(earlier, "run", overwrite=True) as own:
        assert names(earlier) == before, "the old results stay until there are new ones"
        own.replace({"summary.json": "{}"})
    assert names(earlier) == [SUMS, "summary.json"]


def test_overwriting_keeps_the_users_files_in_the_folder(earlier):
    mine = ("notes.txt", "mission.txt", "map_house.csv", "track_jazz.tum", "a.partial")
    for name in mine:
        (earlier / name).write_text("mine")
    ran(earlier, overwrite=True)
    assert names(earlier) == sorted([*mine, SUMS, "summary.json"])


@pytest.mark.parametrize("name", ["README.md", "mission.pdf", "track_active_ekf.tum"])
def test_overwriting_refuses_a_users_file_in_the_place_of_a_result(earlier, name):
    (earlier / name).write_text("mine")
    before = names(earlier)
    with pytest.raises(InputError, match=rf"{name}: is not Pipistrelle's, so it is not replaced"):
        claim(earlier, RESULTS, overwrite=True)
    assert names(earlier) == before


def test_runs_that_is_a_file_is_refused(here):
    here.write_text("mine")
    with pytest.raises(InputError, match=r"^runs: cannot be used"):
        ran()


@pytest.fixture
def landmarks():
    rng = np.random.default_rng(2)
    factor = rng.normal(0.0, 0.3, (5, 2, 2))
    return map_with(
        [51, 4, 4, 4, 17],
        rng.normal(0.0, 20.0, (5, 2)),
        factor @ np.swapaxes(factor, 1, 2),
        [1.0, 0.2, 0.5, 0.3, 1.0],
    )


@pytest.fixture
def track(landmarks):
    rng = np.random.default_rng(1)
    covariance = np.diag([0.04, 0.09, 0.01]) * np.arange(1, 6)[:, None, None]
    return Track(
        time=1.2e9 + 0.125 * np.arange(5),
        pose=Gaussian(mean=rng.normal(0.0, 2.0, (5, 3)), covariance=covariance),
        landmarks=landmarks,
        gated=0,
    )


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-10.0, 10.0), st.integers(0, 2**41))
def test_a_pose_survives_the_tum_format(x, y, heading, microseconds):
    text = tum_text(np.array([microseconds * 1e-6]), np.array([[x, y, heading]]))
    fields = text.split(" ")
    time, *pose = map(float, fields)
    assert len(fields) == 8
    assert time == pytest.approx(microseconds * 1e-6, abs=0.6e-6)
    assert pose[:3] == pytest.approx([x, y, 0.0], abs=1e-12)
    assert np.linalg.norm(pose[3:]) == pytest.approx(1.0, abs=1e-11)
    # Each half-angle part is rounded to 0.5e-12.
    assert wrap(2.0 * np.arctan2(pose[5], pose[6]) - heading) == pytest.approx(0.0, abs=4e-12)


def test_a_map_survives_its_text(landmarks):
    header, *lines = map_text(landmarks).splitlines()
    assert header == "landmark,x,y,xx,xy,yy,status"
    rows = [line.split(",") for line in lines]
    assert [(row[0], row[-1]) for row in rows] == [("51", "full"), ("4", "partial"), ("17", "full")]
    chosen = [0, 2, 4]
    P = landmarks.covariance[chosen]
    expected = np.column_stack([landmarks.mean[chosen], P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]])
    numbers = np.array([row[1:-1] for row in rows], dtype=float)
    assert numbers == pytest.approx(expected, rel=1e-14)


def test_the_step_table_is_the_track_with_its_errors(track):
    true = track.pose.mean + 0.1
    table = step_table(track, true)
    assert table["time_s"].to_list() == track.time.tolist()
    error = pose_error(track.pose.mean, true)
    assert (table["position_error_m"].to_numpy() == position_error(track.pose.mean, true)).all()
    assert (table["heading_error_rad"].to_numpy() == error[:, 2]).all()
    assert (table["nees"].to_numpy() == nees(error, track.pose.covariance)).all()
    assert table["heading_std_rad"].to_numpy() == pytest.approx(0.1 * np.sqrt(np.arange(1, 6)))
    assert table["true_heading_rad"].to_list() == true[:, 2].tolist()


def test_where_the_truth_has_ended_the_step_table_has_neither_errors_nor_nees(track):
    true = track.pose.mean + 0.1
    true[3:] = np.nan
    scored = ["position_error_m", "heading_error_rad", "nees"]
    values = step_table(track, true).select(scored).to_numpy()
    assert np.isfinite(values[:3]).all()
    assert np.isnan(values[3:]).all()


def test_without_truth_the_step_table_has_the_same_columns_and_nulls(track):
    table, scored = step_table(track, None), step_table(track, track.pose.mean)
    assert table.schema == scored.schema
    unknown = [name for name in table.columns if table[name].null_count() == len(table)]
    assert unknown == [
        "true_x_m",
        "true_y_m",
        "true_heading_rad",
        "position_error_m",
        "heading_error_rad",
        "nees",
    ]
    assert sum(table.null_count().row(0)) == len(unknown) * len(table)


def test_the_landmark_table_holds_every_hypothesis_and_every_true_landmark(landmarks):
    labels, positions = np.array([4, 8, 51]), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    table = landmark_table(landmarks, (labels, positions))
    assert table["landmark"].to_list() == [51, 4, 4, 4, 17, 8]
    assert table["status"].to_list() == ["full", *["partial"] * 3, "full", "unseen"]
    assert table["error_m"][0] == pytest.approx(np.hypot(*(landmarks.mean[0] - [5.0, 6.0])))
    assert table["error_m"].is_null().to_list() == [False, False, False, False, True, True]
    assert table["true_x_m"].to_list() == [5.0, 1.0, 1.0, 1.0, None, 3.0]


def test_landmark_table_joins_the_truth_by_the_names_that_a_map_has_there(landmarks):
    labels, positions = np.array([4, 8, 51]), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    mapped = replace(landmarks, landmark=np.array([8, -6, -6, -6, 4]))
    table = landmark_table(landmarks, (labels, positions), mapped)
    assert table["landmark"].to_list() == [51, 4, 4, 4, 17, None]
    assert table["true_landmark"].to_list() == [8, None, None, None, 4, 51]
    assert table["status"].to_list() == ["full", *["partial"] * 3, "full", "unseen"]
    assert table["true_x_m"].to_list() == [3.0, None, None, None, 1.0, 5.0]
    error = np.hypot(*(landmarks.mean[[0, 4]] - positions[[1, 0]]).T)
    assert table["error_m"].drop_nulls().to_list() == pytest.approx(error.tolist())


def test_the_landmark_table_contains_the_covariance_of_each_hypothesis(landmarks):
    table = landmark_table(landmarks, None)
    terms = table.select("xx_m2", "xy_m2", "yy_m2").to_numpy()
    np.testing.assert_array_equal(terms, landmarks.covariance.reshape(-1, 4)[:, [0, 1, 3]])
    np.testing.assert_array_equal(table.select("x_m", "y_m").to_numpy(), landmarks.mean)
    assert table["weight"].to_list() == landmarks.weight.tolist()


def test_the_tables_of_nothing_have_the_columns_of_something(landmarks):
    assert landmark_table(map_with(), None).schema == landmark_table(landmarks, None).schema
    scan = scan_with([1], [0.0], [1.0])
    assert measurement_table([]).schema == measurement_table([scan]).schema


def test_a_passive_measurement_has_no_range_in_the_table():
    scans = [
        scan_with([3, 9], [0.1, -0.2], [7.0, np.nan], time=0.5),
        scan_with(time=1.0),
        scan_with([9], [0.4], [2.0], time=1.5),
    ]
    table = measurement_table(scans)
    rows = table.select("time_s", "landmark", "bearing_rad", "range_m").rows()
    assert rows == [(0.5, 3, 0.1, 7.0), (0.5, 9, -0.2, None), (1.5, 9, 0.4, 2.0)]
    assert table.schema["landmark"] == pl.Int64


def test_the_measurement_table_has_excess_paths_with_their_callers():
    timed = make_scan(
        1.0,
        np.array([4, 4, 5]),
        np.array([0.5, np.nan, 0.1]),
        caller=np.array([1, 2, 0]),
        excess_path=np.array([3.0, 7.0, np.nan]),
        excess_path_std=0.2,
    )
    told = measurement_table([timed], ["beacon"])
    assert told.schema == measurement_table([]).schema
    assert told.select("bearing_rad", "excess_path_m", "excess_path_std_m", "caller").rows() == [
        (0.5, 3.0, 0.2, "beacon"),
        (None, 7.0, 0.2, "caller2"),
        (0.1, None, None, None),
    ]
