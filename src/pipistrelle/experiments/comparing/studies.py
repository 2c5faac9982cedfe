"""Studies side by side: case by case, paired over the worlds that both have met.

A case of one study is compared with the case of another that has its strategy, its filter and its
values of all that either study varies. Where both drew the same worlds (seed, scenario, motion),
the numbers of a world are subtracted, which takes away what makes one world harder than the next;
elsewhere means are. All cases are a family for each score: `evaluation.comparison.judge`.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.comparison import INTERVALS, Finding, Statement, judge
from pipistrelle.evaluation.scores import NOT_MEANS, SCORES
from pipistrelle.experiments.comparing.folders import LETTERS
from pipistrelle.experiments.comparing.matching import (
    alike,
    differing,
    matched,
    named,
    worded,
)
from pipistrelle.experiments.studies.plan import RADIUS, Plan, PlannedCase, cases_of, plan_settings
from pipistrelle.experiments.studies.store import load_study
from pipistrelle.experiments.studies.world import check_world, done_worlds
from pipistrelle.files import read_file

if TYPE_CHECKING:
    import polars as pl

POSITION = "position_rmse_m"
_VERSION = re.compile(r"Written by Pipistrelle (\S+)\.\s")
Key = tuple[str, str, tuple[str, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedCase:
    """A score of one case, in the first study and in another."""

    label: str
    strategies: tuple[str, str]
    filters: tuple[str, str]
    values: Mapping[str, Any]
    """Of what either study varies."""
    beamwidth_deg: float | None
    """Of the vehicle's call, where it matters."""
    score: str
    other: int
    """Which study it is held against the first."""
    paired: bool
    """Whether both met the same worlds."""
    worlds: tuple[int, int]
    """Those that count; where they are paired, the same."""
    means: tuple[float, float]
    """Over these; NaN of none."""
    diverged: tuple[int, int]
    """Worlds in which it diverged or failed, of all that are done."""
    finding: Finding
    """Of the other less the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedStudies:
    """Folders of studies, the first of which the others are held against."""

    folders: tuple[Path, ...]
    versions: tuple[str, ...]
    """Empty where the folder's README does not say it."""
    done: tuple[int, ...]
    planned: tuple[int, ...]
    """Worlds of each."""
    cases: tuple[ComparedCase, ...]
    """By score, then by case, then by study."""
    alone: tuple[tuple[str, tuple[int, ...]], ...]
    """Cases that only some have, by their labels, and which of the folders those are."""
    settings: Mapping[str, tuple[Any, ...]]
    """Those of the plans that differ."""
    dropped_diverged: bool
    """Whether worlds are left out in which either diverged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _ReadStudy:
    """A study's plan, the number of finished worlds, and the trials of each case."""

    plan: Plan
    worlds: int
    trials: "Mapping[int, pl.DataFrame]"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """A case in the first study and in another, with the trials of both."""

    label: str
    cases: tuple[PlannedCase, PlannedCase]
    values: Mapping[str, Any]
    other: int
    paired: bool
    trials: "tuple[pl.DataFrame, pl.DataFrame]"


def compare_studies(folders: Sequence[Path], *, drop_diverged: bool = False) -> ComparedStudies:
    """Compare what studies found.

    `folders`: two or more, none twice (`folders.kind_of`). `drop_diverged`: leave out the worlds in
    which either of two cases diverged; else all count that have a number. Raises InputError: where
    a folder cannot be read, holds no world, or they have no case in common.
    """
    studies = [_read(folder) for folder in folders]
    varied = tuple(dict.fromkeys(name for one in studies for name in one.plan.grid))
    planned = [cases_of(one.plan) for one in studies]
    parts = alike([[(case.strategy, case.filter) for case in cases] for cases in planned])
    keyed = [{_key(case, varied, parts): case for case in cases} for cases in planned]
    common, alone = matched([tuple(cases) for cases in keyed])
    if not common:
        raise _nothing_in_common(folders, studies)
    pairs = [
        _pair(studies, [cases[key] for cases in keyed], other, varied)
        for key in common
        for other in range(1, len(studies))
    ]
    left = [(keyed[who[0]][key], who) for key, who in alone.items()]
    return ComparedStudies(
        folders=tuple(folders),
        versions=tuple(map(_version, folders)),
        done=tuple(one.worlds for one in studies),
        planned=tuple(one.plan.planned for one in studies),
        cases=tuple(
            case for score in _scored(studies) for case in _judged(pairs, score, drop_diverged)
        ),
        alone=tuple((_label([case], varied, studies[who[0]].trials), who) for case, who in left),
        settings=differing([plan_settings(one.plan) for one in studies]),
        dropped_diverged=drop_diverged,
    )


