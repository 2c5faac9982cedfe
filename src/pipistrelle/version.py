"""Which version this is: of a clone what its tags say now, else what was installed.

The metadata of an editable install are those of the day when it was made, and a clone moves on: in
one, git is asked by what makes the metadata, hatch-vcs, wherever that is installed.
"""

import tomllib
import warnings
from functools import cache
from pathlib import Path

UNKNOWN = "0.0"
"""The version of a copy that is not installed and says nothing of its origin."""


@cache
def find_version() -> str:
    """Find the version; git and metadata are slow, so it is asked for where it is written.

    Returns
    -------
    str
        As PEP 440 has it: "0.1.0" is a release, "0.1.1.dev3+g1a2b3c4d5" three commits later, with
        ".d" and a date after it where something was changed that is not committed.

    Examples
    --------
    >>> find_version().startswith("0.")
    True
    """
    return version_of_clone(Path(__file__).resolve().parents[2]) or _installed()


def version_of_clone(folder: Path) -> str | None:
    """Ask git for the version of a clone.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    str or None
        None where it is no clone of this project, or git or hatch-vcs is not there to ask.

    Examples
    --------
    >>> version_of_clone(Path("somewhere else")) is None
    True
    """
    try:
        settings = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
        if settings["project"]["name"] != "pipistrelle" or not (folder / ".git").exists():
            return None
        from setuptools_scm import get_version

        with warnings.catch_warnings(action="ignore"):  # a shallow clone has fewer commits
            return get_version(root=folder)
    except (ImportError, OSError, ValueError, LookupError):
        return None


def _installed() -> str:
    """Read the version that was installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("pipistrelle")
    except PackageNotFoundError:
        return UNKNOWN
