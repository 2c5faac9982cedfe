"""Formulae of the pages: each becomes MathML, of glyphs that the pages' own font has."""

import ast
import re
from collections import Counter
from html import unescape
from inspect import cleandoc
from pathlib import Path
from pkgutil import resolve_name

import pytest
from docs.formulae import FORMULA, ROW, formula_of, labelled, laid_out, mathml
from fontTools.ttLib import TTFont

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "papers" / "bradley_abaid" / "README.md"]
SOURCES = sorted((ROOT / "src").rglob("*.py"))

DISPLAYED = re.compile(r"^( *)\.\. math:: (.*(?:\n\1 +[^ :].*)*)", re.MULTILINE)
INLINE = re.compile(r":math:`([^`]+)`")
DOLLARS = re.compile(r"(?<![\\$])\$([^$\n]+)\$")


def docstrings(path: Path) -> list[str]:
    """Return the docstrings of a module."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds))
    return [text for node in nodes if (text := ast.get_docstring(node))]


def formulae() -> list[tuple[str, bool]]:
    """Return every formula of the docstrings and the pages, and whether it stands by itself."""
    found = [(tex, False) for page in PAGES for tex in DOLLARS.findall(page.read_text())]
    for path in SOURCES:
        for text in docstrings(path):
            found += [(tex, True) for _, tex in DISPLAYED.findall(text)]
            found += [(tex, False) for tex in INLINE.findall(text)]
    return sorted(set(found))


FORMULAE = formulae()
ROWS = list(ROW.finditer((ROOT / "docs" / "equations.md").read_text()))


@pytest.fixture(scope="module")
def glyphs():
    """The characters that the pages' font has."""
    return set(TTFont(ROOT / "docs" / "_static" / "stix-two-math.woff").getBestCmap())


def test_the_formulae_are_found():
    assert len(FORMULAE) > 120
    everywhere = sum(path.read_text().count(".. math::") for path in SOURCES)
    assert sum(len(DISPLAYED.findall(text)) for path in SOURCES for text in docstrings(path)) == (
        everywhere
    )


def test_a_formula_becomes_mathml_of_glyphs_that_the_font_has(glyphs):
    bare = set()
    for tex, displayed in FORMULAE:
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


def test_every_equation_of_the_paper_is_written_in_one_docstring():
    texts = [text for path in SOURCES for text in docstrings(path)]
    assert Counter(number for text in texts for number in labelled(text)) == dict.fromkeys(
        range(1, 28), 1
    )
    labels = sum(text.count(":label:") for text in texts)
    assert labels == sum(len(FORMULA.findall(text)) for text in texts)


@pytest.mark.parametrize("row", ROWS)
def test_a_row_of_the_page_shows_its_equation(row):
    (name,) = re.findall(r"`~([\w.]+)`", row[3])
    tex = formula_of(int(row[1]), name)
    shown = laid_out(row)
    assert f"### ({row[1]}) {row[2][0].upper()}" in shown
    assert f"```{{math}}\n{tex}\n```" in shown
    assert f"<{name}>`" in shown
    assert resolve_name(name)
    assert all(test in shown for test in re.findall(r"`test_\w+`", row[4]))
