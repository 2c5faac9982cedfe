from dataclasses import asdict, dataclass, fields, is_dataclass, replace

import numpy as np
import pytest

from pipistrelle.acoustics.paths import Caller
from pipistrelle.config import (
    STRATEGIES,
    Config,
    FilterConfig,
    InputError,
    ListeningConfig,
    ScenarioConfig,
)
from pipistrelle.detection.noise import without_hidden
from pipistrelle.detection.scans import scan_of, without_labels
from pipistrelle.estimation.beliefs import Assignment, Gaussian
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import draw_scenario
from pipistrelle.experiments.hearing.trajectories import true_motion
from pipistrelle.experiments.named_settings import Case
from pipistrelle.experiments.results.scores import score_path
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.experiments.runs.trial import run_filter, run_mission, run_trial
from reference.missions import map_with, scan_with

SHORT = Config(scenario=ScenarioConfig(steps=80))
RNG = np.random.default_rng


def contents(value):
    """Return everything that a record holds, to the bit, but for how long it took."""
    if is_dataclass(value):
        kept = [f.name for f in fields(value) if f.name != "wall_s"]
        return {name: contents(getattr(value, name)) for name in kept}
    if isinstance(value, tuple):
        return tuple(contents(each) for each in value)
    return (value.dtype.str, value.shape, value.tobytes()) if hasattr(value, "dtype") else value


def test_two_runs_of_a_mission_are_the_same_to_the_bit():
    one, two = (run_mission(SHORT, STRATEGIES, ("ekf", "fastslam")) for _ in range(2))
    assert contents(one) == contents(two)
    other = run_mission(SHORT.model_copy(update={"seed": 8}), STRATEGIES)
    assert contents(one.heard) != contents(other.heard)


def test_a_mission_tries_every_strategy_with_every_filter():
    told = []
    mission = run_mission(
        SHORT, STRATEGIES, ("ekf", "fastslam"), progress=lambda *stage: told.append(stage)
    )
    tried = [(trial.strategy, trial.filter) for trial in mission.trials]
    assert tried == [(s, f) for s in STRATEGIES for f in ("ekf", "fastslam")]
    assert [stage for stage in told if stage[1] == stage[2]] == [
        ("listening", 20, 20),
        *[(f"{s} {f}", 20, 20) for s, f in tried],
    ]
    assert len(mission.heard) == 20
    assert all(len(trial.track.time) == 81 for trial in mission.trials)


def test_strategies_do_not_disturb_each_other():
    alone = run_mission(SHORT, ("passive",)).trials[0]
    among = run_mission(SHORT, STRATEGIES).trials[2]
    assert contents(alone) == contents(among)


def test_fused_is_the_union_of_active_and_passive_in_every_frame():
    mission = run_mission(Config(scenario=ScenarioConfig(steps=400)), STRATEGIES)
    active, fused, passive = (trial.scans for trial in mission.trials)
    for a, f, p in zip(active, fused, passive, strict=True):
        assert set(f.landmark) == set(a.landmark) | set(p.landmark)
        assert np.isnan(p.range).all()
        assert not np.isnan(a.range).any()
    assert sum(scan.landmark.size for scan in active) > 100


def test_an_unknown_filter_is_refused_by_name():
    with pytest.raises(InputError, match="found 'ukf', expected one of ekf, fastslam, iekf"):
        run_mission(SHORT, ("fused",), ("ukf",))


class Ledger:
    """A filter that adds up what it is given and writes down when: x counts steps, y scans."""

    def __init__(self):
        self.log = []

    def init(self, pose):
        self.log.append("init")
        return Count(pose.mean)

    def predict(self, belief, controls, dt, rng):
        rng.random()
        self.log.append((dt.tolist(), controls[:, 0].tolist()))
        x = belief.mean + np.arange(1, len(dt) + 1)[:, None] * [1.0, 0.0, 0.0]
        return Count(x[-1]), Gaussian(mean=x, covariance=np.tile(np.eye(3), (len(dt), 1, 1)))

    def update(self, belief, scan, rng):
        rng.random()
        self.log.append(scan.time)
        return Count(belief.mean + np.array([0.0, 1.0, 0.0]))


class Count:
    gated = 0

    def __init__(self, mean):
        self.mean = mean

    def pose(self):
        return Gaussian(mean=self.mean, covariance=2.0 * np.eye(3))

    def landmarks(self):
        return map_with()


