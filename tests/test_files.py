"""What we write is whole or not there, and what is somebody else's stays as it is."""

import os
import subprocess
import sys
from hashlib import sha256
from shutil import which

import pytest

from pipistrelle.config import InputError
from pipistrelle.files import REPORT, RESULTS, SUMS, OwnFiles, put_in_place, write_whole


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def own(tmp_path):
    """A folder in which we wrote two files."""
    own = OwnFiles(tmp_path, RESULTS)
    own.write("one.txt", "first")
    own.write("figures/two.png", b"\x89PNG")
    return own


def test_one_kind_never_replaces_another(tmp_path):
    report = OwnFiles(tmp_path, REPORT)
    report.write("index.html", "page")
    for change in (OwnFiles.check, OwnFiles.clear):
        with pytest.raises(InputError, match="holds a report of Pipistrelle, which results"):
            change(OwnFiles(tmp_path, RESULTS))
    assert (tmp_path / "index.html").read_text() == "page"
    again = OwnFiles(tmp_path, REPORT)
    again.clear()
    OwnFiles(tmp_path, RESULTS).write("index.html", "other")


def test_what_we_wrote_is_known_again_replaced_and_removed(own, tmp_path):
    again = OwnFiles(tmp_path, RESULTS)
    again.check(["one.txt"])
    again.write("one.txt", "zweite Fassung: µ")
    assert (tmp_path / "one.txt").read_text(encoding="utf-8") == "zweite Fassung: µ"
    OwnFiles(tmp_path, RESULTS).clear()
    assert names(tmp_path) == ["figures"]
    assert names(tmp_path / "figures") == []
    assert not OwnFiles(tmp_path, RESULTS)


def test_what_is_read_is_as_it_was_written_or_refused_by_name(own, tmp_path):
    assert OwnFiles(tmp_path, RESULTS).read("one.txt") == b"first"
    assert ("one.txt" in own, "three.txt" in own) == (True, False)
    (tmp_path / "three.txt").write_text("mine")
    (tmp_path / "one.txt").write_text("first!")
    for name, why in (("one.txt", "was changed since"), ("three.txt", "is not Pipistrelle's")):
        with pytest.raises(InputError, match=why):
            own.read(name)
    (tmp_path / "one.txt").unlink()
    with pytest.raises(InputError, match=r"one\.txt: is missing"):
        own.read("one.txt")
    os.mkfifo(tmp_path / "one.txt")
    with pytest.raises(InputError, match=r"one\.txt: is no file"):
        own.read("one.txt")


def test_what_of_ours_is_there_is_said_by_its_kind(own, tmp_path):
    assert OwnFiles(tmp_path, REPORT).there == RESULTS
    assert OwnFiles(tmp_path / "empty", REPORT).there is None


@pytest.mark.skipif(which("sha256sum") is None, reason="this system has no sha256sum")
def test_anybody_can_check_the_sums(own, tmp_path):
    own.write("one.txt", "second")
    told = subprocess.run(["sha256sum", "-c", SUMS], cwd=tmp_path, capture_output=True, text=True)
    assert (told.returncode, told.stdout) == (0, "one.txt: OK\nfigures/two.png: OK\n")
    (tmp_path / "one.txt").write_text("mine")
    assert subprocess.run(["sha256sum", "-c", SUMS], cwd=tmp_path, capture_output=True).returncode


def test_an_edited_file_is_refused_by_name_and_nothing_is_removed(own, tmp_path):
    (tmp_path / "one.txt").write_text("first, and notes of mine")
    for act in (own.check, own.clear, lambda: own.write("one.txt", "second")):
        with pytest.raises(InputError, match=r"one\.txt: was changed since Pipistrelle wrote it"):
            act()
    assert (tmp_path / "one.txt").read_text() == "first, and notes of mine"
    assert (tmp_path / "figures" / "two.png").exists()


