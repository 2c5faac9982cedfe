"""The smoother from the command line: both of its tracks, and what is said where it is lacking."""

from pathlib import Path

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.estimation import catalogue
from pipistrelle.estimation.catalogue import CATALOGUE, check_there, entry, is_there
from pipistrelle.experiments.runs import compiling, trial
from pipistrelle.experiments.studies import world
from pipistrelle.experiments.studies.plan_file import find_plan, read_plan
from reference.command_line import SHORT, summary, track
from reference.studies import SMALL

LACKING = (
    "filter smoother: needs gtsam, which is not installed; "
    "python -m pip install 'pipistrelle[smoother]' installs it"
)
LOG = Path(__file__).parents[1] / "data" / "unicycle_log"


@pytest.fixture
def without_gtsam(monkeypatch):
    """Let it seem that gtsam is not installed."""
    found = catalogue.find_spec
    monkeypatch.setattr(
        catalogue, "find_spec", lambda name: None if name == "gtsam" else found(name)
    )


@pytest.fixture
def unheard(monkeypatch):
    """Let nothing be heard, not even by what is compiled."""

    def asked(*_, **__):
        raise AssertionError("it listens")

    for module in (trial, world):
        monkeypatch.setattr(module, "listen", asked)
    monkeypatch.setattr(compiling, "compile_kernels", lambda *_: None)


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


def test_without_gtsam_it_is_known_and_not_there(without_gtsam):
    assert [name for name in CATALOGUE if not is_there(name)] == ["smoother"]
    assert entry("smoother").title == "smoother"
    check_there("ekf")
    with pytest.raises(InputError, match="pipistrelle\\[smoother\\]"):
        check_there("smoother")


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(("run", *SHORT, "--filter", "smoother", "-o", "one"), id="run"),
        pytest.param(("slam", LOG, "--filter", "smoother", "-o", "one"), id="slam"),
        pytest.param(("study", "plan.toml", "--workers", "1", "-o", "one"), id="study"),
    ],
)
def test_without_gtsam_a_command_that_asks_for_it_is_refused_in_a_line(
    refused, without_gtsam, unheard, words
):
    Path("plan.toml").write_text('filters = ["ekf", "smoother"]\n' + SMALL)
    said = refused(*words)
    assert said.startswith(LACKING)
    assert "\n" not in said
    assert not Path("one").exists()


def test_without_gtsam_the_other_filters_are_there_and_plans_that_name_it_are_read(
    obey, without_gtsam, unheard, undrawn
):
    assert obey("slam", LOG, "--filter", "both", "--quiet", "-o", "one")[:2] == (0, "one\n")
    assert "smoother" in read_plan(find_plan("beyond")).filters


def test_without_gtsam_kernels_are_compiled_for_the_others(without_gtsam, monkeypatch):
    tried = []
    monkeypatch.setattr(compiling, "run_mission", lambda _, __, filters: tried.extend(filters))
    compiling.compile_kernels(timings=[False])
    assert tried == [name for name in CATALOGUE if name != "smoother"]
