"""A comparison as files."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipistrelle.config import Config, FilterConfig, InputError
from pipistrelle.experiments.comparing import compare_missions, compare_studies
from pipistrelle.experiments.comparison_files import (
    comparison_table,
    settings_rows,
    settings_table,
    write_comparison,
)
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.files import COMPARISON, SUMS, OwnFiles, spelt
from reference.results import loop, mission_folder, study_folder, turned

OFF = turned(loop(), 0.1, (0.5, -0.2))


@pytest.fixture
def missions(tmp_path):
    lost = np.full_like(OFF, np.nan)
    one = {("active", "ekf"): loop(), ("fused", "ekf"): OFF}
    two = {("active", "iekf"): lost, ("fused", "iekf"): loop()}
    sharp = Config(filter=FilterConfig(noise="measured", initial_pose_std=(0.1, 0.1, 0.1)))
    folders = [
        mission_folder(tmp_path / "one", one),
        mission_folder(tmp_path / "two, [2]", two, config=sharp),
    ]
    return compare_missions(folders)


@pytest.fixture
def studies(tmp_path):
    plan = Plan(
        name="made-up", iterations=3, strategies=("active", "passive"), filters=("ekf",),
        config=Config(), grid={"emitter.radius": (0.0025, 0.025), "filter.noise": ("constant",)},
    )  # fmt: skip
    folders = [
        study_folder(tmp_path / name, plan, lambda case, world, k=k: 1.0 + k * (2 + world))
        for k, name in enumerate(("one", "two"))
    ]
    return compare_studies(folders)


def test_missions_have_a_row_for_each_estimate_folder_and_score(missions):
    table = comparison_table(missions)
    rmse = table.filter(pl.col("score") == "position_rmse_m")
    assert rmse["letter"].to_list() == ["A", "B", "A", "B"]
    assert rmse["filter"].to_list() == ["ekf", "iekf"] * 2
    assert rmse["estimate"].to_list() == ["active", "active", "fused", "fused"]
    first, lost, off, exact = rmse["value"].to_list()
    assert (first, lost) == (0.0, None)
    assert off > 0.5 > exact == 0.0
    assert rmse["difference"].to_list() == [0.0, None, 0.0, pytest.approx(-off)]
    diverged = table.filter(pl.col("score") == "diverged")["value"].to_list()
    assert diverged == [0.0, 1.0, 0.0, 0.0]
    assert {"wall_s", "landmarks_full", "nees_max"} <= set(table["score"])
    assert not {"strategy", "filter", "ignored_rows", "online"} & set(table["score"])


def test_studies_have_a_row_for_each_case_and_score(studies):
    table = comparison_table(studies)
    mine = table.filter(pl.col("score") == "map_rmse_m")
    assert mine.select("case", "emitter.radius", "filter.noise", "worlds", "paired").rows() == [
        ("active ekf, 33.0°, filter.noise constant", 0.0025, "constant", 3, True),
        ("active ekf, 33.0°, filter.noise constant", 0.025, "constant", 3, True),
        ("passive ekf, filter.noise constant", None, "constant", 3, True),
    ]
    assert mine["difference"].to_list() == pytest.approx([3.0] * 3)
    assert mine["mean"].to_list() == pytest.approx([4.0] * 3)
    low, high = mine["alone_low"][0], mine["alone_high"][0]
    assert (low + high) / 2.0 == pytest.approx(3.0)


def test_settings_have_a_column_for_each_folder_and_the_version_where_it_differs(missions):
    assert settings_rows(missions) == [
        ("filter.noise", "constant", "measured"),
        ("filter.initial_pose_std", "[0.05, 0.05, 0.0436]", "[0.1, 0.1, 0.1]"),
    ]
    assert settings_table(missions).columns == ["setting", "A", "B"]
    other = replace(missions, versions=("0.1.0", ""), settings={})
    assert settings_rows(other) == [("version of Pipistrelle", "0.1.0", None)]
    assert settings_table(replace(other, versions=("1", "1"))).rows() == []


@pytest.mark.parametrize("kind", ["missions", "studies"])
def test_a_comparison_is_written_with_sums_and_a_readme(kind, request, tmp_path):
    compared, folder = request.getfixturevalue(kind), tmp_path / "out"

    def draw(room):
        (room / "comparison.png").write_bytes(b"picture")

    given = {"command": "pipistrelle compare one", "notes": ["A note."], "draw": draw}
    write_comparison(OwnFiles(folder, COMPARISON), compared, **given)
    names = sorted(path.name for path in folder.iterdir())
    assert names == [
        "README.md", "SHA256SUMS", "comparison.csv", "comparison.parquet", "comparison.png",
        "settings.csv",
    ]  # fmt: skip
    assert OwnFiles(folder, COMPARISON).there == COMPARISON.title
    assert (folder / SUMS).read_text().startswith("# Of Pipistrelle: a comparison\n")
    table = comparison_table(compared)
    assert pl.read_parquet(folder / "comparison.parquet").equals(table)
    assert pl.read_csv(folder / "comparison.csv").height == table.height
    readme = (folder / "README.md").read_text()
    for part in ("pipistrelle compare one", "- A note.", f"- A: `{spelt(compared.folders[0])}`"):
        assert part in readme


def test_changed_files_of_an_earlier_comparison_are_not_replaced(missions, tmp_path):
    folder = tmp_path / "out"
    given = {"command": "", "notes": ()}
    write_comparison(OwnFiles(folder, COMPARISON), missions, **given)
    write_comparison(OwnFiles(folder, COMPARISON), missions, **given)
    (folder / "comparison.csv").write_text("mine")
    with pytest.raises(InputError, match=r"comparison\.csv: was changed since"):
        write_comparison(OwnFiles(folder, COMPARISON), missions, **given)
    assert (folder / "comparison.csv").read_text() == "mine"
    assert (folder / "README.md").exists()


@pytest.mark.parametrize("name", ["<script>", "a`b``c", "`"])
def test_the_readme_shows_folder_names_as_code_without_markup(missions, tmp_path, name):
    compared = replace(missions, folders=(Path(name), *missions.folders[1:]))
    folder = tmp_path / "out"
    write_comparison(OwnFiles(folder, COMPARISON), compared, command="", notes=())
    (line,) = [one for one in (folder / "README.md").read_text().split("\n") if "- A: " in one]
    ticks, text = re.fullmatch(r"- A: (`+) ?(.+?) ?\1", line).groups()
    assert text == name
    assert ticks not in name
