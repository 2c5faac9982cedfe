"""`pipistrelle view` and `pipistrelle array`: their pages and pictures, and refused places."""

import json
import shutil
import tomllib
from hashlib import sha256
from pathlib import Path

import pytest

import pipistrelle
from pipistrelle.config import InputError
from pipistrelle.files import REPORT, OwnFiles
from reference.command_line import SHORT, summary
from reference.studies import TINY


@pytest.fixture
def folder(short_run):
    """A run's folder, to be changed."""
    return shutil.copytree(short_run, Path("one"))


def sums(folder):
    lines = (folder / "SHA256SUMS").read_text().splitlines()[1:]
    return {name: its_sum for its_sum, name in (line.split("  ") for line in lines)}


def is_page(path):
    text = path.read_text(encoding="utf-8")
    return text.startswith("<!doctype html>") and "Mission of seed" in text


def test_the_page_is_added_to_the_result_folder(obey, folder):
    status, printed, said = obey("view", folder)
    assert (status, printed) == (0, "one/view.html\n")
    stages = [line[:17].strip() for line in said.splitlines() if "frames/s" in line]
    assert stages == ["listening", "active ekf", "fused ekf", "passive ekf"]
    page = folder / "view.html"
    assert is_page(page)
    assert sums(folder)["view.html"] == sha256(page.read_bytes()).hexdigest()
    first = page.read_bytes()
    assert obey("view", folder, "--quiet") == (0, "one/view.html\n", "")
    assert page.read_bytes() == first, "the same mission, the same page"


def test_a_new_mission_in_the_folder_takes_the_old_page_away(obey, folder, undrawn):
    assert obey("view", folder, "--quiet")[0] == 0
    assert obey("run", *SHORT, "--quiet", "--overwrite", "-o", folder)[0] == 0
    assert not (folder / "view.html").exists()


def test_the_page_is_written_elsewhere_without_changing_the_folder(obey, folder):
    before = sorted(path.name for path in folder.iterdir())
    for place in ("page.html", "a new [folder]/p q.HTML"):
        assert obey("view", folder, "--quiet", "-o", place) == (0, f"{place}\n", "")
        assert is_page(Path(place))
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_page_in_the_folder_by_another_name_is_one_of_its_files_too(obey, folder):
    obey("view", folder, "--quiet", "-o", folder / "again.html")
    assert "again.html" in sums(folder)


def test_foreign_files_in_the_folder_are_never_replaced(obey, folder, refused):
    page = folder / "view.html"
    page.write_text("mine")
    for more in ((), ("--overwrite",)):
        assert refused("view", folder, *more) == (
            "one/view.html: is not Pipistrelle's, so it is not replaced; move it away, or name "
            "another with -o FILE.html"
        )
        assert page.read_text() == "mine"
    page.unlink()
    obey("view", folder, "--quiet")
    page.write_text(page.read_text() + "<!-- mine -->")
    assert "was changed since Pipistrelle wrote it" in refused("view", folder, "--overwrite")


def test_files_elsewhere_are_replaced_only_on_request(obey, folder, refused):
    Path("page.html").write_text("mine")
    said = refused("view", folder, "-o", "page.html")
    assert said == (
        "page.html: is there already; name another with -o FILE.html, or add --overwrite"
    )
    assert Path("page.html").read_text() == "mine"
    assert obey("view", folder, "--quiet", "--overwrite", "-o", "page.html")[0] == 0
    assert is_page(Path("page.html"))


def test_a_page_of_another_folder_of_ours_stays_whole_though_replacing_is_allowed(folder, refused):
    OwnFiles(Path("report"), REPORT).replace({"summary.json": b"{}", "index.html": b"a report"})
    said = refused("view", folder, "--overwrite", "-o", "report/index.html")
    assert "report/index.html: is of a report of Pipistrelle, which stays whole;" in said
    assert Path("report/index.html").read_bytes() == b"a report"


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("page.pdf", "-o: found page.pdf, expected a name that ends in .html"),
        ("page", "-o: found page, expected a name that ends in .html"),
        ("/dev/stdout", "expected a name that ends in .html"),
        ("folder.html", "folder.html: found a folder, expected a file; name another with -o"),
        ("file/page.html", "file/page.html: cannot be written (Not a directory); name another"),
        ("loop.html", "loop.html: is there already"),
    ],
)
def test_a_place_that_a_page_cannot_have_is_refused_before_anything_is_done(
    folder, refused, place, said, monkeypatch
):
    monkeypatch.setattr("pipistrelle.verbs.view._play_again", None)
    Path("folder.html").mkdir()
    Path("file").write_text("")
    Path("loop.html").symlink_to("loop.html")
    assert said in refused("view", folder, "-o", place)


