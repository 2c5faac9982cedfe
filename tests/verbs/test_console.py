"""Tables for a terminal, and commands that end early."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipistrelle.scripting import missions
from pipistrelle.verbs.console import text_table


def test_a_bug_keeps_its_traceback(obey, monkeypatch):
    def broken(*_, **__):
        raise ValueError("ours")

    monkeypatch.setattr(missions, "run_mission", broken)
    with pytest.raises(ValueError, match="ours"):
        obey("run", "-o", "one")


def test_an_interrupted_run_leaves_no_empty_folder(obey, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(missions, "run_mission", interrupted)
    assert obey("run") == (130, "", "pipistrelle: interrupted\n")
    assert not Path("runs").exists()


def test_exhausted_memory_is_explained_in_a_line(refused, tmp_path, monkeypatch):
    def full(*_, **__):
        raise MemoryError("unable to allocate")

    monkeypatch.setattr("pipistrelle.scripting.missions.run_mission", full)
    assert "not enough memory" in refused("run", "-o", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_reader_that_leaves_early_sees_no_traceback():
    command = [sys.executable, "-m", "pipistrelle", "config", "show"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


HEADS = [["fused", "A", "B"], ["", "ekf", "smoother"]]
ROWS = [["position RMSE [m]", "0.388", "-"], ["[bold]x", "1", "2"]]


def test_where_no_terminal_is_columns_are_plain_and_no_line_ends_in_spaces():
    lines = text_table("Scores", HEADS, ROWS).splitlines()
    assert lines == [
        "Scores",
        "fused                  A         B",
        "                     ekf  smoother",
        "position RMSE [m]  0.388         -",
        "[bold]x                1         2",
    ]


def test_a_table_without_rows_is_its_heads():
    assert text_table("", [["setting", "A"]], []) == "setting  A"


@pytest.mark.parametrize("columns", [60, 200])
def test_a_table_on_a_terminal_keeps_its_width_and_names(monkeypatch, columns):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("NO_COLOR", "1")
    drawn = text_table("Scores [1]", HEADS, ROWS)
    for word in ("Scores [1]", "[bold]x", "position RMSE [m]", "smoother", "0.388"):
        assert word in drawn
    assert "─" in drawn
    plain = re.sub(r"\x1b\[[0-9;]*m", "", drawn)
    assert max(map(len, plain.splitlines())) <= columns
