"""`pipistrelle compare` as a person calls it: what it prints, keeps and refuses."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.config import Config, FilterConfig
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.files import SUMS
from reference.command_line import COMPILING, SHORT, contents
from reference.results import loop, mission_folder, study_folder, turned

OFF = turned(loop(), 0.1, (0.5, -0.2))
LOST = np.full_like(OFF, np.nan)
KEPT = [
    "README.md", "SHA256SUMS", "comparison.csv", "comparison.parquet", "comparison.pdf",
    "comparison.png", "settings.csv",
]  # fmt: skip


def rising(level):
    """Errors that rise with the world and with the case."""
    return lambda case, world: 2.0 + world + level * (1 + case.number)


@pytest.fixture
def missions(in_a_folder_of_its_own):
    sharp = Config(filter=FilterConfig(noise="measured"))
    mission_folder(Path("one"), {("active", "ekf"): OFF, ("fused", "ekf"): OFF})
    mission_folder(Path("two"), {("fused", "smoother"): loop()}, config=sharp)


@pytest.fixture
def studies(in_a_folder_of_its_own):
    for name, filters, level in (("one", ("ekf",), 1.0), ("two", ("iekf",), 0.5)):
        plan = Plan(
            name=name, iterations=4, strategies=("active", "fused"), filters=filters,
            config=Config(), grid={},
        )  # fmt: skip
        study_folder(Path(name), plan, rising(level))


def rows(printed):
    """Cells of each line by its first words."""
    lines = [re.split(r"\s{2,}", line.strip()) for line in printed.splitlines() if line.strip()]
    return {line[0]: line[1:] for line in lines}


def test_estimates_without_labels_and_with_calibration_are_compared(obey, undrawn):
    run = ("run", *SHORT, "--strategy", "fused", "--filter", "smoother", "--quiet")
    obey(*run, "--association.method", "marginal", "-o", "one")
    obey(*run, "--filter.calibrate", "turn_bias", "-o", "two")
    assert obey("compare", "one", "two")[0] == 0


def test_scores_are_printed_side_by_side_with_their_differences(obey, missions):
    status, printed, said = obey("compare", "one", "two")
    assert (status, said) == (0, "")
    blocks = printed.split("\n\n")
    assert blocks[0] == "A  one\nB  two"
    assert re.fullmatch(
        r"(B instead of A changes the (aligned )?position RMSE by −?0(\.\d+)? m\.\n){2}", blocks[-1]
    )
    found = rows(blocks[1])
    assert found["fused"] == ["A", "B", "B - A"]
    assert found["ekf"] == ["smoother"]
    assert found["position RMSE, aligned [m]"] == ["0.000", "0.000", "-0.000"]
    off, exact, less = found["position RMSE [m]"]
    assert (float(off) > 0.5, exact) == (True, "0.000")
    assert float(less) == -float(off)
    assert found["landmarks placed"] == ["2", "2", "+0"]
    assert rows(blocks[2]) == {
        "settings that differ": ["A", "B"], "filter.noise": ["constant", "measured"],
    }  # fmt: skip
    assert blocks[3] == "active ekf: only in A, not compared"
    assert sorted(path.name for path in Path().iterdir()) == ["one", "two"], "nothing is written"


def test_runs_and_their_log_are_compared_from_the_command_line(obey, undrawn):
    obey("run", *SHORT, "--strategy", "fused", "--save-log", "log", "-o", "one")
    obey("slam", "log", "--filter", "iekf", "-o", "two")
    status, printed, said = obey("compare", "one", "two")
    assert (status, said) == (0, "")
    assert "The drives are not the same" not in printed
    assert "Settings of air, assumed, bag, beacon" in printed
    assert "rays.precise_bearings" in printed
    assert printed.splitlines()[4].split() == ["ekf", "iekf"]


def test_a_lost_run_is_compared_by_its_finite_scores(obey, missions):
    mission_folder(Path("lost"), {("fused", "ekf"): LOST})
    _, printed, _ = obey("compare", "one", "lost")
    found = rows(printed)
    assert found["diverged"] == ["no", "yes"]
    assert found["position RMSE [m]"][1:] == ["-", "-"]


def test_a_comparison_is_kept_with_all_numbers_and_a_figure(obey, missions):
    status, printed, said = obey("compare", "one", "two", "-o", "out [1]")
    assert (status, printed.splitlines()[-1]) == (0, "out [1]")
    assert said in ("", "Drawing the comparison ...\n")
    assert list(contents("out [1]")) == KEPT
    assert Path("out [1]/comparison.png").read_bytes()[:4] == b"\x89PNG"
    assert "- active ekf: only in A, not compared" in Path("out [1]/README.md").read_text()
    assert "    pipistrelle compare" not in printed
    first = contents("out [1]")
    assert obey("compare", "one", "two", "-o", "out [1]", "--overwrite", "--quiet") == (
        0, "out [1]\n", "",
    )  # fmt: skip
    assert contents("out [1]").keys() == first.keys()
    assert contents("out [1]")["comparison.png"] == first["comparison.png"]


def test_studies_are_compared_case_by_case(obey, studies):
    status, printed, said = obey("compare", "one", "two")
    assert (status, said) == (0, "")
    blocks = printed.split("\n\n")
    assert blocks[0] == "A  one: 4 worlds\nB  two: 4 worlds"
    raw = "changes the position RMSE by −0.75 m in every world, averaged over 2 cases."
    assert blocks[7].splitlines()[1] == f"B instead of A {raw}"
    assert rows(blocks[2])["active"][:3] == ["4.500", "4.000", "-0.500"]
    assert rows(blocks[2])["fused"][:3] == ["5.500", "4.500", "-1.000"]
    assert rows(blocks[5])["filters"] == ['["ekf"]', '["iekf"]']
    assert blocks[6].startswith(
        "Paired over the worlds that both have met.\n*: shown, as one of all cases"
    )
    assert len(blocks) == 8


def test_significant_and_unpaired_differences_are_marked(obey, studies):
    plan = Plan(
        name="three", iterations=4, strategies=("active", "fused"), filters=("ekf",),
        config=Config(), grid={},
    )  # fmt: skip
    plain = rising(1.0)
    study_folder(
        Path("three"),
        plan,
        lambda case, world: (
            plain(case, world) - (1.0 + 0.01 * world if case.number else 0.9 * (world % 2))
        ),
    )
    study_folder(Path("four"), replace(plan, config=Config(seed=8)), rising(0.9))
    _, printed, _ = obey("compare", "one", "three", "four")
    marks = {
        words[0]: "".join(word for word in words if word in ("*", "~", "*~"))
        for words in (
            re.split(r"\s{2,}", line) for line in printed.split("\n\n")[2].splitlines()[1:]
        )
    }
    assert marks == {
        "active ekf, B": "", "active ekf, C": "~", "fused ekf, B": "*", "fused ekf, C": "~",
    }  # fmt: skip


def test_gated_measurements_are_printed_if_there_are_any(obey, missions):
    _, printed, _ = obey("compare", "one", "two")
    assert "rejected by the gate" not in printed
    mission_folder(Path("gated"), {("fused", "ekf"): OFF}, gated=3)
    _, printed, _ = obey("compare", "one", "gated")
    assert rows(printed)["rejected by the gate"] == ["0", "3", "+3"]


def test_a_difference_that_never_varies_has_no_interval(obey, studies):
    """No spread tells nothing of how surely it is known."""
    _, printed, _ = obey("compare", "one", "two")
    assert "inf" not in printed
    assert rows(printed.split("\n\n")[4])["active"][3] == "-"


def test_diverged_worlds_are_left_out_on_request(obey, studies):
    plan = Plan(
        name="three", iterations=4, strategies=("active", "fused"), filters=("ekf",),
        config=Config(), grid={},
    )  # fmt: skip
    study_folder(Path("three"), plan, lambda case, world: np.nan if world == 1 else 2.0 + world**2)
    _, everything, _ = obey("compare", "one", "three")
    _, left, _ = obey("compare", "one", "three", "--drop-diverged")
    first, second = (rows(text.split("\n\n")[1])["active ekf"] for text in (everything, left))
    assert first[-2:] == ["4", "0 / 1"]
    assert second[-2:] == ["3", "0 / 1"]
    assert "Worlds in which a case diverged are left out." in left


def test_several_folders_are_each_compared_with_the_first(obey, missions):
    shutil.copytree("one", "three")
    _, printed, _ = obey("compare", "one", "three")
    assert "No setting differs.\n" in printed
    assert len(printed.split("\n\n")) == 5, "two estimates, and no notes"
    _, printed, _ = obey("compare", "one", "two", "three")
    assert rows(printed)["fused"] == ["A", "B", "C", "B - A", "C - A"]
    assert rows(printed)["filter.noise"] == ["constant", "measured", "constant"]


def test_a_partial_study_is_printed_with_its_number_of_worlds(obey, studies):
    Path("two/trials/iteration_00003.parquet").unlink()
    _, printed, _ = obey("compare", "one", "two")
    assert printed.startswith("A  one: 4 worlds\nB  two: 3 worlds of 4\n")
    assert rows(printed.split("\n\n")[1])["active"][-1] == "3"


# What is refused


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "compare: found 0 folders, expected 2 to 26 of `run`, `slam` or `study`"),
        (("one",), "compare: found 1 folder, expected 2"),
        (("one", "./one"), "one: is given twice, as A and B; name each folder once"),
        (("one", "nowhere"), "nowhere: found no such folder"),
        (("nowhere", "one"), "nowhere: found no such folder"),
        (("one", "two", "--quiet"), "--quiet: nothing is kept without -o DIR"),
        (("one", "two", "--overwrite"), "--overwrite: nothing is kept without -o DIR"),
        (("one", "two", "--drop-diverged"), "--drop-diverged: is for studies"),
        (("one", "two", "-o", "one"), "one: holds results of Pipistrelle, which a"),
        (("one", "two", "-o", "one", "--overwrite"), "one: holds results of Pipistrelle, which a"),
        (("one", "two", "-o", "one/summary.json"), "cannot be used as a folder for a comparison"),
        (("one", "two", "-o", "mine", "--overwrite"), "mine: is not empty and holds no comparison"),
        (("one", "two", "--seed", "3"), "Unknown option: --seed"),
    ],
)
def test_a_mistake_is_reported_in_a_line_and_nothing_is_touched(refused, missions, words, told):
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine")
    before = {name: contents(name) for name in ("one", "two", "mine")}
    said = refused("compare", *words)
    assert told in said
    assert "\n" not in said
    assert {name: contents(name) for name in before} == before
    assert sorted(path.name for path in Path().iterdir()) == ["mine", "one", "two"]


def test_a_changed_file_is_refused_by_name_and_no_folder_is_left(refused, missions):
    with Path("two/track_fused_smoother.tum").open("a") as file:
        file.write("0 0 0 0 0 0 0 1\n")
    said = refused("compare", "one", "two", "-o", "out")
    assert said.startswith("two/track_fused_smoother.tum: was changed since Pipistrelle wrote it")
    assert not Path("out").exists()


def test_a_figure_that_cannot_be_drawn_leaves_no_folder(obey, missions, monkeypatch):
    def spoilt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pipistrelle.figures.comparison.draw_comparison", spoilt)
    assert obey("compare", "one", "two", "-o", "out", "--quiet")[0] == 130
    assert not Path("out").exists() or Path("out", SUMS).exists()


def test_a_reader_that_stops_early_is_no_mistake(missions):
    code = "from pipistrelle.__main__ import main; import sys; sys.exit(main(sys.argv[1:]))"
    words = [sys.executable, "-c", code, "compare", "one", "two"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as verb:
        verb.stdout.close()
        said = verb.stderr.read().decode().replace(COMPILING + "\n", "")
        assert (verb.wait(), said) == (0, "")
