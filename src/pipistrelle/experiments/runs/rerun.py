"""Missions repeated from their result folders, for views that need the belief of every frame.

Equal settings give equal bits, so a folder stores the settings and, for a recorded log, its path,
sums and options (`log_entry`), but no belief of every frame.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from hashlib import file_digest
from os import fsencode
from pathlib import Path

import numpy as np

from pipistrelle.config import InputError
from pipistrelle.detection.logs.readers import Robot, reader_of
from pipistrelle.estimation.association import KNOWN
from pipistrelle.estimation.catalogue import CATALOGUE, short_name
from pipistrelle.estimation.data_association.sequential import METHODS
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN
from pipistrelle.experiments.hearing.world_folder import read_world
from pipistrelle.experiments.results.reading import SUMMARY, Summary, read_summary
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.results.tables import tum_text
from pipistrelle.experiments.results.writing import settings_hash
from pipistrelle.experiments.runs import truth_files
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.replay import load, replay
from pipistrelle.experiments.runs.trial import Watch, run_mission
from pipistrelle.files import read_file, text_of
from pipistrelle.refusals import refusal
from pipistrelle.settings import from_file, read_toml, resolve
from pipistrelle.version import find_version


def rerun(
    folder: Path,
    *,
    log: Path | None = None,
    trusted: Collection[str] = (),
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Mission:
    """Repeat a mission from its result folder, and compare its tracks with the stored ones.

    `log` is the new path of a log that was moved. Estimators and associations from outside
    (``module:Class``) run only if `trusted` lists them, as the folder may be another person's.

    >>> from tempfile import TemporaryDirectory
    >>> from pipistrelle.config import Config, ScenarioConfig
    >>> from pipistrelle.experiments.drives import NO_TRUTH
    >>> from pipistrelle.experiments.results.writing import write_results
    >>> from pipistrelle.files import RESULTS, OwnFiles
    >>> config = Config(scenario=ScenarioConfig(steps=8, landmarks=3))
    >>> done = run_mission(config, ["fused"])
    >>> kept = {"command": "pipistrelle run", "seed": config.seed, "ignored_rows": {}}
    >>> with TemporaryDirectory() as name:
    ...     own = OwnFiles(Path(name), RESULTS)
    ...     write_results(own, config=config, trials=done.trials, truth=NO_TRUTH, **kept)
    ...     same = rerun(Path(name))
    >>> same.difference, np.array_equal(*(it.trials[0].track.pose.mean for it in (done, same)))
    ('', True)
    """
    summary = read_summary(folder)
    for name in {run.filter for run in summary.runs} - {*CATALOGUE, *trusted}:
        fix = f"add --filter {name} (in Python: filters={name!r}) to run it"
        raise _not_ours(f"{folder / SUMMARY}: runs.filter", name, fix)
    config = resolve(from_file(folder / "config.toml"))
    if (method := config.association.method) not in (KNOWN, *METHODS, *trusted):
        fix = f"add --association.method {method} (in Python: association={method!r}) to run it"
        raise _not_ours(f"{folder / 'config.toml'}: association.method", method, fix)
    strategies = list(dict.fromkeys(run.strategy for run in summary.runs))
    filters = list(dict.fromkeys(run.filter for run in summary.runs))
    if summary.log is None:
        _check_simulated(folder, log)
        world = ALL_DRAWN if (kept := config.scenario.world) is None else read_world(Path(kept))
        mission = run_mission(
            config, strategies, filters, world=world, progress=progress, watch=watch
        )
    else:
        recorded, truth = load(_log_of(folder, summary, log), summary.log.robot, bag=config.bag)
        beam, asked = summary.log.beamwidth_rad, (strategies, filters)
        mission = replay(recorded, truth, *asked, beam, config, progress=progress, watch=watch)
        mission = replace(mission, source=summary.log.model_dump(exclude_defaults=True))
    return replace(mission, difference=_difference(folder, summary, mission.trials))


def _not_ours(where: str, name: str, fix: str) -> InputError:
    """Return the error for code from outside that is named only by a folder."""
    found = f"{name!r}, whose code is not Pipistrelle's"
    return refusal(where, found, "one that you trust", fix)


def log_entry(log: Path, robot: Robot | None, beamwidth: float | None) -> dict[str, object]:
    """Return the entry of a log in ``summary.json``: folder, SHA-256 of its files, beamwidth [rad].

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as name:
    ...     _ = (Path(name) / "log.toml").write_text("format = 1")
    ...     entry = log_entry(Path(name), None, 0.5)
    >>> entry["beamwidth_rad"], list(entry["files"])
    (0.5, ['log.toml'])
    """
    path = str(log.resolve())
    entry: dict[str, object] = {"path": text_of(path), "robot": robot, "beamwidth_rad": beamwidth}
    entry |= {"files": _sums(log)}
    return entry if entry["path"] == path else entry | {"path_bytes": fsencode(path).hex()}


def _sums(log: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a log and its truth, by name."""
    patterns = (*reader_of(log).files, *truth_files.FILES)
    found = {text_of(path.name): path for pattern in patterns for path in log.glob(pattern)}
    found |= {text_of(log.name): log} if log.is_file() else {}
    sums = {}
    for name, path in sorted(found.items()):
        if path.is_file():
            with path.open("rb") as file:
                sums[name] = file_digest(file, "sha256").hexdigest()
    return sums


def _check_simulated(folder: Path, log: Path | None) -> None:
    """Raise if a folder has neither log nor world, or if `log` is given for a simulated mission."""
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
    """Return the path of a mission's log; raise if it is missing or was changed."""
    assert summary.log
    path = summary.log.place if log is None else log
    where = f"{folder / SUMMARY}: log.path" if log is None else f"{folder}, option --log"
    if not path.exists():
        raise refusal(
            where,
            f"{path}, which is not there",
            "the log that was solved",
            "put it back, or say with --log where it is",
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
    """Describe in a line how tracks differ from the tracks of a folder; empty if equal."""
    differences = {}
    for trial in trials:
        track = trial.track
        name = f"track_{trial.strategy}_{short_name(trial.filter)}.tum"
        here = tum_text(track.time, track.pose.mean)
        try:
            there = read_file(folder / name).decode()
        except (OSError, UnicodeDecodeError, InputError):
            differences[name] = "cannot be read"
            continue
        if here != there:
            differences[name] = f"is not as it is found now{_apart(here, there)}"
    if not differences:
        return ""
    name, how = next(iter(differences.items()))
    others = f", nor are {len(differences) - 1} more" if len(differences) > 1 else ""
    return f"{folder / name}: {how}{others}{_reason(folder, summary)}"


def _reason(folder: Path, summary: Summary) -> str:
    """Name the reason for a difference, if known: other settings or another version."""
    if settings_hash(read_toml(folder / "config.toml")) != summary.config_hash:
        return "; config.toml was changed since"
    if summary.version != find_version():
        return f"; it was written by version {summary.version}, this is {find_version()}"
    return ""


def _apart(here: str, there: str) -> str:
    """Format the largest distance between two tracks; empty if they cannot be compared."""
    try:
        paths = [
            np.array([line.split()[1:3] for line in text.splitlines()], dtype=float)
            for text in (here, there)
        ]
        distance = float(np.hypot(*(paths[0] - paths[1]).T).max())
    except ValueError:  # unequal columns or rows, or not numbers
        return ""
    return f", by up to {distance:.2g} m" if math.isfinite(distance) else ""
