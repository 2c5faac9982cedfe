"""The results of a mission for Python: data frames, figures, films."""

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import Robot
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.experiments.hearing.listening import Progress
from pipistrelle.experiments.machine import keep_freed_memory
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.experiments.results.writing import run_entry, tables_of
from pipistrelle.experiments.runs.heard_world import Mission
from pipistrelle.experiments.runs.trial import Watch
from pipistrelle.files import RESULTS, claim, read_file
from pipistrelle.kernel_clock import announce
from pipistrelle.refusals import refusal, shown
from pipistrelle.scripting.arguments import (
    RUN_NAMES,
    SLAM_TAKES,
    WORLD_KEY,
    Base,
    Filters,
    base_layer,
    folder_named,
    mission_settings,
    named_filters,
    named_strategies,
)
from pipistrelle.scripting.missions import (
    Conduct,
    caller_names,
    drawn,
    failures,
    filmed,
    keep,
    prepare_slam,
    simulated,
)
from pipistrelle.settings import Given, Layer, from_keywords

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

Redo = Callable[[Watch | None], Mission]
"""Does a mission again, watched; the same settings give the same bits."""
ALLOW = "overwrite=True"
TABLES = ("steps", "landmarks", "measurements")
"""Tables of a result folder, each a Parquet file."""


class Results:
    """What `run`, `slam` and `load` return: the scores, tracks, maps and measurements of a mission.

    Frames are polars' (`to_pandas` turns one into pandas'), with units in the names of columns;
    where there are several strategies or filters, each row says of which it is.

    Examples
    --------
    >>> import pipistrelle
    >>> done = pipistrelle.run(strategies="fused", duration=4.0, landmarks=10)
    >>> done.summary["strategy"].to_list(), done.tracks.height
    (['fused'], 33)
    >>> done.tracks.columns[:4]
    ['strategy', 'filter', 'time_s', 'x_m']
    """

    def __init__(
        self,
        redo: Redo,
        mission: Mission | None = None,
        folder: Path | None = None,
        command: str = "pipistrelle",
    ) -> None:
        self.folder = folder
        """Where the results are kept, if anywhere."""
        self._redo, self._command = redo, command
        if mission is not None:
            self._mission = mission

    @cached_property
    def _mission(self) -> Mission:
        """The mission itself, done once more where only its folder is known."""
        return self._redo(None)

    @cached_property
    def summary(self) -> "pl.DataFrame":
        """The scores, a row for each strategy and filter, as ``summary.json`` names them."""
        import polars as pl

        if self.folder is not None:
            rows = json.loads(read_file(self.folder / "summary.json"))["runs"]
        else:
            mission = self._mission
            ignored = {} if mission.log is None else mission.log.ignored_rows
            rows = [run_entry(trial, ignored) for trial in mission.trials]
        nested = ("ignored_rows", "online")
        flat = [{name: row[name] for name in row if name not in nested} for row in rows]
        return pl.DataFrame(flat, infer_schema_length=None)

    @property
    def tracks(self) -> "pl.DataFrame":
        """A row for each control step: estimate, standard deviations, truth, errors, NEES."""
        return self._tables["steps"]

    @property
    def landmarks(self) -> "pl.DataFrame":
        """A row for each hypothesis of each landmark, with the true place beside it."""
        return self._tables["landmarks"]

    @property
    def measurements(self) -> "pl.DataFrame":
        """A row for each measurement of each strategy; null is what was not measured."""
        return self._tables["measurements"]

    @cached_property
    def _tables(self) -> "dict[str, pl.DataFrame]":
        """The tables, from the folder where there is one."""
        import polars as pl

        if self.folder is None:
            mission = self._mission
            return tables_of(mission.trials, mission.drive.truth, caller_names(mission))
        paths = {name: self.folder / f"{name}.parquet" for name in TABLES}
        tables = {}
        for name, path in paths.items():
            try:
                tables[name] = pl.read_parquet(read_file(path))
            except (OSError, pl.exceptions.PolarsError):
                found, fix = "no table that is whole", "do the mission anew"
                raise refusal(path, found, "what was written there", fix) from None
        return tables

    def figure(self) -> "Figure":
        """Draw maps and errors side by side, as ``mission.png`` has them."""
        return drawn(self._mission)

    def animate(self, path: Path | str = "mission.gif") -> Path:
        """Film the mission, which is done once more for it.

        Parameters
        ----------
        path : Path
            Ends in .gif or .mp4.

        Returns
        -------
        Path

        Raises
        ------
        InputError
            With another ending, or where the film cannot be made.
        """
        from pipistrelle.figures.film import film_writer
        from pipistrelle.figures.recorder import MissionRecorder

        film_writer(Path(path))
        watch = MissionRecorder()
        filmed(self._redo(watch), watch, Path(path))
        return Path(path)

    def save(self, folder: Path | str, *, overwrite: bool = False) -> Path:
        """Write the results as the command line does.

        Parameters
        ----------
        folder : Path
            A new one, or an empty one.
        overwrite : bool
            Whether earlier results in it may be replaced.

        Returns
        -------
        Path

        Raises
        ------
        InputError
            Where the folder cannot be had.
        """
        own = claim(Path(folder), RESULTS, overwrite=overwrite, flags=("save(DIR)", ALLOW))
        keep(self._mission, own, self._command)
        return own.folder

    def to_xarray(self) -> Any:
        """Return the tracks with the dimensions strategy, filter and time (extra ``export``).

        Raises
        ------
        InputError
            Where xarray or pandas is not installed.
        """
        try:
            import pandas  # noqa: F401 - these three are asked for by polars, and by each other
            import pyarrow  # noqa: F401
            import xarray  # noqa: F401
        except ImportError as missing:
            raise InputError(
                f"to_xarray: found no {missing.name}; install it: pip install 'pipistrelle[export]'"
            ) from None
        return self.tracks.to_pandas().set_index(["strategy", "filter", "time_s"]).to_xarray()

    def _scores_shown(self) -> "pl.DataFrame":
        """Return the scores that a notebook shows."""
        return self.summary.select("strategy", "filter", *shown_in("notebook"))

    def __repr__(self) -> str:
        """Show the scores as a table."""
        return f"Results of a mission\n{self._scores_shown()}"

    def _repr_html_(self) -> str:
        """Show the figure, and the scores beneath it."""
        from base64 import b64encode

        room = BytesIO()
        self.figure().savefig(room, format="png", dpi=80)
        picture = b64encode(room.getvalue()).decode()
        table = self._scores_shown()._repr_html_()
        return f'<img alt="The mission" src="data:image/png;base64,{picture}"/>{table}'


