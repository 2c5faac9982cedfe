"""Sound in: own recordings give the run's own rows, foreign ones what is in them."""

import shutil
import time
import tracemalloc
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

import pipistrelle
from pipistrelle.acoustics.call import Sweep
from pipistrelle.config import Config, DetectionConfig, InputError
from pipistrelle.detection.logs.folder import RowsHeard, read_log
from pipistrelle.detection.sounds.calls import _loudest_around, calls_of
from pipistrelle.detection.sounds.check import check_recording
from pipistrelle.detection.sounds.hearing import hear_recording, log_callers
from pipistrelle.detection.sounds.sound_file import read_description
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.scripting.arguments import Door, base_layer, mission_settings
from pipistrelle.settings import from_flags
from reference.refused import refusal_of
from reference.sounds import FEW, UNLABELLED, foreign, record, swept, with_samples

SLOW = pytest.mark.slow


def heard(folder, config=None):
    """Hear all of a recording; return the scans and the detections of its frames."""
    found, scans, folder = [], [], Path(folder)
    about = read_description(folder)
    rows = RowsHeard(folder, about.log, log_callers(about))

    def look(frame):
        rows.text(frame.scan)
        found.append(frame.detections)
        scans.append(frame.scan)

    hear_recording(folder, about, config or Config(), range, look)
    rows.files()
    return scans, found


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A small recording of our own."""
    return record(tmp_path_factory.mktemp("own") / "tape")


def words(settings):
    """Format settings as command-line flags."""
    flags = []
    for section, table in settings.items():
        for key, value in table.items():
            flags += [f"--{section}.{key.replace('_', '-')}", *map(str, np.atleast_1d(value))]
    return flags


def frames_of_run(settings=None, named=None):
    """Return the rows without labels of the run that was recorded, perhaps with other settings."""
    given = dict(settings or {})
    given["receiver"] = {"elements": 4} | given.get("receiver", {})
    asked = {"duration": 4.0, "landmarks": 20}
    door = Door(asked=asked, beneath=base_layer(named), flags=from_flags(given), command="")
    config, _, _ = mission_settings(door)
    assert FEW[1] == "4"
    (frames,) = listen(world_of(config), config, (config.emitter.radius,), labels=False)
    return [frame.unlabelled for frame in frames]


def agreeing(scan, run, limit, stds=0.0):
    """Count the rows of a run that stand in a scan, too, within a limit or some deviations."""
    count = 0
    for i in range(run.bearing.size):
        same = scan.caller == run.caller[i]
        for name in ("bearing", "range", "excess_path"):
            mine, his, std = getattr(scan, name), getattr(run, name)[i], getattr(run, f"{name}_std")
            same &= (np.isnan(mine) & np.isnan(his)) | (np.abs(mine - his) < limit + stds * std[i])
        count += bool(same.any())
    return count


def test_detections_of_a_recording_equal_the_runs(own):
    log, _ = heard(own)
    run = frames_of_run()
    assert [scan.time for scan in log] == [scan.time for scan in run]
    rows = sum(scan.bearing.size for scan in run)
    found = sum(agreeing(a, b, 1e-6) for a, b in zip(log, run, strict=True))
    assert rows > 100
    assert found >= rows - 2  # next to the threshold the measured noise may decide otherwise
    for mine, his in zip(log, run, strict=True):
        for caller, row in enumerate(his.direct.tolist()):
            assert (mine.direct[caller] < 0) == (row < 0)
    assert agreeing(log[0], run[1], 1e-6) == 0, "another frame is another"


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


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=() if case == "file" else SLOW) for case in CASES]
)
def test_detections_of_a_recorded_call_equal_the_runs(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    call = Sweep(60e3, 35e3, 2.4e-3, "hyperbolic", taper=0.3)
    time = np.arange(round(2.4e-3 * 250e3)) / 250e3
    soundfile.write("own.wav", call.waveform(time, 47.5e3).real, 250_000, subtype="FLOAT")
    log, _ = heard(record(Path("tape").absolute(), *words(CASES[case])))
    run = frames_of_run(CASES[case])
    assert [scan.time for scan in log] == [scan.time for scan in run]
    assert sum(np.count_nonzero(scan.caller == 0) for scan in run) >= 8
    rows = sum(scan.bearing.size for scan in run)
    assert rows > 50
    # the noise before the record, which the file lacks, reaches into it through filters in bands
    assert sum(agreeing(a, b, 0.0, 0.1) for a, b in zip(log, run, strict=True)) >= rows - 2


HARBOUR_SWEEP = {"emitter": {"call": "sweep", "band": (165e3, 135e3), "taper": 0.2}}


@pytest.mark.parametrize(
    ("settings", "limit", "stds"),
    [({}, 1e-6, 0.0), pytest.param(HARBOUR_SWEEP, 0.0, 0.1, marks=SLOW)],
    ids=["tone", "sweep"],
)
def test_detections_of_an_underwater_recording_equal_the_runs(tmp_path, settings, limit, stds):
    harbour = str(Path(__file__).parents[3] / "examples" / "harbour.toml")
    folder = record(tmp_path / "tape", "--settings", harbour, *words(settings))
    medium = read_description(folder).medium
    assert (medium["name"], medium["salinity"]) == ("water", 30.0)
    assert medium["speed_of_sound"] == read_description(folder).speed_of_sound > 1400.0
    log, run = heard(folder)[0], frames_of_run(settings, harbour)
    rows = sum(scan.bearing.size for scan in run)
    assert rows > 100
    assert sum(agreeing(a, b, limit, stds) for a, b in zip(log, run, strict=True)) >= rows - 2


def test_the_log_of_a_recording_holds_its_detections(own, tmp_path):
    done = pipistrelle.hear(own, output=tmp_path / "log")
    log, scans = read_log(tmp_path / "log"), heard(own)[0]
    assert done.measurements.height == sum(scan.bearing.size for scan in scans)
    assert {"hearing.png", "truth.csv", "landmarks.csv"} < {p.name for p in done.folder.iterdir()}
    for mine, his in zip(log.scans, scans, strict=True):
        np.testing.assert_array_equal(mine.numbers, his.numbers)
        np.testing.assert_array_equal(mine.direct, his.direct)
        np.testing.assert_array_equal(mine.caller, his.caller)
    assert pipistrelle.hear(own).measurements.equals(done.measurements)


@pytest.mark.parametrize(
    ("settings", "limit"),
    [pytest.param({}, 0.01, id="tone", marks=SLOW), pytest.param(SWEEP, 0.03, id="sweep")],
)
def test_slam_on_a_recording_repeats_the_run(tmp_path, settings, limit):
    record(tmp_path / "tape", *UNLABELLED, "--filter.noise", "measured", *words(settings))
    pipistrelle.hear(tmp_path / "tape", output=tmp_path / "log")
    asked = {"filters": "smoother", "association__method": "marginal"}
    again = pipistrelle.slam(tmp_path / "log", gate=1.0, **asked).tracks
    run = pipistrelle.run(
        duration=4.0, landmarks=20, strategies="fused", receiver__elements=4,
        listening__excess_paths=True, filter__noise="measured", **settings, **asked,
    ).tracks  # fmt: skip
    for name in ("x_m", "y_m", "heading_rad"):
        assert np.abs(again[name].to_numpy() - run[name].to_numpy()).max() < limit


def test_sixteen_bits_and_flac_give_nearly_the_same_detections(tmp_path):
    record(tmp_path / "short", "--sound-bits", "16")
    samples, rate = soundfile.read(tmp_path / "short" / "recording.wav", dtype="int16")
    assert np.abs(samples.astype(int)).max() > 2000
    run = frames_of_run()
    rows = sum(scan.bearing.size for scan in run)
    (tmp_path / "flac").mkdir()
    for name in ("array.csv", "calls.csv", "odometry.csv", "recording.toml"):
        shutil.copy(tmp_path / "short" / name, tmp_path / "flac")
    about = (tmp_path / "flac" / "recording.toml").read_text()
    (tmp_path / "flac" / "recording.toml").write_text(about.replace(".wav", ".w64"))
    soundfile.write(tmp_path / "flac" / "recording.w64", samples, rate, subtype="PCM_16")
    for name in ("short", "flac"):
        log, _ = heard(tmp_path / name)
        found = sum(agreeing(a, b, 5e-3) for a, b in zip(log, run, strict=True))
        assert found > 0.95 * rows


@pytest.mark.parametrize("faces", [True, False])
def test_a_point_simulated_by_another_program_is_located(tmp_path, faces):
    log, found = heard(foreign(tmp_path / "tape", place=(1.5, 0.9), faces=faces))
    assert len(log) == 3
    for scan in log:
        loudest = int(scan.level_db.argmax())
        assert abs(scan.bearing[loudest] - np.arctan2(0.9, 1.5)) < 0.02
        assert abs(scan.range[loudest] - np.hypot(1.5, 0.9)) < 0.01
        assert scan.caller[loudest] == 0
    assert all(len(one.power) for one in found)


def test_gains_and_offsets_of_channels_do_not_matter(tmp_path):
    rng = np.random.default_rng(4)
    plain, _ = heard(foreign(tmp_path / "plain"))
    gain = 10.0 ** rng.uniform(-1.0, 0.5, 16)
    folder = foreign(tmp_path / "odd", gain=gain)
    offset = rng.uniform(-0.05, 0.05, 16).astype(np.float32)
    with_samples(folder, lambda samples: samples + offset)
    odd, _ = heard(folder)
    for one, other in zip(plain, odd, strict=True):
        a, b = int(one.level_db.argmax()), int(other.level_db.argmax())
        assert abs(one.bearing[a] - other.bearing[b]) < 3e-3
        assert abs(one.level_db[a] - other.level_db[b]) < 0.5


@pytest.mark.parametrize("way", ["period", "trigger", "leak"])
def test_calls_are_found_without_calls_csv_at_the_same_times(tmp_path, way):
    folder = foreign(tmp_path / "tape", calls=(1013, 25_013, 49_013))
    told, _ = heard(folder)
    (folder / "calls.csv").unlink()
    about = (folder / "recording.toml").read_text()
    if way == "period":
        more = f"period = 0.125\nfirst = {1013 / 192e3!r}\n"
        (folder / "recording.toml").write_text(about.replace("[log]", f"{more}[log]"))
    if way == "trigger":
        (folder / "recording.toml").write_text(about.replace("[log]", "trigger = 17\n[log]"))
        trigger = np.zeros((soundfile.info(folder / "tape.wav").frames, 1), dtype=np.float32)
        for begin in (1013, 25_013, 49_013):
            trigger[begin : begin + 121] = 0.8
        with_samples(folder, lambda samples: np.hstack((samples, trigger)))
    found, _ = heard(folder)
    assert len(found) == len(told) == 3
    late = 2.0 / 192e3 if way == "leak" else 1e-9
    for a, b in zip(told, found, strict=True):
        assert abs(a.time - b.time) <= late
        i, j = int(a.level_db.argmax()), int(b.level_db.argmax())
        assert abs(a.range[i] - b.range[j]) <= 170.0 * late + 2e-3


@pytest.mark.parametrize(
    ("header", "left"),
    [
        pytest.param(header, left, marks=() if (i + j) % 4 == 0 else SLOW)
        for j, header in enumerate(("sample", "sample,time"))
        for i, left in enumerate((1, 60, 121, 122, 200, 241, 242, 251, 400))
    ],
)
def test_hear_and_its_check_leave_out_a_call_at_the_end_of_the_sound(tmp_path, header, left):
    folder, out = foreign(tmp_path / "tape"), tmp_path / "log"
    samples = soundfile.info(folder / "tape.wav").frames
    rows = ["1000,", "25000,", "47000,10.3", f"{samples - left},"]
    rows = [row.partition(",")[0] for row in rows] if header == "sample" else rows
    (folder / "calls.csv").write_text("\n".join([header, *rows, ""]))
    times = {*pipistrelle.hear(folder, output=out).measurements["time"].to_list()}
    third = 10.0 + 47_000 / 192e3 if header == "sample" else 10.3
    expected = [10.0 + 1000 / 192e3, 10.0 + 25_000 / 192e3, third]
    np.testing.assert_allclose(sorted(times)[:3], expected)
    assert len(times) == 3 or left == 400, "a whole echo fits into 400 samples, and into no fewer"
    assert check_recording(folder, read_description(folder), Config()) == []


def test_hear_leaves_out_a_call_at_the_end_where_others_call_too(own, tmp_path):
    shutil.copytree(own, tmp_path / "tape")
    with (tmp_path / "tape" / "calls.csv").open("a") as file:
        file.write("799900,4.1\n")
    done = pipistrelle.hear(tmp_path / "tape", output=tmp_path / "log")
    assert done.measurements.equals(pipistrelle.hear(own).measurements)


def test_leaks_are_the_loudest_around_as_if_each_were_compared_with_all():
    rng = np.random.default_rng(3)
    for apart in (1, 7, 40):
        sample = np.sort(rng.uniform(0.0, 1000.0, 300).round(rng.integers(3)))
        sample[5:8] = sample[[7, 5, 6]]
        level = rng.integers(1, 6, 300) / 2.0
        expected = [
            i == np.where(np.abs(sample - sample[i]) <= apart, level, 0.0).argmax()
            for i in range(300)
        ]
        assert _loudest_around(sample, level, apart).tolist() == expected


def test_leaks_of_a_long_loud_tone_are_found_in_seconds():
    sample = np.arange(100_000) * 700.0
    begin = time.perf_counter()
    assert _loudest_around(sample, np.ones(sample.size), 700).sum() == 1
    assert time.perf_counter() - begin < 15.0, "each with all takes many minutes"


def test_hear_refuses_more_calls_of_a_period_than_memory_holds(tmp_path):
    about = SimpleNamespace(start=0.0, call=SimpleNamespace(first=0.0, period=1e-3, trigger=None))
    sound = SimpleNamespace(samples=2**40, rate=192e3, channels=1)
    with pytest.raises(InputError, match="period': found 5726623061 calls"):
        calls_of(tmp_path, about, sound, None, None)


def test_hear_refuses_a_sole_call_at_the_end_of_the_sound(tmp_path):
    folder = foreign(tmp_path / "tape")
    samples = soundfile.info(folder / "tape.wav").frames
    for rows, where, why in (
        (f"{samples - 100}", "", "100 samples follow the first"),
        (f"1000\n{samples}", ", line 3", "outside the sound"),
        ("-1\n1000", ", line 2", "outside the sound"),
    ):
        (folder / "calls.csv").write_text(f"sample\n{rows}\n")
        refused(folder, f"calls.csv{where}", why)


def as_one_place(folder):
    """Have the faces' own places left out: delays are then those of lags."""
    about = (folder / "recording.toml").read_text()
    (folder / "recording.toml").write_text(f"one_centre = true\n{about}")


