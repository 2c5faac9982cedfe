"""The style of all figures and pages: colours, sizes of type; figures saved, pages filled in."""

from collections.abc import Callable, Mapping
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pipistrelle.files import upright

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STRATEGY_COLOURS = {"active": "#1f4e96", "fused": "#d1495b", "passive": "#d99a00"}
"""Distinct for colour-blind readers and, by lightness (L* = 33, 51, 67), in print."""
INK = "#333333"
"""Colour of text, beacon and strategies that are not in `STRATEGY_COLOURS`."""
TRUTH = "#8a8a8a"
"""Colour of the true path and landmarks."""
PAGE = {
    "paper": ("#fbfaf7", "#14171b"),
    "card": ("#ffffff", "#1b1f24"),
    "ink": ("#22262b", "#e8e6e1"),
    "soft": ("#5d646d", "#a3a9b1"),
    "line": ("#e3e0d8", "#30353c"),
    "grid": ("#e9e7e1", "#2a2f36"),
    "truth": (TRUTH, "#9a9fa6"),
    "span": ("#dcd9d1", "#343a42"),
    "accent": ("#b8384b", "#f2838f"),
    "good": ("#1c7a4d", "#6fcf9c"),
    "bad": ("#b3363f", "#f08b92"),
    "wait": ("#80630f", "#e0bd5c"),
    "good-wash": ("#e6f3ec", "#17301f"),
    "bad-wash": ("#fae9ea", "#3a1d20"),
    "wait-wash": ("#f8f0da", "#332a12"),
    "active": (STRATEGY_COLOURS["active"], "#7fb0f2"),
    "fused": (STRATEGY_COLOURS["fused"], "#f2838f"),
    "passive": (STRATEGY_COLOURS["passive"], "#f0bd45"),
}
"""Colours of a page in its light and its dark scheme."""
MAX_COLUMNS = 3
"""Most panels in a row."""

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": "#9a9a9a",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "ytick.minor.size": 0.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.solid_capstyle": "round",
    "pdf.fonttype": 42,
}
"""Settings of matplotlib while a figure is made or saved."""


def picture(width: float, height: float) -> "Figure":
    """Return an empty matplotlib figure of a size [inch] that a notebook displays."""
    from matplotlib.figure import Figure

    class Picture(Figure):
        def _repr_png_(self) -> bytes:
            file = BytesIO()
            self.savefig(file, format="png", dpi=80)
            return file.getvalue()

    return Picture(figsize=(width, height))


def strategy_colour(strategy: str) -> str:
    """Return the colour of a sensing strategy, the same in every figure."""
    return STRATEGY_COLOURS.get(strategy, INK)


def page_colours() -> str:
    """Return the colours of an HTML page as CSS variables, for light and dark schemes."""
    light, dark = (
        " ".join(f"--{name}: {colours[scheme]};" for name, colours in PAGE.items())
        for scheme in (0, 1)
    )
    dark = f"@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}"
    return f":root {{ {light} }}\n{dark}"


def page_of(
    room: str,
    scripts: tuple[str, ...],
    functions: Mapping[str, Callable[..., Any]] = MappingProxyType({}),
    /,
    **values: Any,
) -> str:
    """Return a room's ``page.html`` with its ``page.css``, scripts and values; texts are escaped.

    `room`: a package, as "pipistrelle.report". `functions`: filters of the template.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    def read(name: str) -> str:
        return (files(room) / name).read_text(encoding="utf-8")

    trimmed = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(autoescape=True, undefined=StrictUndefined, **trimmed)
    environment.filters |= functions
    text = environment.from_string(read("page.html")).render(
        style=Markup(read("page.css")),
        script=Markup("".join(map(read, scripts))),
        colours=Markup(page_colours()),
        **values,
    )
    return upright(text)


def save_figure(figure: "Figure", folder: Path, name: str) -> tuple[Path, Path]:
    """Write a figure as ``name.png`` and ``name.pdf``; equal figures give equal bytes.

    `folder`: created if missing.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from matplotlib.figure import Figure
    >>> [path.name for path in save_figure(Figure(), Path(mkdtemp()), "mission")]
    ['mission.png', 'mission.pdf']
    """
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    png, pdf = folder / f"{name}.png", folder / f"{name}.pdf"
    with matplotlib.rc_context(STYLE):
        figure.savefig(png, dpi=160, metadata={"Software": None})
        figure.savefig(pdf, metadata={"CreationDate": None})
    return png, pdf
