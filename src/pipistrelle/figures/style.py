"""One look for every picture: a colour for each strategy, type sizes, how a figure is saved."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STRATEGY_COLOURS = {"active": "#1f4e96", "fused": "#d1495b", "passive": "#d99a00"}
"""Told apart by colour-blind readers and, by lightness alone (L* = 33, 51, 67), in print."""
INK = "#333333"
"""Text, the beacon, and any strategy without a colour of its own."""
TRUTH = "#8a8a8a"
"""What is true: the path and the landmarks."""
COLUMNS = 3
"""Most panels beside each other; further ones start a new row."""

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
"""Matplotlib's settings, in force (`matplotlib.rc_context`) while a figure is made or saved."""


def strategy_colour(strategy: str) -> str:
    """Colour of a strategy, the same in every picture.

    Parameters
    ----------
    strategy : str

    Returns
    -------
    "#rrggbb"; `INK` for a strategy without a colour of its own.

    Examples
    --------
    >>> strategy_colour("fused")
    '#d1495b'
    """
    return STRATEGY_COLOURS.get(strategy, INK)


def save_figure(figure: "Figure", folder: Path, name: str) -> tuple[Path, Path]:
    """Write a figure as ``name.png`` and ``name.pdf``, the same bytes for the same figure.

    Parameters
    ----------
    figure : Figure
    folder : Path
        Made where it is missing.
    name : str
        Without ending.

    Returns
    -------
    Path of the PNG (160 dots per inch), path of the PDF

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
