"""Fill the page of the glossary from `glossary.toml` when the pages are built."""

import re
import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent
TERMS = FOLDER / "glossary.toml"
PLACE = "<!-- terms -->"


def add_terms(app, docname, content):
    """Replace the mark on the glossary's page by the terms."""
    if docname == "glossary":
        app.env.note_dependency(str(TERMS))
        content[0] = content[0].replace(PLACE, markdown())


def terms():
    """Return the entries of the glossary."""
    return tomllib.loads(TERMS.read_text(encoding="utf-8"))["term"]


def markdown():
    """Return all entries as a glossary directive."""
    return "\n\n".join(["```{glossary}\n:sorted:", *map(entry, terms())]) + "\n```"


def entry(term):
    """Return the names of a term, its meaning, a link and the words that it replaces."""
    text = term["meaning"]
    if "page" in term:
        text += f" See [{title_of(term['page'])}]({term['page']})."
    if words := [*term.get("not", ()), *term.get("never", ())]:
        text += f" Not: {', '.join(f'*{word}*' for word in words)}."
    return "\n".join([term["term"], *term.get("also", ()), f"  {text}"])


def title_of(link):
    """Return the heading that a link such as ``page.md#anchor`` leads to; KeyError without it."""
    page, _, anchor = link.partition("#")
    headings = re.findall(r"^#+ (.+)$", (FOLDER / page).read_text(encoding="utf-8"), re.MULTILINE)
    slugs = {re.sub(r"[^\w -]", "", text.lower()).replace(" ", "-"): text for text in headings}
    return slugs[anchor] if anchor else headings[0]


def setup(app):
    app.connect("source-read", add_terms)
    return {"parallel_read_safe": True}
