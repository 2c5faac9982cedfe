"""A world's tables: whole or not there, whoever writes them, and noticed where they changed."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.studies import world as world_files
from pipistrelle.experiments.studies.study import load_study, open_store, run_study
from pipistrelle.experiments.studies.world import (
    TABLES,
    check_world,
    done_worlds,
    failed_records,
    read_ended_trials,
    refuse_strange,
    run_world,
    sweep,
    world_file,
    write_world,
)
from pipistrelle.files import write_down
from pipistrelle.settings import from_flags, resolve
from reference.studies import contents, leftovers


def test_a_world_is_done_when_its_trials_are_there(folder, plan, records):
    assert done_worlds(folder) == set()
    write_world(folder, plan, 2, records)
    assert done_worlds(folder) == {2}
    for table in TABLES:
        assert world_file(folder, table, 2).is_file()
    assert leftovers(folder) == []
    assert read_ended_trials(folder, plan, 2) == [(r.case.strategy, r.error) for r in records]


def test_the_trials_are_written_last(folder, plan, records, monkeypatch):
    order = []
    rename = world_files.put_in_place
    monkeypatch.setattr(
        world_files, "put_in_place", lambda a, b: (order.append(b.parent.name), rename(a, b))
    )
    write_world(folder, plan, 0, records)
    assert order == ["steps", "landmarks", "trials"]


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no device that is always full"
)
def test_a_full_disk_raises_a_clear_error_and_keeps_existing_files(
    folder, plan, records, monkeypatch, table
):
    write_world(folder, plan, 1, records)
    before = contents(folder)

    def full(path, data):
        if path.parent.name == table:
            path.write_bytes(data[:7])
            raise OSError(28, "No space left on device")
        write_down(path, data)

    monkeypatch.setattr(world_files, "write_down", full)
    for iteration in (0, 1):
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

    monkeypatch.setattr(world_files, "put_in_place", failing)
    with pytest.raises(InputError, match="Input/output error"):
        write_world(folder, plan, 0, records)
    assert done_worlds(folder) == set()
    assert leftovers(folder) == []
    assert len(load_study(folder).steps.collect()) == 0


def test_leftovers_of_a_killed_writer_are_removed_with_its_world(folder, plan, records):
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


@pytest.mark.parametrize("table", ["steps", "landmarks"])
@pytest.mark.parametrize("kind", ["text", "link", "other columns"])
def test_a_file_of_somebodys_in_a_tables_place_is_refused_before_the_work(
    folder, plan, tmp_path, table, kind
):
    path, other = world_file(folder, table, 1), tmp_path / "mine.parquet"
    pl.DataFrame({"mine": [1.0]}).write_parquet(other)
    if kind == "link":
        path.symlink_to(other)
    else:
        path.write_bytes(b"my notes" if kind == "text" else other.read_bytes())
    before = contents(folder)
    with pytest.raises(InputError, match=f"{table}/iteration_00001.parquet: is no table .* move"):
        run_study(plan, folder)
    assert contents(folder) == before


def test_tables_that_a_killed_writer_left_without_trials_block_nothing(folder, plan, records):
    write_world(folder, plan, 1, records)
    world_file(folder, "trials", 1).unlink()
    refuse_strange(folder, plan, range(3))


def test_an_overtaken_writer_succeeds(folder, plan, records, monkeypatch):
    write = world_files.write_down

    def overtaken(path, data):
        write(path, data)
        if path.parent.name == "trials" and len(leftovers(folder)) == 3:
            monkeypatch.setattr(world_files, "write_down", write)
            write_world(folder, plan, 0, records)  # which sweeps ours away

    monkeypatch.setattr(world_files, "write_down", overtaken)
    write_world(folder, plan, 0, records)
    assert done_worlds(folder) == {0}
    assert leftovers(folder) == []


def test_a_damaged_world_is_named_with_the_way_out(folder, plan):
    world_file(folder, "trials", 0).write_bytes(b"nothing of ours")
    with pytest.raises(
        InputError, match=r"0\.parquet: could not be read: it is no whole .*; remove"
    ):
        read_ended_trials(folder, plan, 0)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("place", [0.1, 0.5, 0.8, 0.9, 0.98])
def test_one_bit_that_a_disk_changed_is_noticed(folder, plan, records, table, place):
    write_world(folder, plan, 3, records)
    check_world(folder, plan, 3)
    path = world_file(folder, table, 3)
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    with pytest.raises(InputError) as refused:
        read_ended_trials(folder, plan, 3)
    assert str(refused.value).startswith(f"{path}: ")
    assert "remove trials/iteration_00003.parquet" in str(refused.value)


def test_a_world_of_a_plan_with_other_settings_of_a_filters_own_is_noticed(folder, plan, records):
    own = {"ekf": {"filter.gate": 0.9}}
    for there, here in (({}, own), (own, {}), (own, {"ekf": {"filter.gate": 0.8}})):
        write_world(folder, replace(plan, own=there), 0, records)
        check_world(folder, replace(plan, own=there, iterations=99), 0)
        with pytest.raises(InputError, match=r"iteration_00000\.parquet: was computed by another"):
            check_world(folder, replace(plan, own=here), 0)


def test_a_world_of_another_plan_is_noticed_and_more_worlds_are_no_other_plan(
    folder, plan, records
):
    write_world(folder, plan, 0, records)
    check_world(folder, replace(plan, iterations=99), 0)
    other = replace(plan, config=resolve(from_flags({"rays": {"power": 3.0}})))
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: was computed by another plan"):
        check_world(folder, other, 0)


def test_trials_of_other_columns_are_named_though_their_sums_are_right(folder, plan, records):
    tables = world_files.world_tables(plan, 0, records)
    other = tables | {"trials": tables["trials"].drop("error")}
    for name, file in world_files.with_sums(other, plan, 0).items():
        world_file(folder, name, 0).write_bytes(file)
    with pytest.raises(InputError, match=r"iteration_00000\.parquet: has not the columns"):
        read_ended_trials(folder, plan, 0)


@pytest.mark.parametrize("table", TABLES)
def test_a_file_of_another_world_or_by_another_hand_is_noticed(folder, plan, table):
    for world in (0, 1):
        write_world(folder, plan, world, run_world(plan, world))
    here, there = (world_file(folder, table, world) for world in (0, 1))
    kept = here.read_bytes()
    shutil.copy(there, here)
    found = "is the file of world 1" if table == "trials" else "is not as it was written"
    with pytest.raises(InputError, match=found):
        check_world(folder, plan, 0)
    here.write_bytes(kept)
    check_world(folder, plan, 0)
    pl.read_parquet(kept)[::2].write_parquet(here)
    with pytest.raises(InputError, match=r"bears no sums|is not as it was written"):
        check_world(folder, plan, 0)


def test_a_writer_killed_while_it_replaces_a_world_leaves_it_undone(
    folder, plan, records, monkeypatch
):
    write_world(folder, plan, 0, records)
    tables = world_files.world_tables(plan, 0, records)
    other = tables["steps"].select(
        pl.lit(1).cast(kind).alias(c) for c, kind in tables["steps"].schema.items()
    )
    monkeypatch.setattr(world_files, "world_tables", lambda *_: tables | {"steps": other})

    def killed(partial, path):
        partial.replace(path)
        raise KeyboardInterrupt

    monkeypatch.setattr(world_files, "put_in_place", killed)
    with pytest.raises(KeyboardInterrupt):
        write_world(folder, plan, 0, records)
    assert done_worlds(folder) == set(), "new steps beside old trials are no world"


@pytest.mark.parametrize(
    "name",
    ["a*b", "s[1]/x", "q?", "file:x", "{a,b}", "http:/x", "\x1b[31m", "new\nline", "x ", "~x"],
)
def test_no_name_of_a_folder_is_a_pattern_or_a_place_elsewhere(
    tmp_path, plan, records, monkeypatch, name
):
    monkeypatch.chdir(tmp_path)
    beside = Path(name.replace("*", "X").replace("?", "X").replace("[1]", "1"))
    for folder in {Path(name), beside}:
        world_files_of(folder, plan, records)
    for folder in {Path(name), beside}:
        assert len(read_ended_trials(folder, plan, 0)) == len(records)
        study = load_study(folder)
        assert [len(getattr(study, table).collect()) for table in TABLES] == [0, 0, len(records)]


@pytest.mark.skipif(os.name == "nt", reason="all names are Unicode there")
def test_a_folder_with_an_undecodable_name_is_read(tmp_path, plan, records):
    folder = tmp_path / os.fsdecode(b"log\xff")
    world_files_of(folder, plan, records)
    assert len(load_study(folder).trials.collect()) == len(records)


def world_files_of(folder, plan, records):
    """Open a study of one world."""
    open_store(folder, plan)
    write_world(folder, plan, 0, records)