def test_a_page_is_never_written_through_a_link_or_over_a_users_partial(obey, folder):
    Path("precious.txt").write_text("precious")
    Path("page.html.partial").symlink_to("precious.txt")
    Path("other.html").symlink_to("precious.txt")
    Path("other.html.partial").write_text("half")
    assert obey("view", folder, "--quiet", "-o", "page.html")[0] == 0
    assert obey("view", folder, "--quiet", "--overwrite", "-o", "other.html")[0] == 0
    assert Path("precious.txt").read_text() == "precious"
    assert Path("page.html.partial").is_symlink()
    assert Path("other.html.partial").read_text() == "half"
    assert is_page(Path("other.html"))


def test_a_page_that_appeared_meanwhile_is_not_replaced(obey, folder, refused, monkeypatch):
    from pipistrelle.figures import player

    def slow(*args):
        Path("page.html").write_text("mine")
        return page_of(*args)

    page_of = player.page
    monkeypatch.setattr(player, "page", slow)
    assert "page.html: could not be written (File exists)" in refused(
        "view", folder, "--quiet", "-o", "page.html"
    )
    assert Path("page.html").read_text() == "mine"


def test_code_that_a_folder_names_is_not_run_unless_the_user_names_it(folder, refused, monkeypatch):
    told = summary(folder)
    for run in told["runs"]:
        run["filter"] = "evil:X"
    (folder / "summary.json").write_text(json.dumps(told))
    (folder / "evil.py").write_text("open('ran', 'w').close()\nclass X: pass\n")
    monkeypatch.chdir(folder)
    said = refused("view", ".")
    assert "summary.json: runs.filter: found 'evil:X', whose code is not Pipistrelle's" in said
    assert "add --filter evil:X" in said
    with pytest.raises(InputError, match="whose code is not Pipistrelle's"):
        pipistrelle.load(".").figure()
    assert not Path("ran").exists()
    for name in ("evil:X", "ekf,evil:X"):
        assert "lacks init, predict, update" in refused("view", ".", "--filter", name)
    assert Path("ran").exists()


