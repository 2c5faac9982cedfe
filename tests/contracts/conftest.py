"""What the tests of classes from outside share."""

import sys
from pathlib import Path

import pytest


@pytest.fixture
def written(tmp_path, monkeypatch, undrawn):
    """Write a module into the current folder and return its name, a new one each time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def written(text):
        name = f"mine_{tmp_path.name}_{len(list(tmp_path.glob('*.py')))}".replace("-", "_")
        Path(f"{name}.py").write_text(text)
        return name

    return written
