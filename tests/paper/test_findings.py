"""The pages say what the study at full size found, as its report's summary has it."""

import csv
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOUND = json.loads((ROOT / "papers/bradley_abaid/study_summary.json").read_text(encoding="utf-8"))
PAGES = ("README.md", "docs/findings.md")


def rows(page: str) -> dict[int, list[str]]:
    """Cells of the rows that begin with a claim's number."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    found = [re.match(r"\| ([1-8]) \| (.*) \|$", line) for line in lines]
    return {int(row[1]): row[2].split(" | ") for row in found if row}


def test_the_study_was_whole():
    assert FOUND["worlds_done"] == FOUND["worlds_planned"] == 115
    assert FOUND["trials"] == 5750


@pytest.mark.parametrize("page", PAGES)
def test_every_claim_stands_with_its_verdict(page):
    told = rows(page)
    for claim in FOUND["claims"]:
        verdict = claim["verdict"].replace("-", " ")
        assert told[claim["claim"]][1].strip("* ").startswith(verdict), claim["claim"]


def test_table_ii_stands_as_the_study_has_it():
    page = (ROOT / "docs/findings.md").read_text(encoding="utf-8")
    for row in FOUND["table_ii"]:
        for name in ("full", "total"):
            mean, spread = row[name]
            assert f"**{mean:.1f} ± {spread:.1f}**" in page, (row["filter"], row["beamwidth"], name)


def test_what_was_left_out_is_told():
    page = (ROOT / "docs/findings.md").read_text(encoding="utf-8")
    ekf, fastslam = FOUND["exclusions"]
    words = f"{ekf['excluded']} worlds for EKF-SLAM and {fastslam['excluded']} for FastSLAM 2.0"
    assert words in page


def test_every_variant_of_the_study_stands_with_its_numbers():
    page = (ROOT / "docs/findings.md").read_text(encoding="utf-8")
    table = page.split("| verdicts 1 to 8 |")[1].split("\n\n")[0].splitlines()[2:]
    path = ROOT / "papers/bradley_abaid/variants.csv"
    with path.open(encoding="utf-8") as file:
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
    changed = [row["variant"] for row in variants if row["verdicts"] != variants[0]["verdicts"]]
    assert changed == ["particles1000"], "the page says that no other changes a verdict"
