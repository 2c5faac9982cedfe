"""Running a study: the worlds of a plan, computed in this process, in others, or on a cluster.

The unit of work is a world. Its process writes the results (`studies.store`) and returns only the
outcome of its trials, so a study needs little memory and keeps all finished worlds. Any executor
with the ``submit`` of ``concurrent.futures`` can be used (`studies.executors`), with equal results.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pipistrelle.config import InputError
from pipistrelle.estimation.catalogue import CATALOGUE, look_in
from pipistrelle.experiments.hearing.scenario import moving_callers, standing_landmarks
from pipistrelle.experiments.hearing.trajectories import motion_of
from pipistrelle.experiments.machine import check_memory, keep_freed_memory
from pipistrelle.experiments.runs.validate import check_filters, checked_scenario, warnings_of
from pipistrelle.experiments.studies.executors import (
    AHEAD,
    Results,
    check_cluster,
    ended,
    in_processes,
    on_cluster,
)
from pipistrelle.experiments.studies.plan import Plan, PlannedCase, cases_of
from pipistrelle.experiments.studies.store import open_store
from pipistrelle.experiments.studies.world import (
    EndedTrial,
    done_worlds,
    failed_records,
    heard_together,
    read_ended_trials,
    refuse_strange,
    run_world,
    sweep,
    write_world,
)

KILLED = "its process ended without a word, twice: killed, or out of memory\n"
"""Error of the trials of a world whose process died."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyProgress:
    """Numbers of requested and finished worlds and trials of a study; trials by strategy."""

    worlds: int
    done: int
    """Number of finished worlds, including earlier runs."""
    trials: dict[str, int]
    ended: dict[str, int]
    failed: dict[str, int]
    first_error: str | None
    """Message of the first failed trial."""


def run_study(
    plan: Plan,
    folder: Path,
    *,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    scheduler: str | None = None,
    executor: Executor | None = None,
    retry_failed: bool = False,
    progress: Callable[[StudyProgress], None] | None = None,
) -> StudyProgress:
    """Run the unfinished worlds of a plan.

    All workers must have access to the same folder. With several workers processes are spawned, so
    a calling script needs the guard ``if __name__ == "__main__"``. A shard (i, n) is every n-th
    world from world i on. The scheduler is "local" or the address of a Dask scheduler; an executor
    is any other object with ``submit``. `progress` is called with the state at the start and after
    each world.

    >>> import tempfile
    >>> from pipistrelle.config import Config, ScenarioConfig
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",)}
    >>> config = Config(scenario=ScenarioConfig(steps=8, landmarks=12))
    >>> plan = Plan(name="one", iterations=2, config=config, grid={}, **ways)
    >>> with tempfile.TemporaryDirectory() as name:
    ...     so_far = run_study(plan, Path(name))
    >>> so_far.done, so_far.ended
    (2, {'fused': 2})
    """
    if scheduler is not None:
        check_cluster(scheduler)
    check_cases(plan, workers if executor is None and scheduler in (None, "local") else 0)
    open_store(folder, plan)
    worlds = range(shard[0], plan.iterations, shard[1])
    done = done_worlds(folder).intersection(worlds)
    sweep(folder, done)
    so_far = _nothing_done(plan, len(worlds))
    waiting: deque[int] = deque()
    for iteration in worlds:
        trials = read_ended_trials(folder, plan, iteration) if iteration in done else None
        if trials is None or (retry_failed and any(trial.error for trial in trials)):
            waiting.append(iteration)
        else:
            so_far = _advanced(so_far, trials)
    refuse_strange(folder, plan, waiting)
    show = progress or (lambda _: None)
    show(so_far)
    place, here = folder.absolute(), Path.cwd()
    task, give_up = partial(_work, place, plan, here), partial(_give_up, place, plan)
    found: Results
    if executor is not None:
        found = (future.result() for _, future in ended(executor, task, waiting, AHEAD))
    elif scheduler is not None:
        found = on_cluster(task, give_up, waiting, workers, scheduler)
    elif workers > 1:
        found = in_processes(task, give_up, waiting, workers)
    else:
        found = (task(iteration) for iteration in waiting)
    with closing(found):
        for trials in found if waiting else ():
            so_far = _advanced(so_far, trials)
            show(so_far)
    if len(done_worlds(folder).intersection(worlds)) < so_far.done:
        raise InputError(
            f"{folder}: lacks worlds that are done; expected one folder for all workers"
        )
    return so_far


def warnings_of_plan(plan: Plan) -> tuple[str, ...]:
    """Return the warnings about the receivers of a plan (`warnings_of`), without repetition."""
    warnings = (line for cases in heard_together(plan) for line in warnings_of(cases[0].config))
    return tuple(dict.fromkeys(warnings))


def check_cases(plan: Plan, workers: int) -> None:
    """Raise if a case of a plan is invalid, or if the workers need too much memory.

    `workers` counts the processes on this machine; 0 for a cluster.
    """
    for cases in heard_together(plan):
        with _named(cases[0]):
            config = cases[0].config
            scenario = checked_scenario(config, world=plan.world(config), workers=workers)
            here = len(standing_landmarks(scenario)[0])
            moving = [caller.name for caller in moving_callers(scenario).values()]
        for case in cases:
            heard = {"passive": case.strategy != "active", "workers": workers}
            with _named(case):
                check_memory([case.filter], here, case.config, **heard)
                motion = motion_of(case.config.motion)
                check_filters([case.filter], motion, case.config, moving)


@contextmanager
def _named(case: PlannedCase) -> Iterator[None]:
    """Add the grid's values to the message of an InputError."""
    try:
        yield
    except InputError as error:
        values = ", ".join(f"{name} = {value}" for name, value in case.values.items())
        raise InputError(
            f"{error} (where the grid has {values})" if values else f"{error}"
        ) from None


def _nothing_done(plan: Plan, worlds: int) -> StudyProgress:
    """Return the state of a study before its first world."""
    cases = Counter[str](case.strategy for case in cases_of(plan))
    return StudyProgress(
        worlds=worlds,
        done=0,
        trials={strategy: number * worlds for strategy, number in cases.items()},
        ended=dict.fromkeys(cases, 0),
        failed=dict.fromkeys(cases, 0),
        first_error=None,
    )


def _advanced(so_far: StudyProgress, trials: Sequence[EndedTrial]) -> StudyProgress:
    """Return the state of a study after another finished world."""
    errors = [trial.error for trial in trials if trial.error is not None]
    ended = Counter(trial.strategy for trial in trials)
    failed = Counter(trial.strategy for trial in trials if trial.error is not None)
    error = errors[0].strip().splitlines()[-1] if errors else None
    return replace(
        so_far,
        done=so_far.done + 1,
        ended={strategy: n + ended[strategy] for strategy, n in so_far.ended.items()},
        failed={strategy: n + failed[strategy] for strategy, n in so_far.failed.items()},
        first_error=so_far.first_error or error,
    )


def _work(folder: Path, plan: Plan, here: Path, iteration: int) -> list[EndedTrial]:
    """Compute a world and write its results, in any worker."""
    keep_freed_memory()
    if not CATALOGUE.keys() >= set(plan.filters):
        look_in(here)
    records = run_world(plan, iteration)
    write_world(folder, plan, iteration, records)
    return [EndedTrial(record.case.strategy, record.error) for record in records]


def _give_up(folder: Path, plan: Plan, iteration: int) -> list[EndedTrial]:
    """Record all trials of a world as failed, as its process died."""
    records = failed_records(plan, KILLED)
    write_world(folder, plan, iteration, records)
    return [EndedTrial(record.case.strategy, record.error) for record in records]
