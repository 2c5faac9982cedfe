"""The check of a recording names the mistake that was made, and none where none was."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile

from pipistrelle.config import Config
from pipistrelle.detection.sounds.check import check_recording
from pipistrelle.detection.sounds.sound_file import read_description
from reference.sounds import foreign, record, with_samples

DRIVE = ("--landmarks", "20", "--duration", "4", "--seed", "7")
SLOW = pytest.mark.slow
SWEEPS = ("--emitter.call", "sweep", "--emitter.level-db", "65", "--beacon.call", "sweep")


@pytest.fixture(scope="module", params=["tones", pytest.param("sweeps", marks=SLOW)])
def sound(tmp_path_factory, request):
    """A small recording of our own."""
    words = ("--sound-bits", "16", *(SWEEPS if request.param == "sweeps" else ()))
    return record(tmp_path_factory.mktemp("own") / "tape", *words, drive=DRIVE)


@pytest.fixture
def tape(sound, tmp_path):
    """A copy of it, to be spoiled."""
    shutil.copytree(sound, tmp_path / "tape")
    return tmp_path / "tape"


def checked(folder):
    return check_recording(folder, read_description(folder), Config())


def with_rows(folder, name, change):
    head, *rows = (folder / name).read_text().splitlines()
    rows = [row.split(",") for row in rows]
    change(rows)
    (folder / name).write_text("\n".join([head, *(",".join(row) for row in rows), ""]))


def spoilt(folder, change):
    """Change the samples of our own recording; return its faults."""
    with_samples(folder, change, "recording.wav", "PCM_16")
    return checked(folder)


def exchanged(rows, pairs):
    for i, j in pairs:
        rows[i][0], rows[j][0] = rows[j][0], rows[i][0]


def test_a_simulated_recording_passes_all_checks(sound):
    assert checked(sound) == []


def test_channels_that_are_swapped_are_named(tape):
    with_rows(tape, "array.csv", lambda rows: exchanged(rows, [(1, 2), (11, 17)]))
    faults = sorted(one for one in checked(tape) if one.startswith("face"))
    for fault, face, i, j in zip(faults, ("front", "left"), (2, 12), (3, 18), strict=True):
        assert f"face {face}:" in fault
        assert f"swap channels {i} and {j}" in fault or f"swap channels {j} and {i}" in fault


def test_swapped_channels_of_a_circular_array_are_named_from_sweeps(tmp_path):
    circle = ("--receiver.array", str(Path(__file__).parents[3] / "examples/arrays/circle.csv"))
    tape = record(tmp_path / "tape", *SWEEPS, *circle, "--sound-bits", "16", drive=DRIVE)
    assert checked(tape) == []
    with_rows(tape, "array.csv", lambda rows: exchanged(rows, [(3, 7)]))
    (fault,) = checked(tape)
    assert "swap channels 4 and 8" in fault or "swap channels 8 and 4" in fault


def test_lines_that_are_counted_from_the_wrong_end_are_seen(tape):
    ends = [(10 * f + k, 10 * f + 9 - k) for f in range(4) for k in range(5)]
    with_rows(tape, "array.csv", lambda rows: exchanged(rows, ends))
    (fault,) = checked(tape)
    assert "count each face's channels from its other end" in fault


def test_faces_that_are_swapped_are_seen(tape):
    with_rows(tape, "array.csv", lambda rows: exchanged(rows, [(k, 10 + k) for k in range(10)]))
    (fault,) = checked(tape)
    assert "two faces that hear one echo differ" in fault
    # but for turning the whole, to swap the front with the left is to swap the front with the back
    assert any(
        f"let face front be where face {other} is and let face {other} be where face front is"
        in fault or f"let face {other} be where face front is and let face front be where" in fault
        for other in ("left", "back")
    )  # fmt: skip


def test_a_channel_of_the_other_sign_is_named(tape):
    def turn(samples):
        samples[:, 5] *= -1.0

    (fault,) = spoilt(tape, turn)
    assert "turn the sign of channel 6 round" in fault


def test_channels_that_are_dead_clipped_or_off_zero_are_named(tape):
    def spoil(samples):
        samples[:, 2] *= 1e-3
        samples[:, 6] = samples[:, 6].clip(-2e-3, 2e-3)
        samples[:, 9] += 0.01

    faults = spoilt(tape, spoil)
    for words in ("channel 3 is dead", "channel 7 is clipped", "channel 10 is off zero"):
        assert sum(fault.startswith(words) for fault in faults) == 1
    assert len(faults) == 4  # and that the order was not looked at


def test_silence_gives_no_warning_of_the_sample_rate(tape):
    faults = spoilt(tape, lambda samples: samples.fill(0.0))
    assert any("dead" in fault for fault in faults)
    assert not any("sample rate" in fault for fault in faults)


def test_a_wrong_sample_rate_is_reported_with_the_right_value(tape):
    samples, _ = soundfile.read(tape / "recording.wav", dtype="float32")
    soundfile.write(tape / "recording.wav", samples, 192_000, subtype="PCM_16")
    about = (tape / "recording.toml").read_text().replace("200000.0", "192000.0")
    (tape / "recording.toml").write_text(about)
    fault = checked(tape)[0]
    if "sweep" in about:
        assert "of the sound are its call at 192000 Hz" in fault
        assert fault.endswith("at a sample rate of 200000 Hz")
    else:
        assert "33600 Hz are loudest, not 35000 Hz" in fault
        assert "as 200000 Hz nearly would" in fault


def test_a_clock_jump_is_reported_with_its_call(tape):
    def lose(rows):
        for row in rows[5:]:
            row[0] = str(int(row[0]) - 700)

    with_rows(tape, "calls.csv", lose)
    assert any(
        "from call 4 to the next" in fault and "0.0035 s" in fault for fault in checked(tape)
    )


def respelled(folder, change, subtype="PCM_16"):
    """Change the samples of another program's recording; return its faults."""
    with_samples(folder, change, subtype=subtype)
    return checked(folder)


