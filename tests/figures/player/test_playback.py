"""The arrays of a playback, and its page as a file: complete, self-contained, escaped."""

import base64
import json
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config, EmitterConfig, InputError, ScenarioConfig
from pipistrelle.detection.logs.recording import LogCaller
from pipistrelle.detection.scans import rows_of as rows_of_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.player import MAX_PARTICLES, SCRIPTS, page, playback
from pipistrelle.figures.recorder import MissionRecorder, callers_at, pruned, resolved

BAD = "</script><script>alert('a')</script>\"'&"


def rows_of(rows, frame):
    part = slice(*rows.first[frame : frame + 2])
    return rows.landmark[part], rows.numbers[part]


def of(played, strategy, estimator):
    (found,) = [e for e in played.estimates if (e.strategy, e.filter) == (strategy, estimator)]
    return found


def test_every_frame_of_every_estimate_is_there(watched, played):
    _, snapshots = watched
    assert [(e.strategy, e.filter) for e in played.estimates] == list(snapshots)
    assert len(played.estimates) == 6
    for estimate in played.estimates:
        frames = snapshots[estimate.strategy, estimate.filter]
        assert len(frames) == len(played.time) == 40
        np.testing.assert_array_equal(estimate.pose, [frame.pose for frame in frames])
        covariance = np.array([frame.covariance for frame in frames])
        parts = [covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1], covariance[:, 2, 2]]
        np.testing.assert_array_equal(estimate.spread, np.stack(parts, axis=1))
        for i in (0, 17, 39):
            scan, believed = frames[i].scan, frames[i].landmarks
            labels, numbers = rows_of(estimate.heard, i)
            assert labels.tolist() == scan.landmark.tolist()
            np.testing.assert_array_equal(numbers, np.column_stack([scan.bearing, scan.range]))
            labels, numbers = rows_of(estimate.mapped, i)
            assert labels.tolist() == believed.landmark.tolist()
            np.testing.assert_array_equal(numbers[:, :2], believed.mean)
            np.testing.assert_array_equal(numbers[:, 3], believed.covariance[:, 0, 1])
            np.testing.assert_array_equal(numbers[:, 5], believed.weight)


def test_further_excess_paths_are_not_drawn_and_leave_nothing_that_is_no_number(watched, played):
    done, snapshots = watched
    timed = {
        key: [replace(frame, scan=with_excess_path(frame.scan)) for frame in frames]
        for key, frames in snapshots.items()
    }
    for one, other in zip(playback(done, timed).estimates, played.estimates, strict=True):
        np.testing.assert_array_equal(one.heard.numbers, other.heard.numbers)
        assert np.isfinite(one.heard.numbers[:, 0]).all()


def with_excess_path(scan):
    """Return a scan with one row more, if it has any, which is but an excess path."""
    more = rows_of_scan(scan, np.append(np.arange(scan.landmark.size), 0)[: scan.landmark.size * 2])
    more.numbers[:, scan.landmark.size :] = np.nan
    return more


def test_times_and_truth_belong_to_the_frames(watched, played):
    done, _ = watched
    np.testing.assert_allclose(played.time, 0.5 * np.arange(1, 41))
    np.testing.assert_array_equal(played.true_pose, done.drive.truth.path[4::4])
    np.testing.assert_array_equal(played.true_start, done.drive.truth.path[0])
    assert played.title == "Mission of seed 7"
    assert played.facts == ("20.0 s", "40 frames", "beam 33°", "21 landmarks")
    ((label, name, place),) = played.callers
    assert (label, name) == (21, "beacon")
    np.testing.assert_array_equal(place, done.drive.truth.landmarks[1][-1])


def test_pruned_members_belong_to_the_frame_without_them(watched, played):
    _, snapshots = watched
    frames, estimate = snapshots["passive", "ekf"], of(played, "passive", "ekf")
    assert len(rows_of(estimate.pruned, 0)[0]) == 0
    total = 0
    for i in range(1, 40):
        before = frames[i - 1].landmarks
        gone = pruned(before, frames[i].landmarks)
        total += gone.sum()
        np.testing.assert_array_equal(rows_of(estimate.pruned, i)[1][:, :2], before.mean[gone])
    assert total > 5


def test_particles_are_shown_and_of_many_a_part(watched, played):
    done, snapshots = watched
    assert of(played, "fused", "ekf").cloud is None
    assert of(played, "fused", "fastslam").cloud.shape == (40, 100, 3)
    key = ("fused", "fastslam")
    many = {key: [replace(f, cloud=np.tile(f.cloud, (5, 1))) for f in snapshots[key]]}
    (estimate,) = playback(done, many).estimates
    assert estimate.cloud.shape == (40, 167, 3)
    assert estimate.cloud.shape[1] <= MAX_PARTICLES


