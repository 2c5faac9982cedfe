"""The folder for results: what is made, what is refused, what overwriting may remove."""

import json
import os
import sys
from pathlib import Path

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.results.folder import (
    clear_results,
    prepare_folder,
    put_in_place,
    write_file,
    write_whole,
)

OURS = json.dumps({"format": 1, "config_hash": "0" * 16, "runs": []})


@pytest.fixture
def earlier(tmp_path):
    for name in ("track_fused_ekf.tum", "map_fused_ekf.csv", "mission.png", "config.toml"):
        (tmp_path / name).write_text("old")
    (tmp_path / "summary.json").write_text(OURS)
    return tmp_path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_folder_asked_for_is_the_result_folder(tmp_path):
    asked = tmp_path / "a" / "b"
    assert prepare_folder(asked, "run", overwrite=False) == asked
    assert names(asked) == []
    assert prepare_folder(asked, "run", overwrite=False) == asked


def test_without_a_name_runs_latest_is_the_newest_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = prepare_folder(None, "run", overwrite=False)
    second = prepare_folder(None, "run", overwrite=False)
    assert first != second
    assert first.parent == second.parent == Path("runs")
    assert first.name.endswith("-run")
    assert Path("runs/latest").resolve() == second.resolve()
    assert len(names(Path("runs"))) == 3


def test_a_system_without_symbolic_links_only_lacks_the_link(tmp_path, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError("no links here")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "symlink_to", refuse)
    folder = prepare_folder(None, "run", overwrite=False)
    assert names(Path("runs")) == [folder.name]


def test_a_folder_of_the_users_called_latest_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "latest").mkdir(parents=True)
    (tmp_path / "runs" / "latest" / "mine.txt").write_text("mine")
    folder = prepare_folder(None, "run", overwrite=False)
    assert names(tmp_path / "runs") == [folder.name, "latest"]
    assert names(tmp_path / "runs" / "latest") == ["mine.txt"]


def test_a_folder_with_results_is_refused_unless_overwriting(earlier):
    before = names(earlier)
    with pytest.raises(InputError, match=r"not empty.*--overwrite") as refusal:
        prepare_folder(earlier, "run", overwrite=False)
    assert str(earlier) in str(refusal.value)
    assert names(earlier) == before
    assert prepare_folder(earlier, "run", overwrite=True) == earlier
    assert names(earlier) == before, "the old results stay until there are new ones"
    clear_results(earlier)
    assert names(earlier) == []


def test_overwriting_removes_nothing_that_is_not_a_result(earlier):
    (earlier / "notes.txt").write_text("mine")
    (earlier / "mission.d").mkdir()
    (earlier / "mission.d" / "track_fused_ekf.tum").write_text("mine")
    clear_results(prepare_folder(earlier, "run", overwrite=True))
    assert names(earlier) == ["mission.d", "notes.txt"]
    assert names(earlier / "mission.d") == ["track_fused_ekf.tum"]


@pytest.mark.parametrize("summary", [None, "{", "[]", '{"runs": []}', "\xff"])
def test_overwriting_spares_a_folder_without_a_summary_of_ours(tmp_path, summary):
    (tmp_path / "config.toml").write_text("mine")
    if summary is not None:
        (tmp_path / "summary.json").write_text(summary, encoding="latin-1")
    before = names(tmp_path)
    with pytest.raises(InputError, match=r"holds no summary\.json"):
        prepare_folder(tmp_path, "run", overwrite=True)
    assert names(tmp_path) == before


def test_a_file_in_the_way_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("mine")
    for asked in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="cannot be used as a result folder") as refusal:
            prepare_folder(asked, "run", overwrite=True)
        assert str(asked) in str(refusal.value)
    assert (tmp_path / "file").read_text() == "mine"


def test_runs_that_is_a_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").write_text("mine")
    with pytest.raises(InputError, match=r"^runs: cannot be used"):
        prepare_folder(None, "run", overwrite=False)


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        prepare_folder(tmp_path, "run", overwrite=False)


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "one.txt"
    write_file(path, "first")
    write_file(path, "zweite Fassung: µ")
    assert path.read_text(encoding="utf-8") == "zweite Fassung: µ"
    assert names(tmp_path) == ["one.txt"]


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_a_full_disk_keeps_the_old_file_and_says_which(tmp_path, monkeypatch):
    path = tmp_path / "one.txt"
    write_file(path, "first")
    (tmp_path / "one.txt.partial").symlink_to("/dev/full")
    with pytest.raises(InputError, match=r"one\.txt: could not be written \(No space left"):
        write_file(path, "second")
    assert path.read_text() == "first"
    assert names(tmp_path) == ["one.txt"]


def test_whatever_stops_the_writing_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "one.txt"
    write_whole(path, b"first")

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, b"second", writer=".7")
    assert path.read_bytes() == b"first"
    assert names(tmp_path) == ["one.txt"]


def test_who_was_overtaken_is_content_and_who_lost_a_file_is_not(tmp_path):
    path, partial = tmp_path / "one.txt", tmp_path / "one.txt.partial"
    with pytest.raises(FileNotFoundError):
        put_in_place(partial, path)
    path.write_text("by another")
    put_in_place(partial, path)
    assert path.read_text() == "by another"
