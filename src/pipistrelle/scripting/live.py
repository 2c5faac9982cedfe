"""`Slam`: online SLAM of a vehicle that drives now, by single steps and scans."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import inf, nan, tau
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.recording import CALLER, MAX_TIME, STATED, Log, LogCaller, scan_at
from pipistrelle.detection.logs.vehicle import NOISY, read_vehicle, vehicle_of
from pipistrelle.detection.logs.vehicle import Vehicle as VehicleKeys
from pipistrelle.detection.noise import noise_of
from pipistrelle.detection.scans import OWN
from pipistrelle.estimation.beliefs import KNOWN, Belief, Gaussian, completed
from pipistrelle.estimation.catalogue import ASSOCIATION, ESTIMATOR, class_of, entry, names_class
from pipistrelle.estimation.checking import usable_controls
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.fastslam.filter import FastSlamBelief
from pipistrelle.estimation.session import Session
from pipistrelle.experiments.drives import NO_TRUTH, at_sensor, carried, vehicle_in
from pipistrelle.experiments.hearing.trajectories import TIME_TOLERANCE
from pipistrelle.experiments.named_settings import check_own, laid, over_named, own_config
from pipistrelle.experiments.results.writing import landmark_table, path_table
from pipistrelle.experiments.runs.replay import (
    LABELS,
    check_calibrated,
    drive_of,
    with_noise,
    without_unused,
)
from pipistrelle.experiments.runs.trial import with_moving
from pipistrelle.experiments.runs.validate import check_filters
from pipistrelle.refusals import meant, refusal, shown
from pipistrelle.scripting.arguments import (
    TIMING,
    Base,
    base_layer,
    check_open,
    folder_named,
    named_filters,
    with_log,
)
from pipistrelle.scripting.saved_state import (
    DriveState,
    check_going_on,
    read_state,
    refused_if_forged,
    write_state,
)
from pipistrelle.settings import Given, from_keywords
from pipistrelle.text_tables import Table

if TYPE_CHECKING:
    import polars as pl

Vehicle = Path | str | Mapping[str, Any]
"""A ``log.toml``, or its keys."""
OF_ITSELF = {"format": 1, "initial_pose": [0.0, 0.0, 0.0], "initial_pose_std": [0.0, 0.0, 0.0]}
"""Defaults of keys that a table may omit: the frame begins at the vehicle."""
KEPT = 100_000
"""Number of last steps with kept poses."""
ROUNDING = float(np.finfo(float).eps) ** 0.5
"""Half of the digits of a number."""
OWN_WORDS = ("filter", "config", "time", "kept")
"""Keywords that are not settings."""
OF_TRUTH = ("true_x_m", "true_y_m", "error_m", "true_landmark")
"""Columns of a map that only a world with truth has."""
COLUMNS = ("landmark", "bearing", "range", CALLER, *STATED)
"""Columns of a scan."""
_NO_NUMBERS = (str, bytes, bool, np.bool_, complex, np.complexfloating)
"""Types that NumPy converts to numbers, but that are errors here."""
Times = tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]
"""Ends of steps, and their lengths [s]."""
R = TypeVar("R")


class Pose(NamedTuple):
    """Estimated pose of the vehicle at a time, with its covariance."""

    time: float
    """[s]."""
    x: float
    """[m]."""
    y: float
    """[m]."""
    heading: float
    """From the x axis, counter-clockwise [rad]."""
    covariance: Float[np.ndarray, "3 3"]
    """Covariance of x, y and heading [m, m, rad]."""


class Slam:
    """Online SLAM: estimates pose and map of a vehicle step by step while it drives.

    The results are bit-identical to `pipistrelle slam` with the same steps and rows. A call that
    raises an error changes nothing.

    Parameters
    ----------
    vehicle : Path or mapping
        Motion and measurement noise: a ``log.toml``, or a table of its keys, in which ``format``,
        ``initial_pose`` and ``initial_pose_std`` are optional.
    filter : str or class
        Estimator by name, ``module:Class`` or class. Time and memory of the EKFs are bounded; the
        history of the smoother grows unless ``filter__window`` bounds it.
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from.
    time : float [s]
        Time of the start.
    kept : int
        Number of last steps in `path`.
    **settings
        As in `pipistrelle.slam`.

    Raises
    ------
    InputError
        For a bad vehicle, estimator or setting.

    Examples
    --------
    >>> robot = {"motion": "unicycle", "velocity_std": 0.1, "angular_rate_std": 0.1,
    ...          "range_std": 0.1, "bearing_std": 0.02, "range_bounds": [0.5, 20.0]}
    >>> slam = Slam(robot, filter="iekf")
    >>> slam.move([1.0, 0.0], dt=1.0)
    >>> slam.hear(landmark=[7], bearing=[0.0], range=[2.0])
    array([7])
    >>> slam.pose.x, slam.map["x_m"].to_list()
    (1.0, [3.0])
    >>> slam.move([1.0, 0.0], time=0.5)
    Traceback (most recent call last):
    pipistrelle.config.InputError: move: found the time 0.5 s, expected one after 1.0 s, where the
    vehicle is; leave out steps that come late
    """

    def __init__(
        self,
        vehicle: Vehicle,
        /,
        *,
        filter: str | type = "iekf",  # noqa: A002 - the name of the option
        config: Base = None,
        time: float = 0.0,
        kept: int = KEPT,
        **settings: Any,
    ) -> None:
        if not isinstance(kept, int) or isinstance(kept, bool) or kept < 1:
            raise refusal("kept", shown(kept), "a number of steps, 1 or more", "correct it")
        start, flags = finite(time, "time"), from_keywords(settings, OWN_WORDS)
        check_clock(np.array([start]))
        check_open(flags)
        log, where, told = _log_of(vehicle, start)
        named, _ = over_named(base_layer(config), flags)
        layer = laid({TIMING: Given(True, "Slam")}, named)
        check_own(layer)
        resolved, _ = with_log(layer, log, where)
        names = named_filters(filter, "filter")
        if len(names) > 1:
            raise refusal("filter", ", ".join(names), "one estimator", "make a Slam of each")
        self._begin(log, told, own_config(resolved, names[0]), names[0], kept)

    def _begin(self, log: Log, told: VehicleKeys, config: Config, name: str, kept: int) -> None:
        """Build the estimator and its state at the start of the drive."""
        self._log, self._vehicle, self._config = log, told, config
        self._name, self._kept = name, kept
        drive = drive_of(log, NO_TRUTH)
        check_filters([name], drive.motion, config, drive.moving.values())
        check_calibrated(log, config)
        self._drive, found, sensor = drive, entry(name), at_sensor(drive)
        self._follows = found.follows and config.listening.excess_paths
        self._session: Session[Any] = Session(
            found.build(config, sensor.motion),
            sensor.start,
            np.random.default_rng(stream_key(config.seed, 0, name)),
            known=drive.known,
            callers=drive.callers,
            association=association_of(config),
            noise=noise_of(config.filter),
            live=True,
        )
        self._time = float(log.time[0])
        self._heard: set[tuple[Any, ...]] = set()
        self._poses = [(self._time, self._at_vehicle(sensor.start))]

    @property
    def time(self) -> float:
        """Time at the end of the last step [s]."""
        return self._time

    @property
    def pose(self) -> Pose:
        """Estimated pose of the vehicle at the present time."""
        pose = self._at_vehicle(self._session.belief.pose())
        values, axes = np.linalg.eigh(pose.covariance)
        covariance = pose.covariance if values[0] >= 0.0 else (axes * values.clip(0.0)) @ axes.T
        x, y, heading = pose.mean.tolist()
        return Pose(self._time, x, y, heading, covariance.copy())

    @property
    def map(self) -> "pl.DataFrame":
        """Table of the map, a row per hypothesis of each landmark, as in ``landmarks.parquet``."""
        return landmark_table(self._session.landmarks(), None).drop(OF_TRUTH)

    @property
    def moving(self) -> "pl.DataFrame":
        """Table of the moving callers, with the columns of `map`."""
        return landmark_table(completed(self._session.belief, Belief).moving(), None).drop(OF_TRUTH)

    @property
    def alarms(self) -> list[tuple[float, str, bool]]:
        """Failures so far of a drive without labels: time [s], cause, and whether it was repaired.

        The cause is ``"pose"``, ``"vehicle"`` (its ranges do not fit) or a caller's name. Path and
        map are not to be trusted after a failure that was not repaired.
        """
        names = ["pose", "vehicle", *(caller.name for caller in self._log.callers)]  # from -1 on
        alarms = self._session.report().get("alarms", ())
        return [(time, names[call + 1], repaired) for time, call, repaired in alarms]

    @property
    def path(self) -> "pl.DataFrame":
        """Table of time, pose and standard deviations, at the start and after each step.

        The smoothed trajectory, if the estimator revises it; else the kept estimates.
        """
        time, online = self._online()
        revised = completed(self._session.belief, Belief).path()
        if revised is None:
            return path_table(time, online)
        smoothed, kept = self._at_vehicle(revised), slice(-time.size, None)
        poses = Gaussian(mean=smoothed.mean[kept], covariance=smoothed.covariance[kept])
        return path_table(time, poses)

    def move(
        self,
        controls: Sequence[float] | Float[np.ndarray, "k c"],
        dt: float | Sequence[float] | None = None,
        *,
        time: float | Sequence[float] | None = None,
    ) -> None:
        """Predict the vehicle's pose by one step of odometry, or by k steps.

        Parameters
        ----------
        controls : (c) or (k, c)
            By the motion model of the vehicle: velocity [m/s] and angular rate [rad/s]; speed and
            steering angle [rad]; or displacement ahead, to the left [m] and rotation [rad].
        dt : float or (k) [s], optional
            Length of each step.
        time : float or (k) [s], optional
            End of each step, in place of `dt`.

        Raises
        ------
        InputError
            For bad controls or times; nothing has changed then.
        """
        ends, lengths = times_of(dt, time, self._time)
        steps = np.atleast_2d(numbers(controls, "controls"))
        try:
            steps, lengths = usable_controls(self._drive.motion, steps, lengths)
        except InputError as error:  # names the method of the estimator
            raise InputError(str(error).replace("predict:", "move:", 1)) from None
        if not lengths.size:
            return
        check_clock(ends, self._time)
        times = np.array([self._time, *ends])
        gone = at_sensor(replace(self._drive, time=times, controls=steps)).controls
        poses = self._change(lambda: self._session.move(gone, lengths))
        placed = self._at_vehicle(poses)
        self._poses += [
            (end, Gaussian(mean=placed.mean[k], covariance=placed.covariance[k]))
            for k, end in enumerate(ends.tolist())
        ]
        if len(self._poses) > 2 * self._kept:
            del self._poses[: -self._kept]
        self._time, self._heard = float(ends[-1]), set()

    def hear(self, *, time: float | None = None, **columns: Any) -> Int[np.ndarray, " m"]:
        """Update pose and map with a scan that was measured at the present pose.

        Parameters
        ----------
        time : float [s], optional
            Time of the scan, which must be that of the vehicle.
        bearing : (m) [rad]
            From the heading, counter-clockwise; NaN or None in rows with only an excess path.
        landmark : (m), optional
            Labels; rows without (None) are associated by ``association__method``.
        range, excess_path : (m) [m], optional
            NaN or None in rows without.
        caller : (m) of str, optional
            Name of the caller; None for the vehicle itself.
        bearing_std, range_std, excess_path_std : (m) [rad], [m], [m], optional
            Standard deviations, in place of the general ones of the vehicle.

        Returns
        -------
        (m)
            The known or associated label of each row; -1 for clutter.

        Raises
        ------
        InputError
            For bad rows, or rows used before; nothing has changed then.
        """
        if time is not None and abs((stamp := finite(time, "time")) - self._time) > TIME_TOLERANCE:
            late = "the vehicle has moved on: leave out scans that come late"
            early = "move to it first, by a part of a step if need be"
            expected = f"{self._time} s, where the vehicle is"
            fix = early if stamp > self._time else late
            raise refusal("hear", f"the time {stamp} s", expected, fix)
        known = self._config.association.method == KNOWN
        table = table_of(columns, self._log.callers, labelled=known)
        if not table.line.size:
            return table.column["landmark"]
        scan = scan_at(self._time, table, self._log.callers, known=known)
        names = ("landmark", CALLER, "bearing", "range", "excess_path")
        numbers_of = (np.nan_to_num(table.column[name], nan=-1.0).tolist() for name in names)
        rows = zip(*numbers_of, strict=True)
        fresh = {row[:2] if row[0] >= 0 else row for row in rows}  # by label, or by all numbers
        if fresh & self._heard:
            found, fix = f"rows once more at {self._time} s", "leave out what came twice"
            raise refusal("hear", found, "each once", fix)
        scan = with_noise(without_unused(scan, self._config), self._config)
        (scan,) = with_moving([scan], self._drive, follows=self._follows, known=known)
        self._change(lambda: self._session.hear(scan))
        self._heard |= fresh
        pose = self._at_vehicle(self._session.belief.pose())
        self._poses[-1] = (self._time, pose)
        if not self._session.labels:
            return table.column["landmark"]
        order = np.argsort(np.isnan(table.column["bearing"]), kind="stable")  # as in the scan
        return self._session.labels[-1][np.argsort(order)]

    def save(self, file: Path | str) -> Path:
        """Write the vehicle, the settings and the estimates into a file that `load` reads.

        An existing file is replaced only if `save` wrote it.
        """
        path = folder_named(file, "file")
        times, online = self._online()
        state = DriveState(
            name=self._log.name,
            start=float(self._log.time[0]),
            vehicle=self._vehicle.model_dump(),
            settings=self._config.model_dump(mode="json"),
            kept=self._kept,
            session=self._session.state(),
            heard=frozenset(self._heard),
            times=times,
            means=online.mean,
            covariances=online.covariance,
        )
        write_state(path, (self._name, self._config.association.method), state)
        return path

    @classmethod
    def load(
        cls,
        file: Path | str,
        *,
        filter: str | type | None = None,  # noqa: A002 - the name of the option
        association__method: str | None = None,
    ) -> Self:
        """Restore a drive from a file that `save` wrote; it continues with the same bits.

        Parameters
        ----------
        file : Path
        filter : str or class, optional
            The estimator of the file, if it is one of your own: a file alone imports no module.
        association__method : str, optional
            The association of the file, ``module:Class``, if it is one of your own.

        Raises
        ------
        InputError
            For a file of another version or program, or a changed file.
        """
        path = folder_named(file, "file")
        named = None if filter is None else named_filters(filter, "filter")[0]
        for role, name in ((ESTIMATOR, named), (ASSOCIATION, association__method)):
            if name is not None and names_class(name):
                class_of(role, name)
        own = {"filter": named, "association__method": association__method}
        slam = cls.__new__(cls)
        with refused_if_forged(path):
            names, state = read_state(path, own)
            slam._go_on_from(*names, state)
        return slam

    def _go_on_from(self, name: str, association: str, state: DriveState) -> None:
        """Restore this drive from the parsed contents of a file that `save` wrote."""
        config = Config.model_validate(state.settings)
        belief, method = state.session.belief, config.association.method
        particles = isinstance(belief, FastSlamBelief) and belief.log_weight.size
        if method != association or particles not in (False, config.fastslam.particles):
            raise ValueError("settings")
        log, _, vehicle = _log_of(state.vehicle, finite(state.start, "start"))
        self._begin(replace(log, name=state.name), vehicle, config, name, state.kept)
        check_going_on(self._session.state(), state.session, own=names_class(name))
        self._session.go_on_from(state.session)
        parts = zip(state.times.tolist(), state.means, state.covariances, strict=True)
        self._poses = [(t, Gaussian(mean=m, covariance=P)) for t, m, P in parts]
        self._time, self._heard = self._poses[-1][0], {*state.heard}
        check_clock(state.times)
        now = self._session.belief.pose()
        variances = np.diagonal(state.covariances, axis1=1, axis2=2)
        for array in (now.mean, now.covariance, state.means, state.covariances, np.sqrt(variances)):
            if not np.isfinite(array).all():
                raise ValueError("a pose that is no number")

    def copy(self) -> Self:
        """Return an independent copy of the drive, which continues with the same bits."""
        other = type(self).__new__(type(self))
        other._begin(self._log, self._vehicle, self._config, self._name, self._kept)
        other._session.go_on_from(self._session.state())
        other._poses, other._time, other._heard = [*self._poses], self._time, {*self._heard}
        return other

    def __repr__(self) -> str:
        """Format the estimator, the pose and the number of landmarks in a line."""
        pose, landmarks = self.pose, self._session.landmarks().landmark
        return (
            f"Slam by {self._name} at {pose.time:g} s: x {pose.x:.3f} m, y {pose.y:.3f} m, heading "
            f"{pose.heading:.3f} rad; {np.unique(landmarks).size} landmarks"
        )

    def _online(self) -> tuple[Float[np.ndarray, " k"], Gaussian]:
        """Return the times of the last steps, and the pose as estimated at each time."""
        times, poses = zip(*self._poses, strict=True)
        mean = np.array([pose.mean for pose in poses])
        covariance = np.array([pose.covariance for pose in poses])
        return np.array(times), Gaussian(mean=mean, covariance=covariance)

    def _change(self, act: Callable[[], R]) -> R:
        """Call a function that changes the estimator's state; undo the change if it raises."""
        before = self._session.state()
        try:
            result = act()
            if fault := _fault(self._session.belief.pose()):
                fix = "this step or scan was not taken in; is it in metres, seconds and radians?"
                raise refusal(f"at {self._time:g} s", *fault, fix)
            return result
        except BaseException:
            self._session.go_on_from(before)
            raise

    def _at_vehicle(self, pose: Gaussian) -> Gaussian:
        """Convert an estimated pose of the sensor to the pose of the vehicle."""
        sensor = self._drive.sensor
        return carried(pose, vehicle_in(sensor)) if any(sensor) else pose


