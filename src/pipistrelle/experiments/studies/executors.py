"""Executors of a study: worlds computed in this machine's processes, or on a Dask cluster."""

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
from pipistrelle.experiments.studies.world import Outcome

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
        raise InputError(
            f"--scheduler {address}: needs Dask, which is not installed; "
            "python -m pip install dask distributed cryptography"
        ) from error


@contextmanager
def _client(address: str, workers: int) -> Iterator[Any]:
    """Connect to a Dask scheduler, or start a cluster on this machine for the address "local"."""
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
            security=True,  # certificates of this cluster; other clients are rejected
            dashboard_address="127.0.0.1:0",  # 8787 may be taken
            worker_dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
        )
    with cluster, Client(cluster) as client:
        yield client


@contextmanager
def _started_deaf() -> Iterator[None]:
    """Ignore Ctrl-C while the context's body runs; processes started in it inherit this."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