def test_of_a_long_recording_frames_are_chosen_evenly_and_the_last_is_among_them(watched):
    done, snapshots = watched
    few = playback(done, snapshots, most=9)
    np.testing.assert_allclose(np.diff(few.time), 2.5, atol=0.51)
    assert few.time[-1] == pytest.approx(20.0)
    assert "40 frames, of which 9 are shown" in few.facts
    frames = snapshots["fused", "ekf"]
    chosen = [round(2 * t) - 1 for t in few.time]
    expected = [frames[i].pose for i in chosen]
    np.testing.assert_array_equal(of(few, "fused", "ekf").pose, expected)
    np.testing.assert_array_equal(few.true_pose, done.drive.truth.path[[4 * i + 4 for i in chosen]])


def test_an_estimate_that_ended_early_stays_where_it_was(watched):
    done, snapshots = watched
    short = {**snapshots, ("active", "ekf"): snapshots["active", "ekf"][:10]}
    estimate = of(playback(done, short), "active", "ekf")
    assert len(estimate.pose) == 40
    np.testing.assert_array_equal(estimate.pose[9:], np.tile(estimate.pose[9], (31, 1)))


def test_estimates_without_a_frame_are_left_out_and_none_at_all_is_refused(watched):
    done, snapshots = watched
    some = {key: frames for key, frames in snapshots.items() if key[0] == "fused"}
    assert len(playback(done, some).estimates) == 2
    failed = replace(done, trials=(replace(done.trials[0], error="it fell"),))
    with pytest.raises(InputError, match=r"no estimate has a frame .*active ekf: it fell"):
        playback(failed, {})


def test_the_map_without_truth_contains_the_estimates(watched):
    done, snapshots = watched
    blind = playback(
        replace(done, drive=replace(done.drive, truth=NO_TRUTH), callers=()), snapshots
    )
    assert (blind.true_pose, blind.true_start, blind.landmarks) == (None, None, None)
    assert "no truth known" in blind.facts
    (left, right), (bottom, top) = blind.limits
    path = snapshots["fused", "ekf"][-1].pose
    assert left < path[0] < right
    assert bottom < path[1] < top


def moved(value, shift):
    """Return a record with all positions in it shifted."""
    if isinstance(value, np.ndarray):
        value = value.copy()
        value[..., :2] += shift
        return value
    names = {"path", "mean", "place", "pose", "landmarks", "cloud"}
    parts = {name: getattr(value, name) for name in names if hasattr(value, name)}
    return replace(
        value, **{n: moved(part, shift) for n, part in parts.items() if part is not None}
    )


def far_away(done, snapshots, shift):
    """The same mission somewhere else."""
    truth, (labels, points) = done.drive.truth, done.drive.truth.landmarks
    truth = replace(truth, path=moved(truth.path, shift), landmarks=(labels, points + shift))
    callers = tuple(moved(caller, shift) for caller in done.callers)
    trials = tuple(replace(trial, track=moved(trial.track, shift)) for trial in done.trials)
    seen = {key: [moved(frame, shift) for frame in frames] for key, frames in snapshots.items()}
    return replace(
        done, drive=replace(done.drive, truth=truth), callers=callers, trials=trials
    ), seen


def test_a_world_far_from_where_coordinates_begin_is_shown_about_another_origin(watched, played):
    assert played.origin.tolist() == [0.0, 0.0]
    done, snapshots = watched
    far = playback(*far_away(done, snapshots, np.array([4e5, 5.2e6])))
    assert far.origin.tolist() == [4e5, 5.2e6]
    same = partial(np.testing.assert_allclose, atol=1e-8)
    for name in ("limits", "true_pose", "true_start"):
        same(getattr(far, name), getattr(played, name))
    same(far.callers[0][2], played.callers[0][2])
    same(far.landmarks[1], played.landmarks[1])
    for one, other in zip(far.estimates, played.estimates, strict=True):
        for name in ("start", "pose"):
            same(getattr(one, name), getattr(other, name))
        same(one.mapped.numbers, other.mapped.numbers)
        same(one.pruned.numbers, other.pruned.numbers)


class Revising:
    """A belief that says how often it was asked, and may revise its path."""

    gated = 0

    def __init__(self, frame, asked, real):
        self.frame, self.asked, self.real = frame, asked, real

    def pose(self):
        return Gaussian(mean=np.array([float(self.frame), 0.0, 0.0]), covariance=np.eye(3))

    def landmarks(self):
        self.asked["map"].append(self.frame)
        return self.real.landmarks

    def path(self):
        self.asked["path"].append(self.frame)
        mean = np.arange(3.0 * (4 * self.frame + 5)).reshape(-1, 3)
        return Gaussian(mean=mean, covariance=np.tile(np.eye(3), (len(mean), 1, 1)))


