"""One file: what is no file is never read, and what we write is whole or not there."""

import os
from pathlib import Path

import pytest

from pipistrelle.config import InputError
from pipistrelle.files import (
    PiecesFile,
    partial_of,
    put_in_place,
    read_file,
    read_text,
    spelt,
    upright,
    whole_name,
    write_down,
    write_whole,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "link to a device"])
def test_pipes_devices_and_folders_are_refused_without_waiting(tmp_path, kind):
    path = tmp_path / "one.txt"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
        path = path if kind == "link to a device" else path.resolve()
    what = "a folder" if kind == "folder" else "a pipe or a device"
    for read in (read_file, read_text):
        with pytest.raises(InputError, match=f"{path.name}: found {what}, expected a"):
            read(path)


def test_text_is_the_same_whatever_ends_its_lines_or_marks_its_beginning(tmp_path):
    path = tmp_path / "one.txt"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")
    assert read_text(path) == "one\ntwo\nthree\n"
    path.write_bytes(b"one\xff")
    with pytest.raises(InputError, match="found byte 3, which is no UTF-8 text"):
        read_text(path)
    with pytest.raises(InputError, match="found no such file"):
        read_text(tmp_path / "two.txt")


def test_whatever_stops_the_writing_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "one.txt"
    write_whole(path, b"first")

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, b"second")
    assert path.read_bytes() == b"first"
    assert names(tmp_path) == ["one.txt"]


def test_nothing_is_written_through_a_link(tmp_path, monkeypatch):
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    trap = tmp_path / "one.html.0a1b2c3d.partial"
    trap.symlink_to(precious)
    with pytest.raises(FileExistsError):
        write_down(trap, b"page")
    page = tmp_path / "one.html"
    page.symlink_to(precious)
    write_whole(page, b"page")
    assert page.read_bytes() == b"page"
    assert not page.is_symlink()
    assert precious.read_text() == "precious"


@pytest.mark.parametrize("hard_links", [True, False])
def test_a_file_that_appeared_meanwhile_is_not_replaced(tmp_path, monkeypatch, hard_links):
    path = tmp_path / "one.txt"
    if not hard_links:

        def refuse(*_args, **_kwargs):
            raise OSError(1, "no hard links here")

        monkeypatch.setattr(os, "link", refuse)
    write_whole(path, b"first", replace=False)
    with pytest.raises(FileExistsError):
        write_whole(path, b"second", replace=False)
    assert path.read_bytes() == b"first"
    write_whole(path, b"second")
    assert path.read_bytes() == b"second"
    path.unlink()
    path.symlink_to("nowhere")
    with pytest.raises(FileExistsError):
        write_whole(path, b"third", replace=False)
    assert names(tmp_path) == ["one.txt"]


def test_an_overtaken_writer_succeeds_and_a_lost_file_raises(tmp_path):
    path, partial = tmp_path / "one.txt", tmp_path / "one.txt.partial"
    with pytest.raises(FileNotFoundError):
        put_in_place(partial, path)
    path.write_text("by another")
    put_in_place(partial, path)
    assert path.read_text() == "by another"


def test_only_pipistrelles_partial_names_count_as_leftovers(tmp_path):
    path = tmp_path / "one.txt"
    assert partial_of(path) != partial_of(path)
    assert whole_name(partial_of(path).name) == "one.txt"
    for name in ("one.txt", "one.txt.partial", "debian.iso.partial", ".0a1b2c3d.partial"):
        assert whole_name(name) is None


def test_names_are_spelt_whatever_they_are_made_of():
    assert spelt(Path("a b [1] µ")) == "a b [1] µ"
    assert spelt(Path("a\nb")) == "a\\nb"
    assert spelt(Path("a\udcff")) == "a\\xff"


def test_characters_that_turn_the_direction_of_writing_are_escaped_and_no_others():
    turning = [*"\u202a\u202b\u202c\u202d\u202e", *"\u2066\u2067\u2068\u2069"]
    assert "".join(map(upright, turning)).isascii()
    plain = "µ · 95 %\n\tשלום سلام \u200d\u00a0<b>"
    assert upright(plain) == plain


def test_a_file_in_pieces_that_a_disk_does_not_take_is_refused_by_name_and_removed(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        rows = PiecesFile(tmp_path / "rows.csv")
        rows.write(b"more than ten bytes")
        with pytest.raises(InputError, match=r"rows\.csv: could not be written \(File too large\)"):
            rows.close()
        rows.discard()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [*tmp_path.iterdir()]