def drive(steps, at_rest=False):
    time = np.array([0.0, 0.5, 1.5, 2.0, 4.0, 4.5])[: steps + 1]
    return Drive(
        motion=Motion(model="unicycle", control_std=(0.1, 0.1), noise_at_rest=not at_rest),
        start=Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3))),
        time=time,
        controls=np.column_stack((np.arange(steps), np.zeros(steps))).astype(float),
    )


def test_steps_and_scans_reach_the_filter_in_the_order_of_time():
    ledger, seen, told = Ledger(), [], []
    track = run_filter(
        ledger,
        drive(5),
        [scan_with(time=0.0), scan_with(time=1.5), scan_with(time=1.5), scan_with(time=2.0)],
        RNG(7),
        progress=lambda *done: told.append(done),
        watch=lambda scan, belief: seen.append((scan.time, belief.mean[0], belief.mean[1])),
    )
    assert ledger.log == [
        "init", 0.0, ([0.5, 1.0], [0.0, 1.0]), 1.5, 1.5,
        ([0.5], [2.0]), 2.0, ([2.0, 0.5], [3.0, 4.0]),
    ]  # fmt: skip
    assert seen == [(0.0, 0, 1), (1.5, 2, 2), (1.5, 2, 3), (2.0, 3, 4)]
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    # A step that holds a scan shows the pose after it.
    assert track.pose.mean[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert track.pose.mean[:, 1].tolist() == [1, 1, 3, 4, 4, 4]
    assert track.pose.covariance[:, 0, 0].tolist() == [2, 1, 2, 2, 1, 1]


def test_an_association_is_asked_with_the_belief_that_was_predicted_to_its_scan():
    class Noting:
        """Takes the labels as they are, and remembers when it was asked and by which belief."""

        def start(self):
            return []

        def associate(self, memory, belief, scan):
            asked[:] = [*memory, (scan.time, belief.mean.tolist())]
            return list(asked), Assignment(label=scan.landmark)

    asked = []
    scans = [scan_with(time=0.0), scan_with(time=1.5), scan_with(time=1.5), scan_with(time=4.5)]
    run_filter(Ledger(), drive(5), scans, RNG(7), association=Noting())
    # x counts the steps, y the scans that the filter was corrected with before.
    assert asked == [(0.0, [0, 0, 0]), (1.5, [2, 1, 0]), (1.5, [2, 2, 0]), (4.5, [5, 3, 0])]


def further(**columns):
    """Return a scan whose second row is but a further excess path of the first's landmark."""
    known = {
        "caller": np.array([1, 2]),
        "excess_path": np.array([3.0, 5.0]),
        "excess_path_std": 0.1,
    }
    return scan_with([4, 4], [0.5, np.nan], time=1.5, **(known | columns))


def test_a_row_may_contain_only_an_excess_path():
    ledger = Ledger()
    run_filter(ledger, drive(5), [further()], RNG(7))
    assert 1.5 in ledger.log


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"excess_path": np.array([3.0, np.nan])}, "numbers that no filter can use"),
        ({"excess_path": np.array([3.0, np.inf])}, "numbers that no filter can use"),
        ({"excess_path_std": np.array([0.1, np.nan])}, "no standard deviations above 0"),
        ({"excess_path_std": np.array([0.0, 0.1])}, "no standard deviations above 0"),
    ],
)
def test_empty_rows_and_excess_paths_without_deviation_are_refused(columns, said):
    with pytest.raises(InputError, match=rf"scan at 1\.5 s: found {said}.*\[4\]"):
        run_filter(Ledger(), drive(5), [further(**columns)], RNG(7))


