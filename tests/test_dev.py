"""The set-up script: two who start at once make one environment, and help costs none."""

import shutil
import subprocess
import sys
from pathlib import Path

DEV = Path(__file__).resolve().parents[1] / "dev"
START = """\
import sys, time
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

loader = SourceFileLoader("dev", sys.argv[1])
dev = module_from_spec(spec_from_loader("dev", loader))
sys.dont_write_bytecode = True
loader.exec_module(dev)
dev.VENV = Path(sys.argv[2], ".venv")
dev.STAMP, dev.PYTHON = dev.VENV / "stamp", dev.VENV / "python"

def make(wanted):
    if dev.VENV.exists():
        sys.exit("somebody else is at work here")
    dev.VENV.mkdir()
    time.sleep(0.5)
    dev.PYTHON.touch()
    dev.STAMP.write_text(wanted)
    print("made")

dev.make_environment = make
dev.set_up()
"""


def test_only_one_of_several_starters_makes_the_environment(tmp_path):
    command = [sys.executable, "-c", START, str(DEV), str(tmp_path)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    started = [subprocess.Popen(command, text=True, **pipes) for _ in range(4)]
    ended = [process.communicate(timeout=60) for process in started]
    assert [process.returncode for process in started] == [0] * 4
    assert sorted(told for told, _ in ended) == ["", "", "", "made\n"]


def test_a_link_is_refused_as_the_environment(tmp_path):
    (tmp_path / ".venv").symlink_to(tmp_path)
    command = [sys.executable, "-c", START, str(DEV), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, "found a symbolic link" in done.stderr) == (1, True)


def test_help_sets_up_no_environment(tmp_path):
    dev = Path(shutil.copy(DEV, tmp_path))
    for asked in ("help", "--help", "run --help", "lowest -h"):
        done = subprocess.run([sys.executable, dev, *asked.split()], capture_output=True, text=True)
        assert (done.returncode, "`pipistrelle VERB --help`" in done.stdout) == (0, True)
        assert ("`./dev doctor`" in done.stdout) is ("run" in asked)
    assert [*tmp_path.iterdir()] == [dev]
