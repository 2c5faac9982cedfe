"""Missions side by side: which estimates are compared, and how near their paths come."""

import json
import re

import numpy as np
import polars as pl
import pytest
from scipy import stats

from pipistrelle.config import (
    Config,
    FilterConfig,
    InputError,
    MotionConfig,
    RayConfig,
    ScenarioConfig,
    Section,
)
from pipistrelle.evaluation.accuracy import rmse
from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.evaluation.scores import SCORES
from pipistrelle.experiments.comparing import (
    compare_missions,
    compare_studies,
    differing,
    distinguishing,
    draw_of,
    kind_of,
    matched,
    named,
    notes_of,
    path_view,
    section,
    shared_name,
)
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.results.reading import StoredPath
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.world import TABLES, world_file
from pipistrelle.files import RESULTS, OwnFiles
from reference.results import PLACES, STEPS, TIME, TRUTH, loop, mission_folder, study_folder, turned

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


def test_folders_without_a_common_estimate_are_refused_with_their_estimates(folders):
    one = {("active", "ekf"): OFF, ("fused", "fastslam"): OFF}
    two = {("fused", "ekf"): OFF, ("passive", "ekf"): OFF}
    with pytest.raises(InputError, match=r"has active ekf, fused fastslam; .* has fused ekf, pass"):
        compare_missions(folders(one, two))


def test_errors_of_raw_and_aligned_paths_equal_the_scores(folders):
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


def test_the_start_does_not_count_in_the_alignment():
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


def test_different_trajectories_are_reported(folders):
    paths, other = {("fused", "ekf"): loop()}, Truth(time=TIME, path=loop(0.3))
    compared = compare_missions(folders(paths, paths, truth=(TRUTH, other)))
    assert not compared.one_drive
    assert notes_of(compared) == (
        "The drives are not the same: each difference is that of one draw.",
    )
    first, second = compared.compared[0].views
    assert first.error.max() < 1e-9 < 1.0 < second.error.max()


def test_truths_with_headings_a_full_turn_different_are_the_same(folders):
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


def test_differing_settings_have_all_values_and_sections_of_some_folders_are_named(folders):
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


RADII = {"emitter.radius": (0.0025, 0.025)}
WORLDS = 6


def plan(
    *, filters=("ekf",), strategies=("active", "fused"), grid=None, config=None, worlds=WORLDS
):
    return Plan(
        name="made-up", iterations=worlds, strategies=strategies, filters=filters,
        config=config or Config(scenario=ScenarioConfig(steps=8)), grid=grid or {},
    )  # fmt: skip


def hard(world):
    """How hard a world is: most of what is between worlds."""
    return 3.0 * (1 + world % 4)


def noise(case, world, seed):
    return np.random.default_rng([case.number, world, seed]).normal(0.0, 0.1)


def numbers(level, seed):
    """An error of each case in each world."""
    return lambda case, world: hard(world) + level + noise(case, world, seed)


@pytest.fixture
def pair(tmp_path):
    one, two = plan(), plan(filters=("iekf",))
    study_folder(tmp_path / "one", one, numbers(1.0, 1))
    study_folder(tmp_path / "two", two, numbers(0.5, 2))
    return [tmp_path / "one", tmp_path / "two"]


def cases_of_score(compared, score="position_rmse_m"):
    return [case for case in compared.cases if case.score == score]


def told(folder, case, score="position_rmse_m"):
    """A score of a case by world, read with other means."""
    trials = pl.read_parquet(folder / "trials" / "*.parquet").sort("iteration")
    strategy, name = case
    mine = trials.filter(pl.col("strategy") == strategy, pl.col("filter") == name)
    return mine[score].to_numpy()


