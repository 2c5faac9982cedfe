"""The style of all figures and pages: colours, sizes of type; figures saved, pages filled in."""

import tomllib
from collections.abc import Callable, Mapping
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pipistrelle.files import shipped_text, upright

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STRATEGY_COLOURS = {"active": "#1f4e96", "fused": "#d1495b", "passive": "#d99a00"}
"""Distinct for colour-blind readers and, by lightness (L* = 33, 51, 67), in print."""
INK = "#333333"
"""Colour of text, beacon and strategies that are not in `STRATEGY_COLOURS`."""
TRUTH = "#8a8a8a"
"""Colour of the true path and landmarks."""
MAX_COLUMNS = 3
"""Most panels in a row."""

STYLE = tomllib.loads(shipped_text("figures/style.toml"))
"""Settings of matplotlib while a figure is made or saved."""


UNDATED = {".png": "Software", ".pdf": "CreationDate", ".svg": "Date"}
"""Entry of each kind of picture that would differ from file to file."""


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
        colours=Markup(shipped_text("figures/colours.css")),
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
    folder.mkdir(parents=True, exist_ok=True)
    png, pdf = folder / f"{name}.png", folder / f"{name}.pdf"
    for path in (png, pdf):
        path.write_bytes(picture_bytes(figure, path.suffix))
    return png, pdf


def picture_bytes(figure: "Figure", ending: str) -> bytes:
    """Return a figure as a file that ends in .png, .pdf or .svg; equal figures give equal bytes."""
    import matplotlib

    file = BytesIO()
    with matplotlib.rc_context(STYLE | {"svg.hashsalt": "figure"}):
        dpi = 160 if ending == ".png" else "figure"
        figure.savefig(file, format=ending[1:], dpi=dpi, metadata={UNDATED[ending]: None})
    return file.getvalue()
