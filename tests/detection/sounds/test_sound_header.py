"""Headers of sound files: a whole file is read, whatever its kind; a cut one is refused."""

import importlib.util
import struct
from pathlib import Path

import numpy as np
import pytest
import soundfile

from pipistrelle.config import InputError
from pipistrelle.detection.sounds.sound_file import open_sound, read_description
from reference.refused import refusal_of
from reference.sounds import write_beside

KINDS = [
    ("wav", "WAV", "FILE", "PCM_24"),
    ("wav", "WAV", "FILE", "PCM_U8"),
    ("wav", "WAV", "FILE", "PCM_16"),
    ("wav", "WAV", "FILE", "ULAW"),
    ("wav", "WAV", "FILE", "ALAW"),
    ("wav", "WAV", "FILE", "FLOAT"),
    ("wav", "WAV", "BIG", "PCM_24"),
    ("wav", "WAVEX", "FILE", "PCM_24"),
    ("rf64", "RF64", "FILE", "PCM_24"),
    ("w64", "W64", "FILE", "PCM_24"),
    ("aiff", "AIFF", "FILE", "PCM_24"),
    ("caf", "CAF", "FILE", "PCM_24"),
    ("au", "AU", "FILE", "PCM_24"),
    ("flac", "FLAC", "FILE", "PCM_24"),
]


def recording(folder, ending="wav", kind="WAV", order="FILE", width="PCM_24", frames=5001):
    """Write a recording of three channels; return its sound file."""
    folder.mkdir(exist_ok=True)
    path = folder / f"tape.{ending}"
    sound = 0.1 * np.random.default_rng(1).standard_normal((frames, 3))
    soundfile.write(path, sound, 48_000, format=kind, endian=order, subtype=width)
    array = "channel,x,y\n1,0.002,0\n2,0,0.002\n3,-0.002,0\n"
    write_beside(folder, 12e3, 1e-3, 340.0, array, [100, 2000], until=12)
    return path


def samples_of(folder):
    with open_sound(folder, read_description(folder)) as sound:
        return sound.read(0, sound.samples).shape


def refused(folder):
    return refusal_of(lambda: samples_of(folder))


