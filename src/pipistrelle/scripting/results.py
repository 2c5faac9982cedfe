"""`run`, `slam` and `load`, and the results of a mission: data frames, figures, films."""

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from functools import cached_property, partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import STUDY, Robot, kind_of
from pipistrelle.evaluation.scores import shown_in
from pipistrelle.experiments.named_settings import over_named
from pipistrelle.files import RESULTS, OwnFiles, claim, read_file
from pipistrelle.refusals import refusal, shown
from pipistrelle.scripting.arguments import (
    RUN_NAMES,
    SLAM_TAKES,
    Base,
    Door,
    Filters,
    Progress,
    base_layer,
    folder_named,
    mission_settings,
    named_filters,
    named_strategies,
)
from pipistrelle.settings import Layer, from_keywords

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

    from pipistrelle.experiments.runs.heard_world import Mission
    from pipistrelle.experiments.runs.trial import Watch
    from pipistrelle.scripting.missions import Recordings
    from pipistrelle.scripting.studies import StudyResults

TABLES = ("steps", "landmarks", "measurements")
"""Tables of a result folder, each a Parquet file."""


class Results:
    """Results of `run`, `slam` and `load`: scores, tracks, maps and measurements of a mission.

    Tables are polars data frames (`to_pandas` converts them) with units in the column names; each
    row has its strategy and its filter.

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
        redo: "Callable[[Watch | None], Mission]",
        mission: "Mission | None" = None,
        folder: Path | None = None,
        command: str = "pipistrelle",
    ) -> None:
        self.folder = folder
        """Folder of the results, if they are kept."""
        self._redo, self._command = redo, command
        if mission is not None:
            self.mission = mission

    @cached_property
    def mission(self) -> "Mission":
        """The mission with its estimates; run again if only its result folder is known."""
        return self._redo(None)

    @cached_property
    def summary(self) -> "pl.DataFrame":
        """Table of the scores of each strategy and filter, named as in ``summary.json``."""
        import polars as pl

        if self.folder is not None:
            rows = json.loads(read_file(self.folder / "summary.json"))["runs"]
        else:
            from pipistrelle.experiments.results.writing import run_entry

            mission = self.mission
            ignored = {} if mission.log is None else mission.log.ignored_rows
            rows = [run_entry(trial, ignored) for trial in mission.trials]
        nested = ("ignored_rows", "online", "watch", "alarms")
        flat = [{name: row[name] for name in row if name not in nested} for row in rows]
        return pl.DataFrame(flat, infer_schema_length=None)

    @property
    def tracks(self) -> "pl.DataFrame":
        """Table of tracks, a row per control step: pose, deviations, truth, errors, NEES."""
        return self._tables["steps"]

    @property
    def landmarks(self) -> "pl.DataFrame":
        """Table of maps, a row per hypothesis of each landmark, with the true position."""
        return self._tables["landmarks"]

    @property
    def measurements(self) -> "pl.DataFrame":
        """Table of measurements, a row each for every strategy; null for a missing number."""
        return self._tables["measurements"]

    @cached_property
    def _tables(self) -> "dict[str, pl.DataFrame]":
        """The tables by name, read from the result folder if there is one."""
        import polars as pl

        if self.folder is None:
            from pipistrelle.experiments.results.writing import tables_of
            from pipistrelle.scripting.missions import caller_names

            mission = self.mission
            return tables_of(mission.trials, mission.drive.truth, caller_names(mission))
        tables = {}
        for name in TABLES:
            path = self.folder / f"{name}.parquet"
            try:
                tables[name] = pl.read_parquet(read_file(path))
            except (OSError, pl.exceptions.PolarsError):
                found, fix = "no table that is whole", "run the mission again"
                raise refusal(path, found, "the table of the mission", fix) from None
        return tables

    def figure(self) -> "Figure":
        """Draw the maps and errors of the mission, as in ``mission.png``."""
        from pipistrelle.scripting.missions import drawn

        return drawn(self.mission)

    def animate(self, path: Path | str = "mission.gif") -> Path:
        """Write a film of the mission, which is run again for this.

        Parameters
        ----------
        path : Path
            Ends in .gif or .mp4.

        Raises
        ------
        InputError
            For another ending, or without ffmpeg.
        """
        from pipistrelle.figures.film import film_writer
        from pipistrelle.figures.recorder import MissionRecorder
        from pipistrelle.scripting.missions import filmed

        film_writer(Path(path))
        watch = MissionRecorder()
        filmed(self._redo(watch), watch, Path(path))
        return Path(path)

    def save(self, folder: Path | str, *, overwrite: bool = False, save_bag: bool = False) -> Path:
        """Write the results into a folder, as the command line does.

        Parameters
        ----------
        folder : Path
            A new or empty folder.
        overwrite : bool
            Replace earlier results in it.
        save_bag : bool
            Write tracks and maps also as a ROS bag, mission.mcap.

        Raises
        ------
        InputError
            If the folder cannot be used.
        """
        from pipistrelle.detection.logs.bag import need_rosbags
        from pipistrelle.scripting.missions import keep

        if save_bag:
            need_rosbags("save_bag")
        flags = ("save(DIR)", "overwrite=True")
        own = claim(folder_named(folder, "save"), RESULTS, overwrite=overwrite, flags=flags)
        keep(self.mission, own, self._command, save_bag=save_bag)
        return own.folder

    def to_xarray(self) -> Any:
        """Return the tracks as an xarray dataset by strategy, filter, time (extra ``export``).

        Raises
        ------
        InputError
            If xarray or pandas is not installed.
        """
        try:
            import pandas  # noqa: F401 - polars and xarray need them
            import pyarrow  # noqa: F401
            import xarray  # noqa: F401
        except ImportError as missing:
            fix = "python -m pip install pandas pyarrow xarray"
            raise InputError(f"to_xarray: found no {missing.name}; {fix}") from None
        return self.tracks.to_pandas().set_index(["strategy", "filter", "time_s"]).to_xarray()

    def _scores_shown(self) -> "pl.DataFrame":
        """Return the table of scores that a notebook shows."""
        return self.summary.select("strategy", "filter", *shown_in("notebook"))

    def __repr__(self) -> str:
        """Format the scores as a text table."""
        return f"Results of a mission\n{self._scores_shown()}"

    def _repr_html_(self) -> str:
        """Format the figure and a table of the scores as HTML."""
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
    beamwidth: float | None = None,
    landmarks: int | None = None,
    duration: float | None = None,
    particles: int | None = None,
    world: Path | str | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    animate: Literal["gif", "mp4"] | None = None,
    save_bag: bool = False,
    save_log: Path | str | None = None,
    save_world: Path | str | None = None,
    save_sound: Path | str | None = None,
    frames: str | None = None,
    sound_bits: Literal[32, 16] = 32,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Simulate a drive through a world and map it, as `pipistrelle run` does.

    Settings are keywords: ``seed=3``, ``rays__exponent=8.0``, or sections,
    ``air={"temperature_c": 5.0}``; `pipistrelle config show` lists them. Environment variables
    apply only on the command line.

    Parameters
    ----------
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from. The rest is ``settings="best"``, unless they name other settings; a
        `Config` is complete.
    strategies : "active", "fused", "passive", several with commas, or "all"
        Echoes to use: of the vehicle's calls (active), of others' (passive), of both (fused).
    filters : str or class, optional
        Estimators, separated by commas; "both" are the paper's two.
    beamwidth : float, optional
        Half-power beamwidth of the vehicle's call [deg], up to 180; sets emitter.radius.
    landmarks : int, optional
        Number of landmarks; sets scenario.landmarks.
    duration : float, optional
        Length of the drive [s]; sets scenario.steps.
    particles : int, optional
        Particles of FastSLAM; sets fastslam.particles.
    world : Path, optional
        A world of your own: landmarks.csv, path.csv, world.toml; sets scenario.world.
    output : Path, optional
        Folder of the results.
    overwrite : bool
        Replace earlier files of the same kind in the named folders.
    animate : "gif" or "mp4", optional
        Film the mission into the result folder.
    save_bag : bool
        Write tracks and maps also as a ROS bag, mission.mcap, into the result folder.
    save_log : Path, optional
        Write the measurements (fused, if sensed) as a log for `slam` into this folder.
    save_world : Path, optional
        Write the simulated world into this folder, for `world`.
    save_sound : Path, optional
        Write the sound at the microphones into this folder, as a recording for `hear`.
    frames : str, optional
        Frames of the sound: A:B is from number A, counted from 0, to before B.
    sound_bits : 32 or 16
        Samples of the sound: floats of 32 bits or integers of 16.
    progress : callable, optional
        Called with the stage, the number of frames done, and their total.
    **settings
        Any other setting.

    Raises
    ------
    InputError
        For an unknown setting, a bad value, or an unusable world, estimator or folder.

    Examples
    --------
    >>> quiet = run(strategies="active", duration=4.0, landmarks=10, beacon__level_db=-50.0)
    >>> quiet.measurements["range_m"].null_count()
    0
    >>> run(rays__merg=3)
    Traceback (most recent call last):
    pipistrelle.config.InputError: rays__merg: no such setting; did you mean rays__merge?
    """
    asked = {**locals()}
    if isinstance(landmarks, Iterable) and not isinstance(landmarks, str):
        fix = "places of your own are a world's: write them into one, and name it by world="
        raise refusal("landmarks", shown(landmarks), "the number of landmarks", fix)
    flags = from_keywords(settings, run.__kwdefaults__ or ())
    default = "paper" if isinstance(config, Config) else RUN_NAMES
    return _called(run_by, asked, flags, command="pipistrelle.run(...)", default=default)


