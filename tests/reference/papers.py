"""The scripts of the paper's study as modules."""

import sys
from importlib import import_module
from pathlib import Path


def papers_module(name):
    """Import a script of `papers/bradley_abaid`, which imports its neighbours."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "papers/bradley_abaid"))
    try:
        return import_module(name)
    finally:
        sys.path.pop(0)
