"""Missions side by side: which estimates are compared, and how near their paths come."""

import json
import re
from dataclasses import replace
from pathlib import Path

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
    are_studies,
    compare_missions,
    compare_studies,
    comparison_table,
    differing,
    draw_of,
    matched,
    path_view,
    settings_table,
    write_comparison,
)
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.results.reading import StoredPath
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.world import TABLES, world_file
from pipistrelle.files import COMPARISON, RESULTS, SUMS, OwnFiles, spelt
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
    assert [estimate.title for estimate in compared.estimates] == ["fused ekf"]
    assert compared.notes == (
        "active ekf: only in A, not compared",
        "passive ekf: only in B, not compared",
    )


@pytest.mark.parametrize(
    ("one", "two", "titles"),
    [
        ("active ekf, fused ekf", "fused mine:Own, active mine:Own", ["active", "fused"]),
        ("active ekf, active fastslam", "fused fastslam", ["fastslam"]),
        ("active ekf, fused ekf", "fused ekf, passive ekf", ["fused ekf"]),
        ("fused mine:Own, active mine:Own", "active mine:Own", ["active Own"]),
        ("active ekf", "fused iekf", [""]),
    ],
)
def test_estimates_are_matched_by_the_parts_that_differ_within_a_folder(folders, one, two, titles):
    keys = [[tuple(name.split()) for name in text.split(", ")] for text in (one, two)]
    paths = [dict.fromkeys(some, mine) for some, mine in zip(keys, (OFF, NOISY), strict=True)]
    compared = compare_missions(folders(*paths))
    assert [estimate.title for estimate in compared.estimates] == titles
    for estimate in compared.estimates:
        first, second = estimate.estimates
        assert first in keys[0]
        assert second in keys[1]


def test_folders_without_a_common_estimate_are_refused_with_their_estimates(folders):
    one = {("active", "ekf"): OFF, ("fused", "fastslam"): OFF}
    two = {("fused", "ekf"): OFF, ("passive", "ekf"): OFF}
    with pytest.raises(InputError, match=r"has active ekf, fused fastslam; .* has fused ekf, pass"):
        compare_missions(folders(one, two))


def test_errors_of_raw_and_aligned_paths_equal_the_scores(folders):
    paths = {("fused", "ekf"): OFF}, {("fused", "ekf"): NOISY}
    (estimate,) = compare_missions(folders(*paths)).estimates
    raw, aligned = (estimate.scores[f"position_rmse_{kind}m"] for kind in ("", "aligned_"))
    assert [rmse(view.error[1:]) for view in estimate.views] == pytest.approx(raw, rel=1e-9)
    errors = [rmse(view.error_aligned[1:]) for view in estimate.views]
    assert errors == pytest.approx(aligned, rel=1e-6, abs=1e-9)
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
    first, other = compared.estimates[0].views
    assert first.error.max() == 0.0
    assert other.error.max() > 0.5 > 1e-9 > other.error_aligned.max()
    assert compared.one_drive
    assert compared.notes == ()


@pytest.mark.parametrize("truth", [(TRUTH, NO_TRUTH), (NO_TRUTH, TRUTH)])
def test_a_folder_without_truth_is_held_against_the_truth_of_another(folders, truth):
    compared = compare_missions(
        folders({("fused", "ekf"): OFF}, {("fused", "ekf"): OFF}, truth=truth)
    )
    first, other = compared.estimates[0].views
    np.testing.assert_allclose(first.error, other.error, atol=1e-9)
    lacking = "A" if truth[0] is NO_TRUTH else "B"
    assert compared.notes == (f"Without truth: {lacking}; there is nothing to score it by.",)


def test_different_trajectories_are_reported(folders):
    paths, other = {("fused", "ekf"): loop()}, Truth(time=TIME, path=loop(0.3))
    compared = compare_missions(folders(paths, paths, truth=(TRUTH, other)))
    assert not compared.one_drive
    assert compared.notes == ("The drives are not the same: each difference is that of one draw.",)
    first, second = compared.estimates[0].views
    assert first.error.max() < 1e-9 < 1.0 < second.error.max()
    turned_once = Truth(time=TIME, path=TRUTH.path + np.array([0.0, 0.0, 2.0 * np.pi]))
    assert compare_missions(folders(paths, paths, truth=(TRUTH, turned_once))).one_drive


