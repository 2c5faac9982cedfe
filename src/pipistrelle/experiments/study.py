"""A study: a plan's worlds, wherever there is room to compute them.

The unit of work is a world. Whoever computes it writes its results, by
`pipistrelle.experiments.store`, and reports back how its trials ended, so that a study needs
little memory, loses nothing that is done, and may run in this process, in several, or on a Dask
cluster: on whatever has a ``submit`` as the executors of ``concurrent.futures`` have. The results
are the same.
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
from typing import Any

from pipistrelle.config import InputError
from pipistrelle.experiments.machine import check_length, check_memory, keep_freed_memory
from pipistrelle.experiments.plan import Plan, cases_of
from pipistrelle.experiments.store import (
    Outcome,
    done_worlds,
    open_store,
    read_outcomes,
    sweep,
    write_world,
)
from pipistrelle.experiments.world import failed_records, run_world

KILLED = "its process ended without a word, twice: killed, or out of memory\n"
"""Recorded for every trial of a world that takes its process with it."""
AHEAD = 1000
"""Worlds handed to a cluster before the first of them is done."""

Task = Callable[[int], list[Outcome]]
Ended = tuple[int, "Future[list[Outcome]]"]
Results = Generator[list[Outcome], None, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """How far a study is.

    Attributes
    ----------
    worlds, done : int
        Asked for, and done, those of earlier runs included.
    trials : dict
        Number asked for, by strategy.
    ended, failed : dict
        Number that ended and, of these, failed; by strategy.
    first_error : str or None
        What the first failure seen says of itself.
    """

    worlds: int
    done: int
    trials: dict[str, int]
    ended: dict[str, int]
    failed: dict[str, int]
    first_error: str | None


def run_study(
    plan: Plan,
    folder: Path,
    *,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    scheduler: str | None = None,
    executor: Executor | None = None,
    retry_failed: bool = False,
    progress: Callable[[Standing], None] | None = None,
) -> Standing:
    """Run the worlds of a plan that are not done yet.

    Parameters
    ----------
    plan : Plan
    folder : Path
        As `open_store` makes it, or makes of it; it must be the same folder for all workers.
    workers : int
        Processes; 1: this one. More are spawned, so a script that calls this function must be
        guarded by ``if __name__ == "__main__"``.
    shard : i, n
        Run only each n-th world, from world i on.
    scheduler : str, optional
        "local", or the address of a Dask scheduler, whose workers then do the work.
    executor : Executor, optional
        Whatever else has a ``submit``; it must be able to import this package.
    retry_failed : bool
        Run the worlds again that hold failed trials.
    progress : callable, optional
        Given the standing, first as it is found, then whenever a world is done.

    Returns
    -------
    Standing
        Of the shard.

    Raises
    ------
    InputError
        Where the folder holds another plan, results cannot be written, or workers, or memory for
        them on this machine, cannot be had.

    Examples
    --------
    >>> import tempfile
    >>> from pipistrelle.config import Config, ScenarioConfig
    >>> ways = {"strategies": ("fused",), "filters": ("ekf",)}
    >>> config = Config(scenario=ScenarioConfig(steps=8, landmarks=12))
    >>> plan = Plan(name="one", iterations=2, config=config, grid={}, **ways)
    >>> with tempfile.TemporaryDirectory() as name:
    ...     standing = run_study(plan, Path(name))
    >>> standing.done, standing.ended
    (2, {'fused': 2})
    """
    if executor is None and scheduler in (None, "local"):
        _refuse_too_large(plan, workers)
    open_store(folder, plan)
    worlds = range(shard[0], plan.iterations, shard[1])
    done = done_worlds(folder).intersection(worlds)
    sweep(folder, done)
    standing = _nothing_done(plan, len(worlds))
    waiting: deque[int] = deque()
    for iteration in worlds:
        outcomes = read_outcomes(folder, iteration) if iteration in done else None
        if outcomes is None or (retry_failed and any(error for _, error in outcomes)):
            waiting.append(iteration)
        else:
            standing = _advanced(standing, outcomes)
    show = progress or (lambda _: None)
    show(standing)
    place = folder.absolute()
    task, give_up = partial(_work, place, plan), partial(_give_up, place, plan)
    found: Results
    if executor is not None:
        found = (future.result() for _, future in _ended(executor, task, waiting, AHEAD))
    elif scheduler is not None:
        found = _on_cluster(task, give_up, waiting, workers, scheduler)
    elif workers > 1:
        found = _in_processes(task, give_up, waiting, workers)
    else:
        found = (task(iteration) for iteration in waiting)
    with closing(found):
        for outcomes in found if waiting else ():
            standing = _advanced(standing, outcomes)
            show(standing)
    if len(done_worlds(folder).intersection(worlds)) < standing.done:
        raise InputError(
            f"{folder}: lacks worlds that are done; expected one folder for all workers"
        )
    return standing


def _refuse_too_large(plan: Plan, workers: int) -> None:
    """Refuse a plan of which so many worlds at once may need more memory than there is."""
    for case in cases_of(plan):
        check_length(case.config.scenario, workers=workers)
        check_memory(
            [case.filter],
            case.config.scenario.landmarks + 1,
            case.config.fastslam.particles,
            case.config.rays,
            passive=case.strategy != "active",
            workers=workers,
        )


def _nothing_done(plan: Plan, worlds: int) -> Standing:
    """Return the standing at the very start."""
    cases = Counter[str](case.strategy for case in cases_of(plan))
    return Standing(
        worlds=worlds,
        done=0,
        trials={strategy: number * worlds for strategy, number in cases.items()},
        ended=dict.fromkeys(cases, 0),
        failed=dict.fromkeys(cases, 0),
        first_error=None,
    )


def _advanced(standing: Standing, outcomes: Sequence[Outcome]) -> Standing:
    """Return the standing with one more world done."""
    errors = [error for _, error in outcomes if error is not None]
    ended = Counter(strategy for strategy, _ in outcomes)
    failed = Counter(strategy for strategy, error in outcomes if error is not None)
    told = errors[0].strip().splitlines()[-1] if errors else None
    return replace(
        standing,
        done=standing.done + 1,
        ended={strategy: n + ended[strategy] for strategy, n in standing.ended.items()},
        failed={strategy: n + failed[strategy] for strategy, n in standing.failed.items()},
        first_error=standing.first_error or told,
    )


def _work(folder: Path, plan: Plan, iteration: int) -> list[Outcome]:
    """Run a world and write its results; done by a worker, whatever it is."""
    keep_freed_memory()
    records = run_world(plan, iteration)
    write_world(folder, plan, iteration, records)
    return [(record.case.strategy, record.error) for record in records]


def _give_up(folder: Path, plan: Plan, iteration: int) -> list[Outcome]:
    """Record a world that cannot be had as failed."""
    records = failed_records(plan, KILLED)
    write_world(folder, plan, iteration, records)
    return [(record.case.strategy, record.error) for record in records]


def _ended(executor: Executor, task: Task, waiting: deque[int], ahead: int) -> Iterator[Ended]:
    """Keep an executor busy; yield each world when it ended, and its future."""
    running: dict[Future[list[Outcome]], int] = {}
    try:
        while running or (waiting and ahead):
            try:
                while waiting and len(running) < ahead:
                    running[executor.submit(task, waiting[0])] = waiting[0]
                    waiting.popleft()
            except BrokenExecutor:
                ahead = 0  # nothing more can be started; what runs is reported
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future
    finally:
        for future in running:
            future.cancel()


def _in_processes(task: Task, give_up: Task, waiting: deque[int], workers: int) -> Results:
    """Run worlds in processes; those in processes that die are tried again, one at a time."""
    alive = False
    while waiting:
        suspects, lost = deque[int](), deque[int]()
        alive |= yield from _in_pool(task, waiting, workers, suspects)
        while suspects:
            alive |= yield from _in_pool(task, suspects, 1, lost)
        if lost and not alive:
            raise InputError(
                "workers: their processes end before a world is done: killed, out of memory, or "
                'started by a script without if __name__ == "__main__"; one worker needs no other '
                "process"
            )
        yield from map(give_up, lost)


def _in_pool(
    task: Task, waiting: deque[int], workers: int, broken: deque[int]
) -> Generator[list[Outcome], None, bool]:
    """Run worlds until a process dies, and tell which were running then; return if any ended."""
    alive = False
    with _pool(min(workers, len(waiting))) as pool:
        for iteration, future in _ended(pool, task, waiting, workers):
            try:
                yield future.result()
                alive = True
            except BrokenExecutor:
                broken.append(iteration)
    return alive


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Spawn worker processes; kill them when they are no longer wanted."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children, get_context

    others = set(active_children())
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_become_worker)
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - others:
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _become_worker() -> None:
    """Leave Ctrl-C to the process that started this one, and end when that is gone."""
    from multiprocessing import parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("POLARS_MAX_THREADS", "1")
    parent = parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _on_cluster(
    task: Task, give_up: Task, waiting: deque[int], workers: int, address: str
) -> Results:
    """Run worlds on Dask's workers; Dask itself tries again what a dead worker leaves."""
    with _client(address, workers) as client:
        from distributed import KilledWorker

        executor = client.get_executor(pure=False)
        try:
            for iteration, future in _ended(executor, task, waiting, AHEAD):
                try:
                    outcomes = future.result()
                except KilledWorker:
                    outcomes = give_up(iteration)
                except CancelledError as error:
                    raise InputError(
                        f"--scheduler {address}: the cluster is gone; worlds that are done are "
                        "kept, and the same command goes on with the rest"
                    ) from error
                yield outcomes
        finally:
            executor.shutdown(wait=False)


@contextmanager
def _client(address: str, workers: int) -> Iterator[Any]:
    """Connect to a cluster, one on this machine if none is named."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError(
            f"--scheduler {address}: needs Dask, which is not installed; "
            "python -m pip install 'pipistrelle[cluster]'"
        ) from error
    if address != "local":
        try:
            client = Client(address, timeout="10s")
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler: found {address!r}, but no scheduler answers there ({error}); "
                "expected local, or an address such as tcp://127.0.0.1:8786"
            ) from error
        with client:
            yield client
        return
    with _started_deaf():
        cluster = LocalCluster(workers, threads_per_worker=1, dashboard_address=None)
    with cluster, Client(cluster) as client:
        yield client


@contextmanager
def _started_deaf() -> Iterator[None]:
    """Start processes that leave Ctrl-C to this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
