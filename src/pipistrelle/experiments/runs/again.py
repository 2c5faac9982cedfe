"""A mission done again from its result folder.

The same settings give the same bits, so a result folder keeps no belief of every frame: whoever
wants to look at one has the mission done again. The folder holds what that takes, its settings and,
of a recorded log, which it was and how it was heard (`log_entry`).
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from hashlib import file_digest
from pathlib import Path

import numpy as np

from pipistrelle.acoustics.callers import Caller
from pipistrelle.acoustics.emitter import beamwidth_of
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import Robot, reader_of
from pipistrelle.detection.logs.recording import Log
from pipistrelle.estimation.catalogue import CATALOGUE, short_name
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.hearing.world import ANY
from pipistrelle.experiments.hearing.world_folder import read_world
from pipistrelle.experiments.results.reading import SUMMARY, Summary, read_summary
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.results.tables import tum_text
from pipistrelle.experiments.results.writing import settings_hash
from pipistrelle.experiments.runs import truth_files
from pipistrelle.experiments.runs.replay import load, replay
from pipistrelle.experiments.runs.trial import Mission, Watch, run_mission
from pipistrelle.files import read_file
from pipistrelle.refusals import refusal
from pipistrelle.settings import from_file, read_toml, resolve
from pipistrelle.version import find_version


@dataclass(frozen=True, slots=True, kw_only=True)
class Again:
    """A mission, simulated or recorded, that was done again.

    Attributes
    ----------
    config : Config
        Of a log, its sections that estimators read.
    trials : tuple of TrialResult
        As `run_mission` or `replay` gives them.
    truth : Truth
    callers : tuple of Caller
        Who was heard besides the vehicle, as far as that is known.
    beamwidth : [rad] or None
        Of the vehicle's call; of a log, that outside which ranges were hidden.
    mission : Mission or None
    log : Log or None
        One of the two: simulated, or recorded.
    difference : str
        How its tracks are not those of the folder, in a line; empty where they are, bit for bit.
    """

    config: Config
    trials: tuple[TrialResult, ...]
    truth: Truth
    callers: tuple[Caller, ...]
    beamwidth: float | None
    mission: Mission | None
    log: Log | None
    difference: str


def again(
    folder: Path,
    *,
    log: Path | None = None,
    trusted: Collection[str] = (),
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Again:
    """Do a mission again from its result folder, and compare its tracks with those there.

    Parameters
    ----------
    folder : Path
        As `pipistrelle run` or `pipistrelle slam` has filled it.
    log : Path, optional
        Where the log is that was solved, if no longer where it was.
    trusted : collection of str
        Estimators from outside, ``module:Class``, whose code may be run. The folder may come from
        anybody, and their modules may lie in it.
    progress, watch : callable, optional
        As of `run_mission`.

    Returns
    -------
    Again

    Raises
    ------
    InputError
        Where the folder is no such folder or lacks what this takes, where it names an estimator
        from outside that is not trusted, or where the log is gone or is not what it was.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from pipistrelle.config import ScenarioConfig
    >>> from pipistrelle.experiments.drives import NO_TRUTH
    >>> from pipistrelle.experiments.results.writing import write_results
    >>> from pipistrelle.own_files import RESULTS, OwnFiles
    >>> config = Config(scenario=ScenarioConfig(steps=8, landmarks=3))
    >>> done = run_mission(config, ["fused"])
    >>> kept = {"command": "pipistrelle run", "seed": config.seed, "ignored_rows": {}}
    >>> with TemporaryDirectory() as name:
    ...     own = OwnFiles(Path(name), RESULTS)
    ...     write_results(own, config=config, trials=done.trials, truth=NO_TRUTH, **kept)
    ...     same = again(Path(name))
    >>> same.difference, np.array_equal(*(it.trials[0].track.pose.mean for it in (done, same)))
    ('', True)
    """
    summary = read_summary(folder)
    for name in {run.filter for run in summary.runs} - {*CATALOGUE, *trusted}:
        raise refusal(
            f"{folder / SUMMARY}: runs.filter",
            f"{name!r}, whose code is not Pipistrelle's",
            "one that you trust",
            f"add --filter {name} (in Python: filters={name!r}) to run it",
        )
    config = resolve(from_file(folder / "config.toml"))
    strategies = list(dict.fromkeys(run.strategy for run in summary.runs))
    tried = strategies, list(dict.fromkeys(run.filter for run in summary.runs))
    if summary.log is None:
        _check_simulated(folder, log)
        world = ANY if (kept := config.scenario.world) is None else read_world(Path(kept))
        looking = {"progress": progress, "watch": watch}
        mission, recorded = run_mission(config, *tried, world=world, **looking), None
        trials, truth = mission.trials, mission.drive.truth
        callers, beam = mission.scenario.callers[1:], beamwidth_of(config)
    else:
        recorded, truth = load(_log_of(folder, summary, log), summary.log.robot)
        mission, callers, beam = None, (), summary.log.beamwidth_rad
        trials = replay(recorded, truth, *tried, beam, config, progress=progress, watch=watch)
    return Again(
        config=config,
        trials=trials,
        truth=truth,
        callers=callers,
        beamwidth=beam,
        mission=mission,
        log=recorded,
        difference=_difference(folder, summary, trials),
    )


def log_entry(log: Path, robot: Robot | None, beamwidth: float | None) -> dict[str, object]:
    """Say which log is solved, and how it is heard, so that it can be done again.

    Parameters
    ----------
    log : Path
    robot : int or str, optional
        Whose of several.
    beamwidth : [rad], optional
        Outside which ranges are hidden.

    Returns
    -------
    dict
        For ``summary.json``: the folder, and the SHA-256 of each file that may be read of it.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as name:
    ...     _ = (Path(name) / "log.toml").write_text("format = 1")
    ...     entry = log_entry(Path(name), None, 0.5)
    >>> entry["beamwidth_rad"], list(entry["files"])
    (0.5, ['log.toml'])
    """
    heard = {"robot": robot, "beamwidth_rad": beamwidth}
    return {"path": str(log.resolve()), **heard, "files": _sums(log)}


def _sums(log: Path) -> dict[str, str]:
    """Return the sum of each file that may be read of a log or of its truth."""
    patterns = (*reader_of(log).files, *truth_files.FILES)
    found = {path.name: path for pattern in patterns for path in log.glob(pattern)}
    sums = {}
    for name, path in sorted(found.items()):
        if path.is_file():
            with path.open("rb") as file:
                sums[name] = file_digest(file, "sha256").hexdigest()
    return sums


def _check_simulated(folder: Path, log: Path | None) -> None:
    """Refuse a folder that does not say which log was solved in it, and a log where none was."""
    if "scenario" not in read_toml(folder / "config.toml"):
        raise refusal(
            f"{folder / SUMMARY}: log",
            "nothing",
            "which log was solved (it is the folder of an earlier version)",
            "solve it anew, `pipistrelle slam LOG -o DIR`, and name DIR",
        )
    if log is not None:
        raise refusal(
            f"{folder}, option --log",
            f"{log}",
            "none, for `pipistrelle run` simulated this mission",
            "leave it out",
        )


def _log_of(folder: Path, summary: Summary, log: Path | None) -> Path:
    """Return where the log is that was solved; refuse one that is gone or was changed."""
    assert summary.log
    path = Path(summary.log.path) if log is None else log
    where = f"{folder / SUMMARY}: log.path" if log is None else f"{folder}, option --log"
    if not path.is_dir():
        raise refusal(
            where,
            f"{path}, which is not there",
            "the folder of the log that was solved",
            "put it back, or say with --log DIR where it is",
        )
    then, now = summary.log.files, _sums(path)
    changed = [name for name in sorted({*then, *now}) if then.get(name) != now.get(name)]
    if changed:
        name = changed[0]
        how = "is new" if name not in then else "is gone" if name not in now else "was changed"
        others = f", and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise refusal(
            path,
            f"not the log that was solved ({name} {how}{others})",
            f"it as {folder} was made of it",
            "put that back, or solve it as it is, `pipistrelle slam`, and name that folder",
        )
    return path


def _difference(folder: Path, summary: Summary, trials: Sequence[TrialResult]) -> str:
    """Say in a line how tracks are not those of the folder."""
    found = {}
    for trial in trials:
        track = trial.track
        name = f"track_{trial.strategy}_{short_name(trial.filter)}.tum"
        here = tum_text(track.time, track.pose.mean)
        try:
            there = read_file(folder / name).decode()
        except (OSError, UnicodeDecodeError, InputError):
            found[name] = "cannot be read"
            continue
        if here != there:
            found[name] = f"is not as it is found now{_apart(here, there)}"
    if not found:
        return ""
    name, how = next(iter(found.items()))
    others = f", nor are {len(found) - 1} more" if len(found) > 1 else ""
    return f"{folder / name}: {how}{others}{_reason(folder, summary)}"


def _reason(folder: Path, summary: Summary) -> str:
    """Say why a mission may not be what it was, where that is known."""
    if settings_hash(read_toml(folder / "config.toml")) != summary.config_hash:
        return "; config.toml was changed since"
    if summary.version != find_version():
        return f"; it was written by version {summary.version}, this is {find_version()}"
    return ""


def _apart(here: str, there: str) -> str:
    """Say how far apart two tracks are, where they can be compared."""
    try:
        paths = [
            np.array([line.split()[1:3] for line in text.splitlines()], dtype=float)
            for text in (here, there)
        ]
        distance = float(np.hypot(*(paths[0] - paths[1]).T).max())
    except ValueError:  # rows of unlike lengths, or of unlike number, or no numbers
        return ""
    return f", by up to {distance:.2g} m" if math.isfinite(distance) else ""
