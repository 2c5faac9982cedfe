"""Where compiled kernels are kept, in an install that cannot be written to as in any other."""

import io
import os
import shutil
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

from pipistrelle import kernel_folder
from pipistrelle.jit import COMPILING
from pipistrelle.kernel_folder import sources_key

PACKAGE = Path(kernel_folder.__file__).parent
SHOW = (
    "import os; from pipistrelle.kernel_folder import place_kernels; place_kernels(); "
    "print(os.environ['NUMBA_CACHE_DIR'])"
)
"""Choose the folder as `pipistrelle.jit` does, without Numba, which takes ten times as long."""
COMPILE = (
    "import os, pipistrelle.jit; print(os.environ['NUMBA_CACHE_DIR']); "
    "from pipistrelle.geometry import wrap_angle; wrap_angle(4.0)"
)
WIDE = "import os; os.umask(0o002); "
TURNED = "import sys; " + COMPILE.replace(
    "wrap_angle(4.0)", "print(wrap_angle(4.0), file=sys.stderr)"
)
NOWHERE = os.devnull + "/home"  # no folder can be made in a file, not even by root


def place(tmp_path: Path, code: str = SHOW, **environment: str) -> tuple[Path, list[str]]:
    """Return the folder that a fresh process chooses and the lines that it prints to stderr."""
    (tmp_path / "tmp").mkdir(exist_ok=True)
    unset = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    inherited |= {"HOME": str(tmp_path), "TMPDIR": str(tmp_path / "tmp")} | environment
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=inherited,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    return Path(done.stdout.strip()), done.stderr.splitlines()


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A home in which a process of a wide umask compiled a kernel, and what it printed."""
    home = tmp_path_factory.mktemp("home")
    (home / ".cache" / "pipistrelle").mkdir(parents=True)
    (home / ".cache" / "pipistrelle").chmod(0o775)
    return home, *place(home, WIDE + TURNED)


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


@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "NUMBA_CACHE_DIR"])
def test_a_link_to_itself_is_no_place_for_kernels(tmp_path, variable):
    (tmp_path / "loop").symlink_to("loop")
    folder, said = place(tmp_path, **{variable: str(tmp_path / "loop")})
    assert folder == tmp_path / "tmp" / f"pipistrelle-{os.getuid()}" / sources_key()
    assert len(said) == 1
    assert "loop" in said[0]


def test_a_folder_of_ones_own_is_made_in_that_which_the_user_names(tmp_path):
    folder, said = place(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    own = tmp_path / "mine" / f"pipistrelle-{os.getuid()}"
    assert (folder, said) == (own / sources_key(), [])


@pytest.mark.parametrize("variable", ["HOME", "NUMBA_CACHE_DIR", "TMPDIR"])
def test_a_process_that_is_started_by_another_takes_the_same_folder(tmp_path, variable):
    again = "import subprocess, sys; print(subprocess.check_output([sys.executable, '-c', "
    code = f"{SHOW}; {again}{SHOW!r}], text=True))"
    places = {"TMPDIR": {"HOME": NOWHERE}, "HOME": {}}.get(
        variable, {variable: str(tmp_path / "mine")}
    )
    if variable == "TMPDIR":  # of which a new one is made each time
        (tmp_path / "tmp").mkdir()
        (tmp_path / "tmp" / f"pipistrelle-{os.getuid()}").write_text("")
    found, said = place(tmp_path, code, **places)
    first, second = str(found).split("\n")
    assert first == second
    assert len(said) == (variable == "TMPDIR")


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


def test_the_key_changes_only_with_files_that_have_kernels(tmp_path, monkeypatch):
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
    """Flip bits of two hundred bytes in the middle."""
    middle = len(data) // 2
    return (
        data[: middle - 100]
        + bytes(b ^ 0x5A for b in data[middle - 100 : middle + 100])
        + data[middle + 100 :]
    )


def emptied(_: bytes) -> bytes:
    return b""


PIPE = "a pipe that nobody writes into"
AT_NIGHT = [("nbi", cut), ("nbi", flipped), ("nbi", emptied), ("nbc", cut), ("nbc", emptied)]


@pytest.mark.parametrize(
    ("kind", "damage"),
    [
        pytest.param("nbi", PIPE, marks=pytest.mark.skipif(os.name != "posix", reason="pipes")),
        ("nbc", flipped),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in AT_NIGHT),
    ],
)
def test_a_damaged_file_is_replaced_by_compiling_again(compiled, tmp_path, kind, damage):
    home, folder, said = compiled
    shutil.copytree(home / ".cache", tmp_path / ".cache")
    folder = tmp_path / folder.relative_to(home)
    kept = sorted(folder.rglob(f"*.{kind}"))
    assert kept
    for path in kept:
        data = path.read_bytes()
        path.unlink()
        if damage is PIPE:
            os.mkfifo(path)
        else:
            path.write_bytes(damage(data))
    _, again = place(tmp_path, TURNED)
    damaged = [line for line in again if "compiled kernels were damaged" in line]
    assert len(damaged) == 1
    assert str(folder) in damaged[0]
    assert [line for line in again if line not in damaged] == said
    assert said[0] == COMPILING
    assert place(tmp_path, TURNED)[1] == said[1:], "the new kernel was kept"


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_a_cache_that_others_can_write_is_not_trusted(tmp_path, mode):
    mine, _ = place(tmp_path)
    assert mine.stat().st_mode & 0o077 == 0
    mine.chmod(mode)
    folder, said = place(tmp_path)
    assert folder.is_relative_to(tmp_path / "tmp")
    assert f"{mine} can be written by others" in said[0]


def of_group(folder: Path) -> Path:
    """Give a folder to a group of other users; skip if this process may not."""
    try:
        os.chown(folder, -1, 3000)
    except PermissionError:
        pytest.skip("only root gives a folder to a group of others")
    return folder


UNSAFE = {
    "a link": lambda parent, own: own.symlink_to(parent.mkdir() or parent),
    "a link to a folder of one's own": lambda parent, own: own.symlink_to(
        (own.parent / "kept").mkdir(0o700) or own.parent / "kept"
    ),
    "writable by all": lambda parent, own: parent.chmod(0o777),
    "writable by a group": lambda parent, own: of_group(parent).chmod(0o775),
    "of another user": lambda parent, own: os.chown(parent, 2002, 3000),
    "with another user's in it": lambda parent, own: os.chown(own.mkdir(0o700) or own, 2002, -1),
    "with a folder that a group can write": lambda parent, own: (
        (own / sources_key() / "arrays_1").mkdir(parents=True),
        own.chmod(0o700),
        of_group(own / sources_key() / "arrays_1").chmod(0o775),
    ),
    "with a link in it": lambda parent, own: (
        (own / sources_key()).mkdir(parents=True),
        own.chmod(0o700),
        (own / sources_key() / "arrays_1").symlink_to(own.parent, target_is_directory=True),
    ),
}


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
@pytest.mark.parametrize("what", UNSAFE)
@pytest.mark.parametrize("below", ["", "deeper"])
def test_a_folder_writable_by_others_is_not_used(tmp_path, what, below):
    parent = tmp_path / "shared"
    chosen = parent / below
    own = chosen / f"pipistrelle-{os.getuid()}"
    if what == "a link":
        parent, chosen = tmp_path / "elsewhere", tmp_path / "shared"
        own = chosen / f"pipistrelle-{os.getuid()}"
        chosen.mkdir()
    chosen.mkdir(parents=True, exist_ok=True)
    try:
        UNSAFE[what](parent, own)
    except PermissionError:
        pytest.skip("only root makes a folder of another user")
    folder, said = place(tmp_path, NUMBA_CACHE_DIR=str(chosen))
    assert folder.is_relative_to(tmp_path / "tmp")
    assert len(said) == 1
    assert "set NUMBA_CACHE_DIR to a folder of your own" in said[0]


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
def test_a_subfolder_that_another_process_removes_meanwhile_is_no_danger(tmp_path, monkeypatch):
    passing = tmp_path / "own" / "kernels" / "arrays_1"
    passing.mkdir(parents=True)
    monkeypatch.setattr(Path, "is_dir", lambda folder: folder.rmdir() is None)
    assert kernel_folder._open_to_others(passing.parent) is None
    assert not passing.exists()


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
def test_a_shared_folder_with_the_sticky_bit_is_used(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    folder, said = place(tmp_path, NUMBA_CACHE_DIR=str(shared))
    assert (folder.parent.parent, said) == (shared, [])
    assert folder.parent.stat().st_mode & 0o077 == 0


@pytest.mark.skipif(os.name != "posix", reason="permissions are of another kind there")
def test_all_that_is_made_for_kernels_is_closed_to_others(compiled, tmp_path):
    home, folder, said = compiled
    made = [folder.parent, folder, *(one for one in folder.iterdir() if one.is_dir())]
    assert len(made) > 2
    assert place(home, WIDE + TURNED) == (folder, said[1:]), "it is trusted: nothing is compiled"
    new = {"NUMBA_CACHE_DIR": str(tmp_path / "new" / "mine")}
    folder, said = place(tmp_path, WIDE + SHOW, **new)
    assert said == []
    made += [folder.parent, folder]
    assert [one.stat().st_mode & 0o077 for one in made] == [0] * len(made)
    assert place(tmp_path, WIDE + SHOW, **new) == (folder, [])


@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="needs a second user")
def test_kernels_of_another_user_of_the_group_are_not_run(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    of_group(shared).chmod(0o755)
    grouped = "import os; os.setegid(3000); os.umask(0o002); "
    folder, _ = place(tmp_path, grouped + COMPILE, NUMBA_CACHE_DIR=str(shared))
    index = next(folder.rglob("*.nbi"))
    planting = (
        f"import os; os.setgid(3000); os.setuid(2002); open({str(index)!r}, 'wb').write(b'planted')"
    )
    for one in tmp_path.parents[:-2]:
        one.chmod(0o755)
    tmp_path.chmod(0o755)
    done = subprocess.run([sys.executable, "-c", planting], capture_output=True, text=True)
    assert "PermissionError" in done.stderr
    assert not index.read_bytes().startswith(b"planted")


def test_a_cache_without_room_is_not_taken(tmp_path):
    full = "import shutil; shutil.disk_usage = lambda _: shutil._ntuple_diskusage(9, 9, 0); "
    folder, said = place(tmp_path, full + SHOW)
    assert folder.is_relative_to(tmp_path / "tmp")
    assert "has too little room" in said[0]


def test_kernels_that_cannot_be_kept_are_still_compiled(tmp_path):
    full = (
        "import numba.core.caching as c\n"
        "def full(*_): raise OSError(28, 'No space left on device')\n"
        "c.IndexDataCacheFile.save = full\n"
    )
    other = "\nfrom pipistrelle.arithmetic.elementary import exponential; exponential(4.0)"
    folder, said = place(tmp_path, full + COMPILE + other)
    assert said[0] == COMPILING
    assert len(said) == 2, "said once, whatever number of rooms has kernels"
    assert f"{folder}: compiled kernels could not be kept (No space left on device)" in said[1]


def code_of(text: bytes) -> list[tuple[int, str]]:
    """Return the tokens of a source that are code, without any text in three quotes."""
    layout = {tokenize.NL, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT, tokenize.NEWLINE}
    return [
        (token.type, token.string)
        for token in tokenize.tokenize(io.BytesIO(text).readline)
        if token.type not in layout and not token.string.startswith(('"""', 'r"""'))
    ]


def test_the_key_of_kernels_depends_on_all_code_and_on_nothing_else():
    sources = [path.read_bytes() for path in PACKAGE.rglob("*.py")]
    compiled = [text for text in sources if b"jit" in text]
    assert len(compiled) > 40
    for text in compiled:
        kept = kernel_folder._NO_CODE.sub(b"", text)
        assert code_of(kept) == code_of(text)
        assert kept.count(b"\n") < text.count(b"\n")


def test_kernels_are_shared_by_copies_of_the_package_with_other_docstrings(tmp_path):
    copies = [tmp_path / name / "pipistrelle" for name in ("first", "second")]
    for copy in copies:
        shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__", "*.toml"))
    geometry = copies[1] / "geometry.py"
    geometry.write_text('"""Other words.\n\nAnd more."""\n# A remark.\n' + geometry.read_text())
    folders, said = zip(
        *(place(tmp_path, COMPILE, PYTHONPATH=str(copy.parent)) for copy in copies), strict=True
    )
    assert folders[0] == folders[1]
    assert (said[0][0], said[1]) == (COMPILING, [])
