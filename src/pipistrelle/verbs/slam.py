"""`pipistrelle slam`: a recorded log to a map."""

from collections.abc import Sequence
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from pydantic import create_model

from pipistrelle.config import Config, InputError, Section
from pipistrelle.detection.logs.readers import READERS
from pipistrelle.estimation.catalogue import SECTIONS, short_name
from pipistrelle.settings import Given, Key, Layer, from_flags, resolve
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
    short_names,
    strategies,
)
from pipistrelle.verbs.streams import warn

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.experiments.drives import Truth
    from pipistrelle.experiments.results.scores import TrialResult

GATE = 0.999
"""Share of a measurement's predicted distribution that is accepted of real logs."""
GATE_KEY: Key = ("filter", "gate")
OWN: dict[Key, str] = {("rays", "spacing"): "auto", ("filter", "noise"): "measured"}
"""Settings that a recorded log has others of than a simulated mission: its sensor is anyone's."""
SUSPECT = 0.2
"""Share of a log's rows that may not fit before its units are asked about."""
LOGGED = frozenset(
    {
        ("filter", "range_std"),
        ("filter", "bearing_std"),
        ("filter", "initial_pose_std"),
        ("rays", "range_bounds"),
    }
)
"""Settings of the filter that a log decides."""
OF_WORLDS = frozenset({("filter", "start")})
"""Settings of the filter that only mean something where the truth is drawn."""
_FOLDERS = ", or ".join(reader.help for reader in READERS)
FOLDERS = f"{_FOLDERS[0].upper()}{_FOLDERS[1:]}."
ROBOTS = f"Whose log of {', or of '.join(r.robot_help for r in READERS if r.robots)}."
"""What the help says of the formats of logs."""


_REPLAYED: dict[str, Any] = {
    name: (Config.model_fields[name].annotation, ...) for name in ("seed", *SECTIONS)
}
SlamConfig = create_model("SlamConfig", __base__=Section, **_REPLAYED)
"""What a log's replay depends on, beside the log; a file for ``--config``."""


def _is_open(key: Key) -> bool:
    """Whether a log leaves a setting open."""
    return key[0] in SlamConfig.model_fields and key not in LOGGED | OF_WORLDS


if TYPE_CHECKING:
    SlamFlags = dict[str, Any]
