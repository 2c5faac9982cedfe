"""`pipistrelle array` and missions by an array's file."""

import tomllib
from pathlib import Path

import pytest

from reference.command_line import SHORT

CIRCLE = Path(__file__).resolve().parents[2] / "examples" / "arrays" / "circle.csv"
LINE = "channel,x,y\n1,0,-0.0049\n2,0,0\n3,0,0.0049\n"


def test_what_an_array_can_tell_is_printed(obey):
    status, printed, said = obey("array", str(CIRCLE))
    assert (status, said) == (0, "")
    rows = dict(line.rsplit("  ", 1) for line in printed.splitlines()[1:])
    told = {name.strip(): value.strip() for name, value in rows.items()}
    assert told["microphones"] == "8"
    assert told["hears"] == "all around"
    assert float(told["aperture [m]"]) == pytest.approx(0.024, abs=1e-4)
    assert told["bearings with a double"] == "0%"


def test_of_a_line_every_bearing_has_a_double(obey):
    Path("line.csv").write_text(LINE)
    _, printed, _ = obey("array", "line.csv", "--frequency", "30e3")
    assert "% of the bearings have a double" in printed


def test_the_picture_is_written_where_it_is_asked_for_and_nothing_is_replaced(obey):
    assert obey("array", "square", "-o", "new/square.png", "--quiet") == (
        0,
        "new/square.png\n",
        "",
    )
    picture = Path("new/square.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    status, _, said = obey("array", str(CIRCLE), "-o", "new/square.png")
    assert status == 2
    assert "is there already" in said
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
def test_a_mistake_is_told_in_a_line(refused, words, said):
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
    asked = ("--receiver.array", str(CIRCLE), "--listening.timing", "true", "-o", "one", "--quiet")
    assert obey(*words, *asked)[0] == 0


def test_a_run_by_a_line_is_warned_of(obey, undrawn):
    Path("line.csv").write_text(LINE)
    _, _, said = obey("run", *SHORT, "--receiver.array", "line.csv", "-o", "one", "--quiet")
    assert "receiver.array" in said
    assert "% of the bearings" in said
