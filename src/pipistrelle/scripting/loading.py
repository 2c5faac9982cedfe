"""Folders of results and of studies, opened again."""

import warnings
from pathlib import Path

from pipistrelle.experiments.results.reading import read_summary
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.rerun import rerun
from pipistrelle.experiments.runs.trial import Watch
from pipistrelle.scripting.arguments import Filters, folder_named, named_filters
from pipistrelle.scripting.results import Results
from pipistrelle.scripting.studies import StudyResults


def load(
    folder: Path | str, /, *, filters: Filters = (), association: str = ""
) -> Results | StudyResults:
    """Open what a folder holds; a mission is done again only where it must be drawn.

    Parameters
    ----------
    folder : Path
        As `pipistrelle run`, `slam` or `study` has filled it.
    filters : str or class, or several of them, optional
        Estimators of your own, by name or class, that a mission was done with. Code that a folder
        names is not run unless you name it, too.
    association : str, optional
        An association of your own, ``module:Class``, likewise.

    Returns
    -------
    Results or StudyResults

    Raises
    ------
    InputError
        Where it is no such folder; when a mission is done again, where it names an estimator or an
        association that is neither Pipistrelle's nor named here.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import pipistrelle
    >>> with TemporaryDirectory() as place:
    ...     done = pipistrelle.run(strategies="fused", duration=4.0, output=f"{place}/one")
    ...     same = pipistrelle.load(f"{place}/one")
    ...     same.tracks.equals(done.tracks)
    True
    """
    place = folder_named(folder, "load")
    if (place / "plan.toml").is_file():
        return StudyResults(place)
    read_summary(place)
    trusted = (*(named_filters(filters) if filters else ()), association)

    def redo(watch: Watch | None) -> Mission:
        mission = rerun(place, trusted=trusted, watch=watch)
        if mission.difference:
            warnings.warn(mission.difference, stacklevel=3)
        return mission

    return Results(redo, folder=place)
