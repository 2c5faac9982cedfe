"""What every test runs under: kernels where the package keeps them, repeatable examples."""

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


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the picture of missions, by the test's own patch: it is undone in order."""
    from reference.pictures import leave_out_picture

    leave_out_picture(monkeypatch)
