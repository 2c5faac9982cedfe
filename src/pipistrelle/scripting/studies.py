"""The results of a study for Python: its tables as data frames, its report as a page."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pipistrelle.config import InputError
from pipistrelle.evaluation.scores import NOT_MEANS, SCORES
from pipistrelle.experiments.studies.plan import FORMAT, Plan, find_plan, plan_of, read_plan
from pipistrelle.experiments.studies.store import load_study
from pipistrelle.experiments.studies.study import StudyProgress, run_study
from pipistrelle.refusals import shown
from pipistrelle.settings import from_keywords

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

    from pipistrelle.report.page import Answered


class StudyResults:
    """What `study` and `load` return: a study's folder, as far as it is done.

    Frames are polars'; a case is one combination of the grid, a strategy and a filter.

    Examples
    --------
    >>> import pipistrelle
    >>> short = {"steps": 8, "landmarks": 5}
    >>> few = pipistrelle.study("physics", iterations=1, scenario=short)
    >>> few.trials.height, few.summary.height
    (50, 50)
    >>> few.answer[0]
    'Not decided: no world is left.'
    """

    def __init__(self, folder: Path, kept_by: "TemporaryDirectory[str] | None" = None) -> None:
        self.folder = folder
        """Where the study is; gone with this object, if no folder was named."""
        self._kept_by, self._stored = kept_by, load_study(folder)

    @property
    def plan(self) -> Plan:
        """What is tried."""
        return self._stored.plan

    @cached_property
    def trials(self) -> "pl.DataFrame":
        """A row for each world and case: the scores."""
        return self._stored.trials.collect()

    @cached_property
    def steps(self) -> "pl.DataFrame":
        """A row for each world, case and frame: errors and NEES."""
        return self._stored.steps.collect()

    @cached_property
    def landmarks(self) -> "pl.DataFrame":
        """A row for each world, case and landmark: is it placed, and how far off."""
        return self._stored.landmarks.collect()

    @cached_property
    def summary(self) -> "pl.DataFrame":
        """A row for each case: its settings, the worlds that count, mean scores over them."""
        import polars as pl

        case = ["case", "strategy", "filter", *self.plan.grid, "beamwidth_deg"]
        means = [
            pl.col(score).mean()
            for score in SCORES
            if score in self.trials.columns and score not in NOT_MEANS
        ]
        done = self.trials.filter(pl.col("status") == "done")
        return done.group_by(case, maintain_order=True).agg(pl.len().alias("worlds"), *means)

    @property
    def answer(self) -> list[str]:
        """What the report answers to the study's question: a line, then sentences."""
        return list(self._answered.answer)

    def figure(self) -> "Figure":
        """Draw the first figure of the report: what is asked, by what is varied."""
        from pipistrelle.figures.chart import draw_chart
        from pipistrelle.report.charts import study_charts

        answered_study = self._answered
        return draw_chart(study_charts(answered_study.selections[answered_study.rule])[0])

    @cached_property
    def _answered(self) -> "Answered":
        """The study, as the report reads it."""
        from pipistrelle.report.page import answered
        from pipistrelle.report.study import read_study

        return answered(read_study(self.folder))

    def report(self, folder: Path | str | None = None) -> Path:
        """Put the study on one page, with its figures.

        Parameters
        ----------
        folder : Path, optional
            By default that of the study.

        Returns
        -------
        Path
            Of the page.

        Raises
        ------
        InputError
            Where it cannot be written.
        """
        from pipistrelle.report.page import write_report
        from pipistrelle.report.study import read_study

        target = self.folder / "report" if folder is None else Path(folder)
        write_report(read_study(self.folder), target, progress=lambda _: None)
        return target / "index.html"

    def __repr__(self) -> str:
        """Show the mean scores as a table."""
        return f"Study {self.plan.name}\n{self.summary}"

    def _repr_html_(self) -> str:
        """Show the mean scores as a table."""
        return self.summary._repr_html_()


def study(
    plan: Path | str | Mapping[str, Any] = "paper",
    /,
    *,
    iterations: int | None = None,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    scheduler: str | None = None,
    output: Path | str | None = None,
    progress: Callable[[StudyProgress], None] | None = None,
    **settings: Any,
) -> StudyResults:
    """Try all cases of a plan in many worlds, as `pipistrelle study` does.

    Parameters
    ----------
    plan : str or mapping
        "paper", "physics", "beyond", "timing", "association", "callers" or "pair", the path of a
        plan, or a table. A table holds what the file would; paths in it lead from the folder where
        Python works.
    iterations : int, optional
        Number of worlds; the plan's by default.
    workers : int
        Processes. More than one are spawned, so a script must be guarded by
        ``if __name__ == "__main__"``; a notebook need not be.
    shard : i, n
        Only each n-th world, from world i on: of several calls that share an output, on machines
        that share a disk, each does its part.
    scheduler : str, optional
        Of a Dask cluster: "local" for one that is made here, of so many workers, and guarded alike;
        or the address of one that is there. Needs the extra ``cluster``.
    output : Path, optional
        The study's folder, which it goes on in; without one it is gone when what is returned is.
    progress : callable, optional
        Given how far the study is whenever a world is done.
    **settings
        As of `run`, over the plan's own.

    Returns
    -------
    StudyResults

    Raises
    ------
    InputError
        A plan that is refused, a folder of another study, what a world is refused for, a share
        that is none, or a cluster that cannot be had.

    Examples
    --------
    >>> levels = {"grid": {"beacon.level_db": [36.8, 48.8]}, "filters": ["ekf"]}
    >>> study(levels, iterations=1, scenario={"steps": 8, "landmarks": 5}).trials.height
    6
    """
    share, over = _share(shard), from_keywords(settings, study.__kwdefaults__ or ())
    if isinstance(plan, Mapping):
        tried = plan_of(_listed({"format": FORMAT, **plan}), over=over, iterations=iterations)
    else:
        tried = read_plan(find_plan(str(plan)), over, iterations)
    kept_by = None
    if output is None:
        kept_by = TemporaryDirectory(prefix="pipistrelle-")
        output = kept_by.name
    where = {"workers": workers, "shard": share, "scheduler": scheduler}
    run_study(tried, Path(output), progress=progress, **where)
    return StudyResults(Path(output), kept_by)


def _listed(value: Any) -> Any:
    """Convert arrays and tuples to lists, as in a file."""
    if isinstance(value, Mapping):
        return {name: _listed(inner) for name, inner in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [*map(_listed, value)] if isinstance(value, (list, tuple)) else value


def _share(given: object) -> tuple[int, int]:
    """Check the share (i, n) of the worlds."""
    match given:
        case (int(i), int(n)) if 0 <= i < n:
            return i, n
    expected = "(i, n) with i from 0 to n - 1, as in (0, 4)"
    raise InputError(f"shard: found {shown(given)}, expected {expected}")
