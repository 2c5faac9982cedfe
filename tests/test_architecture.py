"""The house keeps its own laws: contracts, rooms, short functions, doors, what no file may hold."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "pipistrelle"
SOURCES = sorted(PACKAGE.rglob("*.py"))
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))

# Written so that this file does not hold what it looks for.
REGISTRIES = re.compile(
    r"[p]y[p]i\.(?:org|io)|[p]ython[h]osted|[n]pm[j]s\.|[c]rates\.io|[d]ocker\.io|[d]ebian\.org"
    r"|[c]onda\.anaconda|[a]naconda\.org|proxy\.[g]olang",
    re.IGNORECASE,
)
MACHINES = re.compile(r"(?<![\w.~])/(?:[w]ork|[r]oot|[t]mp|[h]ome|[U]sers|[m]nt)/\w|\b[C]:\\\\?\w")


def tracked() -> list[Path]:
    """List the files of the repository, those included that are not committed yet."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return [ROOT / name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def nodes() -> list[tuple[Path, ast.AST]]:
    """Functions and calls of all modules, with their files."""
    trees = ((path, ast.parse(path.read_text(encoding="utf-8"))) for path in SOURCES)
    wanted = (ast.FunctionDef, ast.Call)
    return [(path, n) for path, tree in trees for n in ast.walk(tree) if isinstance(n, wanted)]


def body_lines(function: ast.FunctionDef) -> int:
    """Count the lines of a function without its signature and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_the_import_contracts_are_kept():
    linter = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([linter], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_contributing_lists_the_rooms_with_their_docstrings():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", page, re.MULTILINE)
    doors = {room: import_module(f"pipistrelle.{room}").__doc__ or "" for room in ROOMS}
    assert rows == [(room, doc.splitlines()[0] if doc else "") for room, doc in doors.items()]
    assert all(doors.values()), "every room says what it is"


def offered(room: str) -> list[str]:
    """Return the names that a room exports."""
    door = import_module(f"pipistrelle.{room}")
    names = [name for name in dir(door) if not name.startswith("_") and name != "import_module"]
    return [name for name in names if not isinstance(getattr(door, name), ModuleType)]


def test_a_room_exports_at_most_eight_names():
    assert {room: names for room in ROOMS if len(names := offered(room)) > 8} == {}


def most_lines(function: ast.FunctionDef) -> int:
    """Return how long the body of a function may be."""
    compiled = {"kernel", "inlined", "no_alloc", "no_alloc_inlined", "optimised_once"}
    marks = {part.id for part in function.decorator_list if isinstance(part, ast.Name)}
    return 90 if marks & compiled else 60


def test_the_body_of_a_function_fits_on_a_screen(nodes):
    functions = [(path.name, node) for path, node in nodes if isinstance(node, ast.FunctionDef)]
    long = [(name, f.name) for name, f in functions if body_lines(f) > most_lines(f)]
    assert functions
    assert long == []


def test_no_module_has_a_catch_all_name():
    drawers = {"utils", "util", "common", "helpers", "helper", "manager", "misc"}
    assert [path for path in SOURCES if path.stem in drawers] == []


DISK = {
    *("read_bytes", "read_text", "open", "loadtxt", "scan_parquet"),
    *("write_bytes", "write_text", "unlink", "rename", "symlink_to", "rmtree", "rmdir"),
}
"""Methods that read, write or remove files."""
AT_THE_DISK = {
    "experiments/machine.py": {"read_text"},  # of the system: how much memory a process may have
    "experiments/results/writing.py": {"symlink_to", "unlink"},  # runs/latest
    "experiments/results/reading.py": {"loadtxt"},  # of bytes that were read
    "experiments/runs/replay.py": {"open"},  # sums of a log's files, of ordinary ones alone
    "experiments/studies/study.py": {"unlink"},  # what a killed writer left, by its name
    "experiments/studies/world.py": {"rename", "scan_parquet", "unlink"},  # columns; checked; left
    "detection/sounds/sound_file.py": {"open"},  # a few bytes of an ordinary file
    "detection/logs/bag.py": {"open"},  # of a compressed file that rosbags has opened
    "figures/style.py": {"read_text", "write_bytes"},  # our own pages; pictures in a new folder
    "files.py": {"read_bytes", "read_text", "open", "unlink", "rmdir"},
    "kernel_linking.py": {"read_bytes", "unlink", "rmdir"},  # our own cache
    "kernel_folder.py": {"read_bytes", "rmtree", "open"},  # a file that is locked is opened
    "verbs/streams.py": {"open"},  # /dev/null
    "version.py": {"read_text"},  # our own pyproject.toml
}


def test_files_are_read_and_written_through_one_door_but_where_a_reason_is_given(nodes):
    found: dict[str, set[str]] = {}
    for path, node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, (ast.Attribute, ast.Name)):
            named = isinstance(node.func, ast.Name)
            name = node.func.id if named else node.func.attr
            if name in DISK and not (named and name == "read_text"):
                found.setdefault(path.relative_to(PACKAGE).as_posix(), set()).add(name)
    assert found == AT_THE_DISK


def test_tests_make_their_scans_and_maps_in_one_place():
    made = re.compile(r"^(?!\s*(?:class|def)\b).*\b(?:Scan|Landmarks)\(", re.MULTILINE)
    tests = [path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__)]
    makers = {path for path in tests if made.search(path.read_text(encoding="utf-8"))}
    assert makers == {ROOT / "tests" / "reference" / "missions.py"}


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a clone")
def test_no_file_names_a_registry_or_a_machine():
    found = []
    for path in tracked():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        for number, line in enumerate(text.splitlines(), start=1):
            if REGISTRIES.search(line) or MACHINES.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}")
    assert found == []


@pytest.mark.parametrize("text", ["https://{}/simple", "index = {}"])
def test_registries_and_machines_would_be_seen(text):
    assert REGISTRIES.search(text.format("py" + "pi.org"))
    assert MACHINES.search(text.format("/ho" + "me/someone"))
    assert not REGISTRIES.search(text.format("example.org"))
    assert not MACHINES.search(text.format("docs/home/page"))
