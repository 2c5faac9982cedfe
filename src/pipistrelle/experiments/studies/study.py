"""Running a study: the worlds of a plan, computed in this process, in others, or on a cluster.

The unit of work is a world. Its process writes the results and returns only the
outcome of its trials, so a study needs little memory and keeps all finished worlds. Any executor
with the ``submit`` of ``concurrent.futures`` can be used, with equal results.

Its folder has the plan, and per world and table a file that is complete or missing
(`studies.world`): it can be killed at any time, continued, and written by many processes at once.
"""

import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

from pipistrelle.config import InputError
from pipistrelle.detection.logs.readers import wrong_kind
from pipistrelle.estimation.catalogue import CATALOGUE, look_in
from pipistrelle.experiments.hearing.scenario import moving_callers, standing_landmarks
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.hearing.world_folder import kept_world
from pipistrelle.experiments.machine import check_memory, keep_freed_memory
from pipistrelle.experiments.results.scores import OF_ASSOCIATION
from pipistrelle.experiments.runs.validate import check_filters, checked_scenario, warnings_of
from pipistrelle.experiments.studies.plan import (
    Plan,
    PlannedCase,
    cases_of,
    changed_settings,
    kept_plan,
    plan_text,
)
from pipistrelle.experiments.studies.world import (
    TABLES,
    Outcome,
    TrialRecord,
    check_world,
    done_worlds,
    failed_records,
    heard_together,
    read_outcomes,
    refuse_strange,
    run_world,
    scan_tables,
    sweep,
    unusable,
    world_schemas,
    write_world,
)
from pipistrelle.files import read_file, shipped_text, whole_name, write_whole
from pipistrelle.settings import to_toml
from pipistrelle.version import find_version

if TYPE_CHECKING:
    import polars as pl

_FILES = ("plan.toml", "config.toml", "README.md")


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredStudy:
    """A study opened from its folder: its plan, and lazy tables of its finished worlds."""

    plan: Plan
    trials: "pl.LazyFrame"
    steps: "pl.LazyFrame"
    landmarks: "pl.LazyFrame"


def open_store(folder: Path, plan: Plan) -> None:
    """Create a study's folder, or accept an existing folder of the same plan."""
    kept = folder / "plan.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Listed before the plan is read, as other processes that start now write their plan first.
        seen = list(folder.iterdir())
        there = kept_plan(folder) if kept.exists() else None
        left = [path for path in seen if whole_name(path.name) in _FILES]
        # Worlds are kept before the plan that needs them.
        strange = [path.name for path in seen if path not in [*left, folder / "worlds"]]
        holds = f"{min(strange)} and no plan.toml" if there is None and strange else ""
        if there and not (_is_ours(kept, there) or (folder / "trials").is_dir()):
            holds = "a plan.toml that is not Pipistrelle's and no trials"
        if holds:
            fix = "name another with -o DIR"
            raise InputError(f"{folder}: holds {holds}, so it is no study's folder; {fix}")
        if there is not None and (changes := changed_settings(there, plan)):
            differences = "".join(f"\n  {line}" for line in changes)
            fix = f"name a new folder with -o DIR{differences}"
            raise InputError(f"{kept}: is the plan of another study; {fix}")
        if there is None or there.iterations < plan.iterations or there.planned < plan.planned:
            _keep_plan(folder, there, plan)
        readme = shipped_text("experiments/studies/readme.md")
        readme = readme.format(name=plan.name, version=find_version())
        config = plan.config
        if config.scenario.world is not None:
            config, _ = kept_world(config, plan.world(config))
        for name, text in (("config.toml", to_toml(config)), ("README.md", readme)):
            if not (folder / name).exists():
                write_whole(folder / name, text.encode())
        for table in TABLES:
            (folder / table).mkdir(exist_ok=True)
            TemporaryFile(dir=folder / table).close()
        for path in left:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise unusable(folder, error) from error