else:
    SlamFlags = setting_flags(lambda key: _is_open(key) and key != GATE_KEY, OWN)


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
        ChosenFilter, Parameter(name="--filter", help="What draws the map.")
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
        float | None,
        Parameter(
            metavar="P",
            help="Drop measurements outside this share of their predicted distribution; sets "
            f"filter.gate. [default: the log's own, else {GATE}]",
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
    chosen, ways = strategies(strategy), filters(estimator, particles)
    if beamwidth is not None and not 0 < beamwidth <= 360:
        raise InputError(f"--beamwidth: found {beamwidth:g}, expected above 0 and up to 360 [deg]")
    from pipistrelle.experiments.machine import check_memory
    from pipistrelle.experiments.runs.again import log_entry
    from pipistrelle.experiments.runs.replay import load, replay
    from pipistrelle.verbs import delivery

    recorded, truth = load(log, robot)
    settled = _with_log(layer, recorded, log)
    _warn_of_ignored_rows(recorded, log)
    _warn_of_partial_truth(truth, log)
    there = len({label for scan in recorded.scans for label in scan.landmark.tolist()})
    check_memory(ways, there, settled, passive=True)
    with delivery.result_folder(output, "slam") as folder:
        delivery.get_ready(output)
        watch = delivery.recorder(output)
        beam = None if beamwidth is None else radians(beamwidth)
        with progress(output.quiet) as show:
            trials = replay(
                recorded, truth, chosen, ways, beam, settled, progress=show, watch=watch
            )
        _warn_of_units(recorded, trials, log)
        return delivery.deliver(
            folder,
            trials,
            truth,
            config=SlamConfig(**{name: getattr(settled, name) for name in SlamConfig.model_fields}),
            seed=settled.seed,
            options=output,
            beamwidth=beam,
            ignored_rows=recorded.ignored_rows,
            log=log_entry(log, robot, beam),
            watch=watch,
        )


def _layer(
    config: Path | None, settings: SlamFlags, gate: float | None, particles: int | None
) -> Layer:
    """Lay file, environment and flags over each other; refuse flags for what the log decides."""
    flags = from_flags(settings)
    for key, given in flags.items():
        if not _is_open(key):
            why = "the log decides this" if key in LOGGED else "means nothing to a recorded log"
            raise InputError(f"{given.where}: {why}; leave the flag out")
    short: Layer = {
        GATE_KEY: Given(gate, "--gate"),
        ("fastslam", "particles"): Given(particles, "--particles"),
    }
    return layers(config, settings) | short_names(short, settings)


def _with_log(layer: Layer, recorded: "Log", log: Path) -> Config:
    """Settle what the log decides; say so where a file or the environment says otherwise."""
    gate = GATE if recorded.gate is None else recorded.gate
    decided = {key: Given(getattr(recorded, key[1]), f"{log}: {key[1]}") for key in LOGGED}
    own = {GATE_KEY: Given(gate, str(log))}
    own |= {key: Given(value, "slam") for key, value in OWN.items()}
    if ("rays", "likelihood") in layer:  # another reading of the paper is of the paper's rays
        del own["rays", "spacing"]
    wished, settled = resolve(layer), resolve(own | layer | decided)
    for section, name in sorted(LOGGED & layer.keys()):
        value = getattr(getattr(settled, section), name)
        if getattr(getattr(wished, section), name) != value:
            where = layer[section, name].where
            warn(f"{where}: the log decides this, and says {value}")
    return settled


def _warn_of_partial_truth(truth: "Truth", log: Path) -> None:
    """Say how much of the path can be scored, where it is not all of it."""
    if truth.path is None:
        return
    steps = len(truth.time) - 1
    known = sum(1 for pose in truth.path[1:] if pose[0] == pose[0])
    if known < steps:
        warn(f"{log}: the truth covers {known} of {steps} steps; only these are scored")


def _warn_of_units(recorded: "Log", trials: "Sequence[TrialResult]", log: Path) -> None:
    """Ask whether a log has the units that are expected, where much of it does not fit."""
    rows, turned = sum(len(scan.landmark) for scan in recorded.scans), recorded.turned
    for trial in trials:
        heard, name = sum(len(scan.landmark) for scan in trial.scans), short_name(trial.filter)
        if not heard:
            warn(f"{log}: nothing in it is heard by {trial.strategy} sensing, so it maps nothing")
        elif (
            turned <= SUSPECT * rows and SUSPECT * heard < trial.scores.gated and _is_finite(trial)
        ):
            warn(
                f"{log}: {trial.scores.gated} of {heard} measurements do not fit what was expected "
                f"({trial.strategy} {name}); are bearings in radians and ranges in metres?"
            )
    if turned > SUSPECT * rows:
        warn(f"{log}: {turned} of {rows} bearings are beyond a turn; are they in radians?")
    near, far = recorded.range_bounds
    ranges = [r for scan in recorded.scans for r in scan.range.tolist() if r == r]
    beyond = sum(not near <= r <= far for r in ranges)
    if beyond > SUSPECT * len(ranges):
        warn(
            f"{log}: {beyond} of {len(ranges)} ranges are not within range_bounds ({near:g} to "
            f"{far:g} m); are ranges in metres?"
        )


def _is_finite(trial: "TrialResult") -> bool:
    """Tell whether a trial's path is somewhere: else its failure says enough."""
    return all(number == number for pose in trial.track.pose.mean.tolist() for number in pose)


def _warn_of_ignored_rows(recorded: "Log", log: Path) -> None:
    """Name what the reader dropped, in a line."""
    if recorded.ignored_rows:
        reasons = (
            f"{count} {reason.replace('_', ' ')}" for reason, count in recorded.ignored_rows.items()
        )
        warn(f"{log}: rows left out: {', '.join(reasons)}")
