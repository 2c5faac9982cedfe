"""A figure as it is handed out: it shows itself in a notebook."""

from io import BytesIO

from matplotlib.figure import Figure

DPI = 80


class _Picture(Figure):
    """A figure that a notebook shows without pyplot, which would have to know it to do so."""

    def _repr_png_(self) -> bytes:
        """Draw it, as notebooks ask for."""
        room = BytesIO()
        self.savefig(room, format="png", dpi=DPI)
        return room.getvalue()


def picture(width: float, height: float) -> Figure:
    r"""Return an empty figure that a notebook shows as it ends a cell.

    `width` and `height` [inch].

    Examples
    --------
    >>> picture(1.0, 1.0)._repr_png_()[:4]
    b'\x89PNG'
    """
    return _Picture(figsize=(width, height))