def test_a_drive_without_scans_and_scans_without_a_drive_are_tracked():
    ledger = Ledger()
    track = run_filter(ledger, drive(5), [], RNG(7))
    assert ledger.log == ["init", ([0.5, 1.0, 0.5, 2.0, 0.5], [0.0, 1.0, 2.0, 3.0, 4.0])]
    assert track.pose.mean[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    still = run_filter(Ledger(), drive(0), [scan_with(time=0.0)], RNG(7))
    assert still.pose.mean.tolist() == [[0.0, 1.0, 0.0]]


class Retraced:
    """A Kalman filter along a line, that looks back at the end: Rauch, Tung and Striebel.

    A step adds the control, with noise of variance 0.04; a scan's range is the distance to a wall
    at x = 50, with noise of variance 0.25.
    """

    def init(self, pose):
        return Line(at=pose.mean[0], variance=1.0, means=(pose.mean[0],), variances=(1.0,))

    def predict(self, belief, controls, dt, rng):
        x, P = belief.at, belief.variance
        rows = []
        for step in controls[:, 0]:
            x, P = x + step, P + 0.04
            rows.append((x, P))
        along = np.array(rows)
        belief = Line(
            at=x,
            variance=P,
            means=(*belief.means, *along[:, 0]),
            variances=(*belief.variances, *along[:, 1]),
            controls=(*belief.controls, *controls[:, 0]),
        )
        return belief, flat(along[:, 0], along[:, 1])

    def update(self, belief, scan, rng):
        gain = belief.variance / (belief.variance + 0.25)
        x = belief.at + gain * (50.0 - scan.range[0] - belief.at)
        P = (1.0 - gain) * belief.variance
        return replace(
            belief,
            at=x,
            variance=P,
            means=(*belief.means[:-1], x),
            variances=(*belief.variances[:-1], P),
        )


@dataclass(frozen=True, kw_only=True)
class Line(Count):
    at: float
    variance: float
    means: tuple
    variances: tuple
    controls: tuple = ()

    def pose(self):
        line = flat([self.at], [self.variance])
        return Gaussian(mean=line.mean[0], covariance=line.covariance[0])

    def path(self):
        means, variances = [*self.means], [*self.variances]
        for k in range(len(self.controls) - 1, -1, -1):
            gain = variances[k] / (variances[k] + 0.04)
            means[k] += gain * (means[k + 1] - self.means[k] - self.controls[k])
            variances[k] += gain**2 * (variances[k + 1] - self.variances[k] - 0.04)
        return flat(means, variances)


def flat(x, variance):
    """Poses on the line y = 0."""
    mean, covariance = np.zeros((len(x), 3)), np.zeros((len(x), 3, 3))
    mean[:, 0], covariance[:, 0, 0] = x, variance
    covariance[:, 1, 1] = covariance[:, 2, 2] = 1.0
    return Gaussian(mean=mean, covariance=covariance)


def line_drive(rng, steps=60):
    """A drive along the line, what it hears of the wall every third step, and where it was."""
    x = np.cumsum(np.append(rng.normal(), 0.5 + rng.normal(0.0, 0.2, steps)))
    heard = range(3, steps + 1, 3)
    scans = [
        scan_with([1], [0.0], [50.0 - x[k] + rng.normal(0.0, 0.5)], time=float(k)) for k in heard
    ]
    line = replace(drive(1), time=np.arange(steps + 1.0), controls=np.tile([0.5, 0.0], (steps, 1)))
    return line, scans, x


def test_a_revised_path_is_the_batch_solution_and_keeps_the_online_path():
    line, scans, _ = line_drive(RNG(5))
    track = run_filter(Retraced(), line, scans, RNG(7))
    k = line.time.size
    step = np.eye(k, k=1)[:-1] - np.eye(k)[:-1]
    rows = [int(scan.time) for scan in scans]
    wall = np.eye(k)[rows]
    information = 25.0 * step.T @ step + 4.0 * wall.T @ wall
    information[0, 0] += 1.0
    right = 25.0 * step.T @ line.controls[:, 0]
    right[rows] += 4.0 * np.array([50.0 - scan.range[0] for scan in scans])
    covariance = np.linalg.inv(information)
    np.testing.assert_allclose(track.pose.mean[:, 0], covariance @ right, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        track.pose.covariance[:, 0, 0], np.diag(covariance), rtol=0, atol=1e-9
    )
    gain = track.online.covariance - track.pose.covariance
    assert np.all(gain[1:-1, 0, 0] > 0.0)
    np.testing.assert_array_equal(track.online.mean[-1], track.pose.mean[-1])
    assert run_filter(Ledger(), line, scans, RNG(7)).online is None


def test_a_path_that_is_revised_is_nearer_to_the_truth():
    squares = []
    for seed in range(30):
        line, scans, x = line_drive(RNG(seed))
        track = run_filter(Retraced(), line, scans, RNG(7))
        true = flat(x, x).mean
        squares.append(
            [score_path(pose, true)["position_rmse_m"] ** 2 for pose in (track.online, track.pose)]
        )
    gain = -np.diff(squares, axis=1)
    assert gain.mean() > 3.0 * gain.std(ddof=1) / np.sqrt(gain.size)


@pytest.mark.parametrize("name", ["ekf", "fastslam"])
def test_a_filter_predicts_after_its_only_scan_at_the_start(name):
    motion = true_motion(Config().motion)
    known = replace(drive(5), motion=motion)
    first = scan_with([3, 4], [0.1, -0.2], [2.0, np.nan], time=0.0)
    track = run_filter(entry(name).build(Config(), motion), known, [first], RNG(7))
    assert set(track.landmarks.landmark) == {3, 4}
    spread = track.pose.covariance[:, 0, 0] + track.pose.covariance[:, 1, 1]
    assert np.all(np.diff(spread) > 0.0)
    assert np.isfinite(track.pose.mean).all()


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (scan_with(time=0.7), "scan at 0.7 s: expected the time"),
        (scan_with(time=9.0), "scan at 9.0 s: expected the time"),
        (scan_with([3], [np.nan], time=0.5), r"landmarks \[3\]"),
        (scan_with([3, 4], [0.1, 0.1], [2.0, -1.0], time=0.5), r"landmarks \[4\]"),
        (scan_with([3], [0.1], [np.inf], time=0.5), r"landmarks \[3\]"),
        (scan_with([3], [0.1], time=0.5, bearing_std=np.nan), r"no standard deviations .* \[3\]"),
        (scan_with([3], [0.1], time=0.5, bearing_std=0.0), r"no standard deviations .* \[3\]"),
        (scan_with([3], [0.1], [2.0], time=0.5, range_std=np.inf), r"no standard deviations"),
    ],
)
def test_scans_that_no_filter_can_use_are_refused(scan, message):
    with pytest.raises(InputError, match=message):
        run_filter(Ledger(), drive(5), [scan], RNG(7))