def _keep_plan(folder: Path, there: Plan | None, plan: Plan) -> None:
    """Write a plan and its worlds' files, with the larger of old and new numbers of worlds."""
    kept = folder / "plan.toml"
    if there is not None:
        if not _is_ours(kept, there):
            if plan.iterations <= there.iterations:
                return
            changed = "was changed since Pipistrelle wrote it, so it is not replaced"
            raise InputError(f"{kept}: {changed}; set iterations = {plan.iterations} in it")
        most = max(there.iterations, plan.iterations)
        plan = replace(plan, iterations=most, planned=max(there.planned, plan.planned))
    for world in plan.worlds.values():
        _, files = kept_world(plan.config, world)
        for name, content in files.items():
            path = folder / name
            if path.exists() and read_file(path) != content:
                fix = "name a new folder with -o DIR"
                raise InputError(f"{path}: is not the world that is asked for; {fix}")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, content)
    write_whole(kept, plan_text(plan).encode())


def _is_ours(kept: Path, plan: Plan) -> bool:
    """Return whether a plan file has exactly the text that Pipistrelle writes for the plan."""
    return read_file(kept) == plan_text(plan).encode()


def load_study(folder: Path) -> StoredStudy:
    """Open a study's folder: its plan, and the tables of its finished worlds."""
    import polars as pl

    if not (folder / "plan.toml").is_file():
        raise wrong_kind(folder, "the folder of a study", "plan.toml")
    plan = kept_plan(folder)
    worlds = sorted(done_worlds(folder))
    # The files contain their columns, also if an external estimator is not installed.
    frames = {
        name: scan_tables(folder, name, worlds)
        if worlds
        else pl.LazyFrame(schema=world_schemas(plan)[name])
        for name in TABLES
    }
    # Without an association in the plan, the columns of its scores are missing.
    try:
        there = frames["trials"].collect_schema().names()
    except (OSError, pl.exceptions.PolarsError):
        for world in worlds:
            check_world(folder, plan, world)
        raise
    none = [pl.lit(None, pl.Float64).alias(n) for n in OF_ASSOCIATION if n not in there]
    frames["trials"] = frames["trials"].with_columns(none)
    return StoredStudy(plan=plan, **frames)


def load_finished(folder: Path) -> StoredStudy:
    """Open a study's folder; raise if no world is finished, or a file of one was changed."""
    worlds = sorted(done_worlds(folder))
    if not worlds and (folder / "plan.toml").is_file():
        fix = f"`pipistrelle study` with -o {folder} goes on"
        raise InputError(f"{folder}: no world is done yet; {fix}")
    stored = load_study(folder)
    for world in worlds:
        check_world(folder, stored.plan, world)
    return stored


