"""A vehicle that drives now: a step and a scan at a time, as the robot has them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.recording import Log, scan_at
from pipistrelle.detection.logs.vehicle import ODOMETRY, read_vehicle, vehicle_of
from pipistrelle.detection.logs.vehicle import Vehicle as VehicleKeys
from pipistrelle.detection.noise import noise_of
from pipistrelle.estimation.association import KNOWN
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, answer, no_landmarks
from pipistrelle.estimation.catalogue import ASSOCIATION, ESTIMATOR, class_of, entry, names_class
from pipistrelle.estimation.checking import usable_controls
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.fastslam.filter import FastSlamBelief
from pipistrelle.estimation.session import Session
from pipistrelle.experiments.drives import NO_TRUTH, at_sensor, carried, vehicle_in
from pipistrelle.experiments.named_settings import check_own, laid, over_named, own_config
from pipistrelle.experiments.results.tables import landmark_table, path_table
from pipistrelle.experiments.runs.replay import (
    check_calibrated,
    drive_of,
    with_noise,
    without_unused,
)
from pipistrelle.experiments.runs.trial import with_moving
from pipistrelle.experiments.runs.validate import check_filters
from pipistrelle.refusals import refusal, shown
from pipistrelle.scripting.arguments import Base, base_layer, folder_named, named_filters
from pipistrelle.scripting.live_rows import (
    check_clock,
    check_now,
    finite,
    keys_of,
    numbers,
    table_of,
    times_of,
)
from pipistrelle.scripting.log_settings import TIMING, check_open, with_log
from pipistrelle.scripting.saved_records import check_going_on
from pipistrelle.scripting.saved_state import DriveState, Named, not_saved, read_state, write_state
from pipistrelle.settings import Given, from_keywords

if TYPE_CHECKING:
    import polars as pl

Vehicle = Path | str | Mapping[str, Any]
"""A ``log.toml``, or its keys."""
OF_ITSELF = {"format": 1, "initial_pose": [0.0, 0.0, 0.0], "initial_pose_std": [0.0, 0.0, 0.0]}
"""Keys that a table need not have: the frame begins where the vehicle stands."""
KEPT = 100_000
"""Of how many of the last steps the poses are kept."""
ROUNDING = float(np.finfo(float).eps) ** 0.5
"""Half of the digits of a number."""
OWN_WORDS = ("filter", "config", "time", "kept")
"""Keywords that are no settings."""
R = TypeVar("R")


class Pose(NamedTuple):
    """Where the vehicle is."""

    time: float
    """[s]."""
    x: float
    """[m]."""
    y: float
    """[m]."""
    heading: float
    """From the x axis, counter-clockwise [rad]."""
    covariance: Float[np.ndarray, "3 3"]
    """Of x, y and heading [m, m, rad]."""


class Slam:
    """Position and map of a vehicle that drives now.

    What is refused changes nothing, and what `pipistrelle slam` would find of the same steps and
    rows is found to the bit: both conduct a `Session`.

    Parameters
    ----------
    vehicle : Path or mapping
        How it moves and how surely it measures: a ``log.toml``, or a table of its keys, of which
        ``format``, ``initial_pose`` and ``initial_pose_std`` may be left out.
    filter : str or class
        An estimator by its name, ``module:Class`` or its class. The EKFs need bounded time and
        memory; the smoother's history grows with the drive unless ``filter__window`` bounds it.
    config : Config, mapping, name, or path of a TOML file, optional
        Settings to start from.
    time : float [s]
        Of the start.
    kept : int
        Of how many of the last steps the poses are kept, for `path`.
    **settings
        As of `pipistrelle.slam`.

    Raises
    ------
    InputError
        For a vehicle, an estimator or a setting that cannot be had.

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
        filter: str | type = "iekf",  # noqa: A002 - as the command line has it
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
        """Build the estimator, at the start."""
        self._log, self._vehicle, self._config = log, told, config
        self._name, self._kept = name, kept
        drive = drive_of(log, NO_TRUTH)
        check_filters([name], drive.motion, config, drive.moving.values())
        check_calibrated(log, config)
        self._drive, found, sensor = drive, entry(name), at_sensor(drive)
        self._follows = found.follows and config.listening.timing
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
        """Where the last step ended [s]."""
        return self._time

    @property
    def pose(self) -> Pose:
        """Where the vehicle is, as it is believed now."""
        pose = self._at_vehicle(self._session.belief.pose())
        values, axes = np.linalg.eigh(pose.covariance)
        covariance = pose.covariance if values[0] >= 0.0 else (axes * values.clip(0.0)) @ axes.T
        x, y, heading = pose.mean.tolist()
        return Pose(self._time, x, y, heading, covariance.copy())

    @property
    def map(self) -> "pl.DataFrame":
        """The landmarks, a row for each hypothesis, as ``landmarks.parquet`` has them."""
        return _map_table(self._session.landmarks())

    @property
    def moving(self) -> "pl.DataFrame":
        """The callers that move, as `map` has landmarks."""
        return _map_table(answer(self._session.belief, "moving") or no_landmarks())

    @property
    def path(self) -> "pl.DataFrame":
        """The start and the end of each step: time, pose and standard deviations.

        As the estimator believes them now, of one that revises its path; else as they were believed
        at their time, the last of them that are kept.
        """
        time, online = self._online()
        revised = answer(self._session.belief, "path")
        if revised is None:
            return path_table(time, online)
        whole, kept = self._at_vehicle(revised), slice(-time.size, None)
        return path_table(time, Gaussian(mean=whole.mean[kept], covariance=whole.covariance[kept]))

    def move(
        self,
        controls: Sequence[float] | Float[np.ndarray, "k c"],
        dt: float | Sequence[float] | None = None,
        *,
        time: float | Sequence[float] | None = None,
    ) -> None:
        """Take in one step, or k of them.

        Parameters
        ----------
        controls : (c) or (k, c)
            Velocity [m/s] and angular rate [rad/s], speed and steering angle [rad], or the motion
            ahead, to the left [m] and turned [rad], as the vehicle's motion model has them.
        dt : float or (k) [s], optional
            How long each took.
        time : float or (k) [s], optional
            When each ended, in place of `dt`.

        Raises
        ------
        InputError
            For controls or times that cannot be; nothing has changed then.
        """
        ends, lengths = times_of(dt, time, self._time)
        steps = np.atleast_2d(numbers(controls, "controls"))
        try:
            steps, lengths = usable_controls(self._drive.motion, steps, lengths)
        except InputError as error:  # it names the estimator's method
            raise InputError(str(error).replace("predict:", "move:", 1)) from None
        if not lengths.size:
            return
        check_clock(ends, self._time)
        gone = self._at_sensor(steps, ends)
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
        """Take in the rows of a scan, heard where the vehicle is now.

        Parameters
        ----------
        time : float [s], optional
            Checked: that of the vehicle.
        bearing : (m) [rad]
            From the heading, counter-clockwise; NaN or None where a row is an excess path alone.
        landmark : (m), optional
            Labels; without them an association decides (``association__method``).
        range, excess_path : (m) [m], optional
            NaN or None where there is none.
        caller : (m) of str, optional
            Whose call it was, by the vehicle's callers; None of its own.
        bearing_std, range_std, excess_path_std : (m) [rad], [m], [m], optional
            In place of the vehicle's.

        Returns
        -------
        (m)
            The label of each row, as known or decided; -1 where it is of none.

        Raises
        ------
        InputError
            For rows that cannot be, or were heard already; nothing has changed then.
        """
        check_now(time, self._time)
        known = self._config.association.method == KNOWN
        table = table_of(columns, self._log.callers, labelled=known)
        if not table.line.size:
            return table.column["landmark"]
        scan = scan_at(self._time, table, self._log.callers)
        fresh = keys_of(table)
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
        order = np.argsort(np.isnan(table.column["bearing"]), kind="stable")
        labels = np.empty(order.size, dtype=np.int64)
        labels[order] = self._session.labels[-1]
        return labels

    def save(self, file: Path | str) -> Path:
        """Write all that is known into a file, for `load`.

        A file in its place is replaced where `save` wrote it, and refused where it did not.
        """
        path = folder_named(file, "file")
        times, online = self._online()
        state = DriveState(
            name=self._log.name,
            start=float(self._log.time[0]),
            former=self._log.former_names,
            vehicle=self._vehicle.model_dump(),
            settings=self._config.model_dump(mode="json"),
            kept=self._kept,
            session=self._session.state(),
            heard=frozenset(self._heard),
            times=times,
            means=online.mean,
            covariances=online.covariance,
        )
        write_state(path, Named(self._name, self._config.association.method), state)
        return path

    @classmethod
    def load(
        cls,
        file: Path | str,
        *,
        filter: str | type | None = None,  # noqa: A002 - as `Slam` has it
        association__method: str | None = None,
    ) -> Self:
        """Go on from what `save` wrote, to the bit.

        Parameters
        ----------
        file : Path
        filter : str or class, optional
            The estimator that it was saved with, where that is one of your own: no module is
            imported because a file names it.
        association__method : str, optional
            The association, ``module:Class``, where that is one of your own.

        Raises
        ------
        InputError
            For a file that `save` of this version did not write, or that has changed since.
        """
        path = folder_named(file, "file")
        named = None if filter is None else named_filters(filter, "filter")[0]
        for role, name in ((ESTIMATOR, named), (ASSOCIATION, association__method)):
            if name is not None and names_class(name):
                class_of(role, name)
        own = {"filter": named, "association__method": association__method}
        slam = cls.__new__(cls)
        names, state = read_state(path, own)
        try:
            slam._go_on_from(names, state)
        except InputError:
            raise
        except Exception as error:  # of a file that somebody made, and summed
            raise not_saved(path, error) from None
        return slam

    def _go_on_from(self, named: Named, state: DriveState) -> None:
        """Know what a file of `save` holds."""
        config = Config.model_validate(state.settings)
        belief, method = state.session.belief, config.association.method
        particles = isinstance(belief, FastSlamBelief) and belief.log_weight.size
        if method != named.association or particles not in (False, config.fastslam.particles):
            raise ValueError("settings")
        log, _, vehicle = _log_of(state.vehicle, finite(state.start, "start"))
        log = replace(log, name=state.name, former_names=state.former)
        self._begin(log, vehicle, config, named.filter, state.kept)
        check_going_on(self._session.state(), state.session, own=names_class(named.filter))
        self._session.go_on_from(state.session)
        parts = zip(state.times.tolist(), state.means, state.covariances, strict=True)
        self._poses = [(t, Gaussian(mean=m, covariance=P)) for t, m, P in parts]
        self._time, self._heard = self._poses[-1][0], {*state.heard}
        check_clock(state.times)
        now = self._session.belief.pose()
        variances = np.diagonal(state.covariances, axis1=1, axis2=2)
        for known in (now.mean, now.covariance, state.means, state.covariances, np.sqrt(variances)):
            if not np.isfinite(known).all():
                raise ValueError("a pose that is no number")

    def copy(self) -> Self:
        """Return another that goes on from here by itself, to the same bits."""
        other = type(self).__new__(type(self))
        other._begin(self._log, self._vehicle, self._config, self._name, self._kept)
        other._session.go_on_from(self._session.state())
        other._poses, other._time, other._heard = [*self._poses], self._time, {*self._heard}
        return other

    def __repr__(self) -> str:
        """Say where the vehicle is."""
        pose, landmarks = self.pose, self._session.landmarks().landmark
        return (
            f"Slam by {self._name} at {pose.time:g} s: x {pose.x:.3f} m, y {pose.y:.3f} m, heading "
            f"{pose.heading:.3f} rad; {np.unique(landmarks).size} landmarks"
        )

    def _online(self) -> tuple[Float[np.ndarray, " k"], Gaussian]:
        """Return the times that are kept, and the poses as they were believed at their time."""
        times, poses = zip(*self._poses, strict=True)
        mean = np.array([pose.mean for pose in poses])
        covariance = np.array([pose.covariance for pose in poses])
        return np.array(times), Gaussian(mean=mean, covariance=covariance)

    def _change(self, act: Callable[[], R]) -> R:
        """Let the session do something; where that fails, it is as it was."""
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
        """Return where the vehicle is, by where its sensor is."""
        sensor = self._drive.sensor
        return carried(pose, vehicle_in(sensor)) if any(sensor) else pose

    def _at_sensor(
        self, steps: Float[np.ndarray, "k c"], ends: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k c"]:
        """Return the steps of the sensor, by those of its vehicle."""
        time = np.array([self._time, *ends])
        return at_sensor(replace(self._drive, time=time, controls=steps)).controls


def _fault(pose: Gaussian) -> tuple[str, str] | None:
    """Return how a pose is wrong, and what is expected; None where it is sound.

    Rounding makes an eigenvalue of 0 slightly negative; half of the digits are more than rounding.
    """
    if not (np.isfinite(pose.mean).all() and np.isfinite(pose.covariance).all()):
        return "a pose that is no number", "a finite one"
    with suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(pose.covariance)  # sooner than the eigenvalues
        return None
    least, *_, largest = np.linalg.eigvalsh(pose.covariance).tolist()
    if least < -ROUNDING * largest:
        return f"a pose unsure to {largest**0.5:.3g} m, beyond what numbers can hold", "a surer one"
    return None


def _log_of(vehicle: Vehicle, time: float) -> tuple[Log, Path, VehicleKeys]:
    """Return a log of a vehicle that has not moved, where its keys are from, and the keys."""
    if isinstance(vehicle, Mapping):
        where, former = Path("vehicle"), ()
        told = vehicle_of(OF_ITSELF | dict(vehicle), where)
    elif isinstance(vehicle, (str, Path)):
        where = Path(vehicle)
        told, former = read_vehicle(Path(vehicle))
    else:
        fix = "see docs/log_format.md"
        raise refusal("vehicle", shown(vehicle), "the path of a log.toml, or its keys", fix)
    none = {"scans": (), "ignored_rows": {}, "dt": np.empty(0), "former_names": former}
    controls, start = np.empty((0, len(ODOMETRY[told.motion]))), np.array([time])
    log = Log(name=str(where), time=start, controls=controls, **none, **told.told())
    return log, where, told


def _map_table(landmarks: Landmarks) -> "pl.DataFrame":
    """Lay out a map without its truth."""
    return landmark_table(landmarks, None).drop("true_x_m", "true_y_m", "error_m", "true_landmark")