def _read(folder: Path) -> _ReadStudy:
    """Read a study's trials, if every file is as it was written."""
    import polars as pl

    worlds = sorted(done_worlds(folder))
    if not worlds:
        raise InputError(
            f"{folder}: no world is done yet; `pipistrelle study` with -o {folder} goes on"
        )
    stored = load_study(folder)
    for world in worlds:
        check_world(folder, stored.plan, world)
    try:
        trials = stored.trials.collect()
        parted = trials.partition_by("case", as_dict=True)
        found = {case: table for (case,), table in parted.items()}
        for table in found.values():
            table.select("iteration", "status", "diverged", "beamwidth_deg", POSITION)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(
            f"{folder}: its trials have not the columns of this version; run the study anew"
        ) from error
    return _ReadStudy(plan=stored.plan, worlds=len(worlds), trials=found)


def _scored(studies: Sequence[_ReadStudy]) -> list[str]:
    """List the scores that all studies keep and of which there is any number."""
    tables = [table for one in studies for table in one.trials.values()]
    return [
        name
        for name in SCORES
        if name not in NOT_MEANS and all(name in table.columns for table in tables)
        if name == POSITION or any(table[name].cast(float).is_finite().any() for table in tables)
    ]


def _nothing_in_common(folders: Sequence[Path], studies: Sequence[_ReadStudy]) -> InputError:
    """Say what each study tries, where no case is in all."""
    tried = []
    for folder, one in zip(folders, studies, strict=True):
        ways = f"{', '.join(one.plan.strategies)} by {', '.join(map(short_name, one.plan.filters))}"
        varied = "; ".join(f"{name} {list(values)}" for name, values in one.plan.grid.items())
        tried.append(f"{folder} tries {ways}" + f" at {varied}" * bool(varied))
    return InputError(
        f"compare: found no case that all studies have: {'. '.join(tried)}. Expected a strategy, a "
        "filter and values of what either varies that all have"
    )


def _key(case: PlannedCase, varied: Sequence[str], parts: tuple[bool, bool]) -> Key:
    """Return the key by which a case is matched between studies."""
    values = tuple(json.dumps(_value(case, name)) for name in varied)
    return *named((case.strategy, case.filter), parts), values


def _value(case: PlannedCase, name: str) -> Any:
    """Return a case's value of a setting; None for the beam of passive sensing."""
    if name == RADIUS and case.strategy == "passive":
        return None
    value: Any = case.config.model_dump(mode="json")
    for part in name.split("."):
        value = value[part]
    return value


def _label(
    cases: Sequence[PlannedCase], varied: Sequence[str], trials: "Mapping[int, pl.DataFrame]"
) -> str:
    """Name matched cases by what they share; `trials` are those of the first case."""
    first, words = cases[0], [worded([(case.strategy, case.filter) for case in cases])]
    for name in varied:
        value = _value(first, name)
        if name == RADIUS and first.number in trials:
            value = trials[first.number]["beamwidth_deg"].drop_nulls()[:1].to_list()
            words += [f"{width:.1f}°" for width in value]
        elif value is not None:
            words.append(f"{name} {value if isinstance(value, str) else json.dumps(value)}")
    return ", ".join(filter(None, words)) or "the case"


def _pair(
    studies: Sequence[_ReadStudy], cases: Sequence[PlannedCase], other: int, varied: Sequence[str]
) -> _Pair:
    """Put a case of the first study beside that of another."""
    first, second = cases[0], cases[other]
    return _Pair(
        label=_label(cases, varied, studies[0].trials),
        cases=(first, second),
        values={name: _value(first, name) for name in varied},
        other=other,
        paired=same_worlds(first.config, second.config),
        trials=(_trials(studies[0], first), _trials(studies[other], second)),
    )


