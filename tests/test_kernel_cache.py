"""Where compiled kernels are kept, in an install that cannot be written to as in any other."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipistrelle import kernel_folder
from pipistrelle.kernel_clock import COMPILING
from pipistrelle.kernel_folder import sources_key

SHOW = "import os, pipistrelle.jit; print(os.environ['NUMBA_CACHE_DIR'])"
COMPILE = SHOW + "; from pipistrelle.geometry import wrap_angle; wrap_angle(4.0)"
NOWHERE = os.devnull + "/home"  # no folder can be made in a file, not even by root


def place(tmp_path: Path, code: str = SHOW, **environment: str) -> tuple[Path, list[str]]:
    """The folder that a fresh process chooses, and what it says about it."""
    (tmp_path / "tmp").mkdir(exist_ok=True)
    unset = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    inherited |= {"HOME": str(tmp_path), "TMPDIR": str(tmp_path / "tmp")} | environment
    done = subprocess.run(
        [sys.executable, "-c", code], env=inherited, capture_output=True, text=True, check=True
    )
    return Path(done.stdout.strip()), done.stderr.splitlines()


def test_kernels_are_kept_in_the_users_cache_by_the_state_of_the_sources(tmp_path):
    folder, said = place(tmp_path)
    assert folder == tmp_path / ".cache" / "pipistrelle" / sources_key()
    assert said == []


def test_importing_the_package_makes_no_folder_and_sets_no_variable(tmp_path):
    code = "import os, pipistrelle, pipistrelle.config; print('NUMBA_CACHE_DIR' in os.environ)"
    assert place(tmp_path, code) == (Path("False"), [])
    assert not (tmp_path / ".cache").exists()


def test_relative_cache_folder_of_the_desktop_is_not_taken(tmp_path):
    assert place(tmp_path, XDG_CACHE_HOME="here") == place(tmp_path)


def test_folder_that_the_user_names_is_taken(tmp_path):
    folder, said = place(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert (folder, said) == (tmp_path / "mine", [])


def test_numba_imported_before_keeps_them_there_too(tmp_path):
    folder, _ = place(tmp_path, "import numba; " + COMPILE)
    assert folder == tmp_path / ".cache" / "pipistrelle" / sources_key()
    assert list(folder.rglob("*.nbc"))


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"])
def test_a_temporary_folder_is_taken_where_nothing_else_can_be_written(tmp_path, variable):
    folder, said = place(tmp_path, **{variable: NOWHERE})
    assert folder == tmp_path / "tmp" / f"pipistrelle-{os.getuid()}" / sources_key()
    assert len(said) == 1
    assert NOWHERE in said[0]
    assert str(folder) in said[0]
    assert place(tmp_path, **{variable: NOWHERE})[0] == folder


@pytest.mark.parametrize(
    "variable",
    [
        "HOME",
        *(pytest.param(v, marks=pytest.mark.slow) for v in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")),
    ],
)
def test_kernels_are_kept_in_the_temporary_folder(tmp_path, variable):
    folder, _ = place(tmp_path, COMPILE, **{variable: NOWHERE})
    assert list(folder.rglob("*.nbc"))


def test_temporary_folder_that_others_can_write_is_not_trusted(tmp_path):
    others = tmp_path / "tmp" / f"pipistrelle-{os.getuid()}"
    others.mkdir(parents=True)
    others.chmod(0o777)
    folder, _ = place(tmp_path, HOME=NOWHERE)
    assert others not in folder.parents
    assert folder.parent.stat().st_mode & 0o077 == 0


def test_key_changes_with_a_kernel_and_not_with_what_compiles_none(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_folder, "__file__", str(tmp_path / "kernel_folder.py"))
    (tmp_path / "kernel.py").write_text("from numba import njit\n")
    (tmp_path / "plain.py").write_text("")
    before = sources_key()
    (tmp_path / "plain.py").write_text("one = 1\n")
    assert sources_key() == before
    (tmp_path / "kernel.py").write_text("from numba import njit  # changed\n")
    assert sources_key() != before


def test_kernels_of_the_states_used_last_are_kept_and_nothing_else_is_touched(tmp_path):
    home = tmp_path / ".cache" / "pipistrelle"
    states = [home / f"{n:016x}" for n in range(6)]
    for age, state in enumerate(states):
        (state / "kernel.nbc").mkdir(parents=True)
        os.utime(state, (1e9 - age, 1e9 - age))
    (home / "notes").mkdir()
    folder, said = place(tmp_path)
    assert {path.name for path in home.iterdir()} == {
        folder.name, "notes", *(state.name for state in states[:2])
    }  # fmt: skip
    assert said == []


def test_folder_that_the_user_names_is_not_cleared(tmp_path):
    states = [tmp_path / "mine" / f"{n:016x}" for n in range(6)]
    for state in states:
        state.mkdir(parents=True)
    place(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "mine" / f"{0:016x}"))
    assert all(state.is_dir() for state in states)


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    """Two hundred bytes in the middle are others."""
    middle = len(data) // 2
    return (
        data[: middle - 100]
        + bytes(b ^ 0x5A for b in data[middle - 100 : middle + 100])
        + data[middle + 100 :]
    )


def emptied(_: bytes) -> bytes:
    return b""


AT_NIGHT = [("nbi", flipped), ("nbi", emptied), ("nbc", cut), ("nbc", emptied)]


@pytest.mark.parametrize(
    ("kind", "damage"),
    [
        ("nbi", cut),
        ("nbc", flipped),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in AT_NIGHT),
    ],
)
def test_a_damaged_file_is_thrown_away_and_its_kernel_compiled_anew(tmp_path, kind, damage):
    turned = COMPILE.replace("wrap_angle(4.0)", "print(wrap_angle(4.0), file=sys.stderr)")
    folder, said = place(tmp_path, "import sys; " + turned)
    kept = sorted(folder.rglob(f"*.{kind}"))
    assert kept
    for path in kept:
        path.write_bytes(damage(path.read_bytes()))
    _, again = place(tmp_path, "import sys; " + turned)
    damaged = [line for line in again if "a compiled kernel was damaged" in line]
    assert len(damaged) == 1
    assert str(folder) in damaged[0]
    assert [line for line in again if line not in damaged] == said
    assert said[0] == COMPILING
    assert place(tmp_path, "import sys; " + turned)[1] == said[1:], "it was kept anew"


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_a_cache_that_others_can_write_is_not_trusted(tmp_path, mode):
    mine, _ = place(tmp_path)
    assert mine.stat().st_mode & 0o077 == 0
    mine.chmod(mode)
    folder, said = place(tmp_path)
    assert folder.is_relative_to(tmp_path / "tmp")
    assert f"{mine} can be written by others" in said[0]
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    theirs.chmod(mode)
    assert "can be written by others" in place(tmp_path, NUMBA_CACHE_DIR=str(theirs))[1][0]


def test_a_cache_without_room_is_not_taken(tmp_path):
    full = "import shutil; shutil.disk_usage = lambda _: shutil._ntuple_diskusage(9, 9, 0); "
    folder, said = place(tmp_path, full + SHOW)
    assert folder.is_relative_to(tmp_path / "tmp")
    assert "has too little room" in said[0]


def test_what_cannot_be_kept_is_compiled_all_the_same(tmp_path):
    full = (
        "import numba.core.caching as c\n"
        "def full(*_): raise OSError(28, 'No space left on device')\n"
        "c.IndexDataCacheFile.save = full\n"
    )
    _, said = place(tmp_path, full + COMPILE)
    assert said[0] == COMPILING
    assert len(said) == 2
    assert "compiled kernels could not be kept (No space left on device)" in said[1]