def test_other_times_are_another_drive_and_nothing_is_held_against_them(folders):
    later = TIME + 1000.0
    compared = compare_missions(
        folders({("fused", "ekf"): loop()}, {("fused", "ekf"): OFF}, truth=(NO_TRUTH, NO_TRUTH),
                time=(TIME, later))
    )  # fmt: skip
    assert not compared.one_drive
    view = compared.estimates[0].views[1]
    assert np.isnan(view.error).all()
    np.testing.assert_array_equal(view.aligned, view.raw)


def test_a_path_that_is_lost_is_not_moved(folders):
    lost = np.full_like(OFF, np.nan)
    compared = compare_missions(folders({("fused", "ekf"): OFF}, {("fused", "ekf"): lost}))
    view = compared.estimates[0].views[1]
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
    assert compared.settings == {}
    (note,) = (note for note in compared.notes if note.startswith("Settings of "))
    assert note.startswith("Settings of air, ")
    assert note.endswith(": only in B, not compared")
    assert not {"seed", "filter"} & set(re.findall(r"\w+", note))


# Which folders


def test_a_folder_is_given_once_whatever_its_name(tmp_path):
    one = mission_folder(tmp_path / "one", {("fused", "ekf"): OFF})
    (tmp_path / "latest").symlink_to("one")
    for other in (one, tmp_path / "x" / ".." / "one", tmp_path / "latest"):
        with pytest.raises(InputError, match="one: is given twice, as A and B"):
            are_studies([one, other])


@pytest.mark.parametrize("count", [0, 1, 27])
def test_two_folders_or_more_are_compared_up_to_the_alphabet(tmp_path, count):
    with pytest.raises(InputError, match=rf"found {count} folders?, expected 2 to 26"):
        are_studies([tmp_path / f"{i}" for i in range(count)])


def test_missions_and_studies_are_not_compared(tmp_path):
    mission = mission_folder(tmp_path / "one", {("fused", "ekf"): OFF})
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "plan.toml").write_text("format = 1")
    for pair in ([mission, tmp_path / "study"], [tmp_path / "study", mission]):
        with pytest.raises(InputError, match=r"study: is a study's folder, and .*one is not"):
            are_studies(pair)
    with pytest.raises(InputError, match="nowhere: found no such folder"):
        are_studies([tmp_path / "study", tmp_path / "nowhere"])
    assert not are_studies([mission, tmp_path / "nowhere"])


def test_which_logs_were_solved_and_how_is_named_where_it_differs(folders):
    one, two = folders({("active", "ekf"): OFF}, {("active", "ekf"): NOISY})
    for folder, path, beam in ((one, "here", 0.5), (two, "there", None)):
        own = OwnFiles(folder, RESULTS)
        told = json.loads(own.read("summary.json"))
        told["log"] = {"path": path, "robot": None, "beamwidth_rad": beam, "files": {path: "00"}}
        own.add("summary.json", json.dumps(told).encode())
    settings = compare_missions([one, two]).settings
    assert settings["log.path"] == ("here", "there")
    assert settings["log.beamwidth_rad"] == ("0.5", None)
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
    return [row for row in compared.rows if row["score"] == score]


def worlds(case):
    return case["worlds_first"], case["worlds"]


def alone(case):
    return case["alone_low"], case["alone_high"]


def told(folder, case, score="position_rmse_m"):
    """A score of a case by world, read with other means."""
    trials = pl.read_parquet(folder / "trials" / "*.parquet").sort("iteration")
    strategy, name = case
    mine = trials.filter(pl.col("strategy") == strategy, pl.col("filter") == name)
    return mine[score].to_numpy()


def test_cases_are_paired_world_by_world_and_judged_as_a_family(pair):
    compared = compare_studies(pair)
    cases = cases_of_score(compared)
    assert [case["case"] for case in cases] == ["active", "fused"]
    samples = [
        told(pair[1], (strategy, "iekf")) - told(pair[0], (strategy, "ekf"))
        for strategy in ("active", "fused")
    ]
    by_hand = judge([Statement(label="", sample=sample) for sample in samples])
    for case, sample, finding in zip(cases, samples, by_hand, strict=True):
        assert case["paired"]
        assert worlds(case) == (WORLDS, WORLDS)
        assert case["difference"] == pytest.approx(sample.mean(), rel=1e-12)
        assert alone(case) == pytest.approx(finding.alone, rel=1e-12)
        assert (case["low"], case["high"]) == pytest.approx(finding.family, rel=1e-12)
        known = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
        assert alone(case) == pytest.approx((known.low, known.high), rel=1e-9)
        assert case["p"] == pytest.approx(finding.p, rel=1e-12)
        assert case["p"] < 0.05
        assert case["difference"] == pytest.approx(case["mean"] - case["mean_first"], abs=1e-9)
    assert compared.settings == {"filters": ('["ekf"]', '["iekf"]')}
    assert compared.notes[0] == "Paired over the worlds that both have met."


