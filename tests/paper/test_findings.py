"""The pages say what the studies at full size found, as their reports' summaries have it."""

import csv
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "papers/bradley_abaid"
STUDIES = ("paper", "physics")
FOUND = {
    name: json.loads((PAPER / f"study_{name}.json").read_text(encoding="utf-8")) for name in STUDIES
}
PAGES = ("README.md", "docs/findings.md")


def rows(page: str) -> dict[int, list[str]]:
    """Cells of the rows that begin with a claim's number."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    found = [re.match(r"\| ([1-8]) \| (.*) \|$", line) for line in lines]
    return {int(row[1]): row[2].split(" | ") for row in found if row}


def findings() -> str:
    return (ROOT / "docs/findings.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("study", STUDIES)
def test_the_study_was_whole(study):
    assert FOUND[study]["worlds_done"] == FOUND[study]["worlds_planned"] == 115
    assert FOUND[study]["trials"] == 5750
    assert FOUND[study]["study"] == study


@pytest.mark.parametrize("page", PAGES)
def test_every_claim_is_listed_with_its_verdict_of_both_studies(page):
    told = rows(page)
    for column, study in enumerate(STUDIES, start=1):
        for claim in FOUND[study]["claims"]:
            verdict = claim["verdict"].replace("-", " ")
            assert told[claim["claim"]][column].strip("* ") == verdict, (study, claim["claim"])


@pytest.mark.parametrize("study", STUDIES)
def test_table_ii_matches_the_study(study):
    page, column = findings(), STUDIES.index(study)
    for row in FOUND[study]["table_ii"]:
        title = {"ekf": "| EKF-SLAM |", "fastslam": "| FastSLAM 2.0 |"}[row["filter"]]
        table = page.split(title)[1].split("\n\n")[0]
        name = row["beamwidth"] if row["beamwidth"].endswith("°") else "passive"
        (line,) = [x for x in table.splitlines() if re.match(rf"\| (fused )?{name} \|", x)]
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        for place, kind in ((2, "full"), (5, "total")):
            mean, spread = row[kind]
            assert cells[place + column] == f"**{mean:.1f} ± {spread:.1f}**", (name, kind)


@pytest.mark.parametrize("study", STUDIES)
def test_the_page_states_the_excluded_worlds(study):
    ekf, fastslam = FOUND[study]["exclusions"]
    words = f"{ekf['excluded']} worlds for EKF-SLAM and {fastslam['excluded']} "
    assert re.search(rf"{words}for FastSLAM 2\.0 of `{study}`", findings())


def deciding_means(study, claim):
    """Return the mean that decides a claim without diverged worlds, and with everything."""
    if "statistic" in claim:  # a claim with statements of its own
        return claim["statistic"], claim["with_everything"]["mean"]
    (row,) = (r for r in FOUND[study]["sentences"] if r["sentence"] == claim["decided_by"][0])
    world, everything = (row["by_exclusion"][rule] for rule in ("world", "none"))
    one = world["findings"][world["decisive"]]
    place = one["part"], one["label"]
    same = (f for f in everything["findings"] if (f["part"], f["label"]) == place)
    return one["mean"], next(same)["mean"]


def test_the_page_states_the_deciding_numbers_with_and_without_exclusions():
    told = rows("docs/findings.md")
    for study in STUDIES:
        for claim in FOUND[study]["claims"]:
            if claim["claim"] in (3, 5, 7):
                text = told[claim["claim"]][3].replace("−", "-")
                for number in deciding_means(study, claim):
                    assert f"{number:.2f}" in text, (study, claim["claim"], number)


def test_the_misfits_of_readings_match_the_experiment():
    with (PAPER / "readings.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    page = findings().split("| reading |")[1].split("\n\n")[0]
    told = re.findall(r"\| \*{0,2}(\d\.\d\d) ± (\d\.\d\d)\*{0,2} \|", page)
    found = {(f"{float(r['misfit']):.2f}", f"{float(r['standard_error']):.2f}") for r in table}
    assert len(told) == 5
    assert set(told) <= found
    assert told[0] == (
        f"{float(table[0]['misfit']):.2f}",
        f"{float(table[0]['standard_error']):.2f}",
    )


def test_the_misfits_of_the_studies_match_their_table():
    with (PAPER / "held_out.csv").open(encoding="utf-8") as file:
        table = {row["study"]: row for row in csv.DictReader(file)}
    assert list(table) == ["paper", "restart", "anew", "physics"]
    for row in table.values():
        assert f"{float(row['misfit']):.2f} ± {float(row['standard_error']):.2f}" in findings()
    physics = table["physics"]
    words = f"{float(physics['above_first']):.2f} ± {float(physics['above_first_error']):.2f} more"
    assert words in findings()


def test_the_noise_table_matches_the_experiment():
    with (PAPER / "noise.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    lines = findings().split("| noise of bearings |")[1].split("\n\n")[0].splitlines()[3:]
    assert len(lines) == len(table) == 4
    for line, row in zip(lines, table, strict=True):
        assert f"| {row['left_out_ekf']} / {row['left_out_fastslam']} |" in line
        gains = (f"{float(row[f'gain_{beam}_ekf']):+.2f}" for beam in (180, 65, 33, 11))
        assert " / ".join(gains).replace("-", "−") in line
        assert f"{float(row['full_180_ekf']):.1f} / {float(row['full_passive_ekf']):.1f}" in line


def test_every_variant_of_the_study_is_listed_with_its_numbers():
    table = findings().split("| verdicts 1 to 8 |")[1].split("\n\n")[0].splitlines()[2:]
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
