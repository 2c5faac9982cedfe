"""Studies side by side: cases matched, worlds paired, differences judged together."""

import re

import numpy as np
import polars as pl
import pytest
from scipy import stats

from pipistrelle.config import Config, InputError, MotionConfig, RayConfig, ScenarioConfig
from pipistrelle.evaluation.comparison import Statement, judge
from pipistrelle.experiments.comparing.studies import SCORES, compare_studies, notes_of, same_worlds
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.experiments.studies.world import TABLES, world_file
from reference.results import mission_folder, study_folder  # noqa: F401

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


def test_cases_are_paired_world_by_world_and_judged_as_one_family(pair):
    compared = compare_studies(pair)
    cases = cases_of_score(compared)
    assert [case.label for case in cases] == ["active", "fused"]
    samples = [
        told(pair[1], (strategy, "iekf")) - told(pair[0], (strategy, "ekf"))
        for strategy in ("active", "fused")
    ]
    by_hand = judge([Statement(label="", sample=sample) for sample in samples])
    for case, sample, finding in zip(cases, samples, by_hand, strict=True):
        assert case.paired
        assert case.worlds == (WORLDS, WORLDS)
        assert case.finding.mean == pytest.approx(sample.mean(), rel=1e-12)
        assert case.finding.alone == pytest.approx(finding.alone, rel=1e-12)
        assert case.finding.interval == pytest.approx(finding.interval, rel=1e-12)
        known = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
        assert case.finding.alone == pytest.approx((known.low, known.high), rel=1e-9)
        assert case.finding.p < 0.05
        assert case.finding.mean == pytest.approx(case.means[1] - case.means[0], abs=1e-9)
    assert compared.settings == {"filters": (["ekf"], ["iekf"])}
    assert notes_of(compared)[0] == "Paired over the worlds that both have met."


def test_every_score_with_numbers_is_compared(pair):
    compared = compare_studies(pair)
    found = list(dict.fromkeys(case.score for case in compared.cases))
    assert found == [name for name in SCORES if name in found], "in the order of the one table"
    assert "heading_rmse_rad" not in found, "no study has a number"
    (first, _) = cases_of_score(compared, "map_rmse_aligned_m")
    (same, _) = cases_of_score(compared, "position_rmse_aligned_m")
    assert first.finding.mean == pytest.approx(2.0 * same.finding.mean, rel=1e-9)
    still, _ = cases_of_score(compared, "landmarks_full")
    assert (still.finding.mean, still.finding.p) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("config", "other"),
    [
        ("seed", {"seed": 8}),
        ("scenario", {"scenario": ScenarioConfig(steps=8, landmarks=49)}),
        ("motion", {"motion": MotionConfig(speed_std=0.2)}),
    ],
)
def test_other_worlds_are_not_paired_and_that_is_said(tmp_path, config, other):
    base = Config(scenario=ScenarioConfig(steps=8))
    changed = base.model_copy(update=other)
    assert not same_worlds(base, changed), config
    study_folder(tmp_path / "one", plan(config=base), numbers(1.0, 1))
    study_folder(tmp_path / "two", plan(config=changed, worlds=4), numbers(0.5, 2))
    compared = compare_studies([tmp_path / "one", tmp_path / "two"])
    assert notes_of(compared)[0].startswith("Not paired: the worlds are not the same")
    case, _ = cases_of_score(compared)
    assert not case.paired
    assert case.worlds == (WORLDS, 4)
    first, second = (told(tmp_path / name, ("active", "ekf")) for name in ("one", "two"))
    known = stats.ttest_ind(second, first, equal_var=False)
    alone = known.confidence_interval(0.95)
    assert case.finding.alone == pytest.approx((alone.low, alone.high), rel=1e-9)
    assert case.finding.mean == pytest.approx(second.mean() - first.mean(), rel=1e-12)
    assert case.finding.p > 0.05, "what is between worlds hides it"


