"""Settings of the documentation; `./dev docs` builds it, warnings as errors."""

import re
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name, walk_packages

import matplotlib as mpl
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

import pipistrelle

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "benchmarks" / "latest.json"
sys.path.insert(0, str(ROOT))

mpl.use("Agg")

project = "Pipistrelle"
author = "The Pipistrelle developers"
release = pipistrelle.__version__
version = release.partition("+")[0]

suppress_warnings = [
    "config.cache",  # the gallery is given a function
    "ref.python",  # words of a type's description that are fields of several records
]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "docs.columns_page",
    "docs.formulae",
    "docs.glossary_page",
    "docs.settings_page",
]
exclude_patterns = ["_build", "**sg_execution_times.rst"]  # whose table is fetched from elsewhere
default_role = "literal"
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"Pipistrelle {version}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_search_scorer = str(ROOT / "docs" / "search_scores.js")
html_copy_source = False
html_show_copyright = False

add_module_names = False
autodoc_typehints = "none"  # shapes and units stand in the docstrings
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
autodoc_default_options = {"members": True, "exclude-members": "__init__, model_config"}
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False


HIDDEN_COLON = "\ue000"


def figures_of_block(block, block_vars, gallery_conf):
    """Keep the figures that a block of an example made without pyplot, as the package does."""
    paths = []
    for value in list(block_vars["example_globals"].values()):
        if isinstance(value, Figure) and not hasattr(value, "shown_in_gallery"):
            value.shown_in_gallery = True
            path = next(block_vars["image_path_iterator"])
            value.savefig(path, dpi=110)
            paths.append(path)
    return figure_rst(paths, gallery_conf["src_dir"])


sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/\d\d_(?!on_a_cluster)",  # which would start processes
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": (figures_of_block,),
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 3600,
    "remove_config_comments": True,
    "plot_gallery": "True",
    "abort_on_example_error": True,
    "run_stale_examples": True,  # an example shows the package as it is now
}


def add_modules(app, docname, content):
    """Put a room's modules, whichever there are, on the room's page."""
    folder, _, room = docname.partition("/")
    path = Path(pipistrelle.__path__[0]) / room
    if folder == "api" and path.is_dir():
        for module in sorted(path.rglob("[a-z]*.py")):
            name = ".".join(module.relative_to(path).with_suffix("").parts)
            heading, line = name.replace(".", " / "), f".. automodule:: pipistrelle.{room}.{name}"
            content[0] += f"\n{heading}\n{'-' * len(heading)}\n\n{line}\n"


def link_tutorials(app, docname, content):
    """Lead links to the examples, which stand in the repository, to their pages."""
    text = re.sub(r"\]\(\.\./examples/(\w+)\.py\)", r"](gallery/\1)", content[0])
    content[0] = text.replace("](../examples)", "](gallery/index)")


def add_benchmarks(app, docname, content):
    """Put the last run's timings where a page asks for them."""
    from benchmarks.table import markdown, read

    if docname == "performance":
        app.env.note_dependency(str(BENCHMARKS))
        content[0] = content[0].replace("<!-- benchmarks -->", markdown(read(BENCHMARKS)))


def show_kernels(app):
    """Let autodoc see the plain functions under public kernels.

    The gallery has run by now: what follows reads the modules and calls nothing.
    """
    for module in walk_packages(pipistrelle.__path__, "pipistrelle."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
    for name, module in list(sys.modules.items()):
        if name.startswith("pipistrelle"):
            for key, value in list(vars(module).items()):
                if hasattr(value, "py_func") and not key.startswith("_"):
                    setattr(module, key, value.py_func)


def protect(app, what, name, obj, options, lines):
    """Hide from napoleon what it would take for markup.

    A shape such as (*n) opens no emphasis and (k) no list; two attributes that share a line are
    no name and its type; what stands before the colon in a sentence about a constant is no type.
    """
    for i, line in enumerate(lines):
        line = re.sub(r"\(\*(?=\w+[,)])", r"(\\*", line)
        line = re.sub(r"^(\s*\w[\w, ]* : )\((?=\w+\))", r"\1\\(", line)
        if what == "class":
            line = re.sub(r"^(\w+(?:, \w+)+)(?= : )", lambda m: m[1].replace(" ", ""), line)
        if what in ("attribute", "data"):
            line = line.replace(":", HIDDEN_COLON)
        lines[i] = line


def unprotect(app, what, name, obj, options, lines):
    """Show again what was hidden."""
    lines[:] = [line.replace(HIDDEN_COLON, ":") for line in lines]


def add_default(app, what, name, obj, options, lines):
    """Say the default of a setting."""
    owner, _, field = name.rpartition(".")
    settings = getattr(resolve_name(owner), "model_fields", {}) if what == "attribute" else {}
    if field in settings:
        lines += ["", f"Default: ``{settings[field].default!r}``."]


def setup(app):
    app.connect("source-read", add_modules)
    app.connect("source-read", link_tutorials)
    app.connect("source-read", add_benchmarks)
    app.connect("builder-inited", show_kernels, priority=900)
    app.connect("autodoc-process-docstring", protect, priority=100)
    app.connect("autodoc-process-docstring", unprotect, priority=900)
    app.connect("autodoc-process-docstring", add_default, priority=910)
