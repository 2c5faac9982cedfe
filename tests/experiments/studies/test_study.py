"""A study: what is run, what is kept, what is counted."""

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.studies import study, world
from pipistrelle.experiments.studies.study import load_study, run_study
from pipistrelle.experiments.studies.world import done_worlds, world_file
from reference.studies import as_rows, assert_same, leftovers, plan_of, results


@pytest.fixture
def plan(tmp_path):
    return plan_of(tmp_path)


@pytest.fixture
def ran(monkeypatch):
    """The worlds that are run, in order."""
    worlds = []
    run_world = study.run_world

    def noted(plan, iteration):
        worlds.append(iteration)
        return run_world(plan, iteration)

    monkeypatch.setattr(study, "run_world", noted)
    return worlds


@pytest.fixture
def moody(monkeypatch):
    """Make passive FastSLAM fail in world 1, until this is called."""
    run_trial = world.run_trial

    def failing(case, drive, scans, config, **_):
        if (case.strategy, case.filter, case.iteration) == ("passive", "fastslam", 1):
            raise FloatingPointError("weights: all zero")
        return run_trial(case, drive, scans, config)

    monkeypatch.setattr(world, "run_trial", failing)
    return lambda: monkeypatch.setattr(world, "run_trial", run_trial)


def test_a_study_runs_every_world_once_and_goes_on_where_it_stopped(plan, tmp_path, ran):
    def enough(so_far):
        if so_far.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(plan, tmp_path / "study", progress=enough)
    assert (ran, done_worlds(tmp_path / "study")) == ([0, 1], {0, 1})
    so_far = run_study(plan, tmp_path / "study")
    assert ran == [0, 1, 2]
    assert (so_far.done, so_far.worlds) == (3, 3)
    run_study(plan, tmp_path / "study")
    assert ran == [0, 1, 2]


def test_more_worlds_of_a_plan_are_added_to_finished_worlds(plan, tmp_path, ran):
    run_study(plan, tmp_path / "study")
    run_study(plan_of(tmp_path, iterations=5), tmp_path / "study")
    assert ran == [0, 1, 2, 3, 4]


def test_the_progress_counts_worlds_and_trials_by_strategy(plan, tmp_path):
    seen = []
    run_study(plan, tmp_path / "study", progress=seen.append)
    assert [so_far.done for so_far in seen] == [0, 1, 2, 3]
    assert seen[-1].trials == seen[-1].ended == {"active": 12, "fused": 12, "passive": 6}
    assert seen[1].ended == {"active": 4, "fused": 4, "passive": 2}
    assert all(set(so_far.failed.values()) == {0} for so_far in seen)


def test_the_first_of_several_failures_is_reported(plan, tmp_path, monkeypatch):
    def failing(case, drive, scans, config, **_):
        raise FloatingPointError(f"\nweights of world {case.iteration}\nsee the manual")

    monkeypatch.setattr(world, "run_trial", failing)
    seen = []
    run_study(plan, tmp_path / "study", progress=seen.append)
    first = "FloatingPointError: weights of world 0"
    assert [so_far.first_error for so_far in seen] == [None, first, first, first]


def test_shares_are_disjoint_and_make_up_the_whole(plan, tmp_path, ran):
    for i in range(2):
        so_far = run_study(plan, tmp_path / "shares", shard=(i, 2))
        assert so_far.done == so_far.worlds == (2, 1)[i]
    assert ran == [0, 2, 1]
    run_study(plan, tmp_path / "whole")
    assert_same(results(tmp_path / "shares"), results(tmp_path / "whole"))


def test_a_share_without_worlds_is_done_at_once(plan, tmp_path, ran):
    assert run_study(plan, tmp_path / "study", shard=(3, 4)).worlds == 0
    assert ran == []


def test_a_trial_that_raises_is_counted_and_the_study_goes_on(plan, tmp_path, moody):
    so_far = run_study(plan, tmp_path / "study")
    assert so_far.done == 3
    assert so_far.failed == {"active": 0, "fused": 0, "passive": 1}
    assert so_far.first_error == "FloatingPointError: weights: all zero"
    failed = [
        row for row in as_rows(results(tmp_path / "study")["trials"]) if row["status"] == "failed"
    ]
    (row,) = failed
    assert (row["iteration"], row["strategy"], row["filter"]) == (1, "passive", "fastslam")
    assert row["seed"] == plan.config.seed
    assert "weights: all zero" in row["error"]
    assert run_study(plan, tmp_path / "study").failed == so_far.failed


def test_failed_trials_are_run_again_when_asked_and_only_their_worlds(plan, tmp_path, moody, ran):
    run_study(plan, tmp_path / "study")
    ran.clear()
    assert run_study(plan, tmp_path / "study", retry_failed=True).failed["passive"] == 1
    moody()
    seen = []
    run_study(plan, tmp_path / "study", retry_failed=True, progress=seen.append)
    assert ran == [1, 1]
    assert [so_far.done for so_far in seen] == [2, 3]
    assert seen[-1].failed == {"active": 0, "fused": 0, "passive": 0}
    run_study(plan, tmp_path / "untroubled")
    assert_same(results(tmp_path / "study"), results(tmp_path / "untroubled"))


def test_a_retried_world_keeps_its_results_until_it_is_done(plan, tmp_path, moody, monkeypatch):
    run_study(plan, tmp_path / "study")
    before = results(tmp_path / "study")

    def interrupted(plan, iteration):
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_world", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_study(plan, tmp_path / "study", retry_failed=True)
    assert_same(results(tmp_path / "study"), before)
    assert leftovers(tmp_path / "study") == []


def test_a_world_without_trials_is_run_again_with_equal_results(plan, tmp_path, ran):
    run_study(plan, tmp_path / "study")
    before = results(tmp_path / "study")
    world_file(tmp_path / "study", "trials", 1).unlink()
    run_study(plan, tmp_path / "study")
    assert ran == [0, 1, 2, 1]
    assert_same(results(tmp_path / "study"), before)


def test_another_plan_in_the_folder_is_refused_before_anything_runs(plan, tmp_path, ran):
    run_study(plan, tmp_path / "study")
    text = (tmp_path / "small.toml").read_text().replace("landmarks = 12", "landmarks = 13")
    with pytest.raises(InputError, match=r"config\.scenario\.landmarks: 12 there, 13 asked for"):
        run_study(plan_of(tmp_path, text), tmp_path / "study")
    assert ran == [0, 1, 2]


def test_the_tables_hold_a_row_for_each_case_frame_and_mapped_landmark(plan, tmp_path):
    run_study(plan, tmp_path / "study")
    stored = load_study(tmp_path / "study")
    trials, steps = stored.trials.collect(), stored.steps.collect()
    landmarks = stored.landmarks.collect()
    assert trials.select("iteration", "case").rows() == [
        (i, c) for i in range(3) for c in range(10)
    ]
    assert len(steps) == 3 * 10 * 10
    for row in as_rows(trials):
        mine = landmarks.filter(iteration=row["iteration"], case=row["case"])
        assert len(mine) == row["landmarks_total"]
        assert mine["full"].sum() == row["landmarks_full"]