def test_what_is_heard_and_who_maps_it_may_differ_in_the_same_worlds():
    other = Config(rays=RayConfig(power=3.0), beacon={"level_db": 50.0})
    assert same_worlds(Config(), other)


def test_worlds_that_only_one_has_done_do_not_count(tmp_path):
    one = study_folder(tmp_path / "one", plan(), numbers(1.0, 1), worlds=[0, 1, 2, 3])
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2), worlds=[5, 1, 3, 2])
    compared = compare_studies([one, two])
    case, _ = cases_of_score(compared)
    assert case.worlds == (3, 3)
    assert (compared.done, compared.planned) == ((4, 4), (WORLDS, WORLDS))
    both = [1, 2, 3]
    by_hand = [0.5 - 1.0 + noise(*w(case, 2)) - noise(*w(case, 1)) for w in map(of_case, both)]
    assert case.finding.mean == pytest.approx(np.mean(by_hand), rel=1e-9)


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
    assert left.worlds == (3, 3)
    assert everything.worlds == ((WORLDS, WORLDS) if value is not None else (3, 3))
    assert "left out" in notes_of(compare_studies([one, two], drop_diverged=True))[-1]
    assert "count, as far" in notes_of(compare_studies([one, two]))[-1]


def test_a_score_that_is_no_number_counts_in_no_world(tmp_path):
    one = study_folder(tmp_path / "one", plan(), diverging(1.0, 1, {0}, np.nan))
    two = study_folder(tmp_path / "two", plan(), numbers(0.5, 2))
    case, _ = cases_of_score(compare_studies([one, two]), "map_rmse_m")
    assert case.worlds == (WORLDS - 1, WORLDS - 1)


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


def test_a_filter_that_only_one_has_is_named(tmp_path):
    one = study_folder(tmp_path / "one", plan(filters=("ekf", "fastslam")), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(filters=("ekf", "iekf")), numbers(0.5, 2))
    compared = compare_studies([one, two])
    assert [case.label for case in cases_of_score(compared)] == ["active ekf", "fused ekf"]
    assert dict(compared.alone) == {
        "active fastslam": (0,), "fused fastslam": (0,), "active iekf": (1,), "fused iekf": (1,),
    }  # fmt: skip


def test_studies_without_a_case_in_common_say_what_they_try(tmp_path):
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
    assert [case.finding.p for case in cases] == pytest.approx([f.p for f in by_hand], rel=1e-9)


def test_cases_of_which_some_are_paired_are_marked(tmp_path):
    base = Config(scenario=ScenarioConfig(steps=8))
    folders = [
        study_folder(tmp_path / name, plan(config=config), numbers(1.0, 1))
        for name, config in {
            "one": base, "two": base, "three": base.model_copy(update={"seed": 9}),
        }.items()
    ]  # fmt: skip
    compared = compare_studies(folders)
    assert [case.paired for case in cases_of_score(compared)] == [True, False, True, False]
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


def test_a_study_whose_plan_was_changed_is_refused(pair):
    text = (pair[0] / "plan.toml").read_text()
    (pair[0] / "plan.toml").write_text(text.replace("seed = 7", "seed = 8"))
    with pytest.raises(InputError, match=r"computed by another plan than the plan\.toml"):
        compare_studies(pair)


def test_a_study_of_which_no_world_is_done_is_named(tmp_path):
    one = study_folder(tmp_path / "one", plan(), numbers(1.0, 1))
    two = study_folder(tmp_path / "two", plan(filters=("not:There",)), numbers(1.0, 1), worlds=[])
    with pytest.raises(InputError, match=r"two: no world is done yet"):
        compare_studies([one, two])


def test_the_version_of_a_study_is_what_its_readme_says_or_nothing(pair):
    from pipistrelle import __version__

    assert compare_studies(pair).versions == (__version__, __version__)
    (pair[0] / "README.md").write_text("mine")
    (pair[1] / "README.md").unlink()
    assert compare_studies(pair).versions == ("", "")
