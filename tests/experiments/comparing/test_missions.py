"""Missions side by side: which estimates are compared, and how near their paths come."""

import json

import numpy as np
import pytest

from pipistrelle.config import Config, FilterConfig, InputError, Section
from pipistrelle.evaluation.accuracy import rmse
from pipistrelle.experiments.comparing.folders import kind_of
from pipistrelle.experiments.comparing.missions import compare_missions, notes_of, path_view
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.results.reading import StoredPath
from pipistrelle.files import RESULTS, OwnFiles
from reference.results import PLACES, STEPS, TIME, TRUTH, loop, mission_folder, turned

OFF = turned(loop(), 0.1, (0.5, -0.2))
NOISY = OFF + np.random.default_rng(1).normal(0.0, [0.05, 0.05, 0.01], OFF.shape)


@pytest.fixture
def folders(tmp_path):
    def make(*paths, **given):
        return [
            mission_folder(
                tmp_path / f"{i}", p, **{name: value[i] for name, value in given.items()}
            )
            for i, p in enumerate(paths)
        ]

    return make


def test_the_same_estimates_are_compared_and_others_are_named(folders):
    one = {("active", "ekf"): NOISY, ("fused", "ekf"): OFF}
    two = {("fused", "ekf"): NOISY, ("passive", "ekf"): OFF}
    compared = compare_missions(folders(one, two))
    assert [estimate.title for estimate in compared.compared] == ["fused ekf"]
    assert compared.alone == {("active", "ekf"): (0,), ("passive", "ekf"): (1,)}
    assert notes_of(compared) == (
        "active ekf: only in A, not compared",
        "passive ekf: only in B, not compared",
    )


def test_folders_of_one_filter_each_are_compared_by_strategy(folders):
    one = {("active", "ekf"): OFF, ("fused", "ekf"): OFF}
    two = {("fused", "mine:Own"): NOISY, ("active", "mine:Own"): NOISY}
    compared = compare_missions(folders(one, two))
    assert [estimate.title for estimate in compared.compared] == ["active", "fused"]
    assert compared.compared[0].estimates == (("active", "ekf"), ("active", "mine:Own"))
    assert compared.alone == {}


def test_folders_of_one_strategy_each_are_compared_by_filter(folders):
    one = {("active", "ekf"): OFF, ("active", "fastslam"): OFF}
    two = {("fused", "fastslam"): NOISY}
    compared = compare_missions(folders(one, two))
    assert [estimate.title for estimate in compared.compared] == ["fastslam"]


def test_folders_of_one_estimate_each_are_compared_whatever_they_are(folders):
    compared = compare_missions(folders({("active", "ekf"): OFF}, {("fused", "iekf"): NOISY}))
    assert [estimate.title for estimate in compared.compared] == [""]


def test_folders_that_have_no_estimate_in_common_say_what_they_have(folders):
    one = {("active", "ekf"): OFF, ("fused", "fastslam"): OFF}
    two = {("fused", "ekf"): OFF, ("passive", "ekf"): OFF}
    with pytest.raises(InputError, match=r"has active ekf, fused fastslam; .* has fused ekf, pass"):
        compare_missions(folders(one, two))


def test_a_path_is_held_against_its_truth_as_it_is_and_aligned_as_the_scores_are(folders):
    paths = {("fused", "ekf"): OFF}, {("fused", "ekf"): NOISY}
    (estimate,) = compare_missions(folders(*paths)).compared
    for view, scores in zip(estimate.views, estimate.scores, strict=True):
        assert rmse(view.error[1:]) == pytest.approx(scores["position_rmse_m"], rel=1e-9)
        aligned = scores["position_rmse_aligned_m"]
        assert rmse(view.error_aligned[1:]) == pytest.approx(aligned, rel=1e-6, abs=1e-9)
    exact, noisy = estimate.views
    assert exact.error_aligned.max() < 1e-9 < 0.03 < rmse(noisy.error_aligned)
    np.testing.assert_allclose(exact.aligned, TRUTH.path[:, :2], atol=1e-9)
    back = turned(np.column_stack([PLACES[:2] - [0.5, -0.2], [0.0, 0.0]]), -0.1)[:, :2]
    np.testing.assert_allclose(exact.placed_aligned, back, atol=1e-9)
    assert exact.time[[0, -1]].tolist() == [0.0, 0.125 * STEPS]


def test_the_start_does_not_bear_on_the_alignment():
    line = StoredPath(time=np.arange(5.0), pose=np.arange(5.0)[:, None] * [1.0, 0.0, 0.0])
    pose = line.pose.copy()
    pose[0] += 100.0
    view = path_view(StoredPath(time=line.time, pose=pose), np.zeros((0, 2)), line)
    np.testing.assert_allclose(view.error_aligned[1:], 0.0, atol=1e-12)


def test_without_any_truth_paths_are_held_against_the_first(folders):
    compared = compare_missions(
        folders({("fused", "ekf"): loop()}, {("fused", "ekf"): OFF}, truth=(NO_TRUTH, NO_TRUTH))
    )
    first, other = compared.compared[0].views
    assert first.error.max() == 0.0
    assert other.error.max() > 0.5 > 1e-9 > other.error_aligned.max()
    assert compared.one_drive
    assert notes_of(compared) == ()