def _fault(pose: Gaussian) -> tuple[str, str] | None:
    """Return the fault of an estimated pose and the expected state; None for a valid pose.

    Rounding makes an eigenvalue of 0 slightly negative, by less than half of the digits.
    """
    if not (np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()):
        return "a pose that is no number", "a finite one"
    with suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(pose.covariance)  # faster than the eigenvalues
        return None
    least, *_, largest = np.linalg.eigvalsh(pose.covariance).tolist()
    if least < -ROUNDING * largest:
        return f"a pose unsure to {largest**0.5:.3g} m, beyond what numbers can hold", "a surer one"
    return None


def _log_of(vehicle: Vehicle, time: float) -> tuple[Log, Path, VehicleKeys]:
    """Return an empty log of a vehicle, the path of its description, and its parsed keys."""
    if isinstance(vehicle, Mapping):
        where = Path("vehicle")
        told = vehicle_of(OF_ITSELF | dict(vehicle), where)
    elif isinstance(vehicle, (str, Path)):
        where = Path(vehicle)
        told = read_vehicle(Path(vehicle))
    else:
        fix = "see docs/log_format.md"
        raise refusal("vehicle", shown(vehicle), "the path of a log.toml, or its keys", fix)
    none = {"scans": (), "ignored_rows": {}, "dt": np.empty(0)}
    controls, start = np.empty((0, len(NOISY[told.motion]))), np.array([time])
    log = Log(name=str(where), time=start, controls=controls, **none, **told.told())
    return log, where, told


