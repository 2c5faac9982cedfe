"""The pages and what is kept of the studies at full size agree."""

import csv
import json
from pathlib import Path

import polars as pl
import pytest

from pipistrelle.report.claims import judge_sentences
from pipistrelle.report.study import read_study, selections
from reference.papers import papers_module

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "papers/bradley_abaid"
STUDIES = ("paper", "least", "physics")
FOUND = {
    name: json.loads((PAPER / f"study_{name}.json").read_text(encoding="utf-8")) for name in STUDIES
}


def readings() -> str:
    return (PAPER / "readings.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("study", STUDIES)
def test_the_study_was_whole(study):
    found = FOUND[study]
    assert (found["worlds_done"], found["worlds_planned"], found["trials"]) == (115, 115, 5750)


@pytest.mark.parametrize("page", papers_module("pages").PAGES)
def test_the_tables_of_a_page_are_written_from_the_studies(page):
    pages, text = papers_module("pages"), (ROOT / page).read_text(encoding="utf-8")
    assert text.count("<!-- begin: ") == text.count("<!-- end: ") > 0
    assert pages.filled(text) == text


@pytest.mark.parametrize("study", STUDIES)
def test_the_kept_trials_give_the_numbers_of_the_study(study):
    trials = pl.read_parquet(PAPER / "studies" / study / "trials.parquet")
    assert trials.height == 5750
    for row in FOUND[study]["exclusions"]:
        mine = trials.filter(pl.col("filter") == row["filter"])
        assert mine.filter("diverged")["iteration"].n_unique() == row["any_diverged"]


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_a_kept_study_gives_the_verdicts_again(study, tmp_path):
    papers_module("kept_studies").unpack_study(PAPER / "studies" / study, tmp_path / study)
    again = judge_sentences(selections(read_study(tmp_path / study)))
    for row, told in zip(again, FOUND[study]["sentences"], strict=True):
        for yardstick in ("by_means", "by_bands", "verdict"):
            assert row[yardstick] == told[yardstick], row["sentence"]


def test_the_noise_table_matches_the_experiment():
    with (PAPER / "noise.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    lines = readings().split("| noise of bearings |")[1].split("\n\n")[0].splitlines()[3:]
    assert len(lines) == len(table) == 4
    for line, row in zip(lines, table, strict=True):
        assert f"| {row['left_out_ekf']} / {row['left_out_fastslam']} |" in line
        gains = (f"{float(row[f'gain_{beam}_ekf']):+.2f}" for beam in (180, 65, 33, 11))
        assert " / ".join(gains).replace("-", "−") in line
        assert f"{float(row['full_180_ekf']):.1f} / {float(row['full_passive_ekf']):.1f}" in line


def test_every_variant_of_the_study_is_listed_with_its_numbers():
    table = readings().split("| variant of `physics` |")[1].split("\n\n")[0].splitlines()[2:]
    with (PAPER / "variants.csv").open(encoding="utf-8") as file:
        variants = list(csv.DictReader(file))
    told = {tuple(cell.strip() for cell in line.split("|")[2:5]) for line in table}
    assert told == {
        (
            row["placed_passive_ekf"],
            f"{row['left_out_ekf']} / {row['left_out_fastslam']}",
            f"{float(row['gain_ekf_m']):.2f} / {float(row['gain_fastslam_m']):.2f} m",
        )
        for row in variants
    }
    assert len(table) == len(variants)