def revised(watched, rest, frames=40):
    _, snapshots = watched
    seen, asked, watch = snapshots["fused", "ekf"], {"map": [], "path": []}, MissionRecorder(rest)
    for i in range(frames):
        real = seen[i % 40]
        watch("fused", "ekf", real.scan, Revising(i, asked, real))
    return asked, watch.snapshots


def test_a_filter_that_revises_its_path_is_let_rest(watched):
    asked, snapshots = revised(watched, 3)
    assert asked["map"] == list(range(0, 40, 3))
    assert asked["path"] == [0, 15, 30]
    frames = snapshots["fused", "ekf"]
    assert frames[4].landmarks is frames[3].landmarks
    assert frames[6].landmarks is not frames[5].landmarks
    assert [i for i, frame in enumerate(frames) if frame.path is not None] == [0, 15, 30]
    assert frames[15].path.shape == (65, 2)
    asked, snapshots = revised(watched, None)
    assert (asked["map"], asked["path"]) == (list(range(40)), [])


def test_the_longer_it_goes_on_the_longer_it_may_rest(watched):
    asked, _ = revised(watched, 3, frames=600)
    gaps = np.diff(asked["map"])
    assert gaps[0] == 3
    assert gaps[-1] == 9
    assert np.all(np.diff(gaps) >= 0)


def test_revised_paths_have_their_frames_and_the_last_is_the_track(watched):
    done, _ = watched
    _, snapshots = revised(watched, 3)
    (trial,) = [t for t in done.trials if (t.strategy, t.filter) == ("fused", "ekf")]
    end = trial.track.pose.mean + 1.0
    track = replace(trial.track, online=trial.track.pose, pose=replace(trial.track.pose, mean=end))
    (estimate,) = playback(
        replace(done, trials=(replace(trial, track=track),)), snapshots
    ).estimates
    assert estimate.revised_at.tolist() == [0, 15, 30, 39]
    told = snapshots["fused", "ekf"][15].path
    np.testing.assert_array_equal(rows_of(estimate.revised, 1)[1], told[:65:4])
    np.testing.assert_array_equal(rows_of(estimate.revised, 3)[1], end[::4, :2])
    np.testing.assert_array_equal(rows_of(estimate.mapped, 39)[1][:, :2], track.landmarks.mean)
    assert estimate.start[0] == trial.track.pose.mean[0, 0]


def test_excess_paths_have_the_estimated_positions_of_their_callers(timed):
    again, snapshots = timed
    shown = playback(again, snapshots)
    assert [place.ndim for *_, place in shown.callers] == [1, 1, 2]
    active, fused = shown.estimates
    assert len(active.excess_paths.landmark) == 0
    frames = snapshots["fused", "ekf"]
    assert fused.resolved.tolist() == resolved(frames)
    assert fused.callers.shape == (40, 3, 5)
    followed = np.isfinite(fused.callers[:, 2]).all(axis=1)
    assert followed[-1]
    assert np.count_nonzero(np.diff(followed)) == 1, "from a frame on"
    for i in (0, 17, 39):
        believed = callers_at(frames[i])
        np.testing.assert_array_equal(fused.callers[i, :, :2], believed.mean[1:])
        np.testing.assert_array_equal(fused.callers[i, :, 3], believed.covariance[1:, 0, 1])
        labels, numbers = rows_of(fused.excess_paths, i)
        assert np.unique(labels, return_counts=True)[1].max() <= 2
        scan = frames[i].scan
        for label, (caller, excess_path) in zip(labels, numbers, strict=True):
            (row,) = np.flatnonzero((scan.landmark == label) & (scan.excess_path == excess_path))
            assert scan.caller[row] - 1 == caller


def test_a_mission_without_excess_paths_has_no_rows_of_them(played):
    for estimate in played.estimates:
        assert estimate.callers is None
        assert len(estimate.excess_paths.landmark) == 0
        assert set(estimate.resolved) == {-1}


def test_a_logs_callers_have_names_and_no_true_place(watched):
    done, snapshots = watched
    log = SimpleNamespace(name="own", callers=(LogCaller(name="mate", landmark=21),))
    ((label, name, place),) = playback(
        replace(done, log=log, scenario=None, callers=()), snapshots
    ).callers
    assert (label, name) == (21, "mate")
    assert np.isnan(place).all()


