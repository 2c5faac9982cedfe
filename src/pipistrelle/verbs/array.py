"""`pipistrelle array`: a microphone array drawn, and what it can tell of a bearing."""

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipistrelle.config import SQUARE, Config, InputError
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.refusals import shown
from pipistrelle.verbs.options import NamedSettings, layers
from pipistrelle.verbs.view import check_place, write_file

if TYPE_CHECKING:
    from pipistrelle.arrays.beamforming import Pattern


def array(
    file: Annotated[str, Parameter(help="The array: a file as receiver.array names, or square.")],
    /,
    *,
    frequency: Annotated[
        float | None,
        Parameter(metavar="HZ", help="Of the sound [Hz]. [default: that of the vehicle's call]"),
    ] = None,
    named: NamedSettings = None,
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="FILE.png",
            help="Where the picture goes. [default: none is drawn]",
        ),
    ] = None,
    overwrite: Annotated[
        bool, Parameter(negative=(), help="Replace a FILE.png that is there already.")
    ] = False,
    quiet: Annotated[bool, Parameter(negative=(), help="Print the picture's path alone.")] = False,
) -> None:
    """Draw an array, and print what it can tell at a frequency."""
    if output is not None:
        check_place(output, None, ".png", "-o", overwrite)
    from pipistrelle.arrays.array_file import read_array
    from pipistrelle.arrays.beamforming import pattern_of
    from pipistrelle.arrays.layout import scattered, square_microphones
    from pipistrelle.settings import resolve
    from pipistrelle.verbs.streams import put

    settled = resolve(over_named(layers(named, None))[0])
    frequency = _frequency(frequency, settled)
    square = file == SQUARE
    found = square_microphones(settled.receiver) if square else read_array(Path(file))
    layout, c = scattered(found), settled.medium.sound_speed
    patterns = tuple(
        pattern_of(layout, g, frequency=frequency, speed_of_sound=c)
        for g in range(layout.normal.size)
    )
    if not quiet:
        put(_table(layout.name, layout.normal.tolist(), patterns))
        for line in _cannot(layout.name, patterns):
            put(line)
    if output is not None:
        from pipistrelle.figures.sound import draw_array

        name = file if square else Path(file).name
        asked = {"name": name, "frequency": frequency, "speed_of_sound": c}
        picture = io.BytesIO()
        figure = draw_array(found, layout, patterns, **asked)
        figure.savefig(picture, format="png", dpi=160, metadata={"Software": None})
        write_file(output, None, picture.getvalue(), overwrite)
        put(output)


def _frequency(asked: float | None, config: Config) -> float:
    """Return the frequency to look at [Hz]."""
    if asked is None:
        return config.emitter.centre
    if not 1.0 <= asked <= 1e7:
        raise InputError(f"--frequency: found {shown(asked)}, expected 1 to 1e+07 [Hz]")
    return asked


def _table(
    names: tuple[str, ...],
    normals: list[float],
    patterns: "tuple[Pattern, ...]",
) -> str:
    """Lay out the numbers, a column for each group of microphones."""
    from pipistrelle.verbs.text_tables import text_table

    hears = [
        "all around" if math.isnan(n) else f"around {round(math.degrees(n))}°" for n in normals
    ]
    rows = {
        "microphones": [str(p.microphones) for p in patterns],
        "hears": hears,
        "aperture [m]": [f"{p.aperture:.4g}" for p in patterns],
        "next microphone, at most [m]": [f"{p.nearest:.4g}" for p in patterns],
        "waves are plane from [m]": [f"{p.far_field:.3g}" for p in patterns],
        "beam's width [deg]": [_between(*p.width) for p in patterns],
        "highest other lobe [dB]": [f"{p.lobe_db:.1f}" for p in patterns],
        "bearings with a double": [f"{p.alike:.0%}" for p in patterns],
        "least deviation at 20 dB [deg]": [_between(*p.std) for p in patterns],
    }
    heads = [["", *(name or "free" for name in names)]]
    return text_table("", heads, [[key, *cells] for key, cells in rows.items()])


def _between(least: float, most: float) -> str:
    """Return two angles [rad] as a range in degrees."""
    low, high = f"{math.degrees(least):.3g}", f"{math.degrees(most):.3g}"
    return low if low == high else f"{low} to {high}"


def _cannot(names: tuple[str, ...], patterns: "tuple[Pattern, ...]") -> list[str]:
    """Say which bearings sound the same."""
    lines = []
    for name, pattern in zip(names, patterns, strict=True):
        if pattern.alike > 0.0:
            this, that = (f"{math.degrees(angle):.0f}°" for angle in pattern.worst)
            whose = f"face {name}" if name else "these microphones"
            lines.append(
                f"{pattern.alike:.0%} of the bearings have a double, as {this} and {that}: to "
                f"{whose} they sound nearly or quite the same; the deviations of rows say so."
            )
    return lines
