"""A vehicle that drives now ends where its log does, to the bit, and a refusal changes nothing."""

import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle import InputError, Slam
from pipistrelle.__main__ import main
from pipistrelle.estimation.catalogue import CATALOGUE
from reference.missions import ROBOT

LOG = Path(__file__).parents[1] / "data" / "unicycle_log"
ABSURD = (
    {"motion": "bicycle", "speed_std": 0.1, "steering_std": 0.03, "wheelbase": 0.2}
    | {"range_std": 0.05, "bearing_std": 0.01, "range_bounds": [0.5, 40.0]},
    {"motion": "unicycle", "velocity_std": 0.1, "angular_rate_std": 0.1}
    | {"range_std": 0.05, "bearing_std": 0.01, "range_bounds": [0.5, 40.0]},
)
"""Vehicles whose steps may be far too long."""
AS_FOUND = pytest.mark.filterwarnings("ignore::UserWarning")
"""What looks odd in a log that was made odd is warned of."""
ONE = {"landmark": [7, 8], "bearing": [0.1, 0.9], "range": [2.0, 3.0]}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return a log of a mission, and one whose rows have no labels."""
    folder = tmp_path_factory.mktemp("logs")
    settings = ["--listening.excess-paths", "true", "--filter.noise", "measured"]
    run = ["run", "--duration", "20", "--strategy", "fused", "--quiet", *settings]
    assert main([*run, "--save-log", str(folder / "known"), "-o", str(folder / "a")]) == 0
    bare = shutil.copytree(folder / "known", folder / "bare")
    (bare / "SHA256SUMS").unlink()
    rows = pl.read_csv(bare / "measurements.csv").with_columns(landmark=pl.lit(None))
    rows.write_csv(bare / "measurements.csv")
    return {"known": folder / "known", "bare": bare}


def driven(log, *, chunk=1, then=lambda slam: slam, **options):
    """Drive a log step by step; after half of it go on with what `then` returns."""
    odometry, rows = (pl.read_csv(log / f"{name}.csv") for name in ("odometry", "measurements"))
    time, controls = odometry["time"].to_numpy(), odometry.drop("time").to_numpy()
    heard = dict(list(rows.group_by("time", maintain_order=True)))
    slam = Slam(log / "log.toml", time=time[0], **options)
    scans = [k for k in range(1, time.size) if (time[k],) in heard]
    done = 0
    for number, k in enumerate(sorted({*scans, time.size - 1})):
        while done < k:
            last = min(done + chunk, k)
            slam.move(controls[done:last], time=time[done + 1 : last + 1])
            done = last
        if (time[k],) in heard:
            slam.hear(**heard[time[k],].drop("time").to_dict())
        if number == len(scans) // 2:
            slam = then(slam)
    return slam


def same(slam, done):
    """Tell whether track and map are those of a result, to the bit."""
    path, there = slam.path, done.landmarks
    there = there.filter(pl.col("status") != "unseen").select(slam.map.columns)
    return path.equals(done.tracks.select(path.columns)) and slam.map.equals(there)


@pytest.mark.parametrize("name", CATALOGUE)
def test_steps_one_by_one_give_the_track_and_the_map_of_the_log_to_the_bit(logs, name):
    assert same(driven(logs["known"], filter=name), pipistrelle.slam(logs["known"], filters=name))


def test_how_many_steps_come_at_once_changes_no_bit(logs):
    one, three = (driven(logs["known"], chunk=chunk) for chunk in (1, 3))
    assert one.map.equals(three.map)
    assert one.pose.covariance.tobytes() == three.pose.covariance.tobytes()


@pytest.mark.parametrize("name", ["ekf", "iekf"])
def test_named_settings_apply_with_overrides_per_estimator(logs, name):
    best = pipistrelle.slam(logs["known"], filters=name, settings="best")
    assert same(driven(logs["known"], filter=name, settings="best"), best)


@AS_FOUND
@pytest.mark.parametrize("name", ["iekf", "smoother"])
def test_unlabelled_rows_are_associated_as_by_slam(logs, name):
    options = {"association__method": "marginal"}
    slam = driven(logs["bare"], filter=name, **options)
    done = pipistrelle.slam(logs["bare"], filters=name, **options)
    assert slam.map.height > 1
    there = done.landmarks.filter(pl.col("status") != "unseen").select(slam.map.columns)
    assert slam.map.equals(there)
    online = done.mission.trials[0].track.online or done.mission.trials[0].track.pose
    assert slam.pose.x == online.mean[-1, 0]


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("kind", ["known", "bare"])
def test_a_copy_goes_on_to_the_same_bits(logs, name, kind):
    options = {"filter": name} | ({"association__method": "nearest"} if kind == "bare" else {})
    whole, again = (driven(logs[kind], then=then, **options) for then in (Slam.copy, lambda s: s))
    assert again.path.equals(whole.path)
    assert again.map.equals(whole.map)


def test_a_copy_leaves_the_first_where_it_is():
    slam = Slam(ROBOT)
    slam.move([1.0, 0.0], dt=1.0)
    slam.hear(**ONE)
    other, before = slam.copy(), (slam.pose.x, slam.map)
    other.move([1.0, 0.2], dt=1.0)
    other.hear(**ONE)
    assert (slam.pose.x, slam.time) == (before[0], 1.0)
    assert slam.map.equals(before[1])
    assert other.time == 2.0


@AS_FOUND
def test_an_offset_sensor_gives_the_results_of_a_log(tmp_path, logs):
    log = shutil.copytree(logs["known"], tmp_path / "arm")
    (log / "SHA256SUMS").unlink()
    text = (log / "log.toml").read_text()
    (log / "log.toml").write_text(f"sensor_pose = [0.4, -0.1, 0.3]\n{text}")
    slam, done = driven(log, filter="iekf"), pipistrelle.slam(log, filters="iekf")
    tracks = done.tracks.select(slam.path.columns)
    np.testing.assert_allclose(slam.path.to_numpy(), tracks.to_numpy(), rtol=0, atol=1e-9)
    assert abs(slam.path["x_m"] - driven(logs["known"]).path["x_m"]).max() > 0.01


REFUSED = {
    "a step that is late": (lambda s: s.move([1, 0], time=0.5), "one after 1.0 s, where"),
    "a step that is repeated": (lambda s: s.move([1, 0], time=1.0), "one after 1.0 s, where"),
    "steps out of order": (lambda s: s.move([[1, 0]] * 2, time=[3.0, 2.0]), "one after 3.0 s"),
    "no time": (lambda s: s.move([1, 0]), "neither dt nor time"),
    "both times": (lambda s: s.move([1, 0], 1.0, time=2.0), "both dt and time"),
    "a time that is no number": (lambda s: s.move([1, 0], time=np.nan), "one after 1.0 s"),
    "a step of no length": (lambda s: s.move([1, 0], 0.0), "times above 0"),
    "a speed that is no number": (lambda s: s.move([np.nan, 0], 1.0), "found the controls"),
    "words for speeds": (lambda s: s.move(["fast", 0], 1.0), "controls: found"),
    "three controls for two": (lambda s: s.move([1, 0, 0], 1.0), "a row of 2 controls"),
    "a table of times": (lambda s: s.move([[1, 0]] * 2, time=[[0.5, 2.0]]), "the shape (1, 2)"),
    "complex controls": (lambda s: s.move([1j, 0], 1.0), "controls: found"),
    "a step that the clock cannot tell": (
        lambda s: s.move([1, 0], 1e-300),
        "too short for a clock",
    ),
    "a time of the far future": (lambda s: s.move([1, 0], time=1e300), "found the controls"),
    "rows that came already": (lambda s: s.hear(**ONE), "rows once more at 1.0 s"),
    "a scan that is late": (lambda s: s.hear(time=0.9, **ONE), "the vehicle has moved on"),
    "a scan to come": (lambda s: s.hear(time=1.1, **ONE), "move to it first"),
    "a bearing that is no number": (
        lambda s: s.hear(landmark=[9], bearing=[np.nan]),
        "hear, row 1: found bearing ''",
    ),
    "degrees": (lambda s: s.hear(landmark=[9], bearing=[57.3]), "57.3, expected radians"),
    "an endless range": (
        lambda s: s.hear(landmark=[9], bearing=[0.1], range=[np.inf]),
        "hear, row 1: found range inf",
    ),
    "columns of several lengths": (
        lambda s: s.hear(landmark=[9, 10], bearing=[0.1]),
        "columns of the shapes",
    ),
    "a landmark twice": (
        lambda s: s.hear(landmark=[9, 9], bearing=[0.1, 0.2]),
        "hear, row 2: found landmark 9",
    ),
    "a label that is none": (lambda s: s.hear(landmark=[1.5], bearing=[0.1]), "an integer"),
    "no labels": (lambda s: s.hear(bearing=[0.1]), "association__method"),
    "an unknown caller": (
        lambda s: s.hear(landmark=[9], bearing=[0.1], caller=["bat"]),
        "the vehicle itself",
    ),
    "an unknown column": (lambda s: s.hear(landmark=[9], bearings=[0.1]), "did you mean 'bearing'"),
}


@pytest.mark.parametrize("what", REFUSED)
@pytest.mark.parametrize("name", ["iekf", "smoother"])
def test_invalid_input_is_rejected_and_changes_nothing(name, what):
    act, words = REFUSED[what]
    slam = Slam(ROBOT, filter=name)
    slam.move([1.0, 0.1], dt=1.0)
    slam.hear(**ONE)
    untouched = slam.copy()
    with pytest.raises(InputError) as refused:
        act(slam)
    assert words in str(refused.value)
    for one in (slam, untouched):
        one.move([1.0, 0.1], dt=1.0)
        one.hear(**ONE)
    assert slam.path.equals(untouched.path)
    assert slam.map.equals(untouched.map)


def test_a_failing_estimator_changes_nothing(monkeypatch):
    slam = Slam(ROBOT)
    slam.move([1.0, 0.1], dt=1.0)
    before = slam.copy()

    def fails(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr(type(slam._session._estimator), "update", fails)
    with pytest.raises(RuntimeError):
        slam.hear(**ONE)
    monkeypatch.undo()
    assert slam.path.equals(before.path)
    assert slam.hear(**ONE).tolist() == before.hear(**ONE).tolist() == [7, 8]
    assert slam.map.equals(before.map)


def test_returned_arrays_may_be_overwritten_by_the_caller():
    slam = Slam(ROBOT)
    slam.move([1.0, 0.1], dt=1.0)
    labels = slam.hear(**ONE)
    before = slam.copy()
    slam.pose.covariance[:] = 7.0
    labels[:] = 7
    for one in (slam, before):
        one.move([1.0, 0.1], dt=1.0)
        one.hear(**ONE)
    assert slam.path.equals(before.path)
    assert slam.map.equals(before.map)


def test_masked_values_count_as_missing():
    masked, none = Slam(ROBOT), Slam(ROBOT)
    masked.hear(**ONE | {"range": np.ma.masked_array([2.0, 3.0], mask=[False, True])})
    none.hear(**ONE | {"range": [2.0, None]})
    assert masked.map.equals(none.map)
    with pytest.raises(InputError, match="found the controls"):
        masked.move(np.ma.masked_array([1.0, 0.1], mask=[True, False]), dt=1.0)


def test_no_steps_change_nothing():
    slam = Slam(ROBOT)
    before = slam.copy()
    slam.move(np.empty((0, 2)), dt=[])
    assert slam.path.equals(before.path)


@pytest.mark.parametrize("name", CATALOGUE)
def test_ways_with_and_without_a_covariance_follow_one_another(name):
    robot = {"motion": "poses", "forward_std": 0.05, "sideways_std": 0.03, "turn_std": 0.02}
    robot |= {name: ROBOT[name] for name in ("range_std", "bearing_std", "range_bounds")}
    way, sure = [0.5, 0.0, 0.1], [1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4]
    mixed, whole = Slam(robot, filter=name), Slam(robot, filter=name)
    for said in (True, False, True, False):
        mixed.move([*way, *sure] if said else way, dt=0.5)
        whole.move([*way, *(sure if said else [np.nan] * 6)], dt=0.5)
    for slam in (mixed, whole):
        slam.hear(**ONE)
    assert mixed.path.equals(whole.path)
    assert mixed.map.equals(whole.map)


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        ({}, "vehicle: found no key"),
        (ROBOT | {"range_std": -1.0}, "vehicle, key 'range_std'"),
        (ROBOT | {"rang_std": 1.0}, "did you mean 'range_std'"),
        (3, "the path of a log.toml"),
        ("nowhere/log.toml", "nowhere"),
    ],
)
def test_a_vehicle_that_is_none_is_refused(vehicle, words):
    with pytest.raises(InputError) as refused:
        Slam(vehicle)
    assert words in str(refused.value)


def test_settings_of_slam_are_accepted_and_others_rejected():
    assert Slam(ROBOT, filter="smoother", filter__window=50, seed=3).time == 0.0
    for options, words in (
        ({"rays__powr": 2.0}, "did you mean rays__exponent"),
        ({"filter__range_std": 1.0}, "the log decides this"),
        ({"filter": "both"}, "one estimator"),
        ({"filter": "ikef"}, "did you mean 'iekf'"),
        ({"kept": 0}, "kept"),
        ({"time": np.nan}, "a finite number"),
        ({"time": 1e18}, "seconds, up to 1e+11"),
        ({"filter": np.array(3)}, "an estimator's name"),
    ):
        with pytest.raises(InputError) as refused:
            Slam(ROBOT, **options)
        assert words in str(refused.value)


def test_poses_of_the_last_steps_are_kept_and_no_more():
    slam = Slam(ROBOT, kept=10)
    for _ in range(95):
        slam.move([1.0, 0.0], dt=0.1)
    assert 10 <= slam.path.height <= 20
    assert slam.path["time_s"][-1] == slam.time


def test_foreign_files_are_neither_overwritten_nor_loaded(tmp_path):
    slam, mine = Slam(ROBOT), tmp_path / "notes.txt"
    mine.write_text("mine")
    for act in (slam.save, Slam.load):
        with pytest.raises(InputError, match=r"notes\.txt: found a file that Slam\.save did not"):
            act(mine)
    assert mine.read_text() == "mine"
    for act in (slam.save, Slam.load):
        with pytest.raises(InputError, match="folder"):
            act(tmp_path)
    saved = slam.save(tmp_path / "one.slam")
    assert slam.save(saved) == saved, "its own is replaced"
    link = tmp_path / "link.slam"
    link.symlink_to(mine)
    with pytest.raises(InputError):
        slam.save(link)
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("at", [50, 150, -20])
def test_a_saved_drive_that_has_changed_is_refused(tmp_path, at):
    saved = Slam(ROBOT).save(tmp_path / "one.slam")
    data = bytearray(saved.read_bytes())
    data[at] ^= 1
    saved.write_bytes(data)
    with pytest.raises(InputError, match="has changed since"):
        Slam.load(saved)
    saved.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="has changed since"):
        Slam.load(saved)


@pytest.mark.parametrize("name", ["nowhere.slam", "no/such/folder", "a\0b", "x" * 5000])
def test_a_name_that_no_file_has_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"expected a file of Slam\.save"):
        Slam.load(tmp_path / name)
    if name != "nowhere.slam":
        with pytest.raises(InputError, match="cannot be written"):
            Slam(ROBOT).save(tmp_path / name)


def test_a_caller_is_named_as_the_vehicle_names_it():
    robot = ROBOT | {"callers": [{"name": "bat", "landmark": 3, "place": [5.0, 1.0]}]}
    slam = Slam(robot, filter="iekf")
    slam.move([1.0, 0.0], dt=1.0)
    slam.hear(landmark=[9], bearing=[0.5], caller=["bat"], excess_path=[4.0], excess_path_std=[0.1])
    assert slam.map.filter(landmark=9)["status"].to_list() == ["full"]
    slam._session.report = lambda: {"alarms": [(0.5, -1, True), (1.0, 1, False)]}
    assert slam.alarms == [(0.5, "pose", True), (1.0, "bat", False)]


@pytest.mark.slow
def test_a_million_steps_need_no_more_memory_and_no_more_time():
    import tracemalloc
    from time import process_time

    slam, rng = Slam(ROBOT, kept=1000), np.random.default_rng(7)
    places, spans, sizes = rng.uniform(-8.0, 8.0, (20, 2)), [], []
    tracemalloc.start()
    for round_ in range(10):
        began = process_time()
        for _ in range(10_000):
            slam.move(np.tile([0.5, 0.25], (10, 1)), dt=np.full(10, 0.1))
            pose = slam.pose
            way = places[rng.choice(20, 3, replace=False)]
            seen = way - [pose.x, pose.y]
            label = np.flatnonzero((places[:, None] == way).all(axis=2).any(axis=1))
            seen = places[label] - [pose.x, pose.y]
            bearing = np.arctan2(seen[:, 1], seen[:, 0]) - pose.heading
            slam.hear(landmark=label, bearing=bearing, range=np.hypot(*seen.T))
        spans.append(process_time() - began)
        sizes.append(tracemalloc.get_traced_memory()[0])
        assert round_ == 0 or sizes[-1] < sizes[0] + 1e6
    tracemalloc.stop()
    assert spans[-1] < 1.5 * np.median(spans[:3])


@pytest.mark.parametrize("seed", [12, 36, 52, 68, 70, 76])
def test_absurd_steps_and_scans_are_refused_or_leave_a_covariance_that_is_one(seed):
    """Of 400 drawn seeds these ended in a traceback or in negative eigenvalues."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(["ekf", "iekf", "smoother"]))
    method = str(rng.choice(["known", "nearest", "marginal"]))
    slam = Slam(ABSURD[rng.integers(2)], filter=name, association__method=method)
    for _ in range(8):
        with suppress(InputError):
            if rng.random() < 0.5:
                speed, turn = rng.choice([0.5, 10, 1000, -1000]), rng.choice([0, 0.1, -1.2, 1.5])
                slam.move([speed, turn], dt=rng.choice([0.1, 1, 100, 1000]))
            else:
                n = rng.integers(1, 6)
                labels = {"landmark": rng.choice(50, n, replace=False)} if method == "known" else {}
                bearing, far = rng.uniform(-3, 3, n), rng.uniform(0.5, 30, n)
                slam.hear(bearing=bearing, range=far, **labels)
        least, *_, largest = np.linalg.eigvalsh(slam.pose.covariance)
        assert least >= -1e-12 * largest


def test_controls_that_cannot_be_are_refused_by_the_name_of_the_method_that_was_called():
    slam = Slam(ROBOT)
    for controls, dt in (([1.0, 2.0, 3.0], 1.0), ([1e9, 0.0], 1.0), ([1.0, 0.0], -1.0)):
        with pytest.raises(InputError, match=r"^move: found "):
            slam.move(controls, dt=dt)