def run_by(door: Door) -> Results:
    """Simulate a mission as `run` does, with the arguments in `door`."""
    config, world, usual = mission_settings(door)
    strategies = named_strategies(door.asked["strategies"], door.option("strategies"))
    names = door.estimators(usual)
    from pipistrelle.scripting.missions import Recordings, simulated

    mission_of = partial(simulated, config, strategies, names, world)
    with closing(Recordings(config, world, door)) as recordings:
        return _conducted(mission_of, door, "run", door.working(config, names), recordings)


def slam(
    log: Path | str,
    /,
    *,
    config: Base = None,
    robot: Robot | None = None,
    strategies: str | Sequence[str] = "fused",
    filters: Filters | None = None,
    particles: int | None = None,
    beamwidth: float | None = None,
    gate: float | Literal["auto"] | None = None,
    truth: str | None = None,
    output: Path | str | None = None,
    overwrite: bool = False,
    animate: Literal["gif", "mp4"] | None = None,
    save_bag: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Estimate path and map from a recorded log, as `pipistrelle slam` does.

    Doubtful values in the log are warnings; settings that the log decides are refused.

    Parameters
    ----------
    log : Path
        A log folder or a ROS bag; ``bag={"odometry": "/odom", "truth": "/pose"}`` names topics.
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from.
    robot : int or str, optional
        The robot, by number or name, if there are several.
    strategies : "active", "fused", "passive", several with commas, or "all"
        Rows to use: with a range (active), all (fused), or all by bearing (passive).
    filters : str or class, optional
        Estimators, separated by commas; "both" are the paper's two.
    particles : int, optional
        Particles of FastSLAM; sets fastslam.particles.
    beamwidth : float, optional
        Discard ranges outside a beam of this width [deg] about the heading.
    gate : float or "auto", optional
        Probability of the gate: measurements outside this share of their predicted distribution
        are rejected; sets filter.gate.
    truth : str, optional
        Topic of a ROS bag with the true pose of the vehicle; sets bag.truth.
    output : Path, optional
        Folder of the results.
    overwrite : bool
        Replace earlier results in it.
    animate : "gif" or "mp4", optional
        Film the mission into the result folder.
    save_bag : bool
        Write tracks and maps also as a ROS bag, mission.mcap, into the result folder.
    progress : callable, optional
        Called with the stage, the number of frames done, and their total.
    **settings
        Any other setting.

    Raises
    ------
    InputError
        For an error in the log, with its line or key; else as `run`.
    """
    asked, command = {**locals()}, f"pipistrelle.slam({str(log)!r}, ...)"
    flags = from_keywords(settings, slam.__kwdefaults__ or ())
    return _called(slam_by, asked, flags, command=command)


def slam_by(door: Door) -> Results:
    """Estimate path and map from a log as `slam` does, with the arguments in `door`."""
    layer, usual = over_named(door.beneath, door.flags)
    strategies = named_strategies(door.asked["strategies"], door.option("strategies"))
    names = door.estimators(usual or SLAM_TAKES)
    from pipistrelle.scripting.missions import prepare_slam

    mission_of = prepare_slam(door, layer, strategies, names)
    return _conducted(mission_of, door, "slam", door.working())


def _conducted(
    mission_of: "Callable[..., Mission]",
    door: Door,
    name: str,
    working: AbstractContextManager[Any],
    recordings: "Recordings | None" = None,
) -> Results:
    """Run a mission, write its results into a folder and issue its warnings."""
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.experiments.results.writing import result_folder
    from pipistrelle.scripting.missions import filmed, keep

    path, flags = door.folder("output"), door.ways_out("output")
    animate, save_bag, watch = door.asked["animate"], door.asked["save_bag"], None
    if animate:
        from pipistrelle.figures.film import film_writer
        from pipistrelle.figures.recorder import MissionRecorder

        film_writer(Path(f"mission.{animate}"))
        watch = MissionRecorder()
    if save_bag:
        from pipistrelle.detection.logs.bag import need_rosbags

        need_rosbags(door.option("save_bag"))
    kept: AbstractContextManager[OwnFiles | None] = nullcontext()
    if path is not None or door.makes_folder:
        kept = result_folder(path, name, overwrite=door.asked["overwrite"], flags=flags)
    elif option := next((one for one in ("animate", "save_bag") if door.asked[one]), None):
        fix = f"name one by {flags[0]}"
        raise refusal(option, shown(door.asked[option]), "a result folder for it", fix)
    with kept as own:
        keep_freed_memory()
        with working as progress:
            asked = {"progress": progress, "watch": watch}
            mission = recordings.conduct(mission_of, **asked) if recordings else mission_of(**asked)

        def film(room: Path) -> None:
            if watch is not None and watch.snapshots:
                with door.drawing(f"Drawing mission.{animate} ..."):
                    filmed(mission, watch, room / f"mission.{animate}")

        if own is not None:
            keep(mission, own, door.command, film=film, save_bag=save_bag)
        if recordings is not None:
            recordings.write(mission)
        door.warn(*mission.notes())
    return Results(
        lambda watch: mission_of(progress=progress, watch=watch),
        mission,
        None if own is None else own.folder,
        door.command,
    )


def _called(
    conduct_by: Callable[[Door], Results], asked: dict[str, Any], flags: Layer, **more: str
) -> Results:
    """Run a mission that was called from Python; warn of failed estimates."""
    from pipistrelle.jit import announce
    from pipistrelle.scripting.missions import failures

    door = Door(
        asked=asked,
        beneath=base_layer(asked["config"]),
        flags=flags,
        working=lambda *_: nullcontext(asked["progress"]),
        **more,  # pyrefly: ignore[bad-argument-type]
    )
    announce()
    results = conduct_by(door)
    door.warn(*failures(results.mission))
    return results


def load(
    folder: Path | str, /, *, filters: Filters = (), association: str = ""
) -> "Results | StudyResults":
    """Open a result folder of a mission or study; for figures, the mission is run again.

    Parameters
    ----------
    folder : Path
        A folder written by `pipistrelle run`, `slam` or `study`.
    filters : str or class, or several of them, optional
        Estimators of your own, by name or class, that the mission was conducted with. Code that a
        folder names runs only if you name it here.
    association : str, optional
        An association of your own, ``module:Class``, under the same condition.

    Raises
    ------
    InputError
        For a folder without results; when a mission is conducted again, for an estimator or
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
    from pipistrelle.experiments.results.reading import read_summary
    from pipistrelle.experiments.runs.replay import rerun

    place = folder_named(folder, "load")
    if kind_of(place) == STUDY:
        from pipistrelle.scripting.studies import StudyResults

        return StudyResults(place)
    read_summary(place)
    trusted = (*(named_filters(filters) if filters else ()), association)

    def redo(watch: "Watch | None") -> "Mission":
        mission = rerun(place, trusted=trusted, watch=watch)
        if mission.difference:
            warnings.warn(mission.difference, stacklevel=3)
        return mission

    return Results(redo, folder=place)