def same_worlds(config: Config, other: Config) -> bool:
    """Return whether two configurations draw the same worlds, number by number.

    Returns: what is heard in them may differ, and who maps it.

    Examples
    --------
    >>> same_worlds(Config(), Config(seed=8))
    False
    """
    return all(
        getattr(config, name) == getattr(other, name) for name in ("seed", "scenario", "motion")
    )


def _trials(study: _ReadStudy, case: PlannedCase) -> "pl.DataFrame":
    """Return the trials of a case; an empty table if no world has it."""
    some = next(iter(study.trials.values()))
    return study.trials.get(case.number, some.clear())


def _judged(pairs: Sequence[_Pair], score: str, drop_diverged: bool) -> list[ComparedCase]:
    """Judge a score of all pairs as one family."""
    numbers = [_numbers(pair, score, drop_diverged) for pair in pairs]
    statements = [
        Statement(label=pair.label, sample=second - first)
        if pair.paired
        else Statement(label=pair.label, sample=second, against=first)
        for pair, (first, second) in zip(pairs, numbers, strict=True)
    ]
    return [
        ComparedCase(
            label=pair.label,
            strategies=(pair.cases[0].strategy, pair.cases[1].strategy),
            filters=(pair.cases[0].filter, pair.cases[1].filter),
            values=pair.values,
            beamwidth_deg=next(iter(pair.trials[0]["beamwidth_deg"].drop_nulls()), None),
            score=score,
            other=pair.other,
            paired=pair.paired,
            worlds=(len(both[0]), len(both[1])),
            means=(_mean(both[0]), _mean(both[1])),
            diverged=(_diverged(pair.trials[0]), _diverged(pair.trials[1])),
            finding=finding,
        )
        for pair, both, finding in zip(pairs, numbers, judge(statements), strict=True)
    ]


def _numbers(
    pair: _Pair, score: str, drop_diverged: bool
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Return a score of both cases in the worlds that count; paired, the same in both."""
    (worlds, first), (others, second) = (_counted(t, score, drop_diverged) for t in pair.trials)
    if not pair.paired:
        return first, second
    _, own_rows, other_rows = np.intersect1d(worlds, others, return_indices=True)
    return first[own_rows], second[other_rows]


def _counted(
    trials: "pl.DataFrame", score: str, drop_diverged: bool
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the numbers of the worlds that have a score, and the scores."""
    values = trials[score].cast(float).fill_null(np.nan).to_numpy()
    counts = np.isfinite(values)
    if drop_diverged:
        counts &= ~trials["diverged"].fill_null(value=False).to_numpy()
    return trials["iteration"].to_numpy()[counts], values[counts]


def _diverged(trials: "pl.DataFrame") -> int:
    """Count the worlds in which a case diverged or failed."""
    failed = (trials["status"] != "done") | trials["diverged"].fill_null(value=False)
    return int(failed.sum())


def _mean(numbers: Float[np.ndarray, " n"]) -> float:
    """Average numbers; NaN of none."""
    return float(np.mean(numbers)) if len(numbers) else float("nan")


def _version(folder: Path) -> str:
    """Return which version wrote a study, as its README says; nothing where it does not."""
    try:
        text = read_file(folder / "README.md").decode()
    except (OSError, UnicodeDecodeError, InputError):
        return ""
    found = _VERSION.search(text)
    return found[1] if found else ""


def notes_of(compared: ComparedStudies) -> tuple[str, ...]:
    """Say what a reader must know of a comparison, a line each."""
    notes, paired = [], {case.paired for case in compared.cases}
    if paired == {True}:
        notes.append("Paired over the worlds that both have met.")
    elif paired == {False}:
        notes.append(
            "Not paired: the worlds are not the same (seed, scenario or motion differ), so means "
            "over different worlds are compared."
        )
    else:
        notes.append("Paired where the worlds are the same, without a mark; ~: means over others.")
    notes.append(f"*: shown, as one of all cases of its table. {INTERVALS}")
    left = "are left out" if compared.dropped_diverged else "count, as far as they have a number"
    notes.append(f"Worlds in which a case diverged {left}.")
    for who in dict.fromkeys(its for _, its in compared.alone):
        labels = [label for label, its in compared.alone if its == who]
        some = "; ".join(labels[:4]) + f"; and {len(labels) - 4} more" * (len(labels) > 4)
        letters = " and ".join(LETTERS[i] for i in who)
        notes.append(f"Only in {letters}, not compared: {some}")
    return tuple(notes)
