"""What every way of running a study promises: the same results, to the last bit.

A new executor joins with a subclass of `ExecutorContract` that runs the study its own way.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import active_children
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from pipistrelle.config import InputError
from pipistrelle.experiments.studies import study
from pipistrelle.experiments.studies.plan import plan_text
from pipistrelle.experiments.studies.study import run_study
from pipistrelle.experiments.studies.world import done_worlds
from reference.studies import SMALL, assert_same, fatal, leftovers, lost, plan_of, results

UNTIL_KILLED = """\
import os, signal, sys
from pathlib import Path
from pipistrelle import files
from pipistrelle.experiments.studies import world as world_files
from pipistrelle.experiments.studies.plan import read_plan
from pipistrelle.experiments.studies.study import run_study

left = int(sys.argv[3])

def mortal(act, before):
    def once(path, what, **how):
        global left
        left -= 1
        if left == 0:
            before(path, what)
            os.kill(os.getpid(), signal.SIGKILL)
        act(path, what, **how)
    return once

write = files.write_down
for place in (files, world_files):
    place.write_down = mortal(write, lambda path, data: write(path, data[: len(data) // 2]))
    place.put_in_place = mortal(place.put_in_place, lambda partial, path: None)
if __name__ == "__main__":
    run_study(read_plan(Path(sys.argv[1])), Path(sys.argv[2]))
"""
"""Runs a study until its n-th operation on the disk, which is cut off by SIGKILL."""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return plan_of(tmp_path_factory.mktemp("plan"), iterations=3)


@pytest.fixture(scope="module")
def expected(plan, tmp_path_factory):
    return done_inline(plan, tmp_path_factory.mktemp("inline"))


def done_inline(plan, folder):
    """Return the results of a study run in this process, without interruption."""
    run_study(plan, folder)
    return results(folder)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "study"


def after_first(act):
    """Do something once, when the first world is done."""
    waiting = [act]

    def progress(standing):
        if standing.done and waiting:
            waiting.pop()()

    return progress


def kill_workers():
    for child in active_children():
        os.kill(child.pid, signal.SIGKILL)


class ExecutorContract:
    """Subclasses run a study; whatever happens to it, its results are those of one process."""

    def run(self, plan, folder):
        raise NotImplementedError

    def test_results_equal_a_single_process_run(self, plan, folder, expected):
        self.run(plan, folder)
        assert done_worlds(folder) == set(range(plan.iterations))
        assert_same(results(folder), expected)
        assert leftovers(folder) == []


class TestInline(ExecutorContract):
    def run(self, plan, folder):
        assert run_study(plan, folder, workers=1).done == plan.iterations


class TestThreads(ExecutorContract):
    def run(self, plan, folder):
        with ThreadPoolExecutor(2) as executor:
            assert run_study(plan, folder, executor=executor).done == plan.iterations


@pytest.mark.slow
class TestTwoProcesses(ExecutorContract):
    def run(self, plan, folder):
        assert run_study(plan, folder, workers=2).done == plan.iterations
        assert active_children() == []


class TestSharesSideBySide(ExecutorContract):
    def run(self, plan, folder):
        with ThreadPoolExecutor(2) as both:
            for standing in both.map(lambda i: run_study(plan, folder, shard=(i, 2)), range(2)):
                assert standing.done == standing.worlds


class TestTwoAtOnceOnTheSameWorlds(ExecutorContract):
    def run(self, plan, folder):
        with ThreadPoolExecutor(2) as both:
            assert [s.done for s in both.map(lambda _: run_study(plan, folder), "ab")] == 2 * [
                plan.iterations
            ]


class TestTwoProcessesKilledOnce(ExecutorContract):
    def run(self, plan, folder):
        standing = run_study(plan, folder, workers=2, progress=after_first(kill_workers))
        assert standing.done == plan.iterations
        assert set(standing.failed.values()) == {0}
        assert active_children() == []


class TestKilledInTheMiddleOfAFileAndContinued(ExecutorContract):
    operations = (5,)

    def run(self, plan, folder):
        (folder.parent / "mortal.py").write_text(UNTIL_KILLED)
        (folder.parent / "plan.toml").write_text(plan_text(plan))
        for operation in self.operations:
            words = (folder.parent / "mortal.py", folder.parent / "plan.toml", folder, operation)
            killed = subprocess.run([sys.executable, *map(str, words)], check=False)
            assert killed.returncode in (-signal.SIGKILL, 0)
        assert run_study(plan, folder).done == plan.iterations


@pytest.mark.slow
class TestKilledAtEveryOperation(TestKilledInTheMiddleOfAFileAndContinued):
    operations = tuple(range(1, 19))

    @pytest.fixture
    def plan(self, tmp_path_factory):
        return plan_of(tmp_path_factory.mktemp("plan"), iterations=5)

    @pytest.fixture
    def expected(self, plan, tmp_path_factory):
        return done_inline(plan, tmp_path_factory.mktemp("inline"))


class TestWorkersEndWithTheProcessThatIsKilled(ExecutorContract):
    def run(self, plan, folder):
        script = folder.parent / "two.py"
        script.write_text(
            "import os, signal, sys\n"
            "from pathlib import Path\n"
            "from multiprocessing import active_children\n"
            "from pipistrelle.experiments.studies.plan import read_plan\n"
            "from pipistrelle.experiments.studies.study import run_study\n"
            "def progress(standing):\n"
            "    if standing.done:\n"
            "        print(*(child.pid for child in active_children()), flush=True)\n"
            "        os.kill(os.getpid(), signal.SIGKILL)\n"
            "if __name__ == '__main__':\n"
            "    plan = read_plan(Path(sys.argv[1]))\n"
            "    run_study(plan, Path(sys.argv[2]), workers=2, progress=progress)\n"
        )
        path = folder.parent / "plan.toml"
        path.write_text(plan_text(plan))
        killed = subprocess.run(
            [sys.executable, script, path, folder],
            check=False,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert killed.returncode == -signal.SIGKILL
        workers = [int(word) for word in killed.stdout.split()]
        assert len(workers) == 2
        assert gone(workers)
        assert done_worlds(folder)
        assert run_study(plan, folder).done == plan.iterations


def gone(processes, patience=30.0):
    """Wait until processes have ended."""

    def alive(process):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        return True

    end = time.monotonic() + patience
    while any(map(alive, processes)) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(map(alive, processes))


# Processes that die of a world


class Mortal(ThreadPoolExecutor):
    """Breaks at a deadly world as a pool of processes does: nothing more can be started."""

    def submit(self, task, iteration):
        if hasattr(self, "broken"):
            raise BrokenExecutor
        future, (deadly,) = Future(), task.args
        if iteration in deadly:
            self.broken = True
            future.set_exception(BrokenExecutor())
        else:
            future.set_result([(f"world {iteration}", None)])
        return future


class Together(Mortal):
    """Ends its worlds as many at a time as it has workers; one that is deadly breaks them all."""

    def __init__(self, workers):
        super().__init__(workers)
        self.size, self.running = workers, {}

    def submit(self, task, iteration):
        if hasattr(self, "broken"):
            raise BrokenExecutor
        self.running[iteration], (deadly,) = Future(), task.args
        ended = self.running
        if len(ended) == self.size:
            self.running = {}
            for world, future in ended.items():
                if deadly & ended.keys():
                    self.broken = True
                    future.set_exception(BrokenExecutor())
                else:
                    future.set_result([(f"world {world}", None)])
        return ended[iteration]


PROCESSES = pytest.param(study._pool, marks=pytest.mark.slow, id="processes")


@pytest.mark.parametrize("pool", [Mortal, Together, PROCESSES])
def test_a_world_that_kills_its_pool_twice_is_recorded_and_the_others_are_not(monkeypatch, pool):
    monkeypatch.setattr(study, "_pool", pool)
    found = study.in_processes(partial(fatal, {3}), lost, deque(range(6)), 2)
    names = [(f"world {i}", "lost" if i == 3 else None) for i in range(6)]
    assert sorted(found) == [[name] for name in names]


@pytest.mark.parametrize("pool", [Mortal, PROCESSES])
def test_pools_that_finish_no_world_are_an_error(monkeypatch, pool):
    monkeypatch.setattr(study, "_pool", pool)
    with pytest.raises(InputError, match="their processes end before a world is done"):
        list(study.in_processes(partial(fatal, {0, 1}), lost, deque([0, 1]), 2))


def test_an_abandoned_world_counts_as_failed(plan, folder):
    study.open_store(folder, plan)
    study._kept(folder, plan, 2, study.failed_records(plan, study.KILLED))
    standing = run_study(plan, folder, shard=(2, 3))
    assert standing.failed == standing.trials
    assert standing.first_error == study.KILLED.strip()


@pytest.mark.slow  # in the fast suite a signal to a command does so (verbs/test_streams.py)
def test_an_interrupt_stops_the_workers_and_keeps_finished_worlds(plan, folder):
    def interrupt(standing):
        if standing.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(plan, folder, workers=2, progress=interrupt)
    assert active_children() == []
    assert done_worlds(folder)


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, PROCESSES])
def test_results_that_cannot_be_written_by_a_worker_end_the_study(plan, folder, monkeypatch, pool):
    monkeypatch.setattr(study, "_pool", pool)

    def spoil():
        (folder / "steps").rename(folder / "taken")
        (folder / "steps").write_text("no folder")

    said = r"could not be written \((Not a directory|No such file or directory)\)"
    with pytest.raises(InputError, match=said):
        run_study(plan, folder, workers=2, progress=after_first(spoil))
    assert active_children() == []


class Elsewhere(ThreadPoolExecutor):
    """Does all that is asked of it, on a disk of its own."""

    def submit(self, task, iteration):
        return super().submit(lost, iteration)


def test_results_written_to_another_disk_are_reported_missing(plan, folder, monkeypatch):
    monkeypatch.setattr(study, "_advanced", lambda standing, _: replace(standing, done=1))
    with (
        Elsewhere(1) as executor,
        pytest.raises(InputError, match="lacks worlds that are done; expected one folder for all"),
    ):
        run_study(plan, folder, executor=executor)


# Dask


@pytest.fixture(scope="module")
def dask():
    return pytest.importorskip("distributed", reason="Dask is not installed: the extra [cluster]")


@pytest.fixture(scope="module")
def cluster(dask, tmp_path_factory):
    """A scheduler and two workers on the loopback interface, each a process.

    The tests of Dask share it, and kill it bit by bit: first a worker, last the scheduler.
    """
    with _cluster(tmp_path_factory.mktemp("cluster")) as found:
        yield found


@contextmanager
def _cluster(folder):
    """Start a scheduler and two workers; yield the address and the processes."""
    contact = folder / "scheduler.json"
    log = (folder / "dask.log").open("w")

    def start(module, *words):
        command = [sys.executable, "-m", f"distributed.cli.{module}", "--no-dashboard", *words]
        place = ["--scheduler-file", str(contact)]
        return subprocess.Popen([*command, *place], stdout=log, stderr=log)

    started = [start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        workers = ["--host", "127.0.0.1", "--nthreads", "1", "--no-nanny"]
        started += [start("dask_worker", *workers) for _ in range(2)]
        end = time.monotonic() + 60.0
        while not (contact.exists() and contact.stat().st_size) and time.monotonic() < end:
            time.sleep(0.1)
        yield json.loads(contact.read_text())["address"], *started
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()
        log.close()


class TestDask(ExecutorContract):
    @pytest.fixture(autouse=True)
    def found(self, cluster):
        self.address, self.scheduler, *self.workers = cluster

    def run(self, plan, folder):
        standing = run_study(plan, folder, scheduler=self.address)
        assert (standing.done, set(standing.failed.values())) == (plan.iterations, {0})


MINE = """
from pipistrelle.estimation.ekf.filter import EkfSlam

class Mine:
    def from_config(config, motion):
        return EkfSlam(motion=motion, rays=config.rays)
    init = predict = update = EkfSlam.update
"""


@pytest.mark.slow
def test_workers_of_a_cluster_find_an_estimator_where_the_study_was_started(
    cluster, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "mine_of_dask.py").write_text(MINE)
    monkeypatch.chdir(tmp_path / "here")  # the cluster was started elsewhere
    plan = plan_of(tmp_path, 'filters = ["mine_of_dask:Mine"]\n' + SMALL)
    standing = run_study(plan, tmp_path / "study", scheduler=cluster[0])
    assert (standing.done, set(standing.failed.values())) == (plan.iterations, {0})


class TestDaskWithAWorkerKilled(TestDask):
    def run(self, plan, folder):
        kill = after_first(self.workers[1].kill)
        standing = run_study(plan, folder, scheduler=self.address, progress=kill)
        assert (standing.done, set(standing.failed.values())) == (plan.iterations, {0})
        assert self.workers[1].wait(10) == -signal.SIGKILL


class TestDaskLosesItsScheduler(TestDask):
    def run(self, plan, folder):
        kill = after_first(self.scheduler.kill)
        with pytest.raises(InputError, match="the cluster is gone"):
            run_study(plan, folder, scheduler=self.address, progress=kill)
        assert run_study(plan, folder).done == plan.iterations


class TestDaskOnThisMachine(ExecutorContract):
    """In threads, which start at once."""

    @pytest.fixture(autouse=True)
    def threads(self, dask, monkeypatch):
        monkeypatch.setattr(dask, "LocalCluster", partial(dask.LocalCluster, processes=False))

    def run(self, plan, folder):
        assert run_study(plan, folder, workers=2, scheduler="local").done == plan.iterations


@pytest.mark.slow
class TestDaskInProcessesOfThisMachine(TestDaskOnThisMachine):
    @pytest.fixture(autouse=True)
    def threads(self, dask):
        """Leave the processes as they are."""


INTRUDER = """\
import asyncio, sys
from distributed.core import rpc
from distributed.security import Security

async def ask(address, **held):
    async with rpc(address, timeout=3, **held) as door:
        return await asyncio.wait_for(door.identity(), 10)

for address in sys.argv[1:]:
    own = Security.temporary().get_connection_args("client")
    for where, held in ((address.replace("tls:", "tcp:"), {}), (address, {"connection_args": own})):
        try:
            print("let in at", where, asyncio.run(ask(where, **held)))
        except OSError:
            print("refused")
"""


@pytest.mark.slow
def test_a_local_cluster_refuses_other_users_of_the_machine(dask):
    with study._client("local", 1) as client:
        known = client.scheduler_info()
        ((worker, about),) = known["workers"].items()
        doors = [client.scheduler.address, worker, about["nanny"]]
        assert all(door.startswith("tls://127.0.0.1:") for door in doors)
        asked = [sys.executable, "-c", INTRUDER, *doors]
        answers = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
        assert answers.split() == ["refused"] * 6
        for port in (known["services"]["dashboard"], about["services"]["dashboard"]):
            for page in ("", "status", "info/main/workers.html", "json/counts.json"):
                with pytest.raises(HTTPError, match="404"):
                    urlopen(f"http://127.0.0.1:{port}/{page}")
        assert client.submit(sum, [1, 2]).result() == 3, "whom we know is let in"


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 3])
def test_a_cluster_that_is_started_here_has_the_workers_that_were_asked_for(workers, dask):
    with study._client("local", workers) as client:
        assert len(client.scheduler_info(n_workers=-1)["workers"]) == workers


def test_no_scheduler_at_the_address_is_an_error(plan, folder, dask):
    with pytest.raises(InputError, match="--scheduler: found 'nowhere', but no scheduler answers"):
        run_study(plan, folder, scheduler="nowhere")


@pytest.mark.slow
def test_a_world_that_kills_every_worker_of_a_cluster_is_recorded_and_the_others_are_not(dask):
    found = study.on_cluster(partial(fatal, {1}), lost, deque(range(3)), 2, "local")
    assert sorted(found) == [[("world 0", None)], [("world 1", "lost")], [("world 2", None)]]
