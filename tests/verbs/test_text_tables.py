"""Tables for a person."""

import re
import sys

import pytest

from pipistrelle.verbs.text_tables import text_table

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
def test_on_a_terminal_it_is_drawn_within_its_width_and_takes_names_as_they_are(
    monkeypatch, columns
):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("NO_COLOR", "1")
    drawn = text_table("Scores [1]", HEADS, ROWS)
    for word in ("Scores [1]", "[bold]x", "position RMSE [m]", "smoother", "0.388"):
        assert word in drawn
    assert "─" in drawn
    plain = re.sub(r"\x1b\[[0-9;]*m", "", drawn)
    assert max(map(len, plain.splitlines())) <= columns