def test_associated_landmarks_have_the_labels_of_true_landmarks():
    config = Config(seed=7, scenario=ScenarioConfig(steps=160, landmarks=20))
    config = config.model_copy(
        update={
            "association": AssociationConfig(method="marginal"),
            "emitter": EmitterConfig(radius=0.002),
        }
    )
    watch = MissionRecorder()
    done = run_mission(config, ["active"], ["ekf"], watch=watch)
    (estimate,) = playback(done, watch.snapshots).estimates
    true = dict(zip(*(part.tolist() for part in done.drive.truth.landmarks), strict=True))
    labels, rows = rows_of(estimate.mapped, -1 % len(estimate.pose))
    off = [np.hypot(*(row[:2] - true[n])) for n, row in zip(labels, rows, strict=True) if n in true]
    assert len(off) == 3
    assert max(off) < 2.0
    assert {*estimate.heard.landmark.tolist()} & {*labels.tolist()}


def numbers(text):
    found = re.search(r'<script type="application/json" id="numbers">(.*?)</script>', text, re.S)
    return json.loads(found[1])


def unpacked(packed):
    ((name, text),) = packed.items()
    return np.frombuffer(base64.b64decode(text), {"float32": "<f4", "int32": "<i4"}[name])


def test_the_numbers_are_the_missions(played):
    held = numbers(page(played))
    np.testing.assert_array_equal(unpacked(held["time"]), played.time.astype("f4"))
    np.testing.assert_array_equal(unpacked(held["truePose"]), played.true_pose.astype("f4").ravel())
    assert held["limits"] == [list(pair) for pair in played.limits]
    assert [one["name"] for one in held["estimates"][:2]] == [
        "active · EKF",
        "active · FastSLAM 2.0",
    ]
    for one, estimate in zip(held["estimates"], played.estimates, strict=True):
        assert one["role"] == estimate.strategy
        rows = one["mapped"]
        np.testing.assert_array_equal(unpacked(rows["first"]), estimate.mapped.first)
        np.testing.assert_array_equal(unpacked(rows["landmark"]), estimate.mapped.landmark)
        same = estimate.mapped.numbers.astype("f4").ravel()
        np.testing.assert_array_equal(unpacked(rows["numbers"]), same)
    assert held["scales"]["placed"] == pytest.approx(np.sqrt(-2.0 * np.log(0.05)))
    assert held["farthest"] == 20.0


def test_a_page_speaks_of_excess_paths_only_where_some_were_heard(played, timed):
    silent, told = page(played), page(playback(*timed))
    for word in (
        'ellipses" type',
        "An ellipse of an excess path",
        "E hides the ellipses of excess paths",
    ):
        assert word not in silent
        assert word in told
    for one in numbers(silent)["estimates"]:
        assert "callers" not in one
        assert len(unpacked(one["excessPaths"]["landmark"])) == 0
    active, fused = numbers(told)["estimates"]
    assert "callers" in active
    assert len(unpacked(active["excessPaths"]["landmark"])) == 0
    assert len(unpacked(fused["excessPaths"]["landmark"])) > 0


def test_nothing_in_it_is_anywhere_else(played):
    text = page(played)
    assert text == page(played), "the same bytes"
    assert re.findall(r"https?://[^\s\"'<]+", text) == ["http://www.w3.org/2000/svg"]
    assert not re.search(r"(?:src|href)=(?!\"data:)", text)
    assert "url(" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text


def test_whatever_a_mission_is_called_is_text(played):
    label, _, place = played.callers[0]
    named = replace(
        played,
        title=BAD,
        facts=(BAD,),
        callers=((label, BAD, place),),
        estimates=(replace(played.estimates[0], outcome=f"failed: {BAD}"),),
    )
    text = page(named)
    assert "alert('a')" not in text.replace(numbers_text(text), "")
    assert text.count("<script") == 2
    held = numbers(text)
    assert held["callers"][0]["name"] == BAD
    assert held["estimates"][0]["outcome"] == f"failed: {BAD}"


def numbers_text(text):
    return re.search(r'id="numbers">(.*?)</script>', text, re.S)[1]


def test_numbers_that_are_none_do_not_break_it(played):
    estimate = played.estimates[1]
    wild = np.full(estimate.mapped.numbers.shape, 1e300)
    lost = replace(
        estimate,
        pose=np.full_like(estimate.pose, np.nan),
        mapped=replace(estimate.mapped, numbers=wild),
    )
    held = numbers(page(replace(played, estimates=(lost,))))["estimates"][0]
    assert np.isnan(unpacked(held["pose"])).all()
    assert np.isinf(unpacked(held["mapped"]["numbers"])).all()


def test_a_strategy_without_a_colour_is_drawn_in_ink(played):
    strange = replace(played.estimates[0], strategy="someone's own")
    assert numbers(page(replace(played, estimates=(strange,))))["estimates"][0]["role"] == "ink"


def test_every_script_is_in_it(played):
    from importlib.resources import files

    text, here = page(played), files("pipistrelle.figures.player")
    assert {path.name for path in here.iterdir() if path.name.endswith(".js")} == set(SCRIPTS)
    assert all((here / name).read_text(encoding="utf-8") in text for name in SCRIPTS)
