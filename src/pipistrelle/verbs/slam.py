"""`pipistrelle slam`: a recorded log to a map."""

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from pipistrelle.config import InputError
from pipistrelle.detection.logs.readers import READERS
from pipistrelle.scripting.asking import named_strategies, short_names
from pipistrelle.scripting.recorded import (
    GATE_KEY,
    OWN,
    TIMING,
    beforehand,
    check_open,
    check_room,
    is_open,
    with_log,
)
from pipistrelle.settings import Given, Layer, from_flags, resolve
from pipistrelle.verbs.console import progress
from pipistrelle.verbs.options import (
    Chosen,
    ChosenFilter,
    OutputOptions,
    Particles,
    Whole,
    filters,
    layers,
    setting_flags,
)
from pipistrelle.verbs.streams import warn

_FOLDERS = ", or ".join(reader.help for reader in READERS)
FOLDERS = f"{_FOLDERS[0].upper()}{_FOLDERS[1:]}."
ROBOTS = f"Whose log of {', or of '.join(r.robot_help for r in READERS if r.robots)}."
"""What the help says of the formats of logs."""

if TYPE_CHECKING:
    SlamFlags = dict[str, Any]
else:
    SlamFlags = setting_flags(
        lambda key: is_open(key) and key != GATE_KEY,
        OWN | {TIMING: "where the log has detours, or a caller that moves"},
    )


def slam(
    log: Annotated[Path, Parameter(help=FOLDERS)],
    /,
    *,
    robot: Annotated[Whole | None, Parameter(metavar="N", help=ROBOTS)] = None,
    strategy: Annotated[
        Chosen,
        Parameter(help="What is kept: all as it is, only what has a range, or only bearings."),
    ] = "fused",
    estimator: Annotated[
        ChosenFilter,
        Parameter(
            name="--filter",
            help="What draws the map; several, parted by commas, side by side.",
        ),
    ] = "ekf",
    particles: Particles = None,
    beamwidth: Annotated[
        float | None,
        Parameter(
            metavar="DEG",
            help="Hide the ranges outside a beam of this width [deg] about the heading. "
            "[default: hide nothing]",
        ),
    ] = None,
    gate: Annotated[
        float | Literal["auto"] | None,
        Parameter(
            metavar="P",
            help="Drop measurements outside this share of their predicted distribution; sets "
            "filter.gate. [default: the log's own, else what suits the estimator]",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        Parameter(metavar="FILE.toml", help="Settings as `pipistrelle config show` prints them."),
    ] = None,
    settings: Annotated[SlamFlags | None, Parameter(name="*")] = None,
    output: Annotated[OutputOptions | None, Parameter(name="*")] = None,
) -> int:
    """Solve a recorded log; where it has the truth, say how far off the map is."""
    output = output or OutputOptions()
    layer = _layer(config, settings or {}, gate, particles)
    resolve(layer)
    chosen, ways = named_strategies(strategy), filters(estimator, particles)
    if beamwidth is not None and not 0 < beamwidth <= 360:
        raise InputError(f"--beamwidth: found {beamwidth:g}, expected above 0 and up to 360 [deg]")
    from pipistrelle.experiments.runs.replay import load
    from pipistrelle.scripting.missions import solved
    from pipistrelle.verbs import delivery

    recorded, truth = load(log, robot)
    settled, overruled = with_log(layer, recorded, log)
    warn(*overruled, *beforehand(recorded, truth, log))
    check_room(recorded, ways, settled)
    with delivery.result_folder(output, "slam") as own:
        delivery.get_ready(output)
        watch = delivery.recorder(output)
        beam = None if beamwidth is None else radians(beamwidth)
        asked = (settled, chosen, ways, beam)
        with progress(output.quiet) as show:
            done = solved(log, robot, (recorded, truth), *asked, progress=show, watch=watch)
        warn(*done.said)
        return delivery.deliver(own, done, output, watch)


def _layer(config: Path | None, settings: SlamFlags, gate: object, particles: int | None) -> Layer:
    """Lay file, environment and flags over each other; refuse flags for what the log decides."""
    flags = from_flags(settings)
    check_open(flags)
    short: Layer = {
        GATE_KEY: Given(gate, "--gate"),
        ("fastslam", "particles"): Given(particles, "--particles"),
    }
    return layers(config, settings) | short_names(short, flags)
