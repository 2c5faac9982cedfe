"""The smoother from the command line: both of its tracks."""

from pathlib import Path

import numpy as np

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
