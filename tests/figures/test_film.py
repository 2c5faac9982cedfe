"""Films: the panel of a frame, and the files."""

import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from pipistrelle.config import InputError
from pipistrelle.detection.scans import EXCESS_PATH, make_scan, rows_of
from pipistrelle.estimation.beliefs import no_landmarks, placed
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.figures.film import FilmPanel, animate_mission, film_writer
from pipistrelle.figures.maps import draw_maps, drawn_excess_paths
from pipistrelle.figures.recorder import Snapshot, callers_at
from pipistrelle.geometry import range_and_bearing

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


def staged(snapshots, truth=NO_TRUTH, callers=(), beamwidth=None):
    """Return the names in the legend of a film, and its panels."""
    panels = [FilmPanel(key, seen, beamwidth, truth, callers) for key, seen in snapshots.items()]
    figure, _ = draw_maps(panels, truth, callers)
    return [text.get_text() for legend in figure.legends for text in legend.texts], panels


@pytest.fixture(scope="module")
def snapshots(watched):
    return watched[1]


@pytest.fixture(scope="module")
def panels(snapshots, scene):
    """The panels of all estimates, by strategy and filter."""
    _, panels = staged(snapshots, **scene)
    return {panel.case: panel for panel in panels}


def test_a_panel_shows_the_particles_of_its_frame_enlarged(panels, snapshots):
    with_particles = {case for case, panel in panels.items() if panel.closeup is not None}
    assert with_particles == {case for case in panels if case[1] == "fastslam"}
    frame, panel = snapshots["fused", "fastslam"][10], panels["fused", "fastslam"]
    panel.show_picture(0, frame.scan.time)
    assert np.array_equal(panel.closeup.dots.get_xydata(), frame.cloud[:, :2])
    window = panel.closeup.window
    assert np.mean(window.get_xlim()) == pytest.approx(frame.pose[0])
    assert max(artist.zorder for artist in panel.artists) == window.zorder, "over all others"


def test_a_film_redraws_the_window_in_every_picture(snapshots, scene, panels, tmp_path):
    path, key = tmp_path / "mission.gif", ("fused", "fastslam")
    animate_mission({key: snapshots[key]}, path, **scene, pictures=3)
    _, (panel,) = staged({key: snapshots[key]}, **scene)
    extents = panel.closeup.window.get_window_extent().extents
    pictures = []
    with Image.open(path) as film:
        x0, y0, x1, y1 = extents.round().astype(int)
        for picture in range(3):
            film.seek(picture)
            whole = np.asarray(film.convert("L"))[::-1]
            pictures.append(whole[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2])
    for one, other in pairwise(pictures):
        assert np.mean(one != other) > 0.01
    for picture in pictures:
        assert np.mean(picture > 250) > 0.5, "the map below is covered"
        assert np.mean(picture < 250) > 0.03, "particles, vehicle, bar and words"


def test_a_gif_has_the_pictures_asked_for_and_rests_on_the_last(snapshots, scene, tmp_path):
    path = tmp_path / "new" / "mission.gif"
    three = {key: frames for key, frames in snapshots.items() if key[1] == "ekf"}
    animate_mission(three, path, **scene, pictures=6)
    with Image.open(path) as film:
        assert film.n_frames == 6
        assert film.info["loop"] == 0
        assert film.width == 1200
        assert film.width % 2 == film.height % 2 == 0, "as MP4 needs it"
        durations = []
        for picture in range(6):
            film.seek(picture)
            durations.append(film.info["duration"])
            assert film.convert("RGB").getpixel((0, 0)) == (255, 255, 255), "white stays white"
    assert durations == [80] * 5 + [2000]


def test_a_short_mission_is_shown_frame_by_frame(snapshots, tmp_path):
    path = tmp_path / "mission.gif"
    animate_mission({("passive", "ekf"): snapshots["passive", "ekf"][:4]}, path)
    with Image.open(path) as film:
        assert film.n_frames == 4


def test_a_panel_draws_measurements_along_bearings_up_to_their_ranges(snapshots, panels):
    frame, panel = snapshots["fused", "ekf"][6], panels["fused", "ekf"]
    panel.show_picture(0, frame.scan.time)
    ranged = np.isfinite(frame.scan.range)
    assert 0 < ranged.sum() < len(ranged), "the frame has both kinds"
    tips = np.array([segment[1] for segment in panel.ranges.get_segments()])
    distance, bearing = range_and_bearing(frame.pose, tips)
    assert distance == pytest.approx(frame.scan.range[ranged])
    assert bearing == pytest.approx(frame.scan.bearing[ranged])
    tips = np.array([segment[1] for segment in panel.bearings.get_segments()])
    assert range_and_bearing(frame.pose, tips)[1] == pytest.approx(frame.scan.bearing[~ranged])


def test_a_second_excess_path_of_a_landmark_adds_no_line(snapshots, scene):
    frame = snapshots["fused", "ekf"][6]
    old, k = frame.scan, len(frame.scan.landmark)
    more = rows_of(old, np.append(np.arange(k), 0))
    more.numbers[:2, k], more.numbers[EXCESS_PATH, k] = np.nan, 3.0
    drawn = []
    for scan in (old, more):
        _, (panel,) = staged({("fused", "ekf"): [replace(frame, scan=scan)]}, **scene)
        panel.show_picture(0, scan.time)
        drawn.append(panel)
    for lines in ("ranges", "bearings"):
        one, other = (getattr(panel, lines).get_segments() for panel in drawn)
        np.testing.assert_array_equal(one, other)


