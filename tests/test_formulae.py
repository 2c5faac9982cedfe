"""Formulae of the pages: each becomes MathML, of glyphs that the pages' own font has."""

import re
from collections import Counter
from html import unescape
from inspect import cleandoc
from pathlib import Path
from pkgutil import resolve_name

import pytest
from docs.formulae import FORMULA, ROW, formula_of, labelled, laid_out, mathml
from fontTools.ttLib import TTFont

from house import docstrings_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "papers" / "bradley_abaid" / "README.md"]
SOURCES = sorted((ROOT / "src").rglob("*.py"))

DISPLAYED = re.compile(r"^( *)\.\. math:: (.*(?:\n\1 +[^ :].*)*)", re.MULTILINE)
INLINE = re.compile(r":math:`([^`]+)`")
DOLLARS = re.compile(r"(?<![\\$])\$([^$\n]+)\$")


@pytest.fixture(scope="module")
def texts():
    """The docstrings of the package."""
    return [text for path in SOURCES for text in docstrings_of(path)]


@pytest.fixture(scope="module")
def formulae(texts):
    """Every formula of the docstrings and the pages, and whether it is displayed."""
    found = {(tex, False) for page in PAGES for tex in DOLLARS.findall(page.read_text())}
    found |= {(tex, True) for text in texts for _, tex in DISPLAYED.findall(text)}
    return sorted(found | {(tex, False) for text in texts for tex in INLINE.findall(text)})


@pytest.fixture(scope="module")
def glyphs():
    """The characters that the pages' font has."""
    return set(TTFont(ROOT / "docs" / "_static" / "stix-two-math.woff").getBestCmap())


def test_the_formulae_are_found(texts, formulae):
    assert len(formulae) > 120
    everywhere = sum(path.read_text().count(".. math::") for path in SOURCES)
    assert sum(len(DISPLAYED.findall(text)) for text in texts) == everywhere


def test_a_formula_becomes_mathml_of_glyphs_that_the_font_has(formulae, glyphs):
    bare = set()
    for tex, displayed in formulae:
        written = mathml(tex, displayed=displayed)
        assert written.startswith('<math display="block">' if displayed else "<math>")
        text = unescape(re.sub(r"<[^>]+>", "", written))
        assert text.strip(), tex
        assert "\\" not in text, "a command that was not understood"
        bare |= {letter for letter in text if ord(letter) not in glyphs}
    assert bare <= {"\ufe00"}, "but for the mark of a variant"


def test_only_line_breaks_outside_a_matrix_make_rows():
    two = mathml(r"a &= b \\ c &= d", displayed=True)
    assert (two.count("<mtr>"), "&amp;" in two) == (2, False)
    assert mathml(r"a \\ b", displayed=True).count("<mtr>") == 2
    matrix = mathml(r"\begin{bmatrix} 1 & 0 \\ 0 & 1 \end{bmatrix}", displayed=True)
    assert matrix.count("<mtable") == 1


def test_an_invalid_formula_is_refused():
    from math_core import LatexError

    with pytest.raises(LatexError):
        mathml(r"\frac{a}{", displayed=False)


def test_a_label_has_one_or_several_numbers():
    text = cleandoc(
        r"""
        Head.

        .. math:: a = b,
                  c
           :label: eq-3

        .. math:: d

        - item

          .. math:: e
             :label: eq-26-27
        """
    )
    assert labelled(text) == {3: "a = b,\n          c", 26: "e", 27: "e"}


def test_every_equation_of_the_paper_is_written_in_one_docstring(texts):
    assert Counter(number for text in texts for number in labelled(text)) == dict.fromkeys(
        range(1, 28), 1
    )
    labels = sum(text.count(":label:") for text in texts)
    assert labels == sum(len(FORMULA.findall(text)) for text in texts)


def test_a_row_of_the_page_shows_its_equation():
    for row in ROW.finditer((ROOT / "docs" / "equations.md").read_text()):
        (name,) = re.findall(r"`~([\w.]+)`", row[3])
        shown, tests = laid_out(row), re.findall(r"`test_\w+`", row[4])
        tex = formula_of(int(row[1]), name)
        head = f"### ({row[1]}) {row[2][0].upper()}"
        parts = (head, f"```{{math}}\n{tex}\n```", f"<{name}>`", *tests)
        assert [part for part in parts if part not in shown] == [], row[0]
        assert resolve_name(name)
