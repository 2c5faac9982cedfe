"""Scores and the result folder, from a track to what other tools read."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipistrelle.config import AirConfig, Config, InputError, Section
from pipistrelle.estimation.beliefs import Gaussian, Track
from pipistrelle.estimation.catalogue import entry
from pipistrelle.evaluation.accuracy import alignment, moved, position_error, rmse
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.results.scores import Scores, TrialResult, score, with_shared
from pipistrelle.experiments.results.writing import config_hash, write_results
from pipistrelle.files import RESULTS, OwnFiles
from reference.missions import map_with, scan_with

STEPS = 400
EKF_LIMIT = entry("ekf").nees_limit
EVO_APE = shutil.which("evo_ape", path=Path(sys.executable).parent)
KEYS = [
    "strategy", "filter", "position_rmse_m", "heading_rmse_rad", "map_rmse_m",
    "position_rmse_aligned_m", "map_rmse_aligned_m", "map_rmse_shared_m", "position_floor_m",
    "position_bound_m", "heading_bound_rad", "nees_mean", "nees_max", "caller_rmse_m",
    "caller_rmse_aligned_m", "diverged", "landmarks_full", "landmarks_total",
    "measurements_per_frame", "gated", "nis_mean", "gated_of", "ignored_rows", "wall_s",
]  # fmt: skip


def loop():
    angle = np.linspace(0.0, 6.0, STEPS + 1)
    return np.column_stack([7.4 * np.sin(angle), -7.4 * np.cos(angle), angle - 3.0])


TIME = 1.2e9 + 0.125 * np.arange(STEPS + 1)
TRUE_LANDMARKS = (np.array([1, 2, 3, 4]), np.array([[1.0, 1], [5, 2], [-4, 3], [0, 9]]))
TRUTH = Truth(time=TIME, path=loop(), landmarks=TRUE_LANDMARKS)
SCANS = (
    scan_with([1, 2], [0.1, 0.2], [4.0, np.nan], time=TIME[0]),
    scan_with(time=TIME[4]),
    scan_with([3], [-1.0], [2.0], time=TIME[8]),
)


def drifting_track(seed=0, landmarks=(2, 1, 1, 3, 77)):
    """Make a track off the true loop, with a ray for landmark 1 and an unknown landmark 77."""
    rng = np.random.default_rng(seed)
    pose = loop() + np.cumsum(rng.normal(0.0, 0.005, (STEPS + 1, 3)), axis=0)
    labels = np.array(landmarks, dtype=np.int64)
    h = len(labels)
    return Track(
        time=TIME,
        pose=Gaussian(mean=pose, covariance=np.tile(0.01 * np.eye(3), (STEPS + 1, 1, 1))),
        landmarks=map_with(
            labels,
            rng.normal(0.0, 5.0, (h, 2)),
            np.tile(0.04 * np.eye(2), (h, 1, 1)),
            np.where(labels == 1, 0.5, 1.0),
        ),
        gated=6,
    )


def trial(track, strategy="fused", name="ekf"):
    return TrialResult(
        strategy=strategy,
        filter=name,
        track=track,
        heard=SCANS,
        scans=SCANS,
        scores=score(track, TRUTH, SCANS, EKF_LIMIT),
        wall_s=0.25,
    )


def write(folder, *trials, truth=TRUTH, **changes):
    given = {"config": Config(), "command": "pipistrelle run --seed 7", "seed": 7}
    given |= {"trials": trials, "truth": truth, "ignored_rows": {}} | changes
    write_results(OwnFiles(folder, RESULTS), **given)
    return json.loads((folder / "summary.json").read_text())


def with_pose(track, mean):
    pose = Gaussian(mean=mean, covariance=track.pose.covariance)
    return Track(time=track.time, pose=pose, landmarks=track.landmarks, gated=track.gated)


def test_the_start_is_not_scored():
    track = drifting_track()
    moved_start = track.pose.mean.copy()
    moved_start[0] += 100.0
    first = score(track, TRUTH, SCANS, EKF_LIMIT)
    assert score(with_pose(track, moved_start), TRUTH, SCANS, EKF_LIMIT) == first
    moved_end = track.pose.mean.copy()
    moved_end[-1] += 100.0
    assert score(with_pose(track, moved_end), TRUTH, SCANS, EKF_LIMIT) != first


def test_an_exact_start_is_scored_once_the_covariance_is_positive_definite():
    track = drifting_track()
    covariance = track.pose.covariance.copy()
    covariance[:3] = np.diag([0.01, 0.0, 0.01])
    exact = replace(track, pose=replace(track.pose, covariance=covariance))
    scores = score(exact, TRUTH, SCANS, EKF_LIMIT)
    error = track.pose.mean[3:] - loop()[3:]
    epsilon = np.sum(error**2, axis=1) / 0.01
    assert (scores.nees_mean, scores.nees_max) == pytest.approx((epsilon.mean(), epsilon.max()))
    assert scores.diverged is bool(epsilon.max() > EKF_LIMIT)
    covariance[50] = covariance[0]
    later = score(exact, TRUTH, SCANS, EKF_LIMIT)
    assert (later.nees_max, later.diverged) == (np.inf, True)


def test_a_rigid_motion_of_everything_estimated_changes_only_the_raw_errors():
    track, motion = drifting_track(), np.array([3.0, -1.0, 0.7])
    mean = np.column_stack([moved(track.pose.mean[:, :2], motion), track.pose.mean[:, 2] + 0.7])
    turned = Track(
        time=track.time,
        pose=Gaussian(mean=mean, covariance=track.pose.covariance),
        landmarks=replace(track.landmarks, mean=moved(track.landmarks.mean, motion)),
        gated=0,
    )
    here = score(track, TRUTH, SCANS, EKF_LIMIT)
    there = score(turned, TRUTH, SCANS, EKF_LIMIT)
    assert there.position_rmse_aligned_m == pytest.approx(here.position_rmse_aligned_m, rel=1e-9)
    assert there.map_rmse_aligned_m == pytest.approx(here.map_rmse_aligned_m, rel=1e-9)
    assert there.position_rmse_m > 10 * here.position_rmse_m
    assert there.heading_rmse_rad == pytest.approx(0.7, abs=0.2)


def test_scores_count_full_and_partial_landmarks_and_measurements_per_frame():
    scores = score(drifting_track(), TRUTH, SCANS, EKF_LIMIT)
    assert (scores.landmarks_full, scores.landmarks_total) == (3, 4)
    assert scores.measurements_per_frame == 1.0
    assert scores.gated == 6
    more = scan_with([3, 3], [-1.0, np.nan], caller=np.array([1, 2]), excess_path=4.0, time=TIME[8])
    timed = score(drifting_track(), TRUTH, (*SCANS[:2], more), EKF_LIMIT)
    assert timed.measurements_per_frame == 1.0, "a further excess path is no measurement of its own"


def test_the_map_error_counts_full_landmarks_with_known_positions():
    track = drifting_track()
    mapped = track.landmarks.mean[[0, 3]]
    true = TRUE_LANDMARKS[1][[1, 2]]
    scores = score(track, TRUTH, SCANS, EKF_LIMIT)
    assert scores.map_rmse_m == rmse(position_error(mapped, true))
    assert scores.map_rmse_aligned_m == rmse(
        position_error(moved(mapped, alignment(mapped, true)), true)
    )


def test_strategies_are_compared_by_the_landmarks_that_all_have_placed():
    labels = {"active": (1, 2, 3, 4), "fused": (2, 1, 1, 3, 4), "passive": (4, 77, 3, 2)}
    trials = [trial(drifting_track(landmarks=there), way) for way, there in labels.items()]
    true = TRUE_LANDMARKS[1][1:]
    compared = with_shared(trials, TRUTH)
    for one, kept in zip(compared, ([1, 2, 3], [0, 3, 4], [3, 2, 0]), strict=True):
        mapped = one.track.landmarks.mean[kept]
        error = position_error(moved(mapped, alignment(mapped, true)), true)
        assert one.scores.map_rmse_shared_m == pytest.approx(rmse(error))


def test_without_truth_only_the_counts_are_scored():
    scores = score(drifting_track(), NO_TRUTH, SCANS, EKF_LIMIT)
    known = [f.name for f in fields(Scores) if getattr(scores, f.name) is not None]
    assert known == ["landmarks_full", "landmarks_total", "measurements_per_frame", "gated"]


def test_scores_without_data_are_none():
    empty = score(drifting_track(landmarks=()), TRUTH, (), EKF_LIMIT)
    assert empty.map_rmse_m is None
    assert empty.measurements_per_frame is None
    assert empty.landmarks_total == 0
    single = score(drifting_track(landmarks=(2,)), TRUTH, SCANS, EKF_LIMIT)
    assert single.map_rmse_m is not None
    assert single.map_rmse_aligned_m is None


def test_a_truth_of_another_length_is_refused():
    with pytest.raises(ValueError, match="401 poses, but 400 true ones"):
        score(drifting_track(), Truth(time=TIME[1:], path=loop()[1:]), SCANS, EKF_LIMIT)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_a_track_that_is_lost_is_diverged_and_null_in_the_summary(tmp_path, value):
    track = drifting_track()
    lost = track.pose.mean.copy()
    lost[-1] = value
    [run] = write(tmp_path, trial(with_pose(track, lost)))["runs"]
    assert run["diverged"] is True
    assert run["nees_mean"] is None
    assert run["nees_max"] is None
    assert run["position_rmse_m"] is None
    assert run["map_rmse_m"] > 0.0
    if not np.isfinite(value):
        assert score(with_pose(track, lost), NO_TRUTH, SCANS, EKF_LIMIT).diverged is True


def test_the_summary_has_the_promised_keys_in_their_order(tmp_path):
    summary = write(
        tmp_path,
        trial(drifting_track(), "active"),
        trial(drifting_track(1), "fused"),
        ignored_rows={"unknown barcodes": 3},
    )
    assert list(summary) == ["format", "version", "config_hash", "seed", "runs"]
    assert summary["format"] == 1
    assert summary["seed"] == 7
    assert len(summary["config_hash"]) == 16
    assert [list(run) for run in summary["runs"]] == [KEYS, KEYS]
    assert [run["strategy"] for run in summary["runs"]] == ["active", "fused"]
    assert summary["runs"][1]["ignored_rows"] == {"unknown barcodes": 3}
    assert summary["runs"][0]["wall_s"] == 0.25


def test_the_folder_holds_exactly_the_promised_files(tmp_path):
    write(tmp_path, trial(drifting_track(), "active"), trial(drifting_track(1), "fused"))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "README.md", "SHA256SUMS", "config.toml", "landmarks.parquet", "map_active_ekf.csv",
        "map_fused_ekf.csv", "measurements.parquet", "steps.parquet", "summary.json",
        "track_active_ekf.tum", "track_fused_ekf.tum", "truth.tum",
    ]  # fmt: skip
    readme = (tmp_path / "README.md").read_text()
    assert "pipistrelle run --seed 7" in readme
    assert len(readme.splitlines()) <= 40


def test_without_truth_there_is_no_truth_file(tmp_path):
    write(tmp_path, trial(drifting_track()), truth=NO_TRUTH)
    assert not (tmp_path / "truth.tum").exists()


def test_the_settings_come_back_from_the_folder(tmp_path):
    config = Config.model_validate(
        {"seed": 3, "emitter": {"radius": 0.0123}, "rays": {"range_bounds": [0.4, 18.0]}}
    )
    summary = write(tmp_path, trial(drifting_track()), config=config)
    again = Config.model_validate(tomllib.loads((tmp_path / "config.toml").read_text()))
    assert again == config
    assert summary["config_hash"] == config_hash(again) != config_hash(Config())


def test_settings_that_are_none_and_sections_that_are_not_there_are_left_out(tmp_path):
    class Recorded(Section):
        seed: int = 5
        air: AirConfig = AirConfig(relative_humidity=0.3)

    write(tmp_path, trial(drifting_track()), config=Recorded())
    text = (tmp_path / "config.toml").read_text()
    kept = tomllib.loads(text)
    assert list(kept) == ["seed", "air"]
    assert kept["air"]["relative_humidity"] == 0.3
    assert "speed_of_sound" not in kept["air"]
    assert "# speed_of_sound =" in text


def test_the_scores_follow_from_the_tables(tmp_path):
    one, two = trial(drifting_track(), "active"), trial(drifting_track(1), "fused")
    write(tmp_path, one, two)
    steps = pl.read_parquet(tmp_path / "steps.parquet")
    assert len(steps) == 2 * (STEPS + 1)
    landmarks = pl.read_parquet(tmp_path / "landmarks.parquet")
    for t in (one, two):
        rows = steps.filter(pl.col("strategy") == t.strategy)[1:]
        expected = pytest.approx(t.scores.position_rmse_m, rel=1e-12)
        assert np.sqrt((rows["position_error_m"] ** 2).mean()) == expected
        assert rows["nees"].max() == t.scores.nees_max
        full = landmarks.filter(strategy=t.strategy, status="full")
        assert len(full) == t.scores.landmarks_full
        expected = pytest.approx(t.scores.map_rmse_m, rel=1e-12)
        assert np.sqrt((full["error_m"] ** 2).mean()) == expected


def test_two_filters_of_one_strategy_share_their_measurements(tmp_path):
    track = drifting_track()
    write(tmp_path, trial(track), trial(track, name="fastslam"), trial(track, "active"))
    measurements = pl.read_parquet(tmp_path / "measurements.parquet")
    assert measurements.columns == [
        "strategy", "filter", "time_s", "landmark", "caller", "bearing_rad", "range_m",
        "excess_path_m", "bearing_std_rad", "range_std_m", "excess_path_std_m", "assigned",
        "true_landmark",
    ]  # fmt: skip
    assert measurements["filter"].null_count() == 6
    assert measurements["strategy"].to_list() == ["fused"] * 3 + ["active"] * 3
    assert measurements["range_m"].to_list() == [4.0, None, 2.0] * 2


def test_a_folder_that_has_gone_is_an_input_error_and_leaves_no_summary(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"below: could not be written"):
        write(tmp_path / "file" / "below", trial(drifting_track()))


def test_pictures_for_which_there_is_no_room_leave_nothing(tmp_path):
    def draw(room):
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"could not be drawn there \(No space left on device\)"):
        write(tmp_path, trial(drifting_track()), draw=draw)
    assert list(tmp_path.iterdir()) == []


def test_evo_reads_the_files_untouched_and_finds_our_errors(tmp_path):
    track = drifting_track()
    write(tmp_path, trial(track))
    settings = {"HOME": str(tmp_path), "MPLBACKEND": "Agg", "PYTHONWARNINGS": "error"}

    def ape(*options):
        told = subprocess.run(
            [EVO_APE, "tum", "truth.tum", "track_fused_ekf.tum", *options], cwd=tmp_path,
            env=os.environ | settings, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        [found] = [line.split()[1] for line in told.splitlines() if line.split()[:1] == ["rmse"]]
        return float(found)

    # evo prints six decimals, and counts the start.
    path, true = track.pose.mean[:, :2], loop()[:, :2]
    half_digit = 0.5e-6
    assert ape() == pytest.approx(rmse(position_error(path, true)), abs=half_digit)
    aligned = rmse(position_error(moved(path, alignment(path, true)), true))
    assert ape("--align") == pytest.approx(aligned, abs=half_digit)
