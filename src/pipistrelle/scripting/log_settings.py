"""Settings that a recorded log decides, settings that it leaves open, and warnings on it."""

from collections.abc import Sequence
from math import ceil, floor, hypot, inf, log10, pi, radians, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import create_model

from pipistrelle.config import BagConfig, Config, InputError, Section
from pipistrelle.detection.logs.readers import reader_of
from pipistrelle.detection.scans import UNLABELLED, WIDEST
from pipistrelle.estimation.catalogue import GATE, SECTIONS, gate_of, short_name
from pipistrelle.experiments.named_settings import each_its_own, laid, own_config
from pipistrelle.settings import Given, Key, Layer, resolve

if TYPE_CHECKING:
    from pipistrelle.detection.logs.recording import Log
    from pipistrelle.experiments.drives import Truth
    from pipistrelle.experiments.results.scores import TrialResult

GATE_KEY: Key = ("filter", "gate")
OWN: dict[Key, str] = {
    GATE_KEY: "auto",
    ("rays", "spacing"): "auto",
    ("filter", "noise"): "measured",
    ("fastslam", "estimate"): "mixture",
}
"""Defaults of a recorded log that differ from those of a simulated mission."""
TIMING: Key = ("listening", "timing")
"""Key that is on where a log has excess paths, or a caller that moves."""
MAX_IGNORED_SHARE = 0.2
"""Share of a log's rows that do not fit above which a warning asks about its units."""
MAX_GATED_SHARE = 0.01
"""Share of rows that the gate rejects, beyond what it should, above which a warning is given."""
MAX_NIS = 2.0
"""NIS above which a warning is given; below 1 a filter is cautious, as with the paper's noise."""
TURN = 2.0 * pi
"""No bearing or heading need be larger [rad]."""
MIN_EXCESS_PATH = 0.2
"""Excess paths in metres are rarely smaller [m]; in seconds most are."""
UNSURE = {"bearing_std": ("bearings", "rad", WIDEST), "way_std": ("ranges", "m", inf)}
"""Settings by which an association leaves rows out: of which numbers, and up to which deviation a
larger value is advised."""
LOGGED = frozenset(
    {
        ("filter", "range_std"),
        ("filter", "bearing_std"),
        ("filter", "initial_pose_std"),
        ("rays", "range_bounds"),
    }
)
"""Settings of the filter that a log decides."""
OF_WORLDS = frozenset({("filter", "first_pose")})
"""Settings of the filter that only mean something where the truth is drawn."""

_REPLAYED: dict[str, Any] = {
    name: (Config.model_fields[name].annotation, ...)
    for name in ("seed", "settings", "own", *SECTIONS)
}
SlamConfig = create_model("SlamConfig", __base__=Section, **_REPLAYED)
"""All settings on which the solution of a log depends; its folder's ``config.toml`` holds them."""
BagSlamConfig = create_model("BagSlamConfig", __base__=SlamConfig, bag=(BagConfig, ...))
"""The same of a ROS bag that is not read as all are."""


def replayed(config: Config) -> Section:
    """Return the settings on which the solution of a log depends."""
    kind = SlamConfig if config.bag == BagConfig() else BagSlamConfig
    return kind(**{name: getattr(config, name) for name in kind.model_fields})


def is_open(key: Key) -> bool:
    """Return whether a log leaves a setting open.

    >>> is_open(("rays", "power")), is_open(("filter", "range_std")), is_open(("air", "spreading"))
    (True, False, False)
    """
    return key[0] in BagSlamConfig.model_fields and key not in LOGGED | OF_WORLDS


def check_open(flags: Layer) -> None:
    """Refuse settings that a log decides, or that mean nothing to it.

    >>> check_open({("filter", "range_std"): Given(0.1, "filter__range_std")})
    Traceback (most recent call last):
    pipistrelle.config.InputError: filter__range_std: the log decides this; leave it out
    """
    for key, given in flags.items():
        if not is_open(key):
            why = "the log decides this" if key in LOGGED else "means nothing to a recorded log"
            raise InputError(f"{given.where}: {why}; leave it out")


def check_bag(flags: Layer, log: Path) -> None:
    """Refuse settings of bags beside a log that is none."""
    given = [given for key, given in flags.items() if key[0] == "bag"]
    reader = reader_of(log)
    if given and reader.recognises(log) and not reader.configured:
        raise InputError(f"{given[0].where}: means nothing to {reader.title}; leave it out")


