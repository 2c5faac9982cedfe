"""A study's folder: its plan, and who may write it."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import polars as pl
import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies.plan import plan_text, read_plan
from pipistrelle.experiments.studies.study import load_study, open_store
from pipistrelle.experiments.studies.world import TABLES, write_world
from pipistrelle.settings import from_file, resolve
from reference.studies import SMALL, contents, leftovers, plan_of


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


def test_more_worlds_of_one_plan_are_asked_for_in_one_folder_and_fewer_change_nothing(
    folder, tmp_path
):
    open_store(folder, plan_of(tmp_path, iterations=8))
    assert read_plan(folder / "plan.toml").iterations == 8
    open_store(folder, plan_of(tmp_path, iterations=2))
    assert read_plan(folder / "plan.toml").iterations == 8


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


def test_a_folder_of_something_else_is_refused(tmp_path, plan):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("mine")
    with pytest.raises(InputError, match=r"thesis: holds chapter\.txt and no plan\.toml"):
        open_store(tmp_path / "thesis", plan)
    assert len(contents(tmp_path / "thesis")) == 1


@pytest.mark.parametrize("name", ["movie.mkv.partial", "README.md.partial", "plan.toml.1.partial"])
def test_a_folder_of_somebodys_partial_downloads_is_no_study(tmp_path, plan, name):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / name).write_text("mine")
    with pytest.raises(InputError, match=f"mine: holds {name} and no plan"):
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
    with pytest.raises(InputError, match=r"holds no plan\.toml; expected the folder of a study"):
        load_study(tmp_path)


def test_a_plan_file_that_names_the_defaults_still_matches(tmp_path):
    plan = plan_of(tmp_path, SMALL + f"[config.rays]\npower = {Config().rays.power}\n")
    open_store(tmp_path / "one", plan_of(tmp_path))
    open_store(tmp_path / "one", plan)