def test_pure_noise_passes_at_the_false_alarm_probability(tmp_path):
    quiet = {"rate": 200_000, "frequency": 40e3, "duration": 6e-4, "amplitude": 0.0}
    quiet["calls"] = tuple(range(1000, 400_000, 20_000))
    folder = foreign(tmp_path / "tape", **quiet)
    as_one_place(folder)
    rate = 1e-3
    config = Config(detection=DetectionConfig(false_alarm=rate, peak_db=-0.01))
    _, found = heard(folder, config)
    # independent tests, one a call's length; of a maximum the neighbours add to the rate
    lags = sum((20_000 - 120) // 40 for _ in range(20))
    tests = 4 * lags
    seen = sum(len(np.unique(one.delay)) for one in found)
    assert 0.2 * rate * tests < seen < 1.0 * rate * tests + 5.0 * np.sqrt(rate * tests)
    louder = foreign(tmp_path / "loud", noise=0.03, **quiet)
    as_one_place(louder)
    _, loud = heard(louder, config)
    assert abs(sum(len(one.delay) for one in loud) - sum(len(one.delay) for one in found)) < 30


def test_memory_does_not_grow_with_the_length(own, tmp_path):
    shutil.copytree(own, tmp_path / "long")
    about = (own / "recording.toml").read_text()
    parts = [f"part{i}.wav" for i in range(6)]
    for name in parts:
        (tmp_path / "long" / name).hardlink_to(tmp_path / "long" / "recording.wav")
    names = ", ".join(f'"{name}"' for name in parts)
    text = about.replace('"recording.wav"', names).replace("samples = 800000", "samples = 4800000")
    (tmp_path / "long" / "recording.toml").write_text(text)
    calls = "".join(f"{100_000 * i}\n" for i in range(48))
    (tmp_path / "long" / "calls.csv").write_text(f"sample\n{calls}")
    peaks = []
    for folder in (own, tmp_path / "long"):
        heard(own)
        tracemalloc.start()
        try:
            log, _ = heard(folder)
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert len(log) == 48
    # gaps for the noise are up to 64, of eight in the one and 48 in the other
    assert peaks[1] < peaks[0] + 40 * 1300 * 2 * 16 * 4 * 2.5


def test_a_wide_recording_is_announced_with_sizes_of_64_bits(tmp_path):
    from pipistrelle.experiments.hearing.sound_recorder import wav_header

    for size in (64, 5_000_000_000 // 64 * 64):
        path = tmp_path / f"{size}.wav"
        path.write_bytes(wav_header(size, 16, 200e3, 32))
        with path.open("ab") as file:
            file.truncate(path.stat().st_size + size)  # a hole
        with soundfile.SoundFile(path) as sound:
            assert (sound.frames, sound.channels, sound.samplerate) == (size // 64, 16, 200_000)
            assert sound.subtype == "FLOAT"
            assert "should be 0x" not in sound.extra_info


def refused(folder, *words):
    return refusal_of(lambda: heard(folder), *words)


def test_faults_of_a_recording_are_named(tmp_path):
    sound = foreign(tmp_path / "sound")

    def spoiled(name, change):
        folder = tmp_path / "spoiled"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(sound, folder)
        path = folder / name
        if isinstance(change, tuple):
            path.write_text(path.read_text().replace(*change))
        else:
            path.write_bytes(change(path.read_bytes()))
        return folder

    for name, change, words in (
        ("tape.wav", lambda data: b"", ["tape.wav"]),
        ("tape.wav", lambda data: data[: len(data) // 2], ["tape.wav", "header"]),
        ("tape.wav", lambda data: b"RIFX" + data[4:], ["tape.wav"]),
        ("tape.wav", lambda data: data[:40], ["tape.wav"]),
        ("recording.toml", ("340.0", "nan"), ["recording.toml", "speed_of_sound"]),
        ("recording.toml", ("[log]", "pitch = 3\n[log]"), ["call.pitch", "unknown"]),
        ("recording.toml", ("start = 10.0", "sample_rate = 96000.0"), ["tape.wav", "96000 Hz"]),
        ("recording.toml", ("start = 10.0", "samples = 9"), ["'samples'", "9"]),
        ("recording.toml", ("start = 10.0", 'sound = ["../a"]'), ["'sound'"]),
        ("recording.toml", ("0.00063", "0.1"), ["calls.csv", "duration"]),
        ("recording.toml", ("41300.0", "99000.0"), ["99000", "192000"]),
        ("recording.toml", ("velocity_std = 0.1", ""), ["table 'log'", "velocity_std"]),
        ("recording.toml", ("[log]", "trigger = 99\n[log]"), ["trigger"]),
        ("array.csv", ("16,", "17,"), ["array.csv", "channel 17"]),
        ("array.csv", ("\n2,", "\n1,"), ["array.csv, line 3", "channel 1"]),
        ("array.csv", ("\n1,", "\n0,"), ["array.csv, line 2", "channel 0"]),
        ("recording.toml", ("format = 1", "format = 1\none_centre = 1"), ["one_centre"]),
        ("calls.csv", ("25000", "900"), ["calls.csv, line 3"]),
        ("calls.csv", ("25000", "1010"), ["calls.csv", "10 samples"]),
        ("calls.csv", ("47000", "470000000"), ["calls.csv, line 4"]),
        ("odometry.csv", ("9,0,0\n", ""), ["odometry.csv"]),
    ):
        folder = spoiled(name, change)
        if "trigger" in words:
            (folder / "calls.csv").unlink()
        refused(folder, *words)


def test_faces_that_share_a_centre_must_be_equal_lines(tmp_path):
    folder = foreign(tmp_path / "sound")
    as_one_place(folder)
    heard(folder)
    rows = (folder / "array.csv").read_text()
    (folder / "array.csv").write_text(rows.replace("0.002,1", "0.0025,1"))
    refused(folder, "array.csv", "'1'", "evenly spaced line")
    (folder / "array.csv").write_text(rows.replace("\n1,0.008", "\n17,0.008"))
    refused(folder, "array.csv", "channel 17")
    (folder / "array.csv").write_text("\n".join(rows.splitlines()[:-1]))
    refused(folder, "array.csv", "alike")


def test_samples_that_are_no_numbers_are_named_by_channel_and_place(tmp_path):
    folder = foreign(tmp_path / "tape")
    with_samples(folder, lambda samples: np.put(samples, 30_000 * 16 + 4, np.nan))
    refused(folder, "tape.wav, channel 5", "nan as sample 30000")


def test_hear_warns_of_a_channel_that_is_a_copy(tmp_path):
    def copy(samples):
        samples[:, 6] = samples[:, 2]

    folder = foreign(tmp_path / "tape")
    with_samples(folder, copy, subtype="PCM_16")
    with pytest.warns(UserWarning, match="channel 7 is a copy of channel 3:"):
        done = pipistrelle.hear(folder)
    assert len(done.odd) == 1


@pytest.mark.parametrize("value", [0.1, 1.0 / 3.0])
def test_hear_refuses_a_channel_that_is_constant(tmp_path, value):
    folder = foreign(tmp_path / "tape")
    with_samples(folder, lambda samples: samples[:, 6].fill(value))
    refused(folder, "channel 7", "no noise")


def test_a_silent_channel_is_named(tmp_path):
    folder = foreign(tmp_path / "tape", gain=np.array([1.0] * 6 + [0.0] + [1.0] * 9))
    refused(folder, "channel 7", "no noise")


# Calls that are not tones


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
    refused(tape, message)


def test_a_sweep_without_call_times_is_found_by_its_leakage(tmp_path):
    tape = record(tmp_path / "tape", "--emitter.call", "sweep", "--frames", "1:5")
    told, _ = heard(tape)
    (tape / "calls.csv").unlink()
    found, _ = heard(tape)
    assert len(found) == 4
    for mine, his in zip(found, told, strict=True):
        assert abs(mine.time - his.time) <= 1.01 / 200e3

    def quiet(samples):
        for begin in range(0, len(samples), 100_000):
            samples[begin : begin + 600] = 0.0

    with_samples(tape, quiet, "recording.wav")
    refused(tape, "say in calls.csv when")  # no leak: echoes are all that there is


CUT = (-0.5, -0.05, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
"""Shares of a loud echo that the vehicle is deaf to, or that the next call cuts off."""


CUTS = [
    ("begins", 10.0, 3e-3),
    ("begins", 0.5, 2.2e-3),
    ("ends", 10.0, 2.2e-3),
    ("ends", 0.5, 3e-3),
]


@pytest.mark.parametrize(
    ("end", "loud", "deaf"),
    [
        pytest.param(*case, marks=() if case in CUTS else SLOW)
        for case in product(("begins", "ends"), (0.5, 10.0), (3e-3, 2.2e-3))
    ],
)
def test_an_echo_that_the_window_cuts_leaves_no_rows(tmp_path, end, loud, deaf):
    period = 0.05
    whole = {"begins": deaf, "ends": period - 2e-3}[end]
    late = [whole + 2e-3 * share * (1 if end == "ends" else -1) for share in CUT]
    folder, times = swept(tmp_path / "tape", late, deaf=deaf, period=period, loud=loud)
    rows = pipistrelle.hear(folder, detection__false_alarm=1e-10).measurements
    for begin, delay, share in zip(times, late, CUT, strict=True):
        found = rows.filter((rows["time"] - begin).abs() < 1e-6)["range"].to_numpy()
        assert np.min(np.abs(found - 170.0 * 10e-3)) < 0.01, "the faint echo is heard"
        ghosts = np.abs(found - 170.0 * 10e-3) > 0.01
        if share <= 0.0:
            assert np.min(np.abs(found - 170.0 * delay)) < 0.01, "a whole echo is heard"
            ghosts &= np.abs(found - 170.0 * delay) > 0.01
        assert found[ghosts].size == 0
