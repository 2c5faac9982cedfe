"""`study` and its results: tables as data frames, the report as a page."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from pipistrelle.config import InputError
from pipistrelle.evaluation.scores import NOT_MEANS, SCORES
from pipistrelle.refusals import shown
from pipistrelle.settings import from_keywords

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

    from pipistrelle.experiments.studies.plan import Plan
    from pipistrelle.report.page import Answered


class StudyResults:
    """Results of `study` and `load`: the finished worlds of a study.

    Tables are polars data frames; a case is a combination of the grid, a strategy and a filter.

    Examples
    --------
    >>> import pipistrelle
    >>> short = {"steps": 8, "landmarks": 5}
    >>> few = pipistrelle.study("physics", iterations=1, scenario=short)
    >>> few.trials.height, few.summary.height
    (50, 50)
    >>> few.answer[0]
    'Undecided: too few worlds, 1 of 115.'
    """

    def __init__(self, folder: Path, kept_by: "TemporaryDirectory[str] | None" = None) -> None:
        self.folder = folder
        """Folder of the study; deleted with this object if none was named."""
        from pipistrelle.experiments.studies.study import load_study

        self._kept_by, self._stored = kept_by, load_study(folder)

    @property
    def plan(self) -> "Plan":
        """The plan that the study runs."""
        return self._stored.plan

    @cached_property
    def trials(self) -> "pl.DataFrame":
        """Table of scores, a row per world and case."""
        return self._stored.trials.collect()

    @cached_property
    def steps(self) -> "pl.DataFrame":
        """Table of errors and NEES, a row per world, case and frame."""
        return self._stored.steps.collect()

    @cached_property
    def landmarks(self) -> "pl.DataFrame":
        """Table of landmarks, a row per world, case and landmark: status and error."""
        return self._stored.landmarks.collect()

    @cached_property
    def summary(self) -> "pl.DataFrame":
        """Table of cases: settings, number of finished worlds and mean scores."""
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
        """Answer to the question of the study: a headline, then further sentences."""
        return list(self._answered.answer)

    def figure(self) -> "Figure":
        """Draw the first figure of the report: the main score by the varied settings."""
        from pipistrelle.figures.chart import draw_chart
        from pipistrelle.report.charts import study_charts

        answered_study = self._answered
        return draw_chart(study_charts(answered_study.selections[answered_study.rule])[0])

    @cached_property
    def _answered(self) -> "Answered":
        """The study together with the answer that its report gives."""
        from pipistrelle.report.page import answered
        from pipistrelle.report.study import read_study

        return answered(read_study(self.folder))

    def report(self, folder: Path | str | None = None) -> Path:
        """Write the report of the study, a page with figures.

        Parameters
        ----------
        folder : Path, optional
            By default ``report`` in the folder of the study.

        Returns
        -------
        Path
            The page.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        from pipistrelle.report.page import write_report
        from pipistrelle.report.study import read_study

        target = self.folder / "report" if folder is None else Path(folder)
        write_report(read_study(self.folder), target, progress=lambda _: None)
        return target / "index.html"

    def __repr__(self) -> str:
        """Format the mean scores of the cases as a text table."""
        return f"Study {self.plan.name}\n{self.summary}"

    def _repr_html_(self) -> str:
        """Format the mean scores of the cases as HTML."""
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
    retry_failed: bool = False,
    progress: Callable[[Any], None] | None = None,
    **settings: Any,
) -> StudyResults:
    """Run all cases of a plan in many worlds, as `pipistrelle study` does.

    Parameters
    ----------
    plan : str or mapping
        "paper", "physics", "beyond", "timing", "association", "callers", "pair", "sweeps", or a
        FILE.toml like the plan.toml of a study; in Python also its content as a table.
    iterations : int, optional
        Number of worlds.
    workers : int
        Number of processes. A script with several must be guarded by
        ``if __name__ == "__main__"``; a notebook need not be.
    shard : int, int
        Share (i, n): every n-th world from world i on. Calls with different shares may run at the
        same time on one folder.
    scheduler : str, optional
        Dask cluster to work on: local, or the address of a scheduler (tcp://HOST:PORT). Needs the
        extra cluster.
    output : Path, optional
        Folder of the study; finished worlds are kept in it, and the study continues there.
    retry_failed : bool
        Run worlds with failed trials again.
    progress : callable, optional
        Called with the state of the study (a `StudyProgress`) after each world.
    **settings
        Settings that override the plan's.

    Raises
    ------
    InputError
        For a bad plan, setting, world or share, the folder of another study, or an unusable
        cluster.

    Examples
    --------
    >>> levels = {"grid": {"beacon.level_db": [36.8, 48.8]}, "filters": ["ekf"]}
    >>> study(levels, iterations=1, scenario={"steps": 8, "landmarks": 5}).trials.height
    6
    """
    from pipistrelle.experiments.studies.plan import FORMAT, find_plan, plan_of, read_plan
    from pipistrelle.experiments.studies.study import run_study

    match shard:
        case (int(i), int(n)) if 0 <= i < n:
            share = i, n
        case _:
            expected = "(i, n) with i from 0 to n - 1, as in (0, 4)"
            raise InputError(f"shard: found {shown(shard)}, expected {expected}")
    over = from_keywords(settings, study.__kwdefaults__ or ())
    if isinstance(plan, Mapping):
        tried = plan_of(_listed({"format": FORMAT, **plan}), over=over, iterations=iterations)
    else:
        tried = read_plan(find_plan(str(plan)), over, iterations)
    kept_by = None
    if output is None:
        kept_by = TemporaryDirectory(prefix="pipistrelle-")
        output = kept_by.name
    run_study(
        tried,
        Path(output),
        workers=workers,
        shard=share,
        scheduler=scheduler,
        retry_failed=retry_failed,
        progress=progress,
    )
    return StudyResults(Path(output), kept_by)


def _listed(value: Any) -> Any:
    """Convert arrays and tuples in nested data to lists, as a TOML file has them."""
    if isinstance(value, Mapping):
        return {name: _listed(inner) for name, inner in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [*map(_listed, value)] if isinstance(value, (list, tuple)) else value
