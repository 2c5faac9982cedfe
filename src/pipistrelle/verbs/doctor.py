"""`pipistrelle doctor`: the installation, with the fix of each problem."""

import os
import re
import shutil
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import pipistrelle
from pipistrelle.verbs.streams import put


def doctor(
    *,
    compile_kernels: Annotated[
        bool,
        Parameter(
            name="--compile",
            help="Compile the kernels of all estimators, with and without labels, so that no later "
            "run, slam or study waits for them; some minutes.",
        ),
    ] = False,
) -> None:
    """Print versions, folders and tools, a line each, with the fix of each problem."""
    for name, state in _findings():
        put(f"{name:<18}{state}")
    if compile_kernels:
        from pipistrelle.experiments.runs.compiling import compile_all
        from pipistrelle.jit import announce, cpu_s

        announce(None)
        began, worked = time.thread_time(), cpu_s()
        compile_all()
        took = time.thread_time() - began - (cpu_s() - worked)
        put(f"{'kernels':<18}compiled or loaded, in {took:.0f} s of processor time")


def _findings() -> Iterator[tuple[str, str]]:
    """Yield name and state of each checked part of the installation."""
    from pipistrelle.experiments.machine import cores

    yield "python", f"{sys.version.split()[0]} ({sys.executable})"
    yield "pipistrelle", f"{pipistrelle.__version__} ({Path(pipistrelle.__file__).parent})"
    yield from _libraries()
    yield "cores", str(cores())
    yield "kernel cache", os.environ["NUMBA_CACHE_DIR"]
    yield "ffmpeg", shutil.which("ffmpeg") or "not found; --animate mp4 needs it, gif does not"
    place = os.environ.get("PIPISTRELLE_DATA")
    if place is None:
        place = "not set; only tests and timings on recorded logs need it"
    elif not (Path(place) / "mrclam").is_dir():
        place += ": holds no folder mrclam; set it to the folder that does"
    yield "PIPISTRELLE_DATA", place


def _libraries() -> Iterator[tuple[str, str]]:
    """Yield name and version of each required or optional package, or the way to install it."""
    try:
        required = requires("pipistrelle") or []
    except PackageNotFoundError:
        yield "libraries", "not known: pipistrelle is not installed; python -m pip install ."
        return
    for requirement in required:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)", requirement)
        beside = f" (extra {extra[1]})" if extra else ""
        try:
            yield name, version(name) + beside
        except PackageNotFoundError:
            asked = requirement.split(";")[0].strip()
            yield name, f"not found{beside}; python -m pip install '{asked}'"
