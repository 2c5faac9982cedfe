"""The folder for results: what is made, what is refused, where `runs/latest` points."""

from pathlib import Path

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.results.writing import result_folder
from pipistrelle.files import RESULTS, SUMS, OwnFiles, claim


@pytest.fixture
def earlier(tmp_path):
    names = ("track_fused_ekf.tum", "map_fused_ekf.csv", "mission.png", "config.toml")
    OwnFiles(tmp_path, RESULTS).replace(dict.fromkeys(names, "old") | {"summary.json": "{}"})
    return tmp_path


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Path("runs")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def ran(path=None, overwrite=False):
    """Fill a folder as a mission does, and return it."""
    with result_folder(path, "run", overwrite=overwrite) as own:
        own.replace({"summary.json": "{}"})
    return own.folder


def refused():
    """Begin a mission that is refused."""
    with (
        pytest.raises(InputError, match="no such world"),
        result_folder(None, "run", overwrite=False),
    ):
        raise InputError("no such world")


def test_the_folder_asked_for_is_the_result_folder(tmp_path):
    asked = tmp_path / "a" / "b"
    assert ran(asked) == asked
    assert names(asked) == [SUMS, "summary.json"]
    asked = tmp_path / "empty"
    asked.mkdir()
    assert ran(asked) == asked


def test_without_a_name_runs_latest_is_the_newest_folder_that_is_whole(here):
    first, second = ran(), ran()
    assert first != second
    assert first.parent == second.parent == here
    assert first.name.endswith("-run")
    assert (here / "latest").readlink() == Path(second.name)
    with result_folder(None, "slam", overwrite=False) as own:
        assert (here / "latest").readlink() == Path(second.name), "nothing is there yet"
        own.replace({"summary.json": "{}"})
    assert (here / "latest").readlink() == Path(own.folder.name)
    assert len(names(here)) == 4


def test_a_refused_mission_leaves_no_folder_and_latest_where_it_was(here):
    refused()
    assert not here.exists()
    first = ran()
    refused()
    assert names(here) == [first.name, "latest"]
    assert (here / "latest").readlink() == Path(first.name)


def test_a_system_without_symbolic_links_only_lacks_the_link(here, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError("no links here")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    folder = ran()
    assert names(here) == [folder.name]


@pytest.mark.parametrize("kind", ["file", "folder", "link of another tool", "link to nothing"])
def test_a_foreign_file_named_latest_is_not_touched(here, kind):
    here.mkdir()
    mine = here / "latest"
    if kind == "file":
        mine.write_text("notes")
    elif kind == "folder":
        mine.mkdir()
    else:
        mine.symlink_to("checkpoint-7" if kind == "link to nothing" else "../notes")
    before = mine.lstat()
    folder = ran()
    assert names(here) == [folder.name, "latest"]
    after = mine.lstat()
    for name in ("st_ino", "st_mode", "st_size", "st_mtime_ns"):  # a link may be read
        assert getattr(after, name) == getattr(before, name)


def test_a_link_of_ours_to_a_folder_that_was_removed_is_replaced(here):
    here.mkdir()
    (here / "latest").symlink_to("20260101-120000-slam-2")
    assert (here / ran().name).samefile(here / "latest")


def test_a_folder_with_results_is_refused_unless_overwriting(earlier):
    before = names(earlier)
    with pytest.raises(InputError, match=r"not empty.*--overwrite") as refusal:
        ran(earlier)
    assert str(earlier) in str(refusal.value)
    assert names(earlier) == before
    with result_folder(earlier, "run", overwrite=True) as own:
        assert names(earlier) == before, "the old results stay until there are new ones"
        own.replace({"summary.json": "{}"})
    assert names(earlier) == [SUMS, "summary.json"]


def test_overwriting_keeps_the_users_files_in_the_folder(earlier):
    mine = ("notes.txt", "mission.txt", "map_house.csv", "track_jazz.tum", "a.partial")
    for name in mine:
        (earlier / name).write_text("mine")
    ran(earlier, overwrite=True)
    assert names(earlier) == sorted([*mine, SUMS, "summary.json"])


@pytest.mark.parametrize("name", ["README.md", "mission.pdf", "track_active_ekf.tum"])
def test_overwriting_refuses_a_users_file_in_the_place_of_a_result(earlier, name):
    (earlier / name).write_text("mine")
    before = names(earlier)
    with pytest.raises(InputError, match=rf"{name}: is not Pipistrelle's, so it is not replaced"):
        claim(earlier, RESULTS, overwrite=True)
    assert names(earlier) == before


def test_runs_that_is_a_file_is_refused(here):
    here.write_text("mine")
    with pytest.raises(InputError, match=r"^runs: cannot be used"):
        ran()