def test_every_score_with_numbers_is_compared(pair):
    compared = compare_studies(pair)
    found = list(dict.fromkeys(row["score"] for row in compared.rows))
    assert found == [name for name in SCORES if name in found], "in the order of the one table"
    assert "heading_rmse_rad" not in found, "no study has a number"
    (first, _) = cases_of_score(compared, "map_rmse_aligned_m")
    (same, _) = cases_of_score(compared, "position_rmse_aligned_m")
    assert first["difference"] == pytest.approx(2.0 * same["difference"], rel=1e-9)
    still, _ = cases_of_score(compared, "landmarks_full")
    assert (still["difference"], still["p"]) == (0.0, 1.0)


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
    assert compared.notes[0].startswith("Not paired: the worlds are not the same")
    case, _ = cases_of_score(compared)
    assert not case["paired"]
    assert worlds(case) == (WORLDS, 4)
    first, second = (told(tmp_path / name, ("active", "ekf")) for name in ("one", "two"))
    known = stats.ttest_ind(second, first, equal_var=False)
    bounds = known.confidence_interval(0.95)
    assert alone(case) == pytest.approx((bounds.low, bounds.high), rel=1e-9)
    assert case["difference"] == pytest.approx(second.mean() - first.mean(), rel=1e-12)
    assert case["p"] > 0.05, "what is between worlds hides it"


def test_sound_and_estimators_may_differ_in_the_same_worlds():
    other = Config(rays=RayConfig(exponent=3.0), beacon={"level_db": 50.0})
    assert draw_of(Config()) == draw_of(other)


def test_worlds_of_a_single_study_do_not_count(tmp_path):
    one = study_folder(tmp_path / "one", plan(), numbers(1.0, 1), worlds=[0, 1, 2, 3])
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2), worlds=[5, 1, 3, 2])
    compared = compare_studies([one, two])
    case, _ = cases_of_score(compared)
    assert worlds(case) == (3, 3)
    assert compared.worlds == ((4, WORLDS), (4, WORLDS))
    both = [1, 2, 3]
    by_hand = [0.5 - 1.0 + noise(*w(case, 2)) - noise(*w(case, 1)) for w in map(of_case, both)]
    assert case["difference"] == pytest.approx(np.mean(by_hand), rel=1e-9)


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
    for case in (everything, left):
        assert (case["diverged_first"], case["diverged"]) == (1, 2)
    assert worlds(left) == (3, 3)
    assert worlds(everything) == ((WORLDS, WORLDS) if value is not None else (3, 3))
    assert "left out" in compare_studies([one, two], drop_diverged=True).notes[-1]
    assert "count, as far" in compare_studies([one, two]).notes[-1]


def test_a_score_that_is_no_number_counts_in_no_world(tmp_path):
    one = study_folder(tmp_path / "one", plan(), diverging(1.0, 1, {0}, np.nan))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    case, _ = cases_of_score(compare_studies([one, two]), "map_rmse_m")
    assert worlds(case) == (WORLDS - 1, WORLDS - 1)


# Which cases


def test_cases_of_a_grid_are_matched_by_their_values_and_passive_by_no_beam(tmp_path):
    ways = ("active", "passive")
    one = study_folder(tmp_path / "one", plan(strategies=ways, grid=RADII), numbers(1.0, 1))
    grid = {"emitter.radius": (0.025, 0.0088)}
    two = study_folder(tmp_path / "two", plan(strategies=ways, grid=grid), numbers(0.5, 2))
    compared = compare_studies([one, two])
    cases = cases_of_score(compared)
    assert [(case["strategy"], case["emitter.radius"]) for case in cases] == [
        ("active", 0.025),
        ("passive", None),
    ]
    assert compared.notes[-2:] == (
        "Only in A, not compared: active ekf, 33.0°",
        "Only in B, not compared: active ekf, 33.0°",
    )


