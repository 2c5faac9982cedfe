"""The smoother from the command line: both of its tracks."""

from pathlib import Path

import numpy as np
import polars
import pytest

from reference.command_line import SHORT, summary, track


def assert_both_tracks(folder, name):
    """The path by all that was heard, and as it was believed at its time, are there and scored."""
    smoothed, online = track(folder, name), track(folder, f"{name}_online")
    np.testing.assert_array_equal(smoothed[:, 0], online[:, 0])
    np.testing.assert_allclose(smoothed[-1], online[-1], rtol=0, atol=0.05)
    assert np.abs(smoothed[1:, 1:3] - online[1:, 1:3]).max() > 1e-4
    assert f"track_{name}_online.tum" in (Path(folder) / "SHA256SUMS").read_text()
    assert "_online.tum" in (Path(folder) / "README.md").read_text()
    (run,) = summary(folder)["runs"]
    assert set(run["online"]) == {
        "position_rmse_m", "heading_rmse_rad", "position_rmse_aligned_m", "nees_mean", "nees_max",
    }  # fmt: skip
    assert run["online"]["position_rmse_m"] != run["position_rmse_m"]


def test_a_run_and_its_log_give_both_tracks_of_the_smoother(obey, undrawn):
    words = ("--filter", "smoother", "--strategy", "fused", "--quiet")
    assert obey("run", *SHORT, *words, "--save-log", "log", "-o", "one") == (0, "one\n", "")
    assert_both_tracks("one", "fused_smoother")
    words = ("--filter", "smoother", "--filter.gate", "1.0", "--quiet")
    assert obey("slam", "log", *words, "-o", "two") == (0, "two\n", "")
    assert_both_tracks("two", "fused_smoother")
    for name in ("fused_smoother", "fused_smoother_online"):
        ran, replayed = track("one", name), track("two", name)
        np.testing.assert_allclose(replayed, ran, rtol=0, atol=1e-6)


def test_a_filter_that_revises_nothing_has_one_track(obey, undrawn):
    obey("run", *SHORT, "--filter", "ekf", "--strategy", "fused", "--quiet", "-o", "one")
    assert not list(Path("one").glob("*_online.tum"))
    assert "online" not in summary("one")["runs"][0]


def test_what_is_calibrated_is_told_in_the_table_and_in_the_summary(obey, undrawn):
    words = ("--filter", "smoother", "--strategy", "active", "--scenario.steps", "80")
    asked = ("--filter.calibrate", "speed_scale", "sensor_place")
    status, printed, _ = obey("run", *words, *asked, "-o", "out")
    assert status == 0
    (run,) = summary("out")["runs"]
    numbers = ("speed_scale", "sensor_place_x", "sensor_place_y")
    assert [*run["calibration"]] == [one for name in numbers for one in (name, f"{name}_std")]
    assert run["calibration"]["speed_scale"] == pytest.approx(1.0, abs=0.3)
    rows = {line[:32].strip(): line[32:].split() for line in printed.splitlines()}
    assert rows["speed scale"] == [f"{run['calibration']['speed_scale']:.5g}"]
    assert rows["sensor place x, 1 sigma"] == [f"{run['calibration']['sensor_place_x_std']:.2g}"]


def test_a_filter_that_calibrates_nothing_refuses_to(obey):
    status, _, said = obey("run", "--filter", "ekf", "--filter.calibrate", "speed_scale")
    assert status == 2
    assert "filter.calibrate: found speed_scale with the filter ekf" in said
    assert "take smoother" in said


def test_a_parameter_that_there_is_not_is_refused(obey):
    status, _, said = obey("run", "--filter", "smoother", "--filter.calibrate", "gravity")
    assert status == 2
    assert "gravity" in said
    assert "speed_scale" in said


def test_a_study_has_columns_of_what_is_calibrated(obey):
    Path("plan.toml").write_text(
        'format = 1\nname = "own"\niterations = 1\nfilters = ["smoother", "ekf"]\n'
        'strategies = ["active"]\n[config]\nscenario.steps = 40\n'
        '[own.smoother]\nfilter.calibrate = ["turn_bias"]\n'
    )
    status, *_ = obey("study", "plan.toml", "-o", "out")
    assert status == 0
    trials = polars.read_parquet("out/trials/*.parquet").sort("case")
    assert trials["turn_bias_std"].is_null().to_list() == [False, True]
    assert 0.0 < trials["turn_bias_std"][0] <= 0.02