KILLED = "its process ended without a word, twice: killed, or out of memory\n"
"""Error of the trials of a world whose process died."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyProgress:
    """Progress of a study: finished worlds, and ended and failed trials by strategy."""

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
    """Run the unfinished worlds of a plan and store their results in a folder.

    All workers must have access to the same folder. With several workers processes are spawned, so
    a calling script needs the guard ``if __name__ == "__main__"``. A shard (i, n) is every n-th
    world from world i on. The scheduler is "local" or the address of a Dask scheduler; an executor
    is any other object with ``submit``. `progress` is called with the state at the start and after
    each world.
    """
    if scheduler is not None:
        check_cluster(scheduler)
    check_cases(plan, workers if executor is None and scheduler in (None, "local") else 0)
    open_store(folder, plan)
    worlds = range(shard[0], plan.iterations, shard[1])
    done = done_worlds(folder).intersection(worlds)
    sweep(folder, done)
    cases = Counter[str](case.strategy for case in cases_of(plan))
    so_far = StudyProgress(
        worlds=len(worlds),
        done=0,
        trials={strategy: number * len(worlds) for strategy, number in cases.items()},
        ended=dict.fromkeys(cases, 0),
        failed=dict.fromkeys(cases, 0),
        first_error=None,
    )
    waiting: deque[int] = deque()
    for iteration in worlds:
        trials = read_outcomes(folder, plan, iteration) if iteration in done else None
        if trials is None or (retry_failed and any(error for _, error in trials)):
            waiting.append(iteration)
        else:
            so_far = _advanced(so_far, trials)
    refuse_strange(folder, plan, waiting)
    show = progress or (lambda _: None)
    show(so_far)
    place, here = folder.absolute(), Path.cwd()
    task = partial(_work, place, plan, here)
    give_up = partial(_kept, place, plan, records=failed_records(plan, KILLED))
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
        expected = "one folder for all workers"
        raise InputError(f"{folder}: lacks worlds that are done; expected {expected}")
    return so_far


def warnings_of_plan(plan: Plan) -> tuple[str, ...]:
    """Return the warnings about all receivers in a plan (`warnings_of`), without repetition."""
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
                motion = true_motion(case.config.motion)
                check_filters([case.filter], motion, case.config, moving)


@contextmanager
def _named(case: PlannedCase) -> Iterator[None]:
    """Add a case's varied values to the message of an InputError raised in this context."""
    try:
        yield
    except InputError as error:
        values = ", ".join(f"{name} = {value}" for name, value in case.values.items())
        where = f" (where the grid has {values})" if values else ""
        raise InputError(f"{error}{where}") from None


def _advanced(so_far: StudyProgress, trials: Sequence[Outcome]) -> StudyProgress:
    """Return the progress of a study after the trials of another finished world."""
    errors = [error for _, error in trials if error is not None]
    ended = Counter(strategy for strategy, _ in trials)
    failed = Counter(strategy for strategy, error in trials if error is not None)
    error = errors[0].strip().splitlines()[-1] if errors else None
    return replace(
        so_far,
        done=so_far.done + 1,
        ended={strategy: n + ended[strategy] for strategy, n in so_far.ended.items()},
        failed={strategy: n + failed[strategy] for strategy, n in so_far.failed.items()},
        first_error=so_far.first_error or error,
    )


def _work(folder: Path, plan: Plan, here: Path, iteration: int) -> list[Outcome]:
    """Compute a world in a worker, write its results, and return the outcomes of its trials."""
    keep_freed_memory()
    if not CATALOGUE.keys() >= set(plan.filters):
        look_in(here)
    return _kept(folder, plan, iteration, run_world(plan, iteration))


def _kept(
    folder: Path, plan: Plan, iteration: int, records: Sequence[TrialRecord]
) -> list[Outcome]:
    """Write a world's results, and return strategy and error of each trial."""
    write_world(folder, plan, iteration, records)
    return [(record.case.strategy, record.row.get("error")) for record in records]


AHEAD = 1000
"""Worlds submitted to a cluster before the first of them is done."""

_NO_PAGES = {f"distributed.{who}.http.routes": [] for who in ("scheduler", "worker")}
"""Settings of a local cluster that disable Dask's web pages."""


Task = Callable[[int], list[Outcome]]
"""Computes a world, writes its results, and returns the outcome of its trials."""
Results = Generator[list[Outcome], None, None]
"""The trials of each world, in the order in which the worlds end."""


def ended(
    executor: Executor, task: Task, waiting: deque[int], ahead: int
) -> Iterator[tuple[int, Future[list[Outcome]]]]:
    """Submit waiting worlds to an executor; yield each finished world's number and future.

    At most `ahead` worlds are pending. Once the executor is broken, no more are submitted, and the
    rest stays in ``waiting``.
    """
    running: dict[Future[list[Outcome]], int] = {}
    try:
        while running or (waiting and ahead):
            try:
                while waiting and len(running) < ahead:
                    running[executor.submit(task, waiting[0])] = waiting[0]
                    waiting.popleft()
            except BrokenExecutor:
                ahead = 0  # start no more; report the running worlds
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future
    finally:
        for future in running:
            future.cancel()


