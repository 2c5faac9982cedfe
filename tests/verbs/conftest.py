"""A command line to call, in a folder of its own."""

import sys

import pytest

from pipistrelle.__main__ import main
from pipistrelle.experiments.runs import compiling  # noqa: F401 - before a test spoils a mission
from reference.command_line import COMPILING


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pipistrelle"])


@pytest.fixture
def obey(capsys):
    """Run a command line; return its status, what it printed and what it said."""

    def obey(*words):
        status = main([str(word) for word in words])
        printed, said = capsys.readouterr()
        return status, printed, said

    return obey


@pytest.fixture
def refused(obey):
    """Run a command line that must be refused; return what is said."""

    def refused(*words):
        status, printed, said = obey(*words)
        assert (status, printed) == (2, "")
        lines = [line for line in said.splitlines() if line != COMPILING]
        assert lines
        assert all(line.startswith("pipistrelle: error: ") for line in lines)
        return "\n".join(line.removeprefix("pipistrelle: error: ") for line in lines)

    return refused
