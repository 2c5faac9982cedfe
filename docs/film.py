"""Make `images/mission.gif`, the film in the README, anew: `.venv/bin/python docs/film.py`.

It is the film of `pipistrelle run --seed 7 --animate`, every second picture of it, in two thirds of
its size and few colours. What does not change from one picture to the next is left out of it.
"""

from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image, ImageSequence

from pipistrelle.__main__ import main
from pipistrelle.figures.style import INK, STRATEGY_COLOURS

PLACE = Path(__file__).parent / "images" / "mission.gif"
EVERY, WIDTH, STEPS = 2, 840, 12
"""Pictures that become one, pixels, shades of a colour."""
SHOWN, HELD = 160, 3000
"""How long a picture is shown, and the last one [ms]."""


def palette():
    """Return white, what is left out, and the shades of each colour."""
    white, inks = np.ones(3), [to_rgb(ink) for ink in (INK, *STRATEGY_COLOURS.values())]
    shades = [white + (np.array(ink) - white) * k / STEPS for ink in inks for k in range(STEPS + 1)]
    colours = np.rint(255 * np.array([white, *shades])).astype(np.uint8)
    return np.unique(colours, axis=0)[::-1]


def nearest(picture, colours):
    """Return the number of the nearest colour for each pixel."""
    seen, back = np.unique(picture.reshape(-1, 3), axis=0, return_inverse=True)
    away = ((seen[:, None].astype(int) - colours[None].astype(int)) ** 2).sum(axis=2)
    return away.argmin(axis=1).astype(np.uint8)[back].reshape(picture.shape[:2])


def shrink(film, place):
    """Write a film in fewer, smaller pictures."""
    with Image.open(film) as pictures:
        whole = [picture.convert("RGB") for picture in ImageSequence.Iterator(pictures)]
    size = (WIDTH, round(WIDTH * whole[0].height / whole[0].width))
    colours, taken = palette(), whole[::-EVERY][::-1]
    smaller = [np.asarray(picture.resize(size, Image.Resampling.LANCZOS)) for picture in taken]
    numbers = [nearest(picture, colours) for picture in smaller]
    same = len(colours)
    parts = [numbers[0]]
    parts += [np.where(now == before, same, now) for before, now in pairwise(numbers)]
    images = [Image.fromarray(part.astype(np.uint8)) for part in parts]
    for image in images:
        image.putpalette([*colours.ravel().tolist(), 255, 255, 255])
    first, *others = images
    film = {"save_all": True, "append_images": others, "loop": 0, "disposal": 1}
    film |= {"duration": [SHOWN] * len(others) + [HELD], "transparency": same, "optimize": False}
    first.save(place, **film)


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        main(["run", "--seed", "7", "--animate", "gif", "-o", f"{folder}/run", "--quiet"])
        shrink(Path(folder, "run", "mission.gif"), PLACE)
    print(f"{PLACE}: {PLACE.stat().st_size / 1e6:.1f} MB")