def in_processes(task: Task, give_up: Task, waiting: deque[int], workers: int) -> Results:
    """Run worlds in spawned processes, and yield each finished world's trial outcomes.

    The worlds of processes that died are tried again, in a single process; `give_up` is called for
    a world that has lost its process twice.
    """
    alive, suspects, lost = False, deque[int](), deque[int]()
    while waiting or suspects:
        queue, size, broken = (suspects, 1, lost) if suspects else (waiting, workers, suspects)
        with _pool(min(size, len(queue))) as pool:
            for iteration, future in ended(pool, task, queue, size):
                try:
                    yield future.result()
                    alive = True
                except BrokenExecutor:
                    broken.append(iteration)
        if lost and not suspects and not alive:
            raise InputError(
                "workers: their processes end before a world is done: killed, out of memory, or "
                'started by a script without if __name__ == "__main__"; one worker needs no other '
                "process"
            )
        while lost and not suspects:
            yield give_up(lost.popleft())


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Provide a pool of spawned processes; kill them if the body of the context raises."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children, get_context

    class Pool(ProcessPoolExecutor):
        """Process pool that spawns processes on demand, with Ctrl-C ignored from their start."""

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            with _held_interrupt():
                return super().submit(fn, *args, **kwargs)

    others = set(active_children())
    pool = Pool(workers, mp_context=get_context("spawn"), initializer=_become_worker)
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - others:
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _held_interrupt() -> Iterator[None]:
    """Block Ctrl-C while the context's body runs; processes started in it ignore Ctrl-C."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _become_worker() -> None:
    """Make this worker process ignore Ctrl-C, and exit when its parent process has ended."""
    from multiprocessing import parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("POLARS_MAX_THREADS", "1")
    parent = parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def on_cluster(
    task: Task, give_up: Task, waiting: deque[int], workers: int, address: str
) -> Results:
    """Run worlds on Dask's workers, and yield each finished world's trial outcomes.

    `address` is a scheduler's, or "local" for a cluster of `workers` on this machine. Dask retries
    the worlds of a dead worker; `give_up` is called for a world that it abandons.
    """
    with _client(address, workers) as client:
        from distributed import KilledWorker

        executor = client.get_executor(pure=False)
        try:
            for iteration, future in ended(executor, task, waiting, AHEAD):
                try:
                    trials = future.result()
                except KilledWorker:
                    trials = give_up(iteration)
                except CancelledError as error:
                    raise InputError(
                        f"--scheduler {address}: the cluster is gone; worlds that are done are "
                        "kept, and the same command goes on with the rest"
                    ) from error
                yield trials
        finally:
            executor.shutdown(wait=False)


def check_cluster(address: str) -> None:
    """Raise if Dask is not installed."""
    try:
        import cryptography  # noqa: F401  (Dask needs it for certificates)
        import dask  # noqa: F401
        import distributed  # noqa: F401
    except ImportError as error:
        why = "needs Dask, which is not installed"
        fix = "python -m pip install dask distributed cryptography"
        raise InputError(f"--scheduler {address}: {why}; {fix}") from error


@contextmanager
def _client(address: str, workers: int) -> Iterator[Any]:
    """Connect to a Dask scheduler, or start a cluster on this machine for the address "local"."""
    from dask import config as dask_config
    from distributed import Client, LocalCluster

    if address != "local":
        try:
            client = Client(address, timeout="10s")
        except (OSError, ValueError) as error:
            why = f"found {address!r}, but no scheduler answers there ({error})"
            expected = "local, or an address such as tcp://127.0.0.1:8786"
            raise InputError(f"--scheduler: {why}; expected {expected}") from error
        with client:
            yield client
        return
    with _held_interrupt(), dask_config.set(_NO_PAGES):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            security=True,  # certificates of this cluster; other clients are rejected
            dashboard_address="127.0.0.1:0",  # 8787 may be taken
            worker_dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
        )
    with cluster, Client(cluster) as client:
        yield client
