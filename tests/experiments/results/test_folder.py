"""The folder for results: what is made, what is refused, what overwriting may remove."""

import os
from pathlib import Path

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.results.folder import prepare_folder
from pipistrelle.files import RESULTS, SUMS, OwnFiles


@pytest.fixture
def earlier(tmp_path):
    own = OwnFiles(tmp_path, RESULTS)
    for name in ("track_fused_ekf.tum", "map_fused_ekf.csv", "mission.png", "config.toml"):
        own.write(name, "old")
    own.write("summary.json", "{}")
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
    OwnFiles(earlier, RESULTS).clear()
    assert names(earlier) == []


def test_overwriting_accepts_a_folder_with_files_of_the_users_beside_the_results(earlier):
    mine = ("notes.txt", "mission.txt", "map_house.csv", "track_jazz.tum", "a.partial")
    for name in mine:
        (earlier / name).write_text("mine")
    OwnFiles(prepare_folder(earlier, "run", overwrite=True), RESULTS).clear()
    assert names(earlier) == sorted(mine)


@pytest.mark.parametrize("name", ["README.md", "mission.pdf", "track_active_ekf.tum"])
def test_overwriting_refuses_a_users_file_in_the_place_of_a_result(earlier, name):
    (earlier / name).write_text("mine")
    before = names(earlier)
    with pytest.raises(InputError, match=rf"{name}: is not Pipistrelle's, so it is not replaced"):
        prepare_folder(earlier, "run", overwrite=True)
    assert names(earlier) == before


def test_overwriting_refuses_a_result_that_the_user_edited(earlier):
    (earlier / "config.toml").write_text("old, and mine")
    with pytest.raises(InputError, match=r"config\.toml: was changed since Pipistrelle wrote it"):
        prepare_folder(earlier, "run", overwrite=True)


@pytest.mark.parametrize("sums", [None, "", "\xff", "not a list of sums"])
def test_overwriting_spares_a_folder_without_a_list_of_ours(tmp_path, sums):
    (tmp_path / "config.toml").write_text("mine")
    (tmp_path / "summary.json").write_text('{"format": 1, "config_hash": "0", "runs": []}')
    if sums is not None:
        (tmp_path / SUMS).write_text(sums, encoding="latin-1")
    before = names(tmp_path)
    with pytest.raises(InputError, match=r"holds no results of Pipistrelle"):
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

    monkeypatch.setattr("pipistrelle.experiments.results.folder.TemporaryFile", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        prepare_folder(tmp_path, "run", overwrite=False)