def run(
    config: Base = None,
    /,
    *,
    strategies: str | Sequence[str] = "all",
    filters: Filters | None = None,
    world: Path | str | None = None,
    beamwidth: float | None = None,
    landmarks: int | None = None,
    duration: float | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Drive through one world and map it, as `pipistrelle run` does.

    Settings are keywords: ``seed=3``, ``rays__power=8.0``, or a section of them at a time,
    ``air={"temperature_c": 5.0}``; `pipistrelle config show` lists them. Variables of the
    environment count for the command line alone.

    Parameters
    ----------
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from. What they leave open is what serves the estimator best,
        ``settings="best"``, unless they name other settings; a `Config` leaves nothing open.
    strategies : "active", "fused", "passive", several of them, or "all"
    filters : str or class, optional
        The name of an estimator or its class, several of them, "both", the paper's two, or "all";
        by default that of the named settings: the smoother of "best", the EKF of "paper".
    world : Path, optional
        Folder of a world of one's own.
    beamwidth : [deg], optional
        Half-power beamwidth of the vehicle's call.
    landmarks : int, optional
        Number of landmarks.
    duration : [s], optional
    output : Path, optional
        Where to keep the results; nothing is written without it.
    overwrite : bool
        Whether earlier results there may be replaced.
    progress : callable, optional
        Called with what is done, how many frames of it are, and of how many.
    **settings

    Returns
    -------
    Results

    Raises
    ------
    InputError
        An unknown setting or a refused value; a world, an estimator or a folder that cannot be had.

    Examples
    --------
    >>> quiet = run(strategies="active", duration=4.0, landmarks=10, beacon__level_db=-50.0)
    >>> quiet.measurements["range_m"].null_count()
    0
    >>> run(rays__powr=3)
    Traceback (most recent call last):
    pipistrelle.config.InputError: rays__powr: no such setting; did you mean rays__power?
    """
    if isinstance(landmarks, Iterable) and not isinstance(landmarks, str):
        fix = "places of your own are a world's: write them into one, and name it by world="
        raise refusal("landmarks", shown(landmarks), "the number of landmarks", fix)
    short: Layer = {
        WORLD_KEY: Given(None if world is None else str(world), "world"),
        ("scenario", "landmarks"): Given(landmarks, "landmarks"),
    }
    resolved, own_world, usual = mission_settings(
        base_layer(config),
        from_keywords(settings, run.__kwdefaults__ or ()),
        short,
        beamwidth=Given(beamwidth, "beamwidth"),
        duration=Given(duration, "duration"),
        default="paper" if isinstance(config, Config) else RUN_NAMES,
    )
    chosen = named_strategies(strategies)
    ways = named_filters(usual if filters is None else filters)
    conduct = partial(simulated, resolved, chosen, ways, own_world)
    return _finished(conduct, progress, output, overwrite, "pipistrelle.run(...)")


def slam(
    log: Path | str,
    /,
    *,
    config: Base = None,
    robot: Robot | None = None,
    strategies: str | Sequence[str] = "fused",
    filters: Filters | None = None,
    beamwidth: float | None = None,
    gate: float | Literal["auto"] | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Solve a recorded log, as `pipistrelle slam` does.

    What looks odd in it is a warning.

    Parameters
    ----------
    log : Path
        Its folder, or a ROS bag; ``bag={"odometry": "/odom", "truth": "/pose"}`` names topics.
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from.
    robot : int or str, optional
        Whose log, where there are several.
    strategies : "active", "fused", "passive", several of them, or "all"
        What is kept: only what has a range, all as it is, or only bearings.
    filters : str or class, optional
        The name of an estimator or its class, several of them, "both", the paper's two, or "all";
        by default that of the settings that are named, else the smoother.
    beamwidth : [deg], optional
        Ranges outside a beam of this width about the heading are hidden.
    gate : float or "auto", optional
        Measurements outside this share of their predicted distribution are dropped; "auto", as
        suits the estimator, unless the log says its own.
    output, overwrite, progress, **settings
        As of `run`; what the log decides is refused.

    Returns
    -------
    Results

    Raises
    ------
    InputError
        What is wrong in the log, by line or key; as `run`.
    """
    place, flags = folder_named(log, "log"), from_keywords(settings, slam.__kwdefaults__ or ())
    short: Layer = {("filter", "gate"): Given(gate, "gate")}
    beneath, usual = over_named(base_layer(config), flags)
    layers, chosen = (beneath, flags, short), named_strategies(strategies)
    ways = named_filters((usual or SLAM_TAKES) if filters is None else filters)
    width = Given(beamwidth, "beamwidth")
    conduct, _, odd = prepare_slam(place, layers, robot, chosen, ways, width)
    for line in odd:
        warnings.warn(line, stacklevel=2)
    return _finished(conduct, progress, output, overwrite, f"pipistrelle.slam({str(log)!r}, ...)")


def _finished(
    conduct: Conduct,
    progress: Progress | None,
    output: Path | str | None,
    overwrite: bool,
    command: str,
) -> Results:
    """Do a mission, and keep it where that is asked for."""
    keep_freed_memory()
    announce()
    place = None if output is None else Path(output)
    flags = ("output=DIR", ALLOW)
    own = None if place is None else claim(place, RESULTS, overwrite=overwrite, flags=flags)
    mission = conduct(progress=progress)
    if own is not None:
        keep(mission, own, command)
    for line in (*mission.notes(), *failures(mission)):
        warnings.warn(line, stacklevel=3)
    return Results(lambda watch: conduct(progress=progress, watch=watch), mission, place, command)