def test_cases_are_paired_world_by_world_and_judged_as_a_family(pair):
    compared = compare_studies(pair)
    cases = cases_of_score(compared)
    assert [case.label for case in cases] == ["active", "fused"]
    samples = [
        told(pair[1], (strategy, "iekf")) - told(pair[0], (strategy, "ekf"))
        for strategy in ("active", "fused")
    ]
    by_hand = judge([Statement(label="", sample=sample) for sample in samples])
    for case, sample, finding in zip(cases, samples, by_hand, strict=True):
        assert case.contrast.paired
        assert case.contrast.worlds == (WORLDS, WORLDS)
        assert case.contrast.finding.mean == pytest.approx(sample.mean(), rel=1e-12)
        assert case.contrast.finding.alone == pytest.approx(finding.alone, rel=1e-12)
        assert case.contrast.finding.interval == pytest.approx(finding.interval, rel=1e-12)
        known = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
        assert case.contrast.finding.alone == pytest.approx((known.low, known.high), rel=1e-9)
        assert case.contrast.finding.p < 0.05
        assert case.contrast.finding.mean == pytest.approx(
            case.contrast.means[1] - case.contrast.means[0], abs=1e-9
        )
    assert compared.settings == {"filters": (["ekf"], ["iekf"])}
    assert notes_of(compared)[0] == "Paired over the worlds that both have met."


def test_every_score_with_numbers_is_compared(pair):
    compared = compare_studies(pair)
    found = list(dict.fromkeys(case.score for case in compared.cases))
    assert found == [name for name in SCORES if name in found], "in the order of the one table"
    assert "heading_rmse_rad" not in found, "no study has a number"
    (first, _) = cases_of_score(compared, "map_rmse_aligned_m")
    (same, _) = cases_of_score(compared, "position_rmse_aligned_m")
    assert first.contrast.finding.mean == pytest.approx(2.0 * same.contrast.finding.mean, rel=1e-9)
    still, _ = cases_of_score(compared, "landmarks_full")
    assert (still.contrast.finding.mean, still.contrast.finding.p) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("config", "other"),
    [
        ("seed", {"seed": 8}),
        ("scenario", {"scenario": ScenarioConfig(steps=8, landmarks=49)}),
        ("motion", {"motion": MotionConfig(speed_std=0.2)}),
    ],
)
def test_other_worlds_are_not_paired_and_a_note_explains_it(tmp_path, config, other):
    base = Config(scenario=ScenarioConfig(steps=8))
    changed = base.model_copy(update=other)
    assert draw_of(base) != draw_of(changed), config
    study_folder(tmp_path / "one", plan(config=base), numbers(1.0, 1))
    study_folder(tmp_path / "two", plan(config=changed, worlds=4), numbers(0.5, 2))
    compared = compare_studies([tmp_path / "one", tmp_path / "two"])
    assert notes_of(compared)[0].startswith("Not paired: the worlds are not the same")
    case, _ = cases_of_score(compared)
    assert not case.contrast.paired
    assert case.contrast.worlds == (WORLDS, 4)
    first, second = (told(tmp_path / name, ("active", "ekf")) for name in ("one", "two"))
    known = stats.ttest_ind(second, first, equal_var=False)
    alone = known.confidence_interval(0.95)
    assert case.contrast.finding.alone == pytest.approx((alone.low, alone.high), rel=1e-9)
    assert case.contrast.finding.mean == pytest.approx(second.mean() - first.mean(), rel=1e-12)
    assert case.contrast.finding.p > 0.05, "what is between worlds hides it"


def test_sound_and_estimators_may_differ_in_the_same_worlds():
    other = Config(rays=RayConfig(power=3.0), beacon={"level_db": 50.0})
    assert draw_of(Config()) == draw_of(other)


def test_worlds_of_a_single_study_do_not_count(tmp_path):
    one = study_folder(tmp_path / "one", plan(), numbers(1.0, 1), worlds=[0, 1, 2, 3])
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2), worlds=[5, 1, 3, 2])
    compared = compare_studies([one, two])
    case, _ = cases_of_score(compared)
    assert case.contrast.worlds == (3, 3)
    assert (compared.done, compared.planned) == ((4, 4), (WORLDS, WORLDS))
    both = [1, 2, 3]
    by_hand = [0.5 - 1.0 + noise(*w(case, 2)) - noise(*w(case, 1)) for w in map(of_case, both)]
    assert case.contrast.finding.mean == pytest.approx(np.mean(by_hand), rel=1e-9)


def of_case(world):
    """Arguments of the noise of the first case in a world."""
    from pipistrelle.experiments.studies.plan import cases_of

    return lambda _, seed: (cases_of(plan())[0], world, seed)


def diverging(level, seed, lost, value):
    """Numbers of which some worlds' are `value` in every case."""
    plain = numbers(level, seed)
    return lambda case, world: value if world in lost else plain(case, world)


