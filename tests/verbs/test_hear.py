"""`pipistrelle hear`, and the sound that `run` writes for it."""

from pathlib import Path

import pytest
import soundfile

import pipistrelle
from reference.sounds import FEW, foreign, swept

FEWEST = ("--receiver.elements", "2", "--duration", "1", "--strategy", "fused", "--quiet")
"""A mission of two frames, for eight microphones."""


def test_a_recording_is_heard_into_a_log_that_slam_solves(obey, refused, short_tape, undrawn):
    status, printed, _ = obey("hear", short_tape, "-o", "log", "--frames", "0:4")
    assert status == 0
    assert printed.splitlines()[-1] == "log"
    solved = obey("slam", "log", "--association.method", "marginal", "--quiet", "-o", "map")
    assert solved[:2] == (0, "map\n")
    words = ("hear", short_tape, "--frames", "0:1", "-o", "log", "--quiet")
    assert "add --overwrite to replace the log there" in refused(*words)
    assert obey(*words, "--overwrite")[:2] == (0, "log\n")
    for more in ((), ("--check",), ("-o", "other")):
        said = refused("hear", "log", *more)
        assert "log: found a log" in said
        assert "pipistrelle slam log" in said
    assert "found no folder for the log" in refused("hear", short_tape)


def test_some_frames_are_written_and_some_are_heard(obey, refused, short_tape, undrawn):
    line = ("run", *FEW, "--strategy", "fused", "--quiet", "-o", "run")
    assert obey(*line, "--save-sound", "some", "--frames", "2:5")[0] == 0
    some, _ = soundfile.read("some/recording.wav", dtype="float32")
    whole, _ = soundfile.read(short_tape / "recording.wav", dtype="float32")
    assert (some == whole[200_000:500_000]).all()
    assert obey("hear", "some", "-o", "part", "--quiet", "--frames", "0:2")[0] == 0
    assert obey("hear", short_tape, "-o", "same", "--quiet", "--frames", "2:4")[0] == 0
    part, same = (
        Path(name, "measurements.csv").read_text().splitlines() for name in ("part", "same")
    )
    assert {row.split(",")[0] for row in part[1:]} == {"1.5", "2.0"}
    assert len(part) == pytest.approx(len(same), abs=2)
    for frames in ("5:2", "x", "3", "9:", "-1:2", ""):
        assert "--frames" in refused("hear", short_tape, "-o", "none", "--frames", frames)
    assert not Path("none").exists()


def test_the_size_of_the_sound_is_checked_before_the_mission(refused, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000})())
    said = refused("run", *FEWEST, "-o", "run", "--save-sound", "tape")
    assert "--save-sound: found 0.0 GB free" in said
    assert not Path("tape").exists()


def test_check_reports_only_faulty_recordings(obey, tmp_path):
    folder = foreign(tmp_path / "tape")
    assert obey("hear", folder, "--check")[:2] == (0, "nothing odd was found\n")
    samples, rate = soundfile.read(folder / "tape.wav", dtype="float32")
    samples[:, 3] += 0.2
    soundfile.write(folder / "tape.wav", samples, rate, subtype="FLOAT")
    status, printed, _ = obey("hear", folder, "--check")
    assert status == 1
    assert printed.startswith("channel 4 is off zero by 0.2")


def test_hear_names_the_band_of_a_sweep_beyond_half_the_rate(refused, tmp_path):
    folder, _ = swept(tmp_path / "tape", [5e-3, 5e-3])
    about = (folder / "recording.toml").read_text()
    about = about.replace("36000.0, 22000.0", "40000.0, 20000.0").replace("taper = 0.2\n", "")
    about = about.replace("duration = 0.002", "duration = 0.0003")
    (folder / "recording.toml").write_text(about)
    said = refused("hear", folder, "-o", "log")
    assert "a sweep of 20000 to 40000 Hz, whose edges reach from" in said
    assert "half the sample rate of 96000 Hz" in said


def test_the_figure_ends_where_echoes_do_though_noise_makes_a_row_later(tmp_path):
    folder, _ = swept(tmp_path / "tape", [5e-3] * 15, period=0.1, loud=0.2)
    heard = pipistrelle.hear(folder, detection__false_alarm=1e-4)
    latest = max(found.delay.max() for found in heard.overview.detections)
    left, right = heard.figure().axes[0].get_xlim()
    assert left == 0.0
    assert latest > 0.03
    assert 10.0 < right < 30.0


def test_folders_without_a_recording_are_rejected(refused):
    Path("file").touch()
    Path("empty").mkdir()
    Path("link").symlink_to("nowhere")
    kinds = {"file": "found a file", "gone": "no such folder", "empty": "recording.toml"}
    for place, words in (kinds | {"link": "no such folder"}).items():
        assert words in refused("hear", place, "-o", "log")
    refused("hear", "empty", "--rays.exponent", "3", "-o", "log")
    assert "recording.toml" in refused("hear", "empty")
    assert not Path("log").exists()


def test_look_draws_a_log_in_three_formats_with_equal_bytes(obey, refused, short_log):
    for ending in ("png", "svg", "pdf"):
        words = ("look", short_log, "-o", f"one.{ending}")
        assert obey(*words)[1].endswith(f"\none.{ending}\n")
        first = Path(f"one.{ending}").read_bytes()
        assert f"one.{ending}: is there already" in refused(*words)
        obey(*words, "--overwrite")
        assert Path(f"one.{ending}").read_bytes() == first
    assert "expected a name that ends in .png or .svg or .pdf" in refused(*words[:-1], "a.gif")
