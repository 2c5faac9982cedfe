"""Executors: worlds in this machine's processes, or on a Dask cluster."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import contextmanager
from typing import Any

from pipistrelle.config import InputError
from pipistrelle.experiments.studies.world import EndedTrial

AHEAD = 1000
"""Worlds handed to a cluster before the first of them is done."""

_NO_PAGES = {f"distributed.{who}.http.routes": [] for who in ("scheduler", "worker")}
"""Settings of a local cluster: Dask's web pages are off."""


Task = Callable[[int], list[EndedTrial]]
"""Computes a world, writes its results, and tells how its trials ended."""
Ended = tuple[int, "Future[list[EndedTrial]]"]
"""A world that has ended, and the future of its trials."""
Results = Generator[list[EndedTrial], None, None]
"""The trials of one world after another, in the order in which they end."""


def ended(executor: Executor, task: Task, waiting: deque[int], ahead: int) -> Iterator[Ended]:
    """Keep an executor busy, and yield each world that has ended, with the future of its trials.

    At most `ahead` worlds are handed over before the first of them has ended. Once the executor is
    broken, no more is handed to it, and what is left stays in ``waiting``.

    >>> from concurrent.futures import ThreadPoolExecutor
    >>> def task(world):
    ...     return [EndedTrial("fused", None if world else "at sea")]
    >>> with ThreadPoolExecutor() as pool:
    ...     [(world, its.result()[0].error) for world, its in ended(pool, task, deque([3, 0]), 1)]
    [(3, None), (0, 'at sea')]
    """
    running: dict[Future[list[EndedTrial]], int] = {}
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


def in_processes(task: Task, give_up: Task, waiting: deque[int], workers: int) -> Results:
    """Run worlds in spawned processes, and yield the ended trials of one world after another.

    Worlds in processes that die are tried again, one at a time; `give_up` is called for a world
    whose process has died twice.
    """
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
) -> Generator[list[EndedTrial], None, bool]:
    """Run worlds until a process dies; yield those that were running then, return if any ended."""
    alive = False
    with _pool(min(workers, len(waiting))) as pool:
        for iteration, future in ended(pool, task, waiting, workers):
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

    class Pool(ProcessPoolExecutor):
        """A pool whose processes ignore Ctrl-C from their start, and start as tasks come."""

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
    """Defer Ctrl-C; a process that is started meanwhile ignores it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _become_worker() -> None:
    """Ignore Ctrl-C in a worker, and end it when its parent process is gone."""
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
    """Run worlds on Dask's workers, and yield the ended trials of one world after another.

    The address is that of a scheduler, or "local" for a cluster of so many workers on this machine.
    Dask itself tries again what a dead worker leaves; `give_up` is called for a world that it no
    longer tries.
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
    """Refuse a cluster where Dask is not installed."""
    try:
        import cryptography  # noqa: F401  (Dask asks for it when it makes certificates)
        import dask  # noqa: F401
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"--scheduler {address}: needs Dask, which is not installed; "
            "python -m pip install 'pipistrelle[cluster]'"
        ) from error


@contextmanager
def _client(address: str, workers: int) -> Iterator[Any]:
    """Connect to a cluster, one on this machine if none is named."""
    from dask import config as dask_config
    from distributed import Client, LocalCluster

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
    with _started_deaf(), dask_config.set(_NO_PAGES):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            security=True,  # certificates of its own: who does not hold them is not listened to
            dashboard_address="127.0.0.1:0",  # 8787 may be taken
            worker_dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
        )
    with cluster, Client(cluster) as client:
        yield client


@contextmanager
def _started_deaf() -> Iterator[None]:
    """Start processes that ignore Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
