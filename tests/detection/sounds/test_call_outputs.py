"""Sound of calls that are no tones: own recordings give the run's own rows."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

import pipistrelle
from pipistrelle.acoustics.call import Sweep
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.folder import RowsHeard
from pipistrelle.detection.sounds.hearing import hear_recording, log_callers
from pipistrelle.detection.sounds.sound_file import read_description
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.scripting.arguments import Door, mission_settings
from pipistrelle.settings import from_flags
from reference.sounds import UNLABELLED, record, swept

LOUD = {"level_db": 65.0}  # else nothing is near enough for an echo of the vehicle's own
SWEEP = {"emitter": LOUD | {"call": "sweep", "taper": 0.2}}
CASES = {
    "sweep": SWEEP,
    "hyperbolic at another rate, in water": {
        "scenario": {"medium": "water"},
        "emitter": LOUD | {"call": "sweep", "sweep": "hyperbolic"},
        "receiver": {"sample_rate": 192e3},
    },
    "both sweep": SWEEP | {"beacon": {"call": "sweep", "taper": 0.2}},
    "file": {"emitter": LOUD | {"call": "own.wav", "frequency": 47.5e3}},
}


@pytest.fixture
def case(request, tmp_path, monkeypatch):
    """Return settings of a case; its file stands in the working folder."""
    monkeypatch.chdir(tmp_path)
    call = Sweep(60e3, 35e3, 2.4e-3, "hyperbolic", taper=0.3)
    time = np.arange(round(2.4e-3 * 250e3)) / 250e3
    soundfile.write("own.wav", call.waveform(time, 47.5e3).real, 250_000, subtype="FLOAT")
    return CASES[request.param]


def words(settings):
    """Spell settings as flags."""
    pairs = [
        (f"--{section}.{key.replace('_', '-')}", str(value))
        for section, table in settings.items()
        for key, value in table.items()
    ]
    return [word for pair in pairs for word in pair]


def heard(folder):
    """Hear all of a recording; return the scans."""
    scans, about = [], read_description(folder)
    rows = RowsHeard(folder, about.log, log_callers(about))

    def look(frame):
        rows.text(frame.scan)
        scans.append(frame.scan)

    hear_recording(folder, about, Config(), range, look)
    return SimpleNamespace(scans=scans).scans


def scans_of_run(settings):
    """Return the rows without labels of the run that was recorded."""
    receiver = {"elements": 4} | settings.get("receiver", {})
    given = settings | {"receiver": receiver}
    asked = {"duration": 4.0, "landmarks": 20}
    door = Door(asked=asked, beneath={}, flags=from_flags(given), command="")
    config, _, _ = mission_settings(door)
    (frames,) = listen(world_of(config), config, (config.emitter.radius,), labels=False)
    return [frame.unlabelled for frame in frames]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if case in ("sweep", "file") else pytest.mark.slow)
        for case in CASES
    ],
    indirect=True,
)
def test_detections_of_a_recorded_call_equal_the_runs(case):
    tape = record(Path("tape").absolute(), *words(case))
    log, run = heard(tape), scans_of_run(case)
    assert [scan.time for scan in log] == [scan.time for scan in run]
    assert sum(np.count_nonzero(his.caller == 0) for his in run) >= 8
    rows, found = 0, 0
    for mine, his in zip(log, run, strict=True):
        rows += his.bearing.size
        for i in range(his.bearing.size):
            same = mine.caller == his.caller[i]
            for name, limit in (("bearing", 1e-4), ("range", 1e-3), ("excess_path", 1e-3)):
                one, other = getattr(mine, name), getattr(his, name)[i]
                same &= (np.isnan(one) & np.isnan(other)) | (np.abs(one - other) < limit)
            found += bool(same.any())
    assert rows > 50
    assert found >= rows - 2  # next to the threshold the measured noise may decide otherwise


def test_slam_on_a_recorded_sweep_repeats_the_run(tmp_path):
    sweep = words(SWEEP)
    record(tmp_path / "tape", *UNLABELLED, "--filter.noise", "measured", *sweep)
    pipistrelle.hear(tmp_path / "tape", output=tmp_path / "log")
    asked = {"filters": "smoother", "association__method": "marginal"}
    again = pipistrelle.slam(tmp_path / "log", gate=1.0, **asked).tracks
    with pytest.warns(UserWarning, match="every sample is recorded"):
        run = pipistrelle.run(
            duration=4.0, landmarks=20, strategies="fused", receiver__elements=4,
            listening__timing=True, filter__noise="measured", **SWEEP, **asked,
        ).tracks  # fmt: skip
    for name in ("x_m", "y_m", "heading_rad"):
        assert np.abs(again[name].to_numpy() - run[name].to_numpy()).max() < 0.03


def test_a_recording_describes_and_keeps_the_sent_call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    time = np.arange(500) / 250e3
    wave = Sweep(60e3, 35e3, 2e-3).waveform(time, 47.5e3).real
    soundfile.write("own.wav", wave, 250_000, subtype="FLOAT")
    few = ["--emitter.call", "own.wav", "--emitter.frequency", "47e3", "--frames", "0:2"]
    tape = record(tmp_path / "tape", *few, "--beacon.call", "sweep")
    about = read_description(tape)
    assert (about.call.call, about.callers[0].call) == ("call_vehicle.wav", "sweep")
    assert about.callers[0].band == (28e3, 18e3)
    kept, rate = soundfile.read(tape / "call_vehicle.wav")
    assert rate == 250_000
    np.testing.assert_allclose(kept, wave, atol=1e-6)


@pytest.fixture(scope="module")
def two_frames(tmp_path_factory):
    """A recording of two frames of a vehicle that sends sweeps."""
    folder = tmp_path_factory.mktemp("sweep") / "tape"
    return record(folder, "--emitter.call", "sweep", "--frames", "0:2")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('call = "sweep"', 'call = "gone.wav"', "gone.wav"),
        ('call = "sweep"', 'call = "sweep"\ntaper = 2.0', "taper"),
        ("60000.0", "120000.0", "half the sample rate"),
        ("band = [", "bend = [", "bend"),
    ],
)
def test_a_wrongly_described_call_is_refused(two_frames, tmp_path, old, new, message):
    tape = shutil.copytree(two_frames, tmp_path / "tape")
    text = (tape / "recording.toml").read_text()
    text = text.replace("taper = 0.0\n", "", 1).replace(old, new, 1)
    (tape / "recording.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        heard(tape)


def test_a_sweep_without_call_times_is_found_by_its_leakage(tmp_path):
    tape = record(tmp_path / "tape", "--emitter.call", "sweep", "--frames", "1:5")
    told = heard(tape)
    (tape / "calls.csv").unlink()
    found = heard(tape)
    assert len(found) == 4
    for mine, his in zip(found, told, strict=True):
        assert abs(mine.time - his.time) <= 1.01 / 200e3
    samples, rate = soundfile.read(tape / "recording.wav", dtype="float32")
    for begin in range(0, len(samples), 100_000):
        samples[begin : begin + 600] = 0.0
    soundfile.write(tape / "recording.wav", samples, rate, subtype="FLOAT")
    with pytest.raises(InputError, match=r"say in calls\.csv when"):
        heard(tape)  # no leak: echoes are all that there is


CUT = (-0.5, -0.05, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
"""Shares of a loud echo that the vehicle is deaf to, or that the next call cuts off."""


@pytest.mark.parametrize("deaf", [3e-3, 2.2e-3])
@pytest.mark.parametrize("loud", [0.5, 10.0])
@pytest.mark.parametrize("end", ["begins", "ends"])
def test_an_echo_that_the_window_cuts_leaves_no_rows(tmp_path, deaf, loud, end):
    period = 0.05
    whole = {"begins": deaf, "ends": period - 2e-3}[end]
    late = [whole + 2e-3 * share * (1 if end == "ends" else -1) for share in CUT]
    folder, times = swept(tmp_path / "tape", late, deaf=deaf, period=period, loud=loud)
    rows = pipistrelle.hear(folder, detection__false_alarm=1e-9).measurements
    for time, delay, share in zip(times, late, CUT, strict=True):
        found = rows.filter((rows["time"] - time).abs() < 1e-6)["range"].to_numpy()
        assert np.min(np.abs(found - 170.0 * 10e-3)) < 0.01, "the faint echo is heard"
        ghosts = np.abs(found - 170.0 * 10e-3) > 0.01
        if share <= 0.0:
            assert np.min(np.abs(found - 170.0 * delay)) < 0.01, "a whole echo is heard"
            ghosts &= np.abs(found - 170.0 * delay) > 0.01
        assert found[ghosts].size == 0