def with_log(layer: Layer, recorded: "Log", log: Path) -> tuple[Config, list[str]]:
    """Resolve settings with those that a log decides; warn of each that asked for another value."""
    decided: Layer = {key: Given(getattr(recorded, key[1]), f"{log}: {key[1]}") for key in LOGGED}
    own = {key: Given(value, "slam") for key, value in OWN.items()}
    for name, value in recorded.association.items():
        own["association", name] = Given(value, f"{log}: association.{name}")
    if recorded.gate is not None:
        own[GATE_KEY] = Given(recorded.gate, str(log))
    moves = any(caller.moves for caller in recorded.callers)
    own[TIMING] = Given(moves or has_excess_paths(recorded), str(log))
    if recorded.excess_path_std is not None:
        own["filter", "excess_path_std"] = Given(
            recorded.excess_path_std, f"{log}: excess_path_std"
        )
    if ("rays", "likelihood") in layer:  # another reading of the paper is of the paper's rays
        del own["rays", "spacing"]
    wished, settled, notes = resolve(layer), resolve(laid(own, layer, decided)), []
    for section, name in sorted(LOGGED & layer.keys()):
        value = getattr(getattr(settled, section), name)
        if getattr(getattr(wished, section), name) != value:
            where = layer[section, name].where
            notes.append(f"{where}: the log decides this, and says {value}")
    return settled, notes


def has_excess_paths(recorded: "Log") -> bool:
    """Return whether any row of a log has an excess path."""
    return any((scan.excess_path == scan.excess_path).any() for scan in recorded.scans)


def distance_driven(recorded: "Log") -> float:
    """Return how far the vehicle drove by its odometry, forwards and backwards [m]."""
    if recorded.motion == "poses":
        return sum(hypot(*step) for step in recorded.controls[:, :2].tolist())
    return float(abs(recorded.controls[:, 0] * recorded.dt).sum())


def check_room(recorded: "Log", filters: Sequence[str], config: Config) -> None:
    """Refuse a log whose landmarks may need more memory than there is."""
    from pipistrelle.experiments.machine import check_memory

    for own, names in each_its_own(config, filters):
        check_memory(names, len(_labels(recorded)), own, passive=True)


def _labels(recorded: "Log") -> set[int]:
    """Return the labels of all rows."""
    return {label for scan in recorded.scans for label in scan.landmark.tolist()}


def log_warnings(recorded: "Log", truth: "Truth", log: Path) -> list[str]:
    """Warn of what a reader doubts, of rows that were left out, and of jumps in the odometry."""
    from pipistrelle.detection.logs.text_tables import FORMER_NAMES

    notes = [f"{log}: {doubt}" for doubt in recorded.doubts]
    if recorded.ignored_rows:
        reasons = (
            f"{count} {reason.replace('_', ' ')}" for reason, count in recorded.ignored_rows.items()
        )
        notes.append(f"{log}: rows left out: {', '.join(reasons)}")
    notes += [
        f"{log}: {name} is read as {FORMER_NAMES[name]}, as it is called now"
        for name in dict.fromkeys(recorded.former_names)
    ]
    notes += [*_turned_poses(recorded, log), *_jumps(recorded, log), *_unheard(recorded, log)]
    if truth.path is not None:
        steps = len(truth.time) - 1
        known_steps = sum(1 for pose in truth.path[1:] if pose[0] == pose[0])
        if known_steps < steps:
            notes.append(
                f"{log}: the truth covers {known_steps} of {steps} steps; only these are scored"
            )
    return notes


def _turned_poses(recorded: "Log", log: Path) -> list[str]:
    """Ask whether the heading of a pose in ``log.toml`` that is beyond a turn is in degrees."""
    headings = {name: getattr(recorded, name)[2] for name in ("initial_pose", "sensor_pose")}
    return [
        f"{log}: the heading of {name}, {heading:g} rad, is beyond a turn; is it in degrees? "
        f"{heading:g} degrees are {radians(heading):.4g} rad"
        for name, heading in headings.items()
        if abs(heading) > TURN
    ]


def _jumps(recorded: "Log", log: Path) -> list[str]:
    """Warn of poses that may change their frame: a step goes much farther than others."""
    if recorded.motion != "poses":
        return []
    from pipistrelle.detection.logs.poses import jumps

    far_steps = jumps(recorded.controls, recorded.dt)
    if not far_steps.size:
        return []
    step = int(far_steps[0])
    ahead, aside, turn = recorded.controls[step, :3].tolist()
    others = f", and {far_steps.size - 1} more such steps" * (far_steps.size > 1)
    return [
        f"{log}: the odometry moves by {hypot(ahead, aside):.3g} m and turns by {turn:.3g} rad "
        f"in the {recorded.dt[step]:.3g} s from {recorded.time[step]:.15g} s on{others}; "
        "was its frame begun anew?"
    ]