def test_a_panel_shows_the_map_and_rings_new_landmarks(snapshots, scene):
    frames = snapshots["fused", "ekf"]
    _, (panel,) = staged({("fused", "ekf"): frames}, **scene)
    sets = [set(f.landmarks.landmark[placed(f.landmarks)].tolist()) for f in frames]
    step = next(i for i in range(10, 39) if sets[i + 1] > sets[i])
    for picture in range(9):
        panel.show_picture(picture, frames[step].scan.time)
    assert len(panel.rings.get_paths()) == 0
    panel.show_picture(9, frames[step + 1].scan.time)
    assert len(panel.rings.get_paths()) == len(sets[step + 1] - sets[step])
    rows = frames[step + 1].landmarks
    assert len(panel.members.get_paths()) == int(np.sum(~placed(rows)))
    assert len(panel.full.get_paths()) == len(sets[step + 1])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mission.mp4", r"no ffmpeg on the PATH.*install ffmpeg or choose .*gif"),
        ("mission.avi", r"'\.avi', expected \.gif or \.mp4"),
        ("file/mission.gif", "cannot be written"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused(snapshots, tmp_path, monkeypatch, name, message):
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "file").touch()
    frames = {("fused", "ekf"): snapshots["fused", "ekf"][:2]}
    with pytest.raises(InputError, match=message):
        animate_mission(frames, tmp_path / name)


def test_the_legend_of_a_film_names_the_symbols_of_its_frames(snapshots, scene):
    full, heard = "placed landmark, 95 %", ["range and bearing", "bearing without range"]
    rays = ["unresolved ray, 1σ, darker: likelier", "just pruned"]
    for strategy, measured in (("active", heard[:1]), ("passive", heard[1:]), ("fused", heard)):
        key = strategy, "ekf"
        names, _ = staged({key: snapshots[key]}, **scene)
        assert names == [*measured, full, *(rays if strategy != "active" else []), "beacon"]


def test_a_film_without_measurements_needs_no_legend(tmp_path):
    frame = Snapshot(
        scan=make_scan(0.0, np.empty(0), np.empty(0)),
        pose=np.zeros(3),
        covariance=np.zeros((3, 3)),
        landmarks=no_landmarks(),
    )
    animate_mission({("active", "ekf"): [frame]}, tmp_path / "empty.gif")
    assert (tmp_path / "empty.gif").read_bytes().startswith(b"GIF89a")


def test_a_panel_shows_at_most_two_excess_path_ellipses(timed, timed_scene):
    names, (active, fused) = staged(timed[1], **timed_scene)
    assert {"excess-path ellipse, sound path", "caller as estimated"} <= set(names)
    counts = set()
    for frame, label in zip(fused.frames, fused.resolved, strict=True):
        for panel in (active, fused):
            panel.show_picture(0, frame.scan.time)
        outlines, ways = fused.excess_paths.get_paths(), fused.ways.get_segments()
        expected = drawn_excess_paths(frame, label)[0]
        assert len(outlines) == len(ways) == len(fused.crossing.get_xdata()) + (len(outlines) > 1)
        for outline, ellipse in zip(outlines, expected, strict=True):
            np.testing.assert_array_equal(outline.vertices[:121], ellipse)
        counts.add(len(outlines))
        stars = callers_at(frame).mean
        stars = stars[np.isfinite(stars).all(axis=1)]
        np.testing.assert_array_equal(fused.callers.get_xydata(), stars)
        assert active.excess_paths.get_paths() == []
    assert {1, 2} <= counts <= {0, 1, 2}
    assert fused.excess_paths.get_clip_on()


def test_a_mission_without_timing_shows_no_ellipses_or_callers(panels, snapshots, scene):
    names, _ = staged(snapshots, **scene)
    assert "excess-path ellipse, sound path" not in names
    for panel in panels.values():
        panel.show_picture(0, panel.frames[20].scan.time)
        assert (panel.excess_paths.get_paths(), panel.ways.get_segments()) == ([], [])
        for dots in (panel.callers, panel.crossing, panel.movers):
            assert len(dots.get_xdata()) == 0


def test_a_moving_caller_is_a_star_and_leaves_its_estimated_track(timed, timed_scene):
    names, panels = staged(timed[1], **timed_scene)
    boat, time = timed_scene["callers"][2].place, timed_scene["truth"].time
    frame = panels[0].frames[20]
    panels[0].show_picture(0, frame.scan.time)
    step = np.searchsorted(time, frame.scan.time - 1e-9)
    assert 0 < step < len(boat) - 1
    np.testing.assert_array_equal(panels[0].movers.get_xydata(), boat[[step]])
    assert "its estimated track" in names
    panel = panels[1]
    panel.show_picture(0, panel.times[30])
    trail = panel.trails.get_xydata()
    believed = [frame.moving.mean[0] for frame in panel.frames[:31] if len(frame.moving.mean)]
    np.testing.assert_array_equal(trail[-len(believed) :], believed)
    full = placed(panel.frames[30].landmarks).sum()
    assert len(panel.full.get_paths()) == full + 1, "its ellipse"
