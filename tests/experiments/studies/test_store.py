"""A study's folder: whole or not there, whoever writes it and whatever stops it."""

import os
import sys
from pathlib import Path

import polars as pl
import pytest

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies import store
from pipistrelle.experiments.studies.plan_file import read_plan
from pipistrelle.experiments.studies.store import (
    TABLES,
    done_worlds,
    load_study,
    open_store,
    read_ended_trials,
    sweep,
    world_file,
    write_world,
)
from pipistrelle.experiments.studies.world import failed_records
from pipistrelle.settings import from_file, resolve
from reference.studies import SMALL, leftovers, plan_of

FULL = Path("/dev/full")


@pytest.fixture
def plan(tmp_path):
    return plan_of(tmp_path)


@pytest.fixture
def folder(tmp_path, plan):
    folder = tmp_path / "study"
    open_store(folder, plan)
    return folder


@pytest.fixture
def records(plan):
    return failed_records(plan, "for want of a better\n")


def contents(folder):
    """Every file of a folder and what is in it."""
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_study_opens_with_its_plan_its_settings_and_an_explanation(folder, plan):
    assert read_plan(folder / "plan.toml") == plan
    assert resolve(from_file(folder / "config.toml")) == plan.config
    readme = (folder / "README.md").read_text()
    assert all(f"| {table}/ |" in readme for table in TABLES)
    assert leftovers(folder) == []


def test_a_study_opens_again_with_its_own_plan_and_touches_nothing(folder, plan, records):
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


def test_a_damaged_plan_is_named(folder, plan):
    (folder / "plan.toml").write_text("format = ")
    with pytest.raises(InputError, match=r"plan\.toml: not TOML"):
        open_store(folder, plan)


def test_a_world_is_done_when_its_trials_are_there(folder, plan, records):
    assert done_worlds(folder) == set()
    write_world(folder, plan, 2, records)
    assert done_worlds(folder) == {2}
    for table in TABLES:
        assert world_file(folder, table, 2).is_file()
    assert leftovers(folder) == []
    assert read_ended_trials(folder, 2) == [(r.case.strategy, r.error) for r in records]


def test_the_trials_go_last(folder, plan, records, monkeypatch):
    order = []
    rename = store.put_in_place
    monkeypatch.setattr(
        store, "put_in_place", lambda a, b: (order.append(b.parent.name), rename(a, b))
    )
    write_world(folder, plan, 0, records)
    assert order == ["steps", "landmarks", "trials"]


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.skipif(not FULL.exists(), reason="this system has no device that is always full")
def test_a_full_disk_ends_in_a_clear_error_and_leaves_what_was_there(
    folder, plan, records, monkeypatch, table
):
    write_world(folder, plan, 1, records)
    before = contents(folder)
    partial = f".{'0' * 8}.partial"
    monkeypatch.setattr(store, "uuid4", lambda: type("Same", (), {"hex": "0" * 32}))
    for iteration in (0, 1):
        path = world_file(folder, table, iteration)
        path.with_name(path.name + partial).symlink_to(FULL)
        with pytest.raises(InputError, match=r"could not be written \(No space left on device\)"):
            write_world(folder, plan, iteration, failed_records(plan, "never written\n"))
    assert contents(folder) == before
    assert leftovers(folder) == []
    assert done_worlds(folder) == {1}


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_a_rename_that_fails_leaves_no_half_a_world_that_counts(
    folder, plan, records, monkeypatch, nth
):
    calls = []

    def failing(partial, path):
        calls.append(path)
        if len(calls) == nth:
            raise OSError(5, "Input/output error", str(path))
        partial.replace(path)

    monkeypatch.setattr(store, "put_in_place", failing)
    with pytest.raises(InputError, match="Input/output error"):
        write_world(folder, plan, 0, records)
    assert done_worlds(folder) == set()
    assert leftovers(folder) == []
    assert len(load_study(folder).steps.collect()) == 0


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


def test_what_a_killed_writer_left_is_no_result_and_goes_when_its_world_is_done(
    folder, plan, records
):
    for table in TABLES:
        path = world_file(folder, table, 0)
        path.with_name(f"{path.name}.deadbeef.partial").write_bytes(b"PAR1 half a")
    world_file(folder, "steps", 0).write_bytes(b"whole, but of a world that is not done")
    other = world_file(folder, "steps", 1)
    living = other.with_name(f"{other.name}.01234567.partial")
    living.write_bytes(b"another process is writing this")
    assert done_worlds(folder) == set()
    assert len(load_study(folder).steps.collect()) == 0
    write_world(folder, plan, 0, records)
    assert leftovers(folder) == [living]
    sweep(folder, [1])
    assert leftovers(folder) == []


def test_a_writer_that_was_overtaken_is_content(folder, plan, records, monkeypatch):
    write = store.write_down

    def overtaken(path, data):
        write(path, data)
        if path.parent.name == "trials" and len(leftovers(folder)) == 3:
            monkeypatch.setattr(store, "write_down", write)
            write_world(folder, plan, 0, records)  # which sweeps ours away

    monkeypatch.setattr(store, "write_down", overtaken)
    write_world(folder, plan, 0, records)
    assert done_worlds(folder) == {0}
    assert leftovers(folder) == []


def test_a_damaged_world_is_named_with_the_way_out(folder, plan):
    world_file(folder, "trials", 0).write_bytes(b"nothing of ours")
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: could not be read .*; remove"):
        read_ended_trials(folder, 0)


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