@pytest.mark.parametrize("value", [np.nan, None])
def test_worlds_that_diverged_or_failed_are_counted_and_left_out_where_that_is_asked(
    tmp_path, value
):
    one = study_folder(tmp_path / "one", plan(), diverging(1.0, 1, {0}, value))
    two = study_folder(tmp_path / "two", plan(), diverging(0.5, 2, {3, 4}, value))
    everything, _ = cases_of_score(compare_studies([one, two]))
    left, _ = cases_of_score(compare_studies([one, two], drop_diverged=True))
    assert everything.diverged == left.diverged == (1, 2)
    assert left.contrast.worlds == (3, 3)
    assert everything.contrast.worlds == ((WORLDS, WORLDS) if value is not None else (3, 3))
    assert "left out" in notes_of(compare_studies([one, two], drop_diverged=True))[-1]
    assert "count, as far" in notes_of(compare_studies([one, two]))[-1]


def test_a_score_that_is_no_number_counts_in_no_world(tmp_path):
    one = study_folder(tmp_path / "one", plan(), diverging(1.0, 1, {0}, np.nan))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    case, _ = cases_of_score(compare_studies([one, two]), "map_rmse_m")
    assert case.contrast.worlds == (WORLDS - 1, WORLDS - 1)


# Which cases


def test_cases_of_a_grid_are_matched_by_their_values_and_passive_by_no_beam(tmp_path):
    ways = ("active", "passive")
    one = study_folder(tmp_path / "one", plan(strategies=ways, grid=RADII), numbers(1.0, 1))
    grid = {"emitter.radius": (0.025, 0.0088)}
    two = study_folder(tmp_path / "two", plan(strategies=ways, grid=grid), numbers(0.5, 2))
    compared = compare_studies([one, two])
    cases = cases_of_score(compared)
    assert [(case.strategies[0], case.values["emitter.radius"]) for case in cases] == [
        ("active", 0.025),
        ("passive", None),
    ]
    assert [label for label, _ in compared.alone] == ["active ekf, 33.0°", "active ekf, 33.0°"]
    assert [who for _, who in compared.alone] == [(0,), (1,)]
    assert notes_of(compared)[-2:] == (
        "Only in A, not compared: active ekf, 33.0°",
        "Only in B, not compared: active ekf, 33.0°",
    )


