"""What every test runs under: kernels where the package keeps them, repeatable examples."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

import pipistrelle.jit  # noqa: F401 - it chooses where kernels are kept

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile all kernels once before the whole suite: else each worker would, at the same time."""
    config = session.config
    whole = config.args_source is not pytest.Config.ArgsSource.ARGS
    if not whole or not getattr(config.option, "numprocesses", None):
        return
    if not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbc")):
        compile_all = "from pipistrelle.experiments.runs.compiling import compile_kernels as c; c()"
        subprocess.run([sys.executable, "-c", compile_all], check=False)


def pytest_collection_finish() -> None:
    """Spare the collector of garbage all that lasts for the session, and run it less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


@pytest.fixture(scope="session")
def gallery(tmp_path_factory):
    """Folders that are made once per session: `gallery("run")` holds a run, its log, its world."""
    from reference.gallery import Gallery

    base = tmp_path_factory.getbasetemp()
    pieces = Gallery(base.parent if "PYTEST_XDIST_WORKER" in os.environ else base)
    yield pieces
    pieces.check()


@pytest.fixture(scope="session")
def short_run(gallery):
    """The result folder of the paper's mission of eight frames by the EKF, three strategies."""
    return gallery("run") / "run"


@pytest.fixture(scope="session")
def short_log(gallery):
    """The log of `short_run`."""
    return gallery("run") / "log"


@pytest.fixture(scope="session")
def short_world(gallery):
    """The world of `short_run`."""
    return gallery("run") / "world"


@pytest.fixture(scope="session")
def timed_log(gallery):
    """The log of a mission with excess paths of three callers."""
    return gallery("timed") / "log"


@pytest.fixture(scope="session")
def short_tape(gallery):
    """The recording of a drive of eight frames, by sixteen microphones."""
    return gallery("tape") / "tape"


@pytest.fixture(scope="session")
def small_study(gallery):
    """A study of three worlds and thirty trials (`reference.studies.SMALL`)."""
    return gallery("study") / "study"


@pytest.fixture(scope="module")
def browser():
    """A browser; tests that need one are skipped where none is installed."""
    from reference.pages import chromium

    with chromium() as browser:
        yield browser


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the picture of missions, by the test's own patch: it is undone in order."""
    from reference.pictures import leave_out_picture

    leave_out_picture(monkeypatch)


@pytest.fixture
def real():
    """The folder of the real MRCLAM set 6, where it is at hand."""
    place = os.environ.get("PIPISTRELLE_DATA")
    if not place or not (Path(place) / "mrclam" / "MRCLAM_Dataset6").is_dir():
        pytest.skip("PIPISTRELLE_DATA names no folder that holds mrclam/MRCLAM_Dataset6")
    return Path(place) / "mrclam" / "MRCLAM_Dataset6"


@pytest.fixture
def ran(monkeypatch):
    """The worlds that are run, in order."""
    from pipistrelle.experiments.studies import study

    worlds = []
    run_world = study.run_world

    def noted(plan, iteration):
        worlds.append(iteration)
        return run_world(plan, iteration)

    monkeypatch.setattr(study, "run_world", noted)
    return worlds