def test_a_folder_that_cannot_be_written_is_refused_by_name(folder, refused, monkeypatch):
    def closed(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pipistrelle.verbs.view.TemporaryFile", closed)
    assert refused("view", folder) == (
        "one/view.html: cannot be written (Permission denied); name another with -o FILE.html"
    )


def test_a_full_disk_keeps_the_earlier_page(obey, folder, refused, monkeypatch):
    Path("page.html").write_text("mine")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pipistrelle.files.write_down", full)
    said = refused("view", folder, "--quiet", "--overwrite", "-o", "page.html")
    assert "page.html: could not be written (No space left on device); make room" in said
    assert Path("page.html").read_text() == "mine"
    assert "one: could not be written" in refused("view", folder, "--quiet")


def test_a_study_is_refused_with_what_to_do_instead(obey, refused, undrawn):
    Path("tiny.toml").write_text(TINY)
    assert obey("study", "tiny.toml", "--workers", "1", "--quiet", "-o", "study")[0] == 0
    said = refused("view", "study")
    assert said.startswith("study: found a study, expected the result folder of")
    assert "`pipistrelle report study` puts it on a page; `pipistrelle run --settings" in said
    assert obey("run", "--settings", "study/config.toml", "--quiet", "-o", "one")[0] == 0
    assert obey("view", "one", "--quiet")[0] == 0


def test_different_tracks_are_reported_and_the_page_is_written(obey, folder):
    path = folder / "track_fused_ekf.tum"
    path.write_text(path.read_text().replace("0.5", "0.6"))
    status, printed, said = obey("view", folder, "--quiet")
    assert (status, printed) == (0, "one/view.html\n")
    (line,) = said.splitlines()
    assert line.startswith("pipistrelle: warning: one/track_fused_ekf.tum: is not as it is found")
    assert line.endswith("; what is shown is found now")
    assert is_page(folder / "view.html")


def test_a_log_that_was_solved_is_played_too_and_may_be_moved(
    obey, refused, folder, short_log, undrawn
):
    shutil.copytree(short_log, "log")
    obey("slam", "log", "--beamwidth", "60", "--quiet", "-o", "two")
    entry = summary("two")["log"]
    assert entry["path"] == str(Path("log").resolve())
    assert entry["robot"] is None
    assert sorted(entry["files"]) == [
        "landmarks.csv", "log.toml", "measurements.csv", "odometry.csv", "truth.csv",
    ]  # fmt: skip
    assert "and which log was solved, how it was heard" in Path("two/README.md").read_text()
    assert obey("view", "two", "--quiet") == (0, "two/view.html\n", "")
    page = Path("two/view.html").read_text()
    assert "<h1>Log log</h1>" in page
    assert "ranges within 60°" in page
    Path("log").rename("moved")
    assert "restore it, or give its new path by --log" in refused("view", "two")
    assert obey("view", "two", "--quiet", "--log", "moved") == (0, "two/view.html\n", "")
    assert "option --log: found moved, expected none" in refused("view", "one", "--log", "moved")


def test_a_users_estimator_is_played_under_its_title(obey, undrawn):
    Path("mine.py").write_text(
        "from typing import ClassVar\n"
        "from pipistrelle.estimation.ekf.filter import EkfSlam\n"
        "class Mine(EkfSlam):\n"
        "    title: ClassVar[str] = '<i>Mine</i>'\n"
    )
    words = ("--filter", "mine:Mine", "--strategy", "fused")
    assert obey("run", *SHORT, *words, "--quiet", "-o", "one")[0] == 0
    assert obey("view", "one", *words[:2], "--quiet") == (0, "one/view.html\n", "")
    page = Path("one/view.html").read_text()
    assert "fused \\u00b7 \\u003ci>Mine\\u003c/i>" in page


CIRCLE = Path(__file__).resolve().parents[2] / "examples" / "arrays" / "circle.csv"
LINE = "channel,x,y\n1,0,-0.0049\n2,0,0\n3,0,0.0049\n"


def test_properties_of_an_array_are_printed(obey):
    status, printed, said = obey("array", str(CIRCLE))
    assert (status, said) == (0, "")
    rows = dict(line.rsplit("  ", 1) for line in printed.splitlines()[1:])
    told = {name.strip(): value.strip() for name, value in rows.items()}
    assert told["microphones"] == "8"
    assert told["hears"] == "all around"
    assert float(told["aperture [m]"]) == pytest.approx(0.024, abs=1e-4)
    assert told["ambiguous bearings"] == "0%"


def test_every_bearing_of_a_line_array_is_ambiguous(obey):
    Path("line.csv").write_text(LINE)
    _, printed, _ = obey("array", "line.csv", "--frequency", "30e3")
    angles = printed.split("% of the bearings are ambiguous, as ")[1].split("°")[:2]
    assert all(abs(float(angle.removeprefix(" and "))) <= 180.0 for angle in angles)


def test_the_picture_is_written_where_it_is_asked_for_and_nothing_is_replaced(obey, refused):
    assert obey("array", "square", "-o", "new/square.png", "--quiet") == (0, "new/square.png\n", "")
    picture = Path("new/square.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert "is there already" in refused("array", CIRCLE, "-o", "new/square.png")
    assert obey("array", str(CIRCLE), "-o", "new/square.png", "--overwrite", "--quiet")[0] == 0
    assert Path("new/square.png").read_bytes() != picture


def test_a_file_with_dollars_in_its_name_is_drawn(obey):
    Path("$x^{$.csv").write_text(LINE)
    status, _, said = obey("array", "$x^{$.csv", "-o", "line.png", "--quiet")
    assert (status, said) == (0, "")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("array", "no.csv"), "no.csv: found no such file"),
        (("array", "."), ".: found a folder"),
        (("array", "square", "--frequency", "nan"), "--frequency: found nan"),
        (("array", "square", "-o", "square.jpg"), "a name that ends in .png"),
        (("run", "--receiver.array", "no.csv"), "--receiver.array: no.csv: found no such file"),
        (("run", "--receiver.array", "[[1, 2]]"), "--receiver.array: found [[1, 2]], expected"),
        (("run", "--receiver.array", "3"), "--receiver.array: found 3, expected"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else None,
)
def test_mistakes_of_array_are_explained_in_a_line(refused, words, said):
    assert said in refused(*words)


def test_a_run_by_a_file_keeps_its_microphones_and_is_repeated_without_it(obey, undrawn):
    Path("mine").mkdir()
    Path("mine/array.csv").write_text(CIRCLE.read_text())
    Path("mine/my.toml").write_text('receiver.array = "array.csv"\n')
    words = ("run", *SHORT, "--strategy", "fused", "--quiet")
    assert obey(*words, "--config", "mine/my.toml", "-o", "one")[0] == 0
    kept = tomllib.loads(Path("one/config.toml").read_text())["receiver"]["array"]
    assert len(kept) == 8
    assert kept[0] == [0.012, 0.0, 0.0, 0.0, ""]
    Path("mine/array.csv").unlink()
    words = ("run", "--strategy", "fused", "--quiet", "--config", "one/config.toml", "-o", "two")
    assert obey(*words)[0] == 0
    again = [Path(name, "track_fused_ekf.tum").read_bytes() for name in ("one", "two")]
    assert again[0] == again[1]


def test_a_run_by_a_file_does_without_labels(obey, undrawn):
    words = ("run", *SHORT, "--strategy", "fused", "--association.method", "marginal")
    asked = "--receiver.array", str(CIRCLE), "--listening.excess-paths", "true"
    asked = *asked, "-o", "one", "--quiet"
    assert obey(*words, *asked)[0] == 0


def test_a_run_by_a_line_is_warned_of(obey, undrawn):
    Path("line.csv").write_text(LINE)
    _, _, said = obey("run", *SHORT, "--receiver.array", "line.csv", "-o", "one", "--quiet")
    assert "receiver.array" in said
    assert "% of the bearings" in said
