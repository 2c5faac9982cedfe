"""One file: what is no file is never read, and what we write is whole or not there."""

import os
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from shutil import which

import pytest

from pipistrelle import files
from pipistrelle.config import InputError
from pipistrelle.files import (
    KINDS,
    LOG,
    REPORT,
    RESULTS,
    SUMS,
    OwnFiles,
    PiecesFile,
    claim,
    drawn_files,
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


def tree(folder):
    """All that is in a folder: contents of files, targets of links."""
    return {
        path.relative_to(folder).as_posix(): (
            str(path.readlink())
            if path.is_symlink()
            else path.read_bytes()
            if path.is_file()
            else None
        )
        for path in folder.rglob("*")
    }


def listed(folder, *names):
    """Write the list that `sha256sum` would."""
    lines = [f"{sha256((folder / n).read_bytes()).hexdigest()}  {n}\n" for n in names]
    (folder / SUMS).write_text("".join(lines))


@pytest.fixture
def own(tmp_path):
    """A folder in which we wrote two files."""
    own = OwnFiles(tmp_path, REPORT)
    own.replace({"figures/two.png": b"\x89PNG", "index.html": "first"})
    return own


def test_one_kind_never_replaces_another(own, tmp_path):
    before = tree(tmp_path)
    for act in (
        lambda: OwnFiles(tmp_path, RESULTS).check(),
        lambda: OwnFiles(tmp_path, RESULTS).replace({"summary.json": "{}"}),
        lambda: OwnFiles(tmp_path, RESULTS).add("view.html", b"page"),
        lambda: claim(tmp_path, RESULTS, overwrite=True),
    ):
        with pytest.raises(InputError, match="holds a report of Pipistrelle, which results"):
            act()
    assert tree(tmp_path) == before
    assert OwnFiles(tmp_path, RESULTS).there == REPORT.title
    assert OwnFiles(tmp_path / "empty", REPORT).there is None


def test_written_files_are_recognised_and_replaced(own, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    again = OwnFiles(tmp_path, REPORT)
    again.replace({"index.html": "zweite Fassung: µ"})
    assert sorted(tree(tmp_path)) == [SUMS, "figures", "index.html", "notes.txt"]
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == "zweite Fassung: µ"
    again.add("figures/three.png", b"three")
    again.add("figures/three.png", b"four")
    assert OwnFiles(tmp_path, REPORT).read("figures/three.png") == b"four"
    assert OwnFiles(tmp_path, REPORT).read("index.html") == "zweite Fassung: µ".encode()


def test_changed_files_are_refused_by_name_when_read(own, tmp_path):
    assert OwnFiles(tmp_path, REPORT).read("index.html") == b"first"
    assert ("index.html" in own, "summary.json" in own) == (True, False)
    (tmp_path / "summary.json").write_text("mine")
    (tmp_path / "index.html").write_text("first!")
    for name, why in (("index.html", "was changed since"), ("summary.json", "is not Pipistrelle")):
        with pytest.raises(InputError, match=why):
            own.read(name)
    (tmp_path / "index.html").unlink()
    with pytest.raises(InputError, match=r"index\.html: is missing"):
        own.read("index.html")
    os.mkfifo(tmp_path / "index.html")
    with pytest.raises(InputError, match=r"index\.html: found a pipe or a device"):
        own.read("index.html")


@pytest.mark.skipif(which("sha256sum") is None, reason="this system has no sha256sum")
def test_sha256sum_can_check_the_sums(own, tmp_path):
    own.add("index.html", b"second")
    found = subprocess.run(["sha256sum", "-c", SUMS], cwd=tmp_path, capture_output=True, text=True)
    assert (found.returncode, sorted(found.stdout.splitlines())) == (
        0, ["figures/two.png: OK", "index.html: OK"],
    )  # fmt: skip
    (tmp_path / "index.html").write_text("mine")
    assert subprocess.run(["sha256sum", "-c", SUMS], cwd=tmp_path, capture_output=True).returncode


@pytest.mark.parametrize("flaw", ["edited", "link", "link to the same"])
def test_a_file_of_ours_that_is_changed_is_refused_by_name_and_nothing_is_removed(
    own, tmp_path, flaw
):
    page = tmp_path / "index.html"
    if flaw == "edited":
        page.write_text("first, and notes of mine")
    else:
        page.rename(tmp_path / "moved.html")
        page.symlink_to("moved.html" if flaw == "link to the same" else "/dev/null")
    before = tree(tmp_path)
    for act in (
        own.check,
        lambda: own.replace({"index.html": "second"}),
        lambda: own.add("index.html", b"second"),
    ):
        with pytest.raises(InputError, match=r"index\.html: was changed since Pipistrelle wrote"):
            act()
    assert tree(tmp_path) == before


@pytest.mark.parametrize("kind", ["file", "folder", "link to nothing", "pipe"])
def test_foreign_files_are_refused_by_name(own, tmp_path, kind):
    path = tmp_path / "summary.json"
    if kind == "folder":
        path.mkdir()
    elif kind == "link to nothing":
        path.symlink_to("nowhere")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text("mine")
    before = tree(tmp_path)
    for act in (own.check, lambda: own.add("summary.json", b"{}")):
        with pytest.raises(InputError, match=r"summary\.json: is not Pipistrelle's"):
            act()
    assert tree(tmp_path) == before


def test_a_file_of_ours_that_is_gone_is_no_hindrance(own, tmp_path):
    (tmp_path / "index.html").unlink()
    own.check()
    own.replace({"index.html": "again"})
    assert (tmp_path / "index.html").read_text() == "again"


USERS_LISTS = {
    "of a download": lambda lines: lines,
    "in another form": lambda lines: "SHA256 (index.html) = 00\n",
    "with our head below": lambda lines: lines + "# Of Pipistrelle: a report\n",
    "ours, with a file of the user's": lambda lines: "# Of Pipistrelle: a report\n" + lines,
    "ours, with a note": lambda lines: "# Of Pipistrelle: a report\n# and mine\n",
    "ours, of another name": lambda lines: "# Of Pipistrelle: an album\n",
    "ours, without an end": lambda lines: "# Of Pipistrelle: a report",
    "bytes": lambda lines: "\xff\xfe nothing of the kind",
    "empty": lambda lines: "",
}


@pytest.mark.parametrize("kind", USERS_LISTS)
def test_a_list_that_is_a_users_names_nothing_of_ours_and_stays(tmp_path, kind):
    (tmp_path / "index.html").write_text("mine")
    (tmp_path / "debian.iso").write_text("iso")
    listed(tmp_path, "index.html", "debian.iso")
    text = USERS_LISTS[kind]((tmp_path / SUMS).read_text())
    (tmp_path / SUMS).write_text(text, encoding="latin-1")
    (tmp_path / "debian.iso.partial").write_text("half")
    before = tree(tmp_path)
    own = OwnFiles(tmp_path, REPORT)
    assert own.there is None
    for act in (
        lambda: own.replace({"index.html": "ours"}),
        lambda: own.add("figures/a.png", b"ours"),
        lambda: claim(tmp_path, REPORT, overwrite=True),
        lambda: claim(tmp_path, REPORT, overwrite=False),
    ):
        with pytest.raises(InputError, match=r"is not Pipistrelle's|holds no report"):
            act()
    assert tree(tmp_path) == before


@pytest.mark.parametrize("name", ["../precious.txt", "/precious.txt", "h/.bashrc", "./index.html"])
def test_a_list_that_points_outside_is_not_ours(tmp_path, name):
    outside, folder = tmp_path / "precious.txt", tmp_path / "report"
    folder.mkdir()
    outside.write_text("precious")
    name = str(outside) if name.startswith("/") else name
    its_sum = sha256(b"precious").hexdigest()
    (folder / SUMS).write_text(f"# Of Pipistrelle: a report\n{its_sum}  {name}\n")
    assert OwnFiles(folder, REPORT).there is None
    with pytest.raises(InputError, match="holds no report"):
        claim(folder, REPORT, overwrite=True)
    assert outside.exists()


def test_nothing_is_removed_or_written_through_a_linked_folder(own, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "figures").rename(elsewhere)
    (tmp_path / "figures").symlink_to("elsewhere")
    before = tree(tmp_path)
    for act in (own.check, lambda: own.add("figures/three.png", b"three")):
        with pytest.raises(InputError, match="figures: is a link, so it is not replaced"):
            act()
    assert tree(tmp_path) == before


def test_a_list_that_is_a_link_is_a_users(tmp_path):
    folder, other = tmp_path / "one", tmp_path / "other"
    OwnFiles(other, LOG).replace({"log.toml": "ours"})
    folder.mkdir()
    (folder / SUMS).symlink_to(other / SUMS)
    (folder / "log.toml").write_text("ours")
    assert OwnFiles(folder, LOG).there is None
    with pytest.raises(InputError, match="holds no log"):
        claim(folder, LOG, overwrite=True)


def test_only_leftovers_of_a_kill_are_swept_by_the_next_writer(own, tmp_path):
    left = [partial_of(tmp_path / name) for name in ("index.html", "figures/two.png", SUMS)]
    users = [tmp_path / n for n in ("index.html.partial", "a.0a1b2c3d.partial", "figures/x.png")]
    for path in (*left, *users):
        path.write_text("half")
    own.replace({"index.html": "second"})
    assert not any(path.exists() for path in left)
    assert all(path.read_text() == "half" for path in users)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a process to kill")
@pytest.mark.parametrize("killed_at", [*range(16), 99])
def test_whenever_a_writer_is_killed_all_that_it_left_is_known_as_ours(own, tmp_path, killed_at):
    (tmp_path / "notes.txt").write_text("mine")
    if (child := os.fork()) == 0:
        _die_at(killed_at)
        own.replace({"figures/three.png": b"three", "index.html": "second"})
        os._exit(1)
    assert os.waitpid(child, 0)[1] == (256 if killed_at == 99 else 0)
    claim(tmp_path, REPORT, overwrite=True).replace({"index.html": "third"})
    assert sorted(tree(tmp_path)) == [SUMS, "figures", "index.html", "notes.txt"]
    assert (tmp_path / "notes.txt").read_text() == "mine"


def _die_at(step):
    """End this process at its next so many changes of the disk, as a kill would."""
    count = 0

    def dying(change):
        def changed(*args, **kwargs):
            nonlocal count
            count += 1
            if count > step:
                os._exit(0)
            return change(*args, **kwargs)

        return changed

    os.fsync, os.link = dying(os.fsync), dying(os.link)
    Path.replace, Path.unlink = dying(Path.replace), dying(Path.unlink)


@pytest.mark.parametrize("before", ["nothing", "an earlier report"])
@pytest.mark.parametrize("room", range(3))
def test_a_full_disk_leaves_all_files_unchanged(tmp_path, monkeypatch, before, room):
    own = OwnFiles(tmp_path / "new", REPORT)
    if before != "nothing":
        own.replace({"figures/two.png": b"two", "index.html": "first"})
    was, written, write_down = tree(tmp_path), 0, files.write_down

    def full(path, data):
        nonlocal written
        listed = path.name.startswith(SUMS)  # which is short
        written += len(data) > 500 and not listed
        if written > room and not listed:
            raise OSError(28, os.strerror(28), str(path))
        return write_down(path, data)

    with monkeypatch.context() as patched:
        patched.setattr("pipistrelle.files.write_down", full)
        new = {f"figures/{n}.png": bytes(1000) for n in "abc"} | {"index.html": "second"}
        with pytest.raises(InputError, match=r"could not be written \(No space left"):
            own.replace(new)
    assert tree(tmp_path) == was


def test_files_written_after_a_claim_are_not_replaced(tmp_path):
    one, two = (claim(tmp_path / "new", LOG, overwrite=False) for _ in "ab")
    one.replace({"log.toml": "one"})
    with pytest.raises(InputError, match="somebody else wrote into it meanwhile"):
        two.replace({"log.toml": "two"})
    assert (tmp_path / "new" / "log.toml").read_text() == "one"
    three = claim(tmp_path / "other", LOG, overwrite=False)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "log.toml").write_text("mine")
    with pytest.raises(InputError, match=r"log\.toml: is not Pipistrelle's"):
        three.replace({"log.toml": "three"})


def test_a_claim_leaves_no_file_and_refuses_occupied_folders(tmp_path):
    own = claim(tmp_path / "a" / "b", LOG, overwrite=False)
    assert tree(tmp_path) == {}
    own.replace({"log.toml": "one"})
    with pytest.raises(InputError, match=r"not empty; name a new folder with -o DIR, or add --ov"):
        claim(tmp_path / "a" / "b", LOG, overwrite=False)
    with pytest.raises(InputError, match=r"with save\(DIR\), or add overwrite=True to replace the"):
        claim(tmp_path / "a" / "b", LOG, overwrite=False, flags=("save(DIR)", "overwrite=True"))
    (tmp_path / "file").write_text("mine")
    for asked in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="cannot be used as a folder for a log") as refused:
            claim(asked, LOG, overwrite=True)
        assert str(asked) in str(refused.value)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that nobody can write")
