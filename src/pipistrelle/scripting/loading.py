"""Folders of results and of studies, opened again."""

import warnings
from pathlib import Path

from pipistrelle.experiments.hearing.world_folder import read_world
from pipistrelle.experiments.results.reading import read_summary
from pipistrelle.experiments.runs.again import again
from pipistrelle.experiments.runs.trial import Watch
from pipistrelle.scripting.asking import Filters, folder_named, named_filters
from pipistrelle.scripting.missions import Done, done_of, done_of_log
from pipistrelle.scripting.results import Results
from pipistrelle.scripting.studies import StudyResults


def load(folder: Path | str, /, *, filters: Filters = ()) -> Results | StudyResults:
    """Open what a folder holds; a mission is done again only where it must be drawn.

    Parameters
    ----------
    folder : Path
        As `pipistrelle run`, `slam` or `study` has filled it.
    filters : str or class, or several of them, optional
        Estimators of your own, by name or class, that a mission was done with. Code that a folder
        names is not run unless you name it, too.

    Returns
    -------
    Results or StudyResults

    Raises
    ------
    InputError
        Where it is no such folder; when a mission is done again, where it names an estimator that
        is neither Pipistrelle's nor named here.

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
    summary = read_summary(place)
    trusted = named_filters(filters) if filters else ()

    def redo(watch: Watch | None) -> Done:
        found = again(place, trusted=trusted, watch=watch)
        if found.difference:
            warnings.warn(found.difference, stacklevel=3)
        if found.log is not None and summary.log is not None:
            entry = summary.log.model_dump()
            return done_of_log(found.log, found.truth, found.config, found.trials, entry)
        assert found.mission is not None
        world = found.config.scenario.world
        return done_of(found.mission, None if world is None else read_world(Path(world)))

    return Results(redo, folder=place)
