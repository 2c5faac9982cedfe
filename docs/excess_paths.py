"""Make `images/excess_paths.png` anew, by
`.venv/bin/python docs/excess_paths.py`.
"""

import runpy
from pathlib import Path

import matplotlib

PLACE = Path(__file__).parent / "images" / "excess_paths.png"
TUTORIAL = Path(__file__).parents[1] / "examples" / "10_when_not_only_where.py"


def draw(place):
    """Run the tutorial, and write its figure."""
    matplotlib.use("Agg")
    figure = runpy.run_path(str(TUTORIAL))["figure"]
    figure.savefig(place, dpi=160, metadata={"Software": None})


if __name__ == "__main__":
    draw(PLACE)
    print(f"{PLACE}: {PLACE.stat().st_size / 1e3:.0f} kB")
