"""Formulae in the pages: written as MathML, which browsers show by themselves.

A formula with a label such as ``eq-17`` is the paper's Eq. (17), as the code has it. It stands in
one docstring; there it bears its number, and the page of equations shows it in its row.
"""

import re
from inspect import cleandoc
from pkgutil import resolve_name
from sys import modules

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.util import logging

ROW = re.compile(r"^\| \((\d+)\) \| (.*?) \| (.*?) \| (.*?) ?\|$", re.MULTILINE)
HEAD = re.compile(r"^\| Eq\. \|.*\n\|[-|]+\|\n", re.MULTILINE)
FORMULA = re.compile(r"^( *)\.\. math:: (.*(?:\n\1 +[^ :].*)*)\n\1 +:label: (eq(?:-\d+)+)$", re.M)
"""A directive with a label: its indent, its lines, its label."""

WRITER = LatexToMathML()
log = logging.getLogger(__name__)


def mathml(tex, *, displayed):
    """Write a formula of LaTeX as MathML; lines that end in ``\\\\`` stand below each other."""
    tex = tex.strip()
    if r"\\" in re.sub(r"\\begin\{(\w+)\}.*?\\end\{\1\}", "", tex, flags=re.S):
        lines = "aligned" if "&" in tex else "gathered"
        tex = rf"\begin{{{lines}}}{tex}\end{{{lines}}}"
    return WRITER.convert_with_local_state(tex, displaystyle=displayed)


def labelled(docstring):
    """Return the formulae of a docstring that bear a number of the paper's, by it."""
    found = FORMULA.findall(cleandoc(docstring))
    return {int(n): tex for _, tex, label in found for n in re.findall(r"\d+", label)}


def formula_of(number, name):
    """Return an equation of the paper's, from the docstring of what builds it, or its module's."""
    built = resolve_name(name)
    docstrings = (built.__doc__, modules[getattr(built, "__module__", name)].__doc__)
    here = {}
    for text in reversed(docstrings):
        here |= labelled(text or "")
    return here[number]


def show_equations(app, docname, content):
    """Lay out the page of equations: each row with its formula, as wide as the page."""
    if docname == "equations":
        text = HEAD.sub("", content[0])
        content[0] = ROW.sub(laid_out, text)


def laid_out(row):
    """Lay out a row: what, the formula, who builds it, what proves it."""
    number, what, built, proved = row.groups()
    ((role, name),) = re.findall(r"({py:\w+})`~([\w.]+)`", built)
    built = f"{role}`{name.removeprefix('pipistrelle.')} <{name}>`"
    tests = ", ".join(re.findall(r"`test_\w+`", proved))
    return (
        f"(equation-{number})=\n### ({number}) {what[0].upper()}{what[1:]}\n\n"
        f"```{{math}}\n{formula_of(int(number), name)}\n```\n\n"
        f"Implemented by {built}, proved by {tests}.\n"
    )


def visit_inline(self, node):
    """Write a formula in a line of text."""
    self.body.append(written(node, displayed=False))
    raise nodes.SkipNode


def visit_block(self, node):
    """Write a formula of its own, with its number if it is one of the paper's."""
    self.body.append(self.starttag(node, "div", CLASS="math notranslate nohighlight"))
    numbers = re.findall(r"\d+", node.get("label") or "")
    if numbers:
        self.body.append(f'<span class="eqno">{", ".join(f"({n})" for n in numbers)}</span>')
    self.body.append(written(node, displayed=True) + "</div>\n")
    raise nodes.SkipNode


def written(node, *, displayed):
    """Write a node's formula; one that cannot be is a warning."""
    try:
        return mathml(node.astext(), displayed=displayed)
    except LatexError as error:
        log.warning("formula: %s", error, location=node)
        return ""


def setup(app):
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.config.html_math_renderer = "mathml"
    app.connect("source-read", show_equations)
    return {"parallel_read_safe": True}