@pytest.mark.parametrize("frames", [5000, 5001])
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_file_is_read_whatever_its_kind_and_its_number_of_bytes(tmp_path, kind, frames):
    path = recording(tmp_path / "tape", *kind, frames=frames)
    assert samples_of(path.parent) == (frames, 3)
    if path.suffix != ".w64":
        with path.open("ab") as file:
            file.write(b"LIST" + bytes(5))  # what follows the sound does not matter
    assert samples_of(path.parent) == (frames, 3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("missing", [2, 9, 300, 9000])
def test_a_cut_file_is_refused_with_the_bytes_that_are_missing(tmp_path, kind, missing):
    path = recording(tmp_path / "tape", *kind, frames=5000)
    size = 15_000 * {"PCM_24": 3, "FLOAT": 4, "PCM_16": 2}.get(kind[3], 1)
    whole = path.read_bytes()
    if (begin := max(whole.find(b"data", 30), whole.find(b"SSND"))) > 0:
        name, more = {".w64": (24, 0), ".caf": (12, 4), ".aiff": (8, 8)}.get(path.suffix, (8, 0))
        whole = whole[: begin + name + more + size]  # without what may follow
    path.write_bytes(whole[:-missing])
    said = refused(path.parent)
    if path.suffix in (".flac", ".caf"):
        expected = ("samples in place of the 5000", "can be read", f"of which {missing} are")
        assert any(words in said for words in expected)
    else:
        assert f"of which {missing} are missing" in said


@pytest.mark.parametrize("size", [0, 0x7FFFF000, 0xFFFFFFFF])
@pytest.mark.parametrize("order", ["<", ">"])
def test_an_unfilled_size_is_refused_with_the_command_that_mends_it(tmp_path, size, order):
    path = recording(tmp_path / "tape", order="FILE" if order == "<" else "BIG", width="PCM_16")
    data = path.read_bytes()
    place = data.find(b"data") + 4
    path.write_bytes(data[:place] + struct.pack(f"{order}I", size) + data[place + 4 :])
    said = refused(path.parent)
    assert "was never filled in" in said
    assert "sox --ignore-length" in said


def test_a_small_rf64_may_hold_its_true_size_in_either_place(tmp_path):
    path = recording(tmp_path / "tape", "rf64", "RF64")
    data = path.read_bytes()
    place = data.find(b"data") + 4
    for size in (15003 * 3, 0xFFFFFFFF):
        path.write_bytes(data[:place] + struct.pack("<I", size) + data[place + 4 :])
        assert samples_of(path.parent) == (5001, 3)
    long = data.find(b"ds64") + 16
    path.write_bytes(data[:long] + struct.pack("<Q", 2**40) + data[long + 8 :])
    assert "are missing" in refused(path.parent)


@pytest.mark.parametrize("samples", [0, 2**33, 2**36 - 1])
def test_a_flac_that_claims_more_than_its_bytes_can_hold_is_refused(tmp_path, samples):
    path = recording(tmp_path / "tape", "flac", "FLAC")
    data = bytearray(path.read_bytes())
    data[21] = data[21] & 0xF0 | samples >> 32
    data[22:26] = struct.pack(">I", samples & 0xFFFFFFFF)
    path.write_bytes(data)
    said = refused(path.parent)
    assert "samples" in said


@pytest.mark.parametrize("kind", [("flac", "FLAC", "PCM_16"), ("caf", "CAF", "ALAC_16")])
def test_hours_of_digital_silence_in_a_few_bytes_are_refused_before_they_are_read(tmp_path, kind):
    import soundfile

    ending, form, width = kind
    path = recording(tmp_path / "tape")
    path.unlink()
    path = path.with_suffix(f".{ending}")
    soundfile.write(path, np.zeros((400_000, 3)), 96_000, width, format=form)
    assert "a header of 1200000 samples in" in refused(path.parent)
    noise = np.random.default_rng(1).normal(0.0, 2.0**-15, (100_000, 3))
    soundfile.write(path, noise, 96_000, width, format=form)
    assert samples_of(path.parent) == (100_000, 3)


def test_invalid_sound_files_are_refused_by_name(tmp_path):
    import os

    path = recording(tmp_path / "tape")
    whole = path.read_bytes()
    for words, put in (
        ("an empty file", lambda: path.touch()),
        ("a pipe or a device", lambda: os.mkfifo(path)),
        ("a pipe or a device", lambda: path.symlink_to("/dev/zero")),
        ("a folder", lambda: path.mkdir()),
        ("a link to no file", lambda: path.symlink_to(path)),
        ("a link to no file", lambda: path.symlink_to("nowhere.wav")),
        ("can be read", lambda: path.write_bytes(b"RIFF" + bytes(5000))),
    ):
        path.unlink() if path.is_symlink() or path.is_file() or path.is_fifo() else path.rmdir()
        put()
        try:
            assert words in refused(path.parent), words
        except OSError:
            assert path.is_symlink(), words
    path.unlink()
    (tmp_path / "real.wav").write_bytes(whole)
    path.symlink_to(tmp_path / "real.wav")
    assert samples_of(path.parent) == (5001, 3)


def test_public_files_are_read_where_they_are_whole(tmp_path):
    found = importlib.util.find_spec("scipy.io")
    folder = Path(found.origin).parent / "tests" / "data"
    files = sorted(folder.glob("test-*.wav"))
    if not files:
        pytest.skip("scipy is installed without its tests' data")
    path, odd = recording(tmp_path / "tape"), []
    for public in files:
        path.write_bytes(public.read_bytes())
        try:
            samples_of(path.parent)
        except InputError as error:
            odd.append((public.stem, str(error)))
    names = {name for name, _ in odd}
    wide = {f"test-8000Hz-le-3ch-5S-{bits}bit" for bits in (36, 45, 53, 64)}
    broken = {"early-eof", "early-eof-no-data", "incomplete-chunk"}
    broken = {f"test-44100Hz-le-1ch-4bytes-{name}" for name in broken}
    assert names <= wide | broken | {"test-8000Hz-le-3ch-5S-24bit-inconsistent"}
    assert broken <= names
