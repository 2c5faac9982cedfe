"""Films: the recorded frames, the panel of a frame, and the files."""

import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from pipistrelle.config import InputError
from pipistrelle.detection.scans import EXCESS_PATH, make_scan
from pipistrelle.detection.scans import rows_of as rows_of_scan
from pipistrelle.estimation.beliefs import Landmarks, placed
from pipistrelle.figures.film import _stage, animate_mission, film_writer
from pipistrelle.figures.recorder import (
    MissionRecorder,
    Snapshot,
    callers_at,
    drawn_excess_paths,
    pruned,
)
from pipistrelle.geometry import range_and_bearing
from reference.missions import map_with

PICTURES = [np.full((4, 6, 3), level, np.uint8) for level in (1, 2, 3)]


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Put a shell script in the place of ffmpeg."""
    if os.name == "nt":
        pytest.skip("the stand-in for ffmpeg is a shell script")

    def install(script: str) -> None:
        program = tmp_path / "ffmpeg"
        program.write_text(f"#!/bin/sh\nfor last; do :; done\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)

    return install


def test_ffmpeg_is_given_every_picture_whole_and_in_order(stand_in, tmp_path):
    stand_in('cat > "$last"; echo "$@" > "$last.args"')
    path = tmp_path / "mission.mp4"
    film_writer(path)(iter(PICTURES), path)
    assert path.read_bytes() == b"".join(picture.tobytes() for picture in PICTURES)
    assert "-s 6x4 -r 12.5" in (tmp_path / "mission.mp4.args").read_text()


def test_a_failure_of_ffmpeg_is_reported_with_its_message(stand_in, tmp_path):
    stand_in("echo 'Unknown encoder libx264' >&2; exit 3")
    path = tmp_path / "mission.mp4"
    with pytest.raises(InputError, match=r"status 3 \(Unknown encoder libx264\).*mission\.gif"):
        film_writer(path)(iter(PICTURES), path)


def test_an_upper_case_ending_will_do(tmp_path):
    path = tmp_path / "MISSION.GIF"
    film_writer(path)(PICTURES, path)
    assert path.read_bytes()[:6] == b"GIF89a"


@pytest.fixture(scope="module")
def recorder(mission) -> MissionRecorder:
    watch = MissionRecorder()
    for strategy, frames in mission.watched.items():
        for scan, belief in frames:
            watch(strategy, "ekf", scan, belief)
    return watch


@pytest.fixture(scope="module")
def swarm_recorder(watched_swarms) -> MissionRecorder:
    watch = MissionRecorder()
    for scan, belief in watched_swarms["fused"]:
        watch("fused", "fastslam", scan, belief)
    return watch


def rows_of(labels: list[int], x: list[float]) -> Landmarks:
    mean = np.column_stack([x, np.zeros(len(x))])
    return map_with(labels, mean, np.tile(np.eye(2), (len(x), 1, 1)))


def test_a_recorder_keeps_every_frame_of_every_strategy(recorder, mission):
    assert list(recorder.snapshots) == [(s, "ekf") for s in ("active", "fused", "passive")]
    assert {len(frames) for frames in recorder.snapshots.values()} == {375}
    scan, belief = mission.watched["passive"][200]
    kept = recorder.snapshots["passive", "ekf"][200]
    assert kept.scan is scan
    assert np.array_equal(kept.pose, belief.pose().mean)


def test_a_recorder_keeps_the_particles_of_fastslam(recorder, swarm_recorder, watched_swarms):
    assert recorder.snapshots["fused", "ekf"][0].cloud is None
    kept = [frame.cloud for frame in swarm_recorder.snapshots["fused", "fastslam"]]
    assert np.array_equal(kept, [belief.cloud() for _, belief in watched_swarms["fused"]])


def test_a_panel_shows_the_particles_of_its_frame_enlarged(recorder, swarm_recorder, mission):
    _, panels = _stage(recorder.snapshots | swarm_recorder.snapshots, **mission.scene)
    assert [panel.closeup is not None for panel in panels] == [False, False, False, True]
    frame = swarm_recorder.snapshots["fused", "fastslam"][100]
    panels[3].show_frame(frame.scan.time, 0)
    dots, _, window = panels[3].closeup.artists
    assert np.array_equal(dots.get_xydata(), frame.cloud[:, :2])
    assert np.mean(window.get_xlim()) == pytest.approx(frame.pose[0])
    assert panels[3].artists[-1] is window, "nothing is drawn over it"


def test_a_film_redraws_the_window_in_every_picture(swarm_recorder, mission, tmp_path):
    path = tmp_path / "mission.gif"
    animate_mission(swarm_recorder.snapshots, path, **mission.scene, pictures=3)
    _, (panel,) = _stage(swarm_recorder.snapshots, **mission.scene)
    window = panel.closeup.artists[2]
    pictures = []
    with Image.open(path) as film:
        x0, y0, x1, y1 = window.get_window_extent().extents.round().astype(int)
        for picture in range(3):
            film.seek(picture)
            whole = np.asarray(film.convert("L"))[::-1]
            pictures.append(whole[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2])
    for one, other in pairwise(pictures):
        assert np.mean(one != other) > 0.01
    for picture in pictures:
        assert np.mean(picture > 250) > 0.5, "the map below is covered"
        assert np.mean(picture < 250) > 0.03, "particles, vehicle, bar and words"


def test_a_gif_has_the_pictures_asked_for_and_rests_on_the_last(recorder, mission, tmp_path):
    path = tmp_path / "new" / "mission.gif"
    animate_mission(recorder.snapshots, path, **mission.scene, pictures=6)
    with Image.open(path) as film:
        assert film.n_frames == 6
        assert film.info["loop"] == 0
        assert film.width == 1200
        assert film.width % 2 == film.height % 2 == 0, "as MP4 needs it"
        durations = []
        for picture in range(6):
            film.seek(picture)
            durations.append(film.info["duration"])
    assert durations == [80] * 5 + [2000]


def test_white_stays_white_in_a_gif(recorder, tmp_path):
    path = tmp_path / "mission.gif"
    animate_mission({("fused", "ekf"): recorder.snapshots["fused", "ekf"]}, path, pictures=2)
    with Image.open(path) as film:
        film.seek(1)
        assert film.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_a_short_mission_is_shown_frame_by_frame(recorder, tmp_path):
    path = tmp_path / "mission.gif"
    frames = recorder.snapshots["passive", "ekf"][:4]
    animate_mission({("passive", "ekf"): frames}, path)
    with Image.open(path) as film:
        assert film.n_frames == 4


def test_a_panel_draws_measurements_along_bearings_up_to_their_ranges(recorder, mission):
    _, panels = _stage(recorder.snapshots, **mission.scene)
    frame = recorder.snapshots["fused", "ekf"][100]
    panels[1]._show_scan(frame)
    ranged = np.isfinite(frame.scan.range)
    assert 0 < ranged.sum() < len(ranged), "the frame has both kinds"
    tips = np.array([segment[1] for segment in panels[1].ranges.get_segments()])
    distance, bearing = range_and_bearing(frame.pose, tips)
    assert distance == pytest.approx(frame.scan.range[ranged])
    assert bearing == pytest.approx(frame.scan.bearing[ranged])
    tips = np.array([segment[1] for segment in panels[1].bearings.get_segments()])
    assert range_and_bearing(frame.pose, tips)[1] == pytest.approx(frame.scan.bearing[~ranged])


def test_a_second_excess_path_of_a_landmark_adds_no_line(recorder, mission):
    frame = recorder.snapshots["fused", "ekf"][100]
    old, k = frame.scan, len(frame.scan.landmark)
    rows = np.append(np.arange(k), 0)
    more = rows_of_scan(old, rows)
    more.numbers[:2, k], more.numbers[EXCESS_PATH, k] = np.nan, 3.0
    panels = []
    for scan in (old, more):
        _, (panel, *_) = _stage({("fused", "ekf"): [replace(frame, scan=scan)]}, **mission.scene)
        panel._show_scan(panel.frames[0])
        panels.append(panel)
    for lines in ("ranges", "bearings"):
        one, other = (getattr(panel, lines).get_segments() for panel in panels)
        np.testing.assert_array_equal(one, other)


def test_a_panel_shows_the_map_and_rings_new_landmarks(recorder, mission):
    _, panels = _stage(recorder.snapshots, **mission.scene)
    frames = recorder.snapshots["fused", "ekf"]
    sets = [set(f.landmarks.landmark[placed(f.landmarks)].tolist()) for f in frames]
    step = next(i for i in range(50, 374) if sets[i + 1] > sets[i])
    for picture in range(9):
        panels[1].show_frame(frames[step].scan.time, picture)
    assert len(panels[1].rings.get_paths()) == 0
    panels[1].show_frame(frames[step + 1].scan.time, 9)
    assert len(panels[1].rings.get_paths()) == len(sets[step + 1] - sets[step])
    rows = frames[step + 1].landmarks
    assert len(panels[1].members.get_paths()) == int(np.sum(~placed(rows)))
    assert len(panels[1].full.get_paths()) == len(sets[step + 1])


def test_members_without_a_successor_of_their_landmark_are_pruned():
    before = rows_of([1, 1, 1, 2, 2], [0.7, 2.1, 6.4, 0.0, 5.0])
    after = rows_of([1, 1, 2, 3], [2.3, 6.0, 4.0, 0.7])
    assert pruned(before, after).tolist() == [True, False, False, True, False]
    nothing = rows_of([], [])
    assert pruned(before, nothing).all()
    assert len(pruned(nothing, after)) == 0


def test_an_mp4_without_ffmpeg_is_rejected_with_a_fix(recorder, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"no ffmpeg on the PATH.*install ffmpeg or choose .*gif"):
        animate_mission(recorder.snapshots, tmp_path / "mission.mp4")


def test_an_unknown_ending_of_a_film_is_rejected(recorder, tmp_path):
    with pytest.raises(InputError, match=r"'\.avi', expected \.gif or \.mp4"):
        animate_mission(recorder.snapshots, tmp_path / "mission.avi")


def test_a_path_that_cannot_be_written_is_rejected(recorder, tmp_path):
    (tmp_path / "file").touch()
    frames = {("fused", "ekf"): recorder.snapshots["fused", "ekf"][:2]}
    with pytest.raises(InputError, match="cannot be written"):
        animate_mission(frames, tmp_path / "file" / "mission.gif")


def test_a_film_without_frames_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        animate_mission({}, tmp_path / "mission.gif")


def test_the_legend_of_a_film_names_the_symbols_of_its_frames(recorder, mission, tmp_path):
    def named(strategy, frames=slice(None)):
        key = strategy, "ekf"
        figure, _ = _stage({key: recorder.snapshots[key][frames]}, **mission.scene)
        return [text.get_text() for text in figure.legends[0].texts]

    full = "placed landmark, 95 %"
    rays = ["ray, 1σ, darker: likelier", "just pruned"]
    assert named("active") == ["range and bearing", full, "beacon"]
    assert named("passive") == ["bearing alone", *rays, full, "beacon"]
    assert named("fused") == ["range and bearing", "bearing alone", *rays, full, "beacon"]


def test_a_film_without_measurements_needs_no_legend(tmp_path):
    frame = Snapshot(
        scan=make_scan(0.0, np.empty(0), np.empty(0)),
        pose=np.zeros(3),
        covariance=np.zeros((3, 3)),
        landmarks=rows_of([], []),
    )
    animate_mission({("active", "ekf"): [frame]}, tmp_path / "empty.gif")
    assert (tmp_path / "empty.gif").read_bytes().startswith(b"GIF89a")


def test_a_panel_shows_at_most_two_excess_path_ellipses(timed):
    again, snapshots = timed
    scene = {"truth": again.drive.truth, "callers": again.callers, "beamwidth": again.beamwidth}
    figure, panels = _stage(snapshots, **scene)
    named = [text.get_text() for text in figure.legends[0].texts]
    assert {"excess-path ellipse and its way", "caller as estimated"} <= set(named)
    active, fused = panels
    counts = set()
    for frame, label in zip(fused.frames, fused.resolved, strict=True):
        for panel in panels:
            panel.show_frame(frame.scan.time, 0)
        outlines, ways = fused.excess_paths.get_paths(), fused.ways.get_segments()
        expected = drawn_excess_paths(frame, label)[0]
        assert len(outlines) == len(ways) == len(fused.crossing.get_xdata()) + (len(outlines) > 1)
        for outline, ellipse in zip(outlines, expected, strict=True):
            np.testing.assert_array_equal(outline.vertices[:121], ellipse)
        counts.add(len(outlines))
        stars = callers_at(frame).mean
        np.testing.assert_array_equal(fused.callers.get_xydata(), stars)
        assert active.excess_paths.get_paths() == []
    assert {1, 2} <= counts <= {0, 1, 2}
    assert fused.excess_paths.get_clip_on()


def test_a_mission_without_timing_shows_no_ellipses_or_callers(recorder, mission):
    figure, panels = _stage(recorder.snapshots, **mission.scene)
    assert "excess-path ellipse and its way" not in [t.get_text() for t in figure.legends[0].texts]
    for panel in panels:
        frame = panel.frames[200]
        panel.show_frame(frame.scan.time, 0)
        drawn = (panel.excess_paths.get_paths(), panel.ways.get_segments())
        assert drawn == ([], [])
        assert [len(one.get_xdata()) for one in (panel.callers, panel.crossing, panel.movers)] == [
            0
        ] * 3


def test_a_moving_caller_is_a_star_at_its_current_position(timed):
    again, snapshots = timed
    boat = again.callers[2].place
    _, panels = _stage(snapshots, truth=again.drive.truth, callers=again.callers, beamwidth=None)
    frame = panels[0].frames[20]
    panels[0].show_frame(frame.scan.time, 0)
    step = np.searchsorted(again.drive.truth.time, frame.scan.time - 1e-9)
    assert 0 < step < len(boat) - 1
    np.testing.assert_array_equal(panels[0].movers.get_xydata(), boat[[step]])


def test_a_tracked_caller_leaves_its_estimated_track(timed):
    again, snapshots = timed
    figure, panels = _stage(
        snapshots, truth=again.drive.truth, callers=again.callers, beamwidth=None
    )
    assert "its estimated track" in [text.get_text() for text in figure.legends[0].texts]
    panel = panels[1]
    panel.show_frame(panel.times[30], 0)
    trail = panel.trails.get_xydata()
    believed = [frame.moving.mean[0] for frame in panel.frames[:31] if len(frame.moving.mean)]
    np.testing.assert_array_equal(trail[-len(believed) :], believed)
    assert len(panel.around.get_paths()) == 1
