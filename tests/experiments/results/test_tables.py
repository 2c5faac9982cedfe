"""The files' contents: numbers survive them, and what is missing is null."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian, Track
from pipistrelle.evaluation.accuracy import pose_error, position_error
from pipistrelle.evaluation.consistency import nees
from pipistrelle.experiments.results.tables import (
    landmark_table,
    map_text,
    measurement_table,
    step_table,
    tum_text,
)
from pipistrelle.geometry import wrap
from reference.missions import map_with, scan_with


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