def test_a_trial_is_scored_against_the_path_and_all_landmarks_the_beacon_last():
    mission = run_mission(SHORT, ("fused",))
    (trial,) = mission.trials
    error = np.hypot(*(trial.track.pose.mean - mission.scenario.path)[1:, :2].T)
    assert trial.scores.position_rmse_m == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    labels, places = mission.drive.truth.landmarks
    assert labels.tolist() == list(range(1, 52))
    assert places[-1].tolist() == mission.scenario.callers[1].place.tolist()
    assert mission.drive.start.mean.tolist() == mission.scenario.path[0].tolist()
    assert np.sqrt(np.diag(mission.drive.start.covariance)) == pytest.approx([0.05, 0.05, 0.0436])


@pytest.mark.parametrize(
    ("off", "ekf", "fastslam"), [(0.0, False, False), (1.0, True, False), (5.0, True, True)]
)
def test_divergence_is_judged_by_the_filters_limit(off, ekf, fastslam):
    mission = run_mission(SHORT, ("fused",))
    truth = mission.drive.truth
    beside = replace(truth, path=truth.path + np.array([0.0, off, 0.0]))
    for name, diverged in (("ekf", ekf), ("fastslam", fastslam)):
        drive = replace(mission.drive, truth=beside)
        scans = mission.trials[0].scans
        trial = run_trial(Case(strategy="fused", filter=name), drive, scans, SHORT)
        assert trial.scores.diverged is diverged


def test_the_initial_covariance_follows_the_settings():
    config = Config(filter=FilterConfig(initial_pose_std=(0.1, 0.3, 0.2)), scenario=SHORT.scenario)
    start = drive_of(draw_scenario(config, RNG(3)), config).start
    np.testing.assert_allclose(start.covariance, np.diag([0.01, 0.09, 0.04]), rtol=1e-12)


def test_a_caller_that_moves_is_heard_but_is_no_landmark():
    world = draw_scenario(SHORT, RNG(3))
    path = 9.0 * np.column_stack((np.cos(0.05 * world.time), np.sin(0.05 * world.time)))
    boat = Caller(name="boat", frequency=25e3, level_db=42.8, place=path)
    post = replace(boat, name="post", frequency=20e3, place=np.array([-12.0, 3.0]))
    three = replace(world, callers=(*world.callers, boat, post))
    drive = drive_of(three, SHORT)
    labels, places = drive.truth.landmarks
    assert labels.tolist() == [*range(1, 52), 53]
    assert (places[-1].tolist(), drive.moving) == ([-12.0, 3.0], {52: "boat"})
    (heard,) = listen(three, SHORT, (SHORT.emitter.radius,))
    scans = scans_of(heard, "fused", SHORT)
    assert any(52 in scan.landmark for scan in scans)
    trial = run_trial(Case(strategy="fused", filter="ekf"), drive, scans, SHORT)
    assert not any(52 in scan.landmark for scan in trial.scans)
    assert {51, 53} <= set(trial.track.landmarks.landmark.tolist())
    assert 52 not in trial.track.landmarks.landmark
    kept = sum(scan.landmark.size for scan in trial.scans)
    assert kept == sum(np.count_nonzero(scan.landmark != 52) for scan in scans)


