"""Folders that may be compared: two or more, each once, all of one kind."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pipistrelle.config import InputError
from pipistrelle.experiments.results.reading import results_in
from pipistrelle.files import without_links

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""What folders are called where their names have no room."""
Kind = Literal["missions", "studies"]


def kind_of(folders: Sequence[Path]) -> Kind:
    """Return whether folders hold missions or studies, from their names and contents.

    Raises InputError where they are too few or too many, one of them twice, or not all of one
    kind.

    Examples
    --------
    >>> kind_of([Path("one"), Path("two"), Path("./one")])
    Traceback (most recent call last):
    pipistrelle.config.InputError: one: is given twice, as A and C; name each folder once
    """
    if not 2 <= len(folders) <= len(LETTERS):
        expected = f"expected 2 to {len(LETTERS)} of `run`, `slam` or `study`"
        alone = "; the table of `run` or `slam` compares the estimates of one folder"
        found = f"found {len(folders)} folder{'' if len(folders) == 1 else 's'}"
        raise InputError(f"compare: {found}, {expected}{alone * (len(folders) == 1)}")
    seen: dict[Path, int] = {}
    for i, folder in enumerate(folders):
        first = seen.setdefault(without_links(folder), i)
        if first != i:
            twice = f"is given twice, as {LETTERS[first]} and {LETTERS[i]}"
            also = "" if folders[first].absolute() == folder.absolute() else f" ({folder})"
            raise InputError(f"{folders[first]}: {twice}{also}; name each folder once")
    studies = [(folder / "plan.toml").is_file() for folder in folders]
    if all(studies):
        return "studies"
    if any(studies):
        one, other = folders[studies.index(True)], folders[studies.index(False)]
        results_in(other)
        raise InputError(
            f"{one}: is a study's folder, and {other} is not; expected folders of one kind"
        )
    return "missions"
