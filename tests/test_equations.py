"""Every equation of the paper is cited by a docstring, and has its row in the documentation."""

import re
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name

from house import docstrings_of

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
OF_THE_PAPER = set(range(1, 28))

CITATION = re.compile(r"\bEqs?\. ((?:\(\d+\)(?:, | and | to )?)+)")
OTHER_WORK = re.compile(r"\bSource: .*")
LOOSE = re.compile(r"\b(?:[Ee]qs?\.?|[Ee]quations?) ?\d|\bEqs?\.? ?\(\d+[^)\d]|\bEqs? \(\d")

ROW = re.compile(r"^\| \((\d+)\) \| .*? \| (.*?) \| (.*?) ?\|$", re.MULTILINE)
ROWS = {
    int(number): (implemented, proved)
    for number, implemented, proved in ROW.findall((ROOT / "docs" / "equations.md").read_text())
}


def docstrings(path: Path) -> Iterator[str]:
    """Yield a module's docstrings, each paragraph on one line, other works' equations left out."""
    for text in docstrings_of(path):
        for paragraph in text.split("\n\n"):
            yield OTHER_WORK.sub("", " ".join(paragraph.split()))


def cited(text: str) -> set[int]:
    """Return the numbers that a text cites: "Eq. (3)", "Eqs. (2), (5) and (6)", "Eqs. (2) to (4)".

    A range cites what lies between its ends.
    """
    numbers: set[int] = set()
    for listed in CITATION.findall(text):
        for part in re.split(r", | and ", listed):
            ends = [int(number) for number in re.findall(r"\d+", part)]
            numbers |= set(range(min(ends), max(ends) + 1)) if ends else set()
    return numbers


def test_citations_of_equations_are_parsed():
    assert cited("Bradley & Abaid, Eqs. (2), (4) to (6) and (9), and Eq. (11).") == {
        2, 4, 5, 6, 9, 11
    }  # fmt: skip
    assert cited("Sec. III, Table 4, (5), Eq. 6, f(7)") == set()


def test_every_equation_of_the_paper_is_cited_by_a_docstring():
    everywhere = set().union(*(cited(text) for path in SOURCES for text in docstrings(path)))
    assert sorted(OF_THE_PAPER - everywhere) == []
    assert sorted(everywhere - OF_THE_PAPER) == [], "the paper has 27 equations"


def test_citations_have_one_form():
    loose = [
        f"{path.name}:{number}: {line.strip()}"
        for path in SOURCES
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if LOOSE.search(line)
    ]
    assert loose == []


def test_the_page_of_equations_has_a_row_for_each():
    assert set(ROWS) == OF_THE_PAPER


def test_functions_of_all_rows_cite_their_equations_and_their_tests_exist():
    everywhere = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    existing = set(re.findall(r"def (test_\w+)\(", everywhere))
    faults = []
    for number, (implemented, proved) in ROWS.items():
        (name,) = re.findall(r"`~([\w.]+)`", implemented)
        if number not in cited(" ".join((resolve_name(name).__doc__ or "").split())):
            faults.append(f"({number}): {name} does not cite it")
        tests = re.findall(r"`(test_\w+)`", proved)
        missing = set(tests) - existing
        if missing or not tests:
            faults.append(f"({number}): {proved} names no test, or {missing}")
    assert faults == []