def _unheard(recorded: "Log", log: Path) -> list[str]:
    """Warn of timed callers that no row and no position places: their excess paths are useless."""
    heard = _labels(recorded)
    if heard == {UNLABELLED}:  # nobody tells which row is whose
        return []
    timed = {
        number
        for scan in recorded.scans
        for number in scan.caller[scan.excess_path == scan.excess_path].tolist()
    }
    return [
        f"{log}: no row measures landmark {caller.landmark}, the caller {caller.name!r}, so its "
        "excess paths say nothing; correct its number, or say its place"
        for number, caller in enumerate(recorded.callers, start=1)
        if number in timed and caller.landmark not in heard and caller.place is None
    ]


def fit_warnings(
    recorded: "Log", trials: "Sequence[TrialResult]", log: Path, config: Config
) -> list[str]:
    """Warn where much of a log does not fit; name the mistake in its columns that explains it.

    Without such a mistake the warnings ask about units and labels.
    """
    beyond, odd_ranges = _beyond_a_turn(recorded), _out_of_bounds(recorded, "ranges")
    questions, unmapped, wide = beyond + odd_ranges, [], []
    notes = [
        f"{log}: {_nothing_used(trial)}, so it maps nothing"
        for trial in trials
        if not any(len(scan.landmark) for scan in trial.scans)
    ]
    for trial in trials if not beyond else ():
        questions += _rejected(trial, recorded, config)
        unmapped += _unmapped(trial, recorded)
        if trial.track.labels:
            from pipistrelle.scripting.misreadings import wide_sight

            wide += wide_sight(trial, recorded, own_config(config, trial.filter))
    if questions or unmapped:
        from pipistrelle.scripting.misreadings import misreading

        mistake, fits = misreading(recorded)
        questions += [] if fits else unmapped
        if mistake:
            questions = [(questions[0][0], mistake)]
    questions += wide + _out_of_bounds(recorded, "excess paths")
    notes += [f"{log}: {found}; {question}" for found, question in questions]
    return notes + _unsure(trials, log, config)


Question = tuple[str, str]
"""What was found, and what is asked or advised."""


def _units(recorded: "Log") -> str:
    """Ask whether a log's numbers have the units and the sense that they ought to have."""
    metric = "ranges and excess paths" if has_excess_paths(recorded) else "ranges"
    angles = "bearings and headings" if recorded.motion == "poses" else "bearings"
    labels = ", and all labels right" if _labels(recorded) != {UNLABELLED} else ""
    return f"are {angles} in radians and counter-clockwise, {metric} in metres{labels}?"


def _rejected(trial: "TrialResult", recorded: "Log", config: Config) -> list[Question]:
    """Question measurements that a trial's gate rejects, or else that surprise its estimator."""
    from pipistrelle.experiments.results.scores import is_placed, judged

    heard = judged(trial.scans)
    if not heard or not is_placed(trial):
        return []
    gated, who = trial.scores.gated, f"{trial.strategy} {short_name(trial.filter)}"
    if MAX_IGNORED_SHARE * heard < gated:
        found = f"{gated} of {heard} measurements do not fit what was expected ({who})"
        return [(found, _units(recorded))]
    if strayed := _strayed(trial, who):
        return strayed
    expected = 1.0 - _gate(trial.filter, config)
    if (MAX_GATED_SHARE + expected) * heard < gated:
        found = (
            f"the gate rejects {gated / heard:.1%} of the measurements ({who}), expected "
            f"{expected:.1%}: they are less sure than they say, or something was placed wrong "
            "before"
        )
        return [
            (found, 'larger standard deviations help, or a gate of 1 with filter.robust = "huber"')
        ]
    found, _, advice = nis_warning(trial).partition("; ")
    return [(found, advice)] if found else []


def _strayed(trial: "TrialResult", who: str) -> list[Question]:
    """Question landmarks of which many successive measurements are far from map and path."""
    from pipistrelle.evaluation.consistency import strayed_landmarks

    if trial.track.labels:
        return []
    strayed = strayed_landmarks(trial.track, trial.scans, GATE, MAX_GATED_SHARE + 1.0 - GATE)
    if not strayed:
        return []
    label, (first, last, count) = max(strayed.items(), key=lambda one: one[1][2])
    others = f", and {len(strayed) - 1} more landmarks likewise" * (len(strayed) > 1)
    found = (
        f"{count} measurements of landmark {label} in a row, from {first:.15g} to {last:.15g} s, "
        f"are far from the map and path at the end{others} ({who})"
    )
    return [(found, "was it moved, is its label right, or was a loop not closed?")]


