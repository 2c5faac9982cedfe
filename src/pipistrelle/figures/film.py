"""Pictures to a film file: GIF by Pillow, MP4 by ffmpeg."""

import contextlib
import itertools
import shutil
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from pipistrelle.config import InputError
from pipistrelle.figures.style import INK, STRATEGY_COLOURS

if TYPE_CHECKING:
    from PIL.Image import Image

Pictures = Iterable[UInt8[np.ndarray, "h w 3"]]
"""Red, green and blue; all of one size, both sides even."""
RATE = 12.5
"""Pictures per second: a GIF counts in hundredths of a second."""
HOLD = 2.0
"""How long a GIF rests on its last picture before it starts again [s]."""


def film_writer(path: Path) -> Callable[[Pictures, Path], None]:
    """Choose how to write a film by the ending of its name.

    `path`: ends in .gif or .mp4. Raises InputError with another ending, or for an MP4 where there
    is no ffmpeg.

    Examples
    --------
    >>> film_writer(Path("mission.gif")).__name__
    'write_gif'
    """
    ending = path.suffix.lower()
    if ending == ".gif":
        return write_gif
    if ending != ".mp4":
        raise InputError(
            f"{path}: found the ending {ending!r}, expected .gif or .mp4; "
            f"choose {path.with_suffix('.gif').name}"
        )
    if shutil.which("ffmpeg") is None:
        raise InputError(
            f"{path}: found no ffmpeg on the PATH, which .mp4 needs; "
            f"install ffmpeg or choose {path.with_suffix('.gif').name}"
        )
    return write_mp4


def write_gif(pictures: Pictures, path: Path) -> None:
    """Write a GIF that starts again after a rest, in one fixed palette so that nothing flickers.

    `pictures`: at least one.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "grey.gif"
    >>> write_gif([np.full((4, 4, 3), level, np.uint8) for level in (0, 99)], path)
    >>> path.read_bytes()[:6]
    b'GIF89a'
    """
    from PIL import Image

    palette = _palette()
    first, *others = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    duration = [round(1000.0 / RATE)] * len(others) + [round(1000.0 * HOLD)]
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)


def write_mp4(pictures: Pictures, path: Path) -> None:
    """Write an MP4 (H.264) through ffmpeg.

    `pictures`: at least one; h and w even. Raises InputError where ffmpeg fails; in its own words.
    Raises ValueError without pictures.

    Examples
    --------
    >>> write_mp4([], Path("mission.mp4"))
    Traceback (most recent call last):
    ValueError: a film needs at least one picture
    """
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a film needs at least one picture")
    path.parent.mkdir(parents=True, exist_ok=True)
    command = _ffmpeg(first.shape[1], first.shape[0], path)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin
        with contextlib.suppress(BrokenPipeError):
            for picture in itertools.chain([first], pictures):
                ffmpeg.stdin.write(picture.tobytes())
        reason = ffmpeg.communicate()[1].decode(errors="replace").strip().splitlines()[:1]
    if ffmpeg.returncode:
        raise InputError(
            f"{path}: ffmpeg ended with status {ffmpeg.returncode} "
            f"({reason[0] if reason else 'no reason given'}); "
            f"mend that or choose {path.with_suffix('.gif').name}"
        )


def _ffmpeg(width: int, height: int, path: Path) -> list[str]:
    """Return the command that turns raw pictures on its input into an MP4."""
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {RATE} -i -"
    target = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart"
    return ["ffmpeg", "-y", "-loglevel", "error", *source.split(), *target.split(), str(path)]


def _palette() -> "Image":
    """Return the colours there are: the inks, on their way to white, to dark ink, to each other.

    Steps towards white are wide enough that Pillow, which compares colours by their upper six
    bits, keeps white white.
    """
    from matplotlib.colors import to_rgb
    from PIL import Image

    white, ink = np.ones(3), np.array(to_rgb(INK))
    inks = [np.array(to_rgb(colour)) for colour in STRATEGY_COLOURS.values()]
    ramps = [(white, end, 16) for end in (ink, *inks)]
    ramps += [(colour, ink, 6) for colour in inks]
    ramps += [(one, other, 6) for one, other in itertools.pairwise(inks)]
    steps = [a + (b - a) * np.linspace(0.0, 1.0, n)[:, None] for a, b, n in ramps]
    colours = np.rint(255.0 * np.concatenate(steps)).astype(np.uint8)
    image = Image.new("P", (1, 1))
    image.putpalette(colours.tobytes())
    return image