@pytest.mark.parametrize("kind", ["file", "folder", "dangling link", "partial"])
def test_what_is_not_ours_is_refused_by_name(own, tmp_path, kind):
    path = tmp_path / ("three.txt.partial" if kind == "partial" else "three.txt")
    if kind == "folder":
        path.mkdir()
    elif kind == "dangling link":
        path.symlink_to("nowhere")
    else:
        path.write_text("mine")
    before = names(tmp_path)
    for act in (lambda: own.check(["three.txt"]), lambda: own.write("three.txt", "ours")):
        with pytest.raises(InputError, match=rf"{path.name}: is not Pipistrelle's"):
            act()
    own.clear()
    assert names(tmp_path) == [name for name in before if name not in ("one.txt", SUMS)]


def test_a_file_of_ours_that_is_gone_is_no_hindrance(own, tmp_path):
    (tmp_path / "one.txt").unlink()
    own.check()
    own.write("one.txt", "again")
    assert (tmp_path / "one.txt").read_text() == "again"


def test_a_list_that_is_not_ours_names_nothing(tmp_path):
    (tmp_path / SUMS).write_bytes(b"\xff\xfe nothing of the kind")
    (tmp_path / "one.txt").write_text("mine")
    assert not OwnFiles(tmp_path, RESULTS)
    with pytest.raises(InputError, match="is not Pipistrelle's"):
        OwnFiles(tmp_path, RESULTS).write("one.txt", "ours")


def test_a_list_that_points_outside_removes_nothing_there(tmp_path):
    outside, folder = tmp_path / "precious.txt", tmp_path / "results"
    OwnFiles(tmp_path, RESULTS).write("precious.txt", "of another folder")
    folder.mkdir()
    line = (tmp_path / SUMS).read_text().replace("precious", "../precious")
    (folder / SUMS).write_text(line + line.replace("../precious.txt", str(outside)))
    OwnFiles(folder, RESULTS).clear()
    assert outside.exists()


def test_what_was_stopped_in_the_middle_is_known_as_ours(own, tmp_path, monkeypatch):
    def stop(*_):
        raise SystemExit

    with monkeypatch.context() as patched:
        patched.setattr("pipistrelle.files.write_whole", stop)
        with pytest.raises(SystemExit):
            own.write("three.txt", "ours")
    (tmp_path / "three.txt.partial").write_text("ou")  # as a kill would leave it
    OwnFiles(tmp_path, RESULTS).check(["three.txt"])
    OwnFiles(tmp_path, RESULTS).clear()
    assert names(tmp_path) == ["figures"]


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_a_full_disk_keeps_the_old_file_and_says_which(own, tmp_path):
    (tmp_path / "one.txt.partial").symlink_to("/dev/full")
    with pytest.raises(InputError, match=r"one\.txt: could not be written \(No space left"):
        own.write("one.txt", "second")
    assert (tmp_path / "one.txt").read_text() == "first"
    assert names(tmp_path) == [SUMS, "figures", "one.txt"]


def test_what_is_drawn_in_a_lent_room_is_put_in_place_at_its_end(own, tmp_path):
    with own.room("figures") as room:
        (room / "three.png").write_bytes(b"three")
        assert names(tmp_path / "figures") == ["two.png"]
    assert names(tmp_path / "figures") == ["three.png", "two.png"]

    def stopped():
        with own.room() as room:
            (room / "four.png").write_bytes(b"four")
            raise KeyError

    with pytest.raises(KeyError):
        stopped()
    assert names(tmp_path) == [SUMS, "figures", "one.txt"]


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


def test_a_device_in_place_of_the_list_or_of_a_file_of_ours_is_never_read(own, tmp_path):
    (tmp_path / "one.txt").unlink()
    (tmp_path / "one.txt").symlink_to("/dev/null")
    own._sums["one.txt"] = sha256(b"").hexdigest()  # of what a device that ends would give
    with pytest.raises(InputError, match=r"one\.txt: was changed"):
        own.check()
    (tmp_path / SUMS).unlink()
    (tmp_path / SUMS).symlink_to("/dev/null")
    with pytest.raises(InputError, match=f"{SUMS}: is no file; remove what stands in its place"):
        OwnFiles(tmp_path, RESULTS)