def test_a_value_that_only_one_study_varies_is_matched_with_the_settings_of_the_other(tmp_path):
    grid = {"rays.exponent": (1.5, 2.0)}
    one = study_folder(tmp_path / "one", plan(grid=grid), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    compared = compare_studies([one, two])
    assert {row["rays.exponent"] for row in compared.rows} == {2.0}
    assert [case["case"] for case in cases_of_score(compared)] == [
        "active ekf, rays.exponent 2.0",
        "fused ekf, rays.exponent 2.0",
    ]
    assert compared.settings["grid.rays.exponent"] == ("[1.5, 2.0]", None)


def test_a_filter_of_a_single_study_is_named(tmp_path):
    one = study_folder(tmp_path / "one", plan(filters=("ekf", "fastslam")), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(filters=("ekf", "iekf")), numbers(0.5, 2))
    compared = compare_studies([one, two])
    assert [case["case"] for case in cases_of_score(compared)] == ["active ekf", "fused ekf"]
    assert compared.notes[-2:] == (
        "Only in A, not compared: active fastslam; fused fastslam",
        "Only in B, not compared: active iekf; fused iekf",
    )


def test_studies_without_a_common_case_are_refused_with_their_cases(tmp_path):
    one = study_folder(tmp_path / "one", plan(grid={"rays.exponent": (1.5, 3.0)}), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    with pytest.raises(InputError, match=r"no case .* tries active, fused by ekf at rays.exponent"):
        compare_studies([one, two])


def test_several_studies_are_held_against_the_first_in_one_family(tmp_path):
    folders = [
        study_folder(tmp_path / name, plan(strategies=("fused",)), numbers(level, seed))
        for seed, (name, level) in enumerate({"one": 1.0, "two": 0.5, "three": 0.9}.items())
    ]
    cases = cases_of_score(compare_studies(folders))
    assert [case["letter"] for case in cases] == ["B", "C"]
    samples = [
        told(folder, ("fused", "ekf")) - told(folders[0], ("fused", "ekf"))
        for folder in folders[1:]
    ]
    by_hand = judge([Statement(label="", sample=sample) for sample in samples])
    assert [case["p"] for case in cases] == pytest.approx([f.p for f in by_hand], rel=1e-9)


def test_unpaired_cases_are_marked_among_paired_cases(tmp_path):
    base = Config(scenario=ScenarioConfig(steps=8))
    folders = [
        study_folder(tmp_path / name, plan(config=config), numbers(1.0, 1))
        for name, config in {
            "one": base, "two": base, "three": base.model_copy(update={"seed": 9}),
        }.items()
    ]  # fmt: skip
    compared = compare_studies(folders)
    assert [case["paired"] for case in cases_of_score(compared)] == [True, False, True, False]
    assert compared.notes[0].startswith("Paired where the worlds are the same")


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

    assert "version of Pipistrelle" not in compare_studies(pair).settings
    (pair[0] / "README.md").write_text("mine")
    for path, known in ((pair[1], __version__), (pair[1] / "README.md", None)):
        if known is None:
            path.unlink()
        settings = compare_studies(pair).settings
        expected = None if known is None else (None, known)
        assert settings.get("version of Pipistrelle") == expected


def test_names_of_all_come_in_the_order_of_the_first_and_others_with_their_owners():
    common, alone = matched([["c", "a", "b"], ["a", "d", "c"], ["c", "a"]])
    assert common == ("c", "a")
    assert alone == {"b": (0,), "d": (1,)}
    assert matched([["a"], ["b"]]) == ((), {"a": (0,), "b": (1,)})


def test_settings_differ_where_a_value_does_or_is_not_there():
    found = differing([{"a": 1, "b": [1, 2], "c": 0}, {"a": 1, "b": [2, 1], "d": False}])
    assert found == {"b": ("[1, 2]", "[2, 1]"), "c": ("0", None), "d": (None, "false")}
    assert differing([{"a": 1}, {"a": 1.0}]) == {}


# What is kept


@pytest.fixture
def missions(tmp_path):
    lost = np.full_like(OFF, np.nan)
    one = {("active", "ekf"): loop(), ("fused", "ekf"): OFF}
    two = {("active", "iekf"): lost, ("fused", "iekf"): loop()}
    sharp = Config(filter=FilterConfig(noise="measured", initial_pose_std=(0.1, 0.1, 0.1)))
    folders = [
        mission_folder(tmp_path / "one", one),
        mission_folder(tmp_path / "two, [2]", two, config=sharp),
    ]
    return compare_missions(folders)


@pytest.fixture
def studies(tmp_path):
    given = Plan(
        name="made-up", iterations=3, strategies=("active", "passive"), filters=("ekf",),
        config=Config(), grid={"emitter.radius": (0.0025, 0.025), "filter.noise": ("constant",)},
    )  # fmt: skip
    folders = [
        study_folder(tmp_path / name, given, lambda case, world, k=k: 1.0 + k * (2 + world))
        for k, name in enumerate(("one", "two"))
    ]
    return compare_studies(folders)


def test_missions_have_a_row_for_each_estimate_folder_and_score(missions):
    table = comparison_table(missions)
    rmse = table.filter(pl.col("score") == "position_rmse_m")
    assert rmse["letter"].to_list() == ["A", "B", "A", "B"]
    assert rmse["filter"].to_list() == ["ekf", "iekf"] * 2
    assert rmse["estimate"].to_list() == ["active", "active", "fused", "fused"]
    first, lost, off, exact = rmse["value"].to_list()
    assert (first, lost) == (0.0, None)
    assert off > 0.5 > exact == 0.0
    assert rmse["difference"].to_list() == [0.0, None, 0.0, pytest.approx(-off)]
    diverged = table.filter(pl.col("score") == "diverged")["value"].to_list()
    assert diverged == [0.0, 1.0, 0.0, 0.0]
    assert {"wall_s", "landmarks_full", "nees_max"} <= set(table["score"])
    assert not {"strategy", "filter", "ignored_rows", "online"} & set(table["score"])


def test_studies_have_a_row_for_each_case_and_score(studies):
    table = comparison_table(studies)
    mine = table.filter(pl.col("score") == "map_rmse_m")
    assert mine.select("case", "emitter.radius", "filter.noise", "worlds", "paired").rows() == [
        ("active ekf, 33.0°, filter.noise constant", 0.0025, "constant", 3, True),
        ("active ekf, 33.0°, filter.noise constant", 0.025, "constant", 3, True),
        ("passive ekf, filter.noise constant", None, "constant", 3, True),
    ]
    assert mine["difference"].to_list() == pytest.approx([3.0] * 3)
    assert mine["mean"].to_list() == pytest.approx([4.0] * 3)
    low, high = mine["alone_low"][0], mine["alone_high"][0]
    assert (low + high) / 2.0 == pytest.approx(3.0)


def test_settings_have_a_column_for_each_folder(missions):
    assert settings_table(missions).columns == ["setting", "A", "B"]
    assert settings_table(missions).rows() == [
        ("filter.noise", "constant", "measured"),
        ("filter.initial_pose_std", "[0.05, 0.05, 0.0436]", "[0.1, 0.1, 0.1]"),
    ]
    assert settings_table(replace(missions, settings={})).rows() == []


@pytest.mark.parametrize("kind", ["missions", "studies"])
def test_a_comparison_is_written_with_sums_and_a_readme(kind, request, tmp_path):
    compared, folder = request.getfixturevalue(kind), tmp_path / "out"

    def draw(room):
        (room / "comparison.png").write_bytes(b"picture")

    given = {"command": "pipistrelle compare one", "notes": ["A note."], "draw": draw}
    write_comparison(OwnFiles(folder, COMPARISON), compared, **given)
    names = sorted(path.name for path in folder.iterdir())
    assert names == [
        "README.md", "SHA256SUMS", "comparison.csv", "comparison.parquet", "comparison.png",
        "settings.csv",
    ]  # fmt: skip
    assert OwnFiles(folder, COMPARISON).there == COMPARISON.title
    assert (folder / SUMS).read_text().startswith("# Of Pipistrelle: a comparison\n")
    table = comparison_table(compared)
    assert pl.read_parquet(folder / "comparison.parquet").equals(table)
    assert pl.read_csv(folder / "comparison.csv").height == table.height
    readme = (folder / "README.md").read_text()
    for part in ("pipistrelle compare one", "- A note.", f"- A: `{spelt(compared.folders['A'])}`"):
        assert part in readme


@pytest.mark.parametrize("name", ["<script>", "a`b``c", "`"])
def test_the_readme_shows_folder_names_as_code_without_markup(missions, tmp_path, name):
    compared = replace(missions, folders={**missions.folders, "A": Path(name)})
    folder = tmp_path / "out"
    write_comparison(OwnFiles(folder, COMPARISON), compared, command="", notes=())
    (line,) = [one for one in (folder / "README.md").read_text().split("\n") if "- A: " in one]
    ticks, text = re.fullmatch(r"- A: (`+) ?(.+?) ?\1", line).groups()
    assert text == name
    assert ticks not in name