def numbers(values: object, where: str) -> Float[np.ndarray, "*n"]:
    """Convert values to a float array, None and masked values to NaN; raise for other types."""
    try:
        given = np.asarray(values)
        if isinstance(values, np.ma.MaskedArray):
            given = given.astype(object)
            given[np.ma.getmaskarray(values)] = None
        if given.dtype.kind not in "iuf":
            if given.dtype.kind != "O" or any(isinstance(v, _NO_NUMBERS) for v in given.flat):
                raise TypeError
            given = np.array(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise refusal(where, shown(values), "numbers", "correct it") from None
    return given.astype(float)


def finite(value: object, where: str) -> float:
    """Convert a value to a single finite float, or raise InputError."""
    number = numbers(value, where)
    if number.shape != () or not np.isfinite(number):
        raise refusal(where, shown(value), "a finite number", "correct it")
    return float(number)


def times_of(dt: object, time: object, now: float) -> Times:
    """Return the end times and the lengths [s] of control steps, given either of them."""
    if (dt is None) == (time is None):
        found = "neither dt nor time" if dt is None else "both dt and time"
        fix = "say how long the step took, or when it ended"
        raise refusal("move", found, "one of them", fix)
    if time is None:
        lengths = np.atleast_1d(numbers(dt, "dt"))
        return now + np.cumsum(lengths), lengths
    ends = np.atleast_1d(numbers(time, "time"))
    if ends.ndim > 1:
        raise refusal("move", f"times of the shape {ends.shape}", "one for each step", "correct it")
    lengths = np.diff(ends, prepend=now)
    late = np.flatnonzero(~(lengths > 0.0))
    if late.size:
        k = int(late[0])
        before = f"{ends[k - 1].item()} s" if k else f"{now} s, where the vehicle is"
        found = f"the time {ends[k].item()} s"
        raise refusal("move", found, f"one after {before}", "leave out steps that come late")
    return ends, lengths


def check_clock(ends: Float[np.ndarray, " k"], now: float = -inf) -> None:
    """Raise if a time exceeds `MAX_TIME`, or a step after `now` [s] is too short for floats."""
    if (far := np.abs(ends) > MAX_TIME).any():
        found = f"the time {ends[far][0].item()} s"
        raise refusal("time", found, f"seconds, up to {MAX_TIME:g}", "take another zero or unit")
    if not (np.diff(ends, prepend=now) > 0.0).all():
        found, expected = f"a step too short for a clock at {now} s", "a later time at its end"
        raise refusal("move", found, expected, "join it with the next, or take another zero")


def table_of(columns: Mapping[str, Any], callers: Sequence[LogCaller], *, labelled: bool) -> Table:
    """Check a scan's columns and convert them to a log's table; `labelled` requires labels."""
    if unknown := sorted(columns.keys() - {*COLUMNS}):
        near = meant(unknown[0], COLUMNS)
        fix = f"did you mean {near!r}?" if near else "leave it out"
        raise refusal("hear", repr(unknown[0]), f"some of {', '.join(COLUMNS)}", fix)
    given = {name: values for name, values in columns.items() if values is not None}
    if CALLER in given:
        names, known = given[CALLER], [caller.name for caller in callers]
        whole = [names] if names is None or isinstance(names, str) else names
        number = {None: nan, "": nan} | {n: float(k) for k, n in enumerate(known, start=OWN + 1)}
        try:
            given[CALLER] = [number[name] for name in whole]
        except (KeyError, TypeError):
            expected = " or ".join([*map(repr, known), "None, the vehicle itself"])
            fix = "say the vehicle's callers"
            raise refusal("hear, caller", shown(names), expected, fix) from None
    column = {name: np.atleast_1d(numbers(values, name)) for name, values in given.items()}
    shapes = {name: values.shape for name, values in column.items()}
    if len({*shapes.values()}) > 1 or any(len(shape) > 1 for shape in shapes.values()):
        raise refusal("hear", f"columns of the shapes {shapes}", "one row each", "correct them")
    (size,) = next(iter(shapes.values()), (0,))
    column = {name: column.get(name, np.full(size, nan)) for name in COLUMNS}
    if (far := column["bearing"][np.abs(column["bearing"]) > tau]).size:
        raise refusal("hear, bearing", f"{far[0]:g}", "radians, within a turn", "convert it")
    if labelled and np.isnan(column["landmark"]).any():
        raise refusal("hear", "no landmark", LABELS, 'give association__method="marginal"')
    return Table(path="hear", line=np.arange(1, size + 1), unit="row", column=column)