def _unmapped(trial: "TrialResult", recorded: "Log") -> list[Question]:
    """Question a map to which an association gave fewer than half of the rows."""
    import numpy as np

    if not trial.track.labels:
        return []
    labels = np.concatenate(trial.track.labels)
    mapped = np.count_nonzero(np.isin(labels, trial.track.landmarks.landmark))
    if 2 * mapped >= labels.size:
        return []
    found = f"{mapped} of {labels.size} rows are of landmarks of the map at the end"
    return [(f"{found} ({trial.strategy} {short_name(trial.filter)})", _units(recorded))]


def _beyond_a_turn(recorded: "Log") -> list[Question]:
    """Question bearings that are beyond a turn."""
    bearings = recorded.recorded_bearings()
    turned = int((abs(bearings) > TURN).sum())
    if not turned > MAX_IGNORED_SHARE * bearings.size:
        return []
    return [(f"{turned} of {bearings.size} bearings are beyond a turn", "are they in radians?")]


def _nothing_used(trial: "TrialResult") -> str:
    """Say that a trial used no row: of none that it heard, or of some."""
    rows = sum(scan.landmark.size for scan in trial.heard)
    if not rows:
        return f"nothing in it is heard by {trial.strategy} sensing"
    return f"none of the {rows} rows of {trial.strategy} sensing is of a landmark"


def _unsure(trials: "Sequence[TrialResult]", log: Path, config: Config) -> list[str]:
    """Warn if an association leaves out most rows as too unsure, and name what would take them."""
    notes = []
    for trial in trials:
        settings = own_config(config, trial.filter).association
        rows = sum(scan.landmark.size for scan in trial.heard)
        for name, stds in trial.left_out.items():
            if stds.size < (1.0 - MAX_IGNORED_SHARE) * rows:
                continue
            what, unit, most = UNSURE[name]
            limit, taken = getattr(settings, name), stds[stds <= most]
            spread = dict.fromkeys(f"{std:.2g}" for std in (stds.min(), stds.max()))
            note = (
                f"{log}: {stds.size} rows of {trial.strategy} sensing are left out: the standard "
                f"deviation of their {what}, {' to '.join(spread)} {unit}, is above "
                f"association.{name}, {limit:g} {unit}"
            )
            if taken.size:
                digit = 10.0 ** floor(log10(taken.max()))
                flag = f"--association.{name.replace('_', '-')}"
                value = ceil(taken.max() / digit) * digit
                whole = "them" if taken.size == stds.size else f"{taken.size} of them"
                note += f"; {flag} {value:g} takes {whole}"
            notes.append(note)
    return [*dict.fromkeys(notes)]


def _gate(name: str, config: Config) -> float:
    """Return the share of a measurement's predicted distribution that an estimator accepts."""
    return gate_of(name, own_config(config, name))


def nis_warning(trial: "TrialResult") -> str:
    """Warn that innovations are much larger than a filter expects; empty where they are not."""
    nis = trial.scores.nis_mean
    if nis is None or not MAX_NIS < nis < inf:
        return ""
    return (
        f"{trial.strategy} {short_name(trial.filter)}: its innovations are {sqrt(nis):.1f} times "
        f"what it expects (NIS {nis:.3g}, 1 where it believes rightly): measurements or odometry "
        "are less sure than they say, or labels are wrong; larger standard deviations help"
    )


def _out_of_bounds(recorded: "Log", name: str) -> list[Question]:
    """Question ranges or excess paths that are probably not in metres.

    An excess path is no more than twice the range of its landmark.
    """
    import numpy as np

    near, far = recorded.range_bounds
    bounds = f"range_bounds ({near:g} to {far:g} m)"
    column = name.replace(" ", "_").removesuffix("s")
    values = np.concatenate([getattr(scan, column) for scan in recorded.scans])
    values = values[~np.isnan(values)]
    odd = {
        "ranges": (((values < near) | (values > far), MAX_IGNORED_SHARE, f"not within {bounds}"),),
        "excess paths": (
            (values > 2.0 * far, MAX_IGNORED_SHARE, f"more than twice the far end of {bounds}"),
            (values < MIN_EXCESS_PATH, 1.0 - MAX_IGNORED_SHARE, f"below {MIN_EXCESS_PATH:g} m"),
        ),
    }[name]
    return [
        (f"{np.count_nonzero(rows)} of {rows.size} {name} are {where}", f"are {name} in metres?")
        for rows, share, where in odd
        if np.count_nonzero(rows) > share * rows.size
    ]