def test_a_folder_that_cannot_be_written_is_refused_before_the_work():
    with pytest.raises(InputError, match="cannot be used as a folder for results"):
        claim(Path("/proc/1/results"), RESULTS, overwrite=False)


def test_no_kind_writes_outside_its_folder_or_over_the_list():
    for kind in KINDS:
        for name in (SUMS, "../index.html", "/index.html", "figures/../../x", "figures//x", "x.sh"):
            assert not kind.writes(name)
        assert all(kind.writes(name.replace("*", "x")) for name in (*kind.names, *kind.more))


def test_a_name_of_two_lines_is_refused(own):
    with pytest.raises(InputError, match="holds a line break"):
        own.add("figures/a\nb.png", b"")


def test_pictures_are_drawn_elsewhere_and_come_back_by_their_names(tmp_path):
    def draw(room):
        (room / "b.png").write_bytes(b"two")
        (room / "a.png").write_bytes(b"one")
        assert room.resolve().is_relative_to(tmp_path.resolve()) is False

    assert drawn_files(draw, "figures/") == {"figures/a.png": b"one", "figures/b.png": b"two"}


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="only Linux has such a path")
@pytest.mark.parametrize("moment", ["partial_of", "write_down", "put_in_place"])
def test_a_folder_that_another_takes_the_place_of_while_it_is_written_is_not_touched(
    tmp_path, monkeypatch, moment
):
    folder, other = tmp_path / "mine", tmp_path / "other"
    own = OwnFiles(folder, REPORT)
    own.replace({"index.html": "first", "summary.json": "{}"})
    other.mkdir()
    for name in ("index.html", "summary.json"):
        (other / name).write_text("another's")
    was, plain = tree(other), getattr(files, moment)

    def swapped(*args, **words):
        if not folder.is_symlink():
            folder.rename(tmp_path / "moved")
            folder.symlink_to(other)
        return plain(*args, **words)

    monkeypatch.setattr(files, moment, swapped)
    own.replace({"index.html": "second", "summary.json": "[]"})
    assert tree(other) == was
    assert tree(tmp_path / "moved")["index.html"] == b"second"
    assert len(tree(tmp_path / "moved")) == 3
