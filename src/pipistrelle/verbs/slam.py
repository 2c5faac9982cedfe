"""`pipistrelle slam`: a recorded log to a map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from pipistrelle.detection.logs.readers import READERS
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.scripting.arguments import SLAM_TAKES, named_strategies, short_names
from pipistrelle.scripting.log_settings import GATE_KEY, OWN, TIMING, is_open
from pipistrelle.settings import Given, Layer, from_flags
from pipistrelle.verbs.options import (
    Chosen,
    ChosenFilter,
    NamedSettings,
    OutputOptions,
    Particles,
    Whole,
    filters,
    layers,
    setting_flags,
)
from pipistrelle.verbs.streams import say, warn

_FOLDERS = ", or ".join(reader.help for reader in READERS)
FOLDERS = f"{_FOLDERS[0].upper()}{_FOLDERS[1:]}."
ROBOTS = f"Whose log of {', or of '.join(r.robot_help for r in READERS if r.robots)}."
"""Help on the formats of logs."""

if TYPE_CHECKING:
    SlamFlags = dict[str, Any]
else:
    SlamFlags = setting_flags(
        lambda key: is_open(key) and key != GATE_KEY,
        OWN | {TIMING: "where the log has excess paths, or a caller that moves"},
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
        ChosenFilter | None,
        Parameter(
            name="--filter",
            help="What draws the map; several, parted by commas, side by side. "
            "[default: that of the settings, else smoother]",
        ),
    ] = None,
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
    named: NamedSettings = None,
    truth: Annotated[
        str | None,
        Parameter(
            metavar="TOPIC",
            help="The topic of a ROS bag that tells where the vehicle truly was; sets bag.truth.",
        ),
    ] = None,
    topics: Annotated[
        bool,
        Parameter(negative=(), help="List what is in a ROS bag, and what is taken for what; end."),
    ] = False,
    settings: Annotated[SlamFlags | None, Parameter(name="*")] = None,
    output: Annotated[OutputOptions | None, Parameter(name="*")] = None,
) -> int:
    """Solve a recorded log; where it has the truth, say how far off the map is."""
    short: Layer = {
        GATE_KEY: Given(gate, "--gate"),
        ("fastslam", "particles"): Given(particles, "--particles"),
        ("bag", "truth"): Given(truth, "--truth"),
    }
    beneath, usual = over_named(layers(named, None))
    flags = from_flags(settings or {})
    if topics:
        from pipistrelle.verbs.bag_topics import list_topics

        return list_topics(log, beneath | flags | short_names(short, flags))
    from pipistrelle.scripting.missions import prepare_slam
    from pipistrelle.verbs import delivery

    options = output or OutputOptions()
    conduct, notes, odd = prepare_slam(
        log,
        (beneath, flags, short),
        robot,
        named_strategies(strategy),
        filters(estimator or usual or SLAM_TAKES, particles),
        Given(beamwidth, "--beamwidth"),
    )
    for note in () if options.quiet else notes:
        say(f"pipistrelle: {note}")
    warn(*odd)
    return delivery.conduct(conduct, options, "slam")
