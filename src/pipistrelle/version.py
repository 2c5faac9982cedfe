"""The version of the package: from git's tags in a clone, else from the installed metadata.

The metadata of an editable install are of the day of installation, and a clone may have changed
since. So in a clone hatch-vcs, which makes the metadata, asks git, if it is installed.
"""

import tomllib
import warnings
from functools import cache
from pathlib import Path

UNKNOWN = "0.0"
"""The version of a copy that is neither installed nor a clone."""


@cache
def find_version() -> str:
    """Return the package's version by PEP 440; cached, as git and metadata are slow.

    "0.1.0" is a release, "0.1.1.dev3+g1a2b3c4d5" three commits later, with ".d" and a date after it
    if there are uncommitted changes.

    >>> find_version().startswith("0.")
    True
    """
    if of_clone := version_of_clone(Path(__file__).resolve().parents[2]):
        return of_clone
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("pipistrelle")
    except PackageNotFoundError:
        return UNKNOWN


def version_of_clone(folder: Path) -> str | None:
    """Return the package's version from git if a folder is its clone; None otherwise.

    None if the folder is not a clone of this project, or git or hatch-vcs is missing.
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