def test_a_value_that_only_one_study_varies_is_matched_with_the_settings_of_the_other(tmp_path):
    grid = {"rays.power": (1.5, 2.0)}
    one = study_folder(tmp_path / "one", plan(grid=grid), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    compared = compare_studies([one, two])
    assert {case.values["rays.power"] for case in compared.cases} == {2.0}
    assert [case.label for case in cases_of_score(compared)] == [
        "active ekf, rays.power 2.0",
        "fused ekf, rays.power 2.0",
    ]
    assert compared.settings["grid.rays.power"] == ([1.5, 2.0], None)


def test_a_filter_of_a_single_study_is_named(tmp_path):
    one = study_folder(tmp_path / "one", plan(filters=("ekf", "fastslam")), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(filters=("ekf", "iekf")), numbers(0.5, 2))
    compared = compare_studies([one, two])
    assert [case.label for case in cases_of_score(compared)] == ["active ekf", "fused ekf"]
    assert dict(compared.alone) == {
        "active fastslam": (0,), "fused fastslam": (0,), "active iekf": (1,), "fused iekf": (1,),
    }  # fmt: skip


def test_studies_without_a_common_case_are_refused_with_their_cases(tmp_path):
    one = study_folder(tmp_path / "one", plan(grid={"rays.power": (1.5, 3.0)}), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    with pytest.raises(InputError, match=r"no case .* tries active, fused by ekf at rays.power"):
        compare_studies([one, two])


def test_several_studies_are_held_against_the_first_in_one_family(tmp_path):
    folders = [
        study_folder(tmp_path / name, plan(strategies=("fused",)), numbers(level, seed))
        for seed, (name, level) in enumerate({"one": 1.0, "two": 0.5, "three": 0.9}.items())
    ]
    cases = cases_of_score(compare_studies(folders))
    assert [case.other for case in cases] == [1, 2]
    samples = [
        told(folder, ("fused", "ekf")) - told(folders[0], ("fused", "ekf"))
        for folder in folders[1:]
    ]
    by_hand = judge([Statement(label="", sample=sample) for sample in samples])
    assert [case.contrast.finding.p for case in cases] == pytest.approx(
        [f.p for f in by_hand], rel=1e-9
    )


def test_unpaired_cases_are_marked_among_paired_cases(tmp_path):
    base = Config(scenario=ScenarioConfig(steps=8))
    folders = [
        study_folder(tmp_path / name, plan(config=config), numbers(1.0, 1))
        for name, config in {
            "one": base, "two": base, "three": base.model_copy(update={"seed": 9}),
        }.items()
    ]  # fmt: skip
    compared = compare_studies(folders)
    assert [case.contrast.paired for case in cases_of_score(compared)] == [True, False, True, False]
    assert notes_of(compared)[0].startswith("Paired where the worlds are the same")


# What is refused


@pytest.mark.parametrize("table", TABLES)
def test_a_file_that_is_cut_changed_or_another_worlds_is_named(pair, table):
    path = world_file(pair[1], table, 3)
    whole = path.read_bytes()
    for spoilt in (whole[:-9], whole[:40] + b"x" + whole[41:], b""):
        path.write_bytes(spoilt)
        with pytest.raises(InputError, match=rf"{re.escape(str(path))}: .*run the study again"):
            compare_studies(pair)
    path.write_bytes(whole)
    compare_studies(pair)


def test_a_study_with_a_changed_plan_is_refused(pair):
    text = (pair[0] / "plan.toml").read_text()
    (pair[0] / "plan.toml").write_text(text.replace("seed = 7", "seed = 8"))
    with pytest.raises(InputError, match=r"computed by another plan than the plan\.toml"):
        compare_studies(pair)


def test_a_study_without_a_finished_world_is_refused(tmp_path):
    one = study_folder(tmp_path / "one", plan(), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(filters=("not:There",)), numbers(1.0, 1), worlds=[])
    with pytest.raises(InputError, match=r"two: no world is done yet"):
        compare_studies([one, two])


def test_the_version_of_a_study_is_read_from_its_readme(pair):
    from pipistrelle import __version__

    assert compare_studies(pair).versions == (__version__, __version__)
    (pair[0] / "README.md").write_text("mine")
    (pair[1] / "README.md").unlink()
    assert compare_studies(pair).versions == ("", "")


THREE = [("active", "ekf"), ("fused", "ekf"), ("passive", "ekf")]
BOTH = [("fused", "ekf"), ("fused", "fastslam")]


def test_parts_that_differ_within_no_folder_do_not_name_an_estimate():
    assert distinguishing([THREE, THREE]) == (True, False)
    assert distinguishing([THREE, [("fused", "smoother")]]) == (True, False)
    assert distinguishing([BOTH, [("fused", "ekf")]]) == (False, True)
    assert distinguishing([BOTH, THREE]) == (True, True)
    assert distinguishing([[("active", "ekf")], [("fused", "smoother")]]) == (False, False)


def test_a_key_omits_parts_that_distinguish_nothing():
    assert named(("fused", "ekf")) == ("fused", "ekf")
    assert named(("fused", "ekf"), (False, True)) == ("", "ekf")
    assert named(("fused", "ekf"), (False, False)) == ("", "")


def test_a_title_has_the_shared_parts_of_estimates():
    assert shared_name([("fused", "ekf"), ("fused", "ekf")]) == "fused ekf"
    assert shared_name([("active", "mine:Own"), ("fused", "mine:Own")]) == "Own"
    assert shared_name([("active", "ekf"), ("fused", "iekf")]) == ""


def test_names_of_all_come_in_the_order_of_the_first_and_others_with_their_owners():
    common, alone = matched([["c", "a", "b"], ["a", "d", "c"], ["c", "a"]])
    assert common == ("c", "a")
    assert alone == {"b": (0,), "d": (1,)}
    assert matched([["a"], ["b"]]) == ((), {"a": (0,), "b": (1,)})


def test_settings_differ_where_a_value_does_or_is_not_there():
    told = differing([{"a": 1, "b": [1, 2], "c": 0}, {"a": 1, "b": [2, 1], "d": False}])
    assert told == {"b": ([1, 2], [2, 1]), "c": (0, None), "d": (None, False)}
    assert differing([{"a": 1}, {"a": 1.0}]) == {}


def test_a_section_is_the_part_before_the_first_dot():
    assert [section(name) for name in ("a.b.c", "seed")] == ["a", "seed"]