def copied(source, target, scale=1.0, late=0):
    def change(samples):
        samples[:, target] = scale * np.roll(samples[:, source], late)

    return change


@pytest.mark.parametrize(
    ("change", "words", "subtype"),
    [
        pytest.param(copied(0, 1, *how), words, subtype, marks=[] if (i - j) % 3 == 0 else SLOW)
        for i, (how, words) in enumerate(
            [
                ((), ": of one"),
                ((-1.0,), ", times -1: of one"),
                ((0.3,), ", times 0.3: of one"),
                ((1.0, 1), ", 1 samples late: of one"),
                ((-0.5, -1), ", times -0.5, 1 samples early: of one"),
            ]
        )
        for j, subtype in enumerate(("FLOAT", "PCM_24", "PCM_16"))
    ],
)
def test_the_check_names_a_channel_that_is_a_copy(tmp_path, change, words, subtype):
    faults = respelled(foreign(tmp_path / "tape"), change, subtype)
    named = [fault for fault in faults if "copy" in fault]
    assert len(named) == 1
    assert named[0].startswith(f"channel 2 is a copy of channel 1{words}")


def test_the_check_names_all_channels_where_all_are_one(tmp_path):
    def same(samples):
        return np.repeat(samples[:, :1], 16, axis=1)

    faults = respelled(foreign(tmp_path / "tape"), same)
    copies = [fault for fault in faults if "is a copy of channel 1:" in fault]
    assert len(copies) == 15


@pytest.mark.parametrize("noise", [1.0, 0.5, 0.3, 0.1, 0.01])
def test_independent_noise_near_a_files_quantum_is_no_copy(tmp_path, noise):
    def faint(samples):
        rng = np.random.default_rng(5)
        return samples * 1e-9 + noise / 32768 * rng.standard_normal(samples.shape)

    faults = respelled(foreign(tmp_path / "tape"), faint)
    assert not [fault for fault in faults if "copy" in fault]


def test_noise_that_all_microphones_hear_is_no_copy(tmp_path):
    def humming(samples):
        hum = np.sin(np.arange(len(samples)) / 50.0)[:, np.newaxis]
        return 0.3 * hum + samples * 0.01

    faults = respelled(foreign(tmp_path / "tape"), humming, "FLOAT")
    assert not [fault for fault in faults if "copy" in fault]


@pytest.mark.parametrize("value", [0.0, 0.1])
def test_the_check_names_a_channel_that_is_constant_as_dead(tmp_path, value):
    def constant(samples):
        samples[:, 3:5] = value

    faults = respelled(foreign(tmp_path / "tape"), constant, "FLOAT")
    assert [fault[:17] for fault in faults[:2]] == ["channel 4 is dead", "channel 5 is dead"]
    assert not [fault for fault in faults if "copy" in fault]