@pytest.mark.parametrize("truth", [(TRUTH, NO_TRUTH), (NO_TRUTH, TRUTH)])
def test_a_folder_without_truth_is_held_against_the_truth_of_another(folders, truth):
    compared = compare_missions(
        folders({("fused", "ekf"): OFF}, {("fused", "ekf"): OFF}, truth=truth)
    )
    first, other = compared.compared[0].views
    np.testing.assert_allclose(first.error, other.error, atol=1e-9)
    lacking = "A" if truth[0] is NO_TRUTH else "B"
    assert notes_of(compared) == (f"Without truth: {lacking}; there is nothing to score it by.",)


def test_other_drives_are_said_to_be_such(folders):
    paths, other = {("fused", "ekf"): loop()}, Truth(time=TIME, path=loop(0.3))
    compared = compare_missions(folders(paths, paths, truth=(TRUTH, other)))
    assert not compared.one_drive
    assert notes_of(compared) == (
        "The drives are not the same: each difference is that of one draw.",
    )
    first, second = compared.compared[0].views
    assert first.error.max() < 1e-9 < 1.0 < second.error.max()


def test_a_truth_whose_headings_are_told_by_a_turn_more_is_the_same(folders):
    paths, told = {("fused", "ekf"): loop()}, TRUTH.path + np.array([0.0, 0.0, 2.0 * np.pi])
    compared = compare_missions(folders(paths, paths, truth=(TRUTH, Truth(time=TIME, path=told))))
    assert compared.one_drive


def test_other_times_are_another_drive_and_nothing_is_held_against_them(folders):
    later = TIME + 1000.0
    compared = compare_missions(
        folders({("fused", "ekf"): loop()}, {("fused", "ekf"): OFF}, truth=(NO_TRUTH, NO_TRUTH),
                time=(TIME, later))
    )  # fmt: skip
    assert not compared.one_drive
    view = compared.compared[0].views[1]
    assert np.isnan(view.error).all()
    np.testing.assert_array_equal(view.aligned, view.raw)


def test_a_path_that_is_lost_is_not_moved(folders):
    lost = np.full_like(OFF, np.nan)
    compared = compare_missions(folders({("fused", "ekf"): OFF}, {("fused", "ekf"): lost}))
    view = compared.compared[0].views[1]
    assert np.isnan(view.error_aligned).all()
    np.testing.assert_allclose(view.placed_aligned, PLACES[:2])


def test_settings_that_differ_are_named_with_all_values_and_sections_of_some_apart(folders):
    paths = {("fused", "ekf"): OFF}
    sharp = Config(filter=FilterConfig(noise="measured"))
    assert compare_missions(folders(paths, paths)).settings == {}
    compared = compare_missions(folders(paths, paths, config=(Config(), sharp)))
    assert compared.settings == {"filter.noise": ("constant", "measured")}

    class OfALog(Section):
        seed: int = 7
        filter: FilterConfig = sharp.filter

    compared = compare_missions(folders(paths, paths, config=(OfALog(), sharp)))
    assert compared.sections_alone["air"] == (1,)
    assert not {"seed", "filter"} & set(compared.sections_alone)
    assert compared.settings == {}
    assert any(note.startswith("Settings of ") for note in notes_of(compared))


# Which folders


def test_a_folder_is_given_once_whatever_its_name(tmp_path):
    one = mission_folder(tmp_path / "one", {("fused", "ekf"): OFF})
    (tmp_path / "latest").symlink_to("one")
    for other in (one, tmp_path / "x" / ".." / "one", tmp_path / "latest"):
        with pytest.raises(InputError, match="one: is given twice, as A and B"):
            kind_of([one, other])


@pytest.mark.parametrize("count", [0, 1, 27])
def test_two_folders_or_more_are_compared_up_to_the_alphabet(tmp_path, count):
    with pytest.raises(InputError, match=rf"found {count} folders?, expected 2 to 26"):
        kind_of([tmp_path / f"{i}" for i in range(count)])


def test_missions_and_studies_are_not_compared(tmp_path):
    mission = mission_folder(tmp_path / "one", {("fused", "ekf"): OFF})
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "plan.toml").write_text("format = 1")
    for pair in ([mission, tmp_path / "study"], [tmp_path / "study", mission]):
        with pytest.raises(InputError, match=r"study: is a study's folder, and .*one is not"):
            kind_of(pair)
    with pytest.raises(InputError, match="nowhere: found no such folder"):
        kind_of([tmp_path / "study", tmp_path / "nowhere"])
    assert kind_of([mission, tmp_path / "nowhere"]) == "missions"


def test_which_logs_were_solved_and_how_is_named_where_it_differs(folders):
    one, two = folders({("active", "ekf"): OFF}, {("active", "ekf"): NOISY})
    for folder, path, beam in ((one, "here", 0.5), (two, "there", None)):
        own = OwnFiles(folder, RESULTS)
        told = json.loads(own.read("summary.json"))
        told["log"] = {"path": path, "robot": None, "beamwidth_rad": beam, "files": {path: "00"}}
        own.add("summary.json", json.dumps(told).encode())
    settings = compare_missions([one, two]).settings
    assert settings["log.path"] == ("here", "there")
    assert settings["log.beamwidth_rad"] == (0.5, None)
    assert "log.robot" not in settings
    assert len(set(settings["log.files"])) == 2
