"""A figure as it is handed out: it shows itself in a notebook."""

from io import BytesIO

from matplotlib.figure import Figure

DPI = 80


class Picture(Figure):
    r"""A figure that a notebook shows without pyplot, which would have to know it to do so.

    Examples
    --------
    >>> Picture(figsize=(1.0, 1.0))._repr_png_()[:4]
    b'\x89PNG'
    """

    def _repr_png_(self) -> bytes:
        """Draw it, as notebooks ask for."""
        room = BytesIO()
        self.savefig(room, format="png", dpi=DPI)
        return room.getvalue()
