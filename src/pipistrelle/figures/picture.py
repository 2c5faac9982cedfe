"""Figures that a notebook displays."""

from io import BytesIO

from matplotlib.figure import Figure

DPI = 80


class _Picture(Figure):
    """A figure that a notebook displays although pyplot does not know it."""

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG, for notebooks."""
        file = BytesIO()
        self.savefig(file, format="png", dpi=DPI)
        return file.getvalue()


def picture(width: float, height: float) -> Figure:
    r"""Return an empty figure of a width and a height [inch] that a notebook displays.

    Examples
    --------
    >>> picture(1.0, 1.0)._repr_png_()[:4]
    b'\x89PNG'
    """
    return _Picture(figsize=(width, height))