@pytest.mark.parametrize("seed", [1000, 1001])
def test_the_smoother_follows_a_caller_that_circles_by_its_sound(seed):
    config = Config(
        seed=seed,
        scenario=ScenarioConfig(steps=280),
        callers=({"course": "circle", "radius": 10.0, "speed": 0.75},),
        listening={"excess_paths": True},
        filter=FilterConfig(noise="measured", robust="huber"),
    )
    for trial in run_mission(config, ["fused", "passive"], ["smoother"]).trials:
        (track,) = trial.track.callers.values()
        assert np.isfinite(track.mean[:, 0]).sum() > 0.75 * len(trial.scans)
        assert trial.scores.caller_rmse_m < 1.0
        assert trial.scores.caller_rmse_aligned_m < 0.05
        assert not {*trial.track.callers} & {*trial.track.landmarks.landmark.tolist()}


@pytest.mark.slow
def test_the_smoother_has_a_map_though_cholesky_fails():
    config = Config(
        seed=774396,
        scenario=ScenarioConfig(steps=160, landmarks=3),
        motion={"speed_std": 1e-6},
        listening={"excess_paths": True},
        callers=(
            {"name": "c0", "frequency": 45e3, "course": "mission"},
            {"name": "c1", "frequency": 25e3},
            {"name": "c2", "frequency": 40e3, "course": "walk", "speed_std": 0.1},
        ),
    )
    (trial,) = run_mission(config, ["active"], ["smoother"]).trials
    assert trial.error is None
    assert np.isfinite(trial.track.pose.covariance).all()
    assert np.isfinite(trial.track.landmarks.covariance).all()


def test_trials_of_one_world_do_not_depend_on_their_order():
    scenario = draw_scenario(SHORT, RNG(3))
    mission = run_mission(SHORT, ("fused",))
    told = drive_of(scenario, SHORT)
    scans = scans_of(mission.heard, "fused", SHORT)
    case = Case(strategy="fused", filter="fastslam", iteration=4)
    one = run_trial(case, told, scans, SHORT)
    run_trial(replace(case, iteration=5), told, scans, SHORT)
    assert contents(run_trial(case, told, scans, SHORT)) == contents(one)
    other = run_trial(replace(case, iteration=5), told, scans, SHORT)
    assert contents(other.track) != contents(one.track)


def test_only_a_filter_that_draws_depends_on_the_seed():
    scenario = draw_scenario(SHORT, RNG(3))
    told = drive_of(scenario, SHORT)
    scans = scans_of(run_mission(SHORT, ("fused",)).heard, "fused", SHORT)
    for name, draws in (("ekf", False), ("fastslam", True)):
        case = Case(strategy="fused", filter=name)
        one, two = (
            run_trial(case, told, scans, SHORT.model_copy(update={"seed": seed})) for seed in (7, 8)
        )
        assert (contents(one.track) != contents(two.track)) == draws


@pytest.mark.slow
def test_the_band_recorder_finds_about_the_same_landmarks():
    scenario = ScenarioConfig(steps=24)
    block, band = (
        run_mission(Config(scenario=scenario, emitter=EmitterConfig(taper=taper)), STRATEGIES)
        for taper in (0.0, 0.2)
    )
    for one, two in zip(block.trials, band.trials, strict=True):
        first, second = (set().union(*(s.landmark for s in t.scans)) for t in (one, two))
        assert len(first & second) >= 0.8 * max(len(first), len(second))
        assert max(len(first), len(second)) >= 5


OF_MAPS = ("map_", "gospa_", "landmarks_missed", "landmarks_false", "landmarks_twice")


