"""Outputs of a command line: its folder, its table, its tracks."""

import json
import re
from itertools import takewhile
from pathlib import Path

import numpy as np

from pipistrelle.jit import COMPILING  # noqa: F401 - said where the cache has none

SHORT = ("--settings", "paper", "--duration", "4", "--landmarks", "10")
"""The paper's mission in a world of eight frames."""


def summary(folder):
    return json.loads((Path(folder) / "summary.json").read_text())


def track(folder, name):
    return np.loadtxt(Path(folder) / f"track_{name}.tum")


def table(printed):
    """Parse the rows of the final table: title and cells, eleven characters each."""
    lines = [line for line in printed.splitlines()[:-1] if not line.endswith(".")]
    lines = list(takewhile(bool, lines))
    return {line[:32].strip(): re.findall(r".{11}", line[32:]) for line in lines[2:]}


def contents(folder):
    paths = (path for path in sorted(Path(folder).iterdir()) if path.is_file())
    return {path.name: path.read_bytes() for path in paths}
