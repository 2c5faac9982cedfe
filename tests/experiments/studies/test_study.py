"""A study: what is run, what is kept, what is counted."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import polars as pl
import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies import study, world
from pipistrelle.experiments.studies.plan import plan_text, read_plan
from pipistrelle.experiments.studies.study import load_study, open_store, run_study
from pipistrelle.experiments.studies.world import TABLES, done_worlds, world_file, write_world
from pipistrelle.settings import from_file, resolve
from reference.studies import SMALL, as_rows, assert_same, contents, leftovers, plan_of, results


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


def test_a_study_continued_since_settings_were_renamed_is_read_whole(tmp_path):
    plan = plan_of(tmp_path, SMALL.replace("emitter.radius", "rays.exponent"))
    folder, records = tmp_path / "study", world.failed_records(plan, "")
    open_store(folder, plan)
    for number in (0, 1):
        write_world(folder, plan, number, records)
    old = world_file(folder, "trials", 0)
    pl.read_parquet(old).rename({"rays.exponent": "rays.power"}).write_parquet(old)
    trials = load_study(folder).trials.collect()
    assert (len(trials), "rays.power" in trials) == (2 * len(records), False)


def test_a_study_opens_with_its_plan_its_settings_and_an_explanation(folder, plan):
    assert read_plan(folder / "plan.toml") == plan
    assert resolve(from_file(folder / "config.toml")) == plan.config
    readme = (folder / "README.md").read_text()
    assert all(f"| {table}/ |" in readme for table in TABLES)
    assert leftovers(folder) == []


def test_reopening_a_study_with_its_plan_changes_no_file(folder, plan, records):
    write_world(folder, plan, 0, records)
    before = contents(folder)
    open_store(folder, plan)
    assert contents(folder) == before


def test_a_folder_remembers_how_many_worlds_its_plan_names(tmp_path, plan):
    folder, kept = tmp_path / "few", tmp_path / "few" / "plan.toml"
    open_store(folder, plan_of(tmp_path, iterations=1))
    assert (read_plan(kept).iterations, read_plan(kept).planned) == (1, 3)
    open_store(folder, read_plan(kept))
    open_store(folder, plan_of(tmp_path, iterations=2))
    assert (read_plan(kept).iterations, read_plan(kept).planned) == (2, 3)
    open_store(folder, plan)
    assert (read_plan(kept), "planned" in kept.read_text()) == (plan, False)
    open_store(
        folder, plan_of(tmp_path, SMALL.replace("iterations = 3", "iterations = 9"), iterations=2)
    )
    assert (read_plan(kept).iterations, read_plan(kept).planned) == (3, 9)


def test_a_folder_from_before_it_remembered_is_read_and_goes_on(tmp_path, plan):
    """It named the worlds that were asked for, and no others."""
    folder, kept = tmp_path / "old", tmp_path / "old" / "plan.toml"
    open_store(folder, replace(plan, iterations=1, planned=1))
    assert "planned" not in kept.read_text()
    assert load_study(folder).plan.planned == 1
    open_store(folder, plan_of(tmp_path, iterations=2))
    assert (read_plan(kept).iterations, read_plan(kept).planned) == (2, 3)


def test_a_plan_with_notes_is_left_where_only_the_planned_number_is_new(tmp_path, folder, plan):
    kept = folder / "plan.toml"
    kept.write_text("# what I think of it\n" + kept.read_text())
    before = kept.read_text()
    open_store(
        folder, plan_of(tmp_path, SMALL.replace("iterations = 3", "iterations = 9"), iterations=2)
    )
    assert kept.read_text() == before


def test_another_plan_is_refused_with_the_difference(folder, tmp_path):
    before = contents(folder)
    other = plan_of(tmp_path, SMALL.replace("steps = 40", "steps = 44"))
    with pytest.raises(InputError) as error:
        open_store(folder, other)
    assert str(error.value).splitlines() == [
        f"{folder / 'plan.toml'}: is the plan of another study; name a new folder with -o DIR",
        "  config.scenario.steps: 40 there, 44 asked for",
    ]
    assert contents(folder) == before


@pytest.mark.parametrize(
    "name", ["chapter.txt", "movie.mkv.partial", "README.md.partial", "plan.toml.1.partial"]
)
def test_a_folder_of_something_else_is_refused(tmp_path, plan, name):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / name).write_text("mine")
    with pytest.raises(InputError, match=rf"mine: holds {name} and no plan\.toml"):
        open_store(tmp_path / "mine", plan)
    assert contents(tmp_path / "mine") == {Path(name): b"mine"}


def test_leftovers_of_a_killed_start_are_removed_and_other_files_kept(folder, plan):
    (folder / "plan.toml.deadbeef.partial").write_text("form")
    (folder / "movie.mkv.partial").write_text("mine")
    open_store(folder, plan)
    assert [path.name for path in leftovers(folder)] == ["movie.mkv.partial"]


def test_a_plan_of_the_users_own_is_not_taken_for_a_study(tmp_path, plan):
    (tmp_path / "plans").mkdir()
    text = "# what I think of it\n" + plan_text(plan)
    (tmp_path / "plans" / "plan.toml").write_text(text)
    with pytest.raises(InputError, match=r"holds a plan\.toml that is not Pipistrelle's"):
        open_store(tmp_path / "plans", plan)
    assert contents(tmp_path / "plans") == {Path("plan.toml"): text.encode()}


def test_a_new_study_may_be_opened_by_several_threads_at_once(tmp_path, plan):
    rounds, together = 10, 6
    start = Barrier(together)

    def open_each(_: int) -> None:
        for number in range(rounds):
            start.wait(timeout=20)
            open_store(tmp_path / str(number), plan)

    with ThreadPoolExecutor(together) as pool:
        list(pool.map(open_each, range(together)))
    for number in range(rounds):
        assert read_plan(tmp_path / str(number) / "plan.toml") == plan
        assert leftovers(tmp_path / str(number)) == []


def test_a_users_remarks_in_a_studys_plan_are_not_lost(folder, plan):
    text = "# what I think of it\n" + plan_text(plan)
    (folder / "plan.toml").write_text(text)
    open_store(folder, plan)
    with pytest.raises(InputError, match=r"so it is not replaced; set iterations = 9 in it"):
        open_store(folder, replace(plan, iterations=9))
    assert (folder / "plan.toml").read_text() == text


def test_a_damaged_plan_is_named(folder, plan):
    (folder / "plan.toml").write_text("format = ")
    with pytest.raises(InputError, match=r"plan\.toml: found .*, expected TOML"):
        open_store(folder, plan)


@pytest.mark.skipif(sys.platform != "linux", reason="a place where nobody may write is known there")
def test_a_place_that_cannot_be_written_is_refused(plan):
    with pytest.raises(InputError, match=r"could not be written \(.*\); worlds that are done are"):
        open_store(Path("/proc/self/fd/study"), plan)


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write anywhere")
def test_a_study_in_a_read_only_folder_is_refused(folder, plan):
    for table in TABLES:
        (folder / table).chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        open_store(folder, plan)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, plan):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="could not be written"):
        open_store(tmp_path / "file", plan)


def test_a_study_loads_lazily_world_after_world(folder, plan, records):
    empty = load_study(folder)
    assert isinstance(empty.trials, pl.LazyFrame)
    assert len(empty.trials.collect()) == 0
    for iteration in (11, 2):
        write_world(folder, plan, iteration, records)
    study = load_study(folder)
    assert study.plan == plan
    assert study.trials.collect()["iteration"].unique(maintain_order=True).to_list() == [2, 11]
    for table in TABLES:
        schema = getattr(empty, table).collect_schema()
        assert getattr(study, table).collect_schema() == schema


def test_a_folder_without_a_plan_is_no_study(tmp_path):
    with pytest.raises(InputError, match=r"found no plan\.toml, expected the folder of a study"):
        load_study(tmp_path)


def test_a_plan_file_that_names_the_defaults_still_matches(tmp_path):
    plan = plan_of(tmp_path, SMALL + f"[config.rays]\nexponent = {Config().rays.exponent}\n")
    open_store(tmp_path / "one", plan_of(tmp_path))
    open_store(tmp_path / "one", plan)