@pytest.mark.parametrize("timing", [False, True])
def test_an_association_with_the_oracles_labels_gives_the_oracles_map(timing):
    listening = {"listening": ListeningConfig(excess_paths=timing)}
    config = SHORT.model_copy(update=listening)
    world = draw_scenario(config, RNG(3))
    (heard,) = listen(world, config, (config.emitter.radius,))
    case, drive = Case(strategy="fused", filter="ekf"), drive_of(world, config)
    known = run_trial(case, drive, scans_of(heard, "fused", config), config)
    labels = {frame.rows.time: frame.rows.landmark for frame in heard}
    rows = (without_labels(frame.rows, frame.rows.callers) for frame in heard)
    hidden = [scan_of(without_hidden(scan, config.filter, timing=timing), "fused") for scan in rows]

    class Oracle:
        """Labels rows by the time of their scan."""

        def start(self):
            return None

        def associate(self, memory, belief, scan):
            return None, Assignment(label=labels[scan.time])

    found = run_trial(case, drive, hidden, config, association=Oracle())
    assert [label.tolist() for label in found.track.labels] == [
        labels[scan.time].tolist() for scan in hidden
    ]
    assert contents(replace(found.track, labels=())) == contents(known.track)
    assert contents(found.scans) == contents(known.scans)
    paths = [
        {name: value for name, value in asdict(scores).items() if not name.startswith(OF_MAPS)}
        for scores in (found.scores, known.scores)
    ]
    assert paths[0] == paths[1]
    assert 0.0 < found.scores.map_rmse_m < known.scores.map_rmse_m, "of pairs by position"
    assert (
        any(scan.excess_path.size > np.isnan(scan.excess_path).sum() for scan in found.scans)
        is timing
    )


def test_scans_out_of_order_are_refused():
    late, early = drive(5).time[[4, 2]].tolist()
    scans = [scan_with([3], [0.1], time=time) for time in (late, early)]
    with pytest.raises(InputError, match=f"scan at {early} s: follows one at {late} s"):
        run_filter(Ledger(), drive(5), scans, RNG(7))


@pytest.mark.parametrize("left", [slice(-1, None), -1])
def test_predictions_that_are_not_one_pose_for_each_step_are_refused(left):
    class Short(Ledger):
        def predict(self, belief, controls, dt, rng):
            belief, poses = super().predict(belief, controls, dt, rng)
            return belief, Gaussian(mean=poses.mean[left], covariance=poses.covariance[left])

    with pytest.raises(InputError, match=r"predict: found arrays of .* one after each step"):
        run_filter(Short(), drive(5), [scan_with([3], [0.1], time=0.5)], RNG(7))


@pytest.mark.parametrize("method", ["predict", "update"])
def test_a_method_that_returns_nothing_is_refused_by_its_name(method):
    forgetful = type("Forgetful", (Ledger,), {method: lambda self, *given: None})
    with pytest.raises(InputError, match=rf"Forgetful\.{method}: found NoneType returned"):
        run_filter(forgetful(), drive(5), [scan_with([3], [0.1], time=0.5)], RNG(7))


def test_a_prediction_without_its_poses_is_refused():
    alone = type("Alone", (Ledger,), {"predict": lambda self, belief, *given: belief})
    with pytest.raises(InputError, match=r"Alone\.predict: found .* returned, expected"):
        run_filter(alone(), drive(5), [scan_with([3], [0.1], time=0.5)], RNG(7))


@pytest.mark.parametrize("rows", [5, 6, 7])
def test_tracks_of_callers_that_are_not_a_place_for_each_step_are_refused(rows):
    @dataclass(frozen=True, kw_only=True)
    class Chaser(Line):
        def moving(self):
            return map_with([9], [[1.0, 2.0]])

        def tracks(self):
            places = np.tile([3.0, 4.0], (rows, 1))
            return {9: Gaussian(mean=places, covariance=np.tile(np.eye(2), (rows, 1, 1)))}

    class Chasing(Retraced):
        def init(self, pose):
            return Chaser(at=pose.mean[0], variance=1.0, means=(pose.mean[0],), variances=(1.0,))

        def predict(self, belief, controls, dt, rng):
            line, poses = super().predict(belief, controls, dt, rng)
            return Chaser(**{one.name: getattr(line, one.name) for one in fields(line)}), poses

    heard = replace(scan_with([3], [0.1], [40.0], time=0.5), moving=np.array([9]))
    if rows == 6:
        assert run_filter(Chasing(), drive(5), [heard], RNG(7)).callers[9].mean[0, 0] == 3.0
    else:
        with pytest.raises(InputError, match=r"tracks: found arrays of .* for caller 9"):
            run_filter(Chasing(), drive(5), [heard], RNG(7))
