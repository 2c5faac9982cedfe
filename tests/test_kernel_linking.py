"""Kernels that kernels call are linked: the same numbers as by Numba alone, and no code twice."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit

from pipistrelle.jit import kernel
from pipistrelle.kernel_linking import TESTED

LINES = """
import numpy as np
from pipistrelle.jit import kernel

@kernel
def halved(x):
    return 0.5 * x if x > 1.0 else x

@kernel
def rows(array):
    found = np.empty(len(array))
    for i in range(len(array)):
        found[i] = halved(array[i]) + halved(array[i] * array[i])
    return found
"""
SHOW = "print(rows(np.array([0.1, 3.0, np.inf])).tobytes().hex(), rows.stats.cache_hits)"


@kernel
def power(x: float, n: int) -> float:
    """Be compiled for two types."""
    product = 1.0
    for _ in range(n):
        product *= x
    return product


@kernel
def filled(n: int, value: float) -> np.ndarray:
    """Allocate, which needs Numba's counting of references."""
    return np.full(n, value)


@kernel
def mixed(values: np.ndarray) -> tuple[float, np.ndarray]:
    """Call the others."""
    total, many = 0.0, filled(values.size, 0.1)
    for i in range(values.size):
        many[i] += math.sin(values[i]) / power(values[i], 3) + power(1, i)
        total += many[i]
    return total, many


@kernel
def refuses(n: int) -> int:
    """Raise, which needs the kernel's own constants."""
    if n < 0:
        raise ValueError("a negative count")
    return n


@kernel
def asks(n: int) -> int:
    """Call what raises."""
    return refuses(n) + 1


def by_numba_alone(function):
    """Compile a kernel's function and all that it calls as Numba does by itself."""
    python = function.py_func
    called = {
        name: by_numba_alone(value)
        for name, value in python.__globals__.items()
        if name in python.__code__.co_names and hasattr(value, "py_func")
    }
    own = type(python)(python.__code__, {**python.__globals__, **called}, python.__name__)
    return njit(error_model="numpy")(own)


def test_linked_kernels_give_the_bits_of_plain_numba():
    values = np.random.default_rng(0).standard_normal(1000)
    values[::50], values[7] = 0.0, np.nan
    ours, alone = mixed(values), by_numba_alone(mixed)(values)
    assert np.float64(ours[0]).tobytes() == np.float64(alone[0]).tobytes()
    assert ours[1].tobytes() == alone[1].tobytes()


def test_an_error_within_a_linked_kernel_reaches_python():
    assert asks(3) == 4
    with pytest.raises(ValueError, match="a negative count"):
        asks(-1)


def test_a_kernel_that_is_called_has_no_machine_code_but_within_its_caller():
    mixed(np.ones(3))
    assert not filled.signatures
    assert filled(2, 0.5).tolist() == [0.5, 0.5]
    assert filled.signatures


def test_linked_kernels_are_the_same_from_the_cache_of_another_process(tmp_path):
    (tmp_path / "kernels_of_a_test.py").write_text(LINES)
    command = [sys.executable, "-c", f"from kernels_of_a_test import *; {SHOW}"]
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)}
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert first.split()[0] == second.split()[0]
    assert first.split(maxsplit=1)[1].strip() == "Counter()"
    assert second.split(maxsplit=1)[1].count(": 1") == 1


HIDE = """
import builtins
whole = builtins.__import__

def lacking(name, globals=None, locals=None, fromlist=(), level=0):
    if str((globals or {{}}).get("__name__")).startswith("pipistrelle"):
        if {name!r} in (name, *(f"{{name}}.{{one}}" for one in fromlist or ())):
            raise ImportError(name)
    return whole(name, globals, locals, fromlist, level)

builtins.__import__ = lacking
"""
NEWER = """
import numba
from numba.core.codegen import JITCodeLibrary

def fails(self):
    if type(self).__module__.startswith("pipistrelle"):
        raise AttributeError("object caching")
    return whole(self)

whole, JITCodeLibrary.enable_object_caching = JITCodeLibrary.enable_object_caching, fails
numba.version_info = numba.version_info._replace(short=(0, 99))
"""
LACKING = {
    "a class": HIDE.format(name="numba.core.caching"),
    "a module": HIDE.format(name="numba.core.environment"),
    "its events": HIDE.format(name="numba.core.event"),
    "a method, of a newer version": NEWER,
}


def by_a_numba_that_lacks(what, tmp_path, words, code):
    """Run code, or the command line, in a process whose Numba lacks something."""
    (tmp_path / "sitecustomize.py").write_text(LACKING[what])
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)}
    return subprocess.run(
        [sys.executable, *words] if words else [sys.executable, "-c", code],
        env=os.environ | environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    "what", [pytest.param(w, marks=pytest.mark.slow) if w == "a module" else w for w in LACKING]
)
def test_kernels_work_without_numbas_private_parts(tmp_path, what):
    (tmp_path / "linked.py").write_text(LINES)
    code = f"from linked import rows, np; {SHOW.split(', rows.stats')[0]})"
    done = by_a_numba_that_lacks(what, tmp_path, [], code)
    wanted = np.array([0.1 + 0.1 * 0.1, 1.5 + 4.5, np.inf]).tobytes().hex()
    assert done.stdout == wanted + "\n", done.stderr
    lines = [line for line in done.stderr.splitlines() if "Compiling the kernels" not in line]
    if what == "its events":
        assert lines == []
        return
    assert len(lines) == 1
    assert lines[0].startswith(f"pipistrelle: Numba {numba.__version__} is not as those")
    assert "takes longer" in lines[0]
    assert list((tmp_path / "kept").rglob("*.nbc")), "it is kept, in a folder of one's own"
    again = by_a_numba_that_lacks(what, tmp_path, [], code)
    assert (again.stdout, len(again.stderr.splitlines())) == (done.stdout, 1)


@pytest.mark.slow
def test_a_mission_is_the_same_without_numbas_private_parts(tmp_path):
    run = ["-m", "pipistrelle", "run", "--duration", "2", "--filter", "ekf", "--quiet", "-o"]
    assert subprocess.run([sys.executable, *run, str(tmp_path / "as_it_is")]).returncode == 0
    done = by_a_numba_that_lacks("a class", tmp_path, [*run, str(tmp_path / "plain")], "")
    assert done.returncode == 0, done.stderr
    assert sum("is not as those that were tested" in one for one in done.stderr.splitlines()) == 1
    tracks = sorted((tmp_path / "as_it_is").glob("*.tum"))
    assert len(tracks) > 2
    for track in tracks:
        assert track.read_bytes() == (tmp_path / "plain" / track.name).read_bytes()


def test_the_newest_numba_that_is_allowed_is_the_newest_that_was_tested():
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    major, minor = TESTED
    assert f'"numba>=0.61,<{major}.{minor + 1}"' in text
