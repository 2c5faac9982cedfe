"""Draw the picture of `sound.md` anew: `.venv/bin/python docs/sound_picture.py`.

A drive of 30 s is recorded, heard, and what was heard drawn, as `pipistrelle hear` draws it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import pipistrelle
from pipistrelle.verbs.command_line import obey

PICTURE = Path(__file__).parent / "images" / "hearing.png"


def main():
    """Record, hear and draw."""
    with TemporaryDirectory() as place:
        words = ["run", "--strategy", "fused", "--duration", "30", "--quiet", "-o", f"{place}/run"]
        assert obey([*words, "--save-sound", f"{place}/tape"]) == 0
        figure = pipistrelle.hear(f"{place}/tape").figure()
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
