"""Calls: what sweeps are by definition, what a Doppler shift makes of them, and files."""

import numpy as np
import pytest
import soundfile

from pipistrelle.acoustics.call import Sweep, ToneBurst, coupling, settings_of, sound_of
from pipistrelle.config import CallConfig, InputError

LENGTH, RATE = 2.8e-3, 1e6
TIME = np.arange(round(LENGTH * RATE)) / RATE
LAWS = ["linear", "hyperbolic"]


def cycles(call, time, scale=1.0):
    """Return the instantaneous frequency of a call, by finite differences [Hz]."""
    step = 1e-9
    before, after = (call.waveform(time + s, scale * call.frequency) for s in (-step, step))
    return np.angle(after * before.conj()) / (4.0 * np.pi * step)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("band", [(60e3, 35e3), (20e3, 80e3), (40e3, 40e3)])
def test_frequency_or_period_is_linear_in_time(law, band):
    share = np.linspace(0.01, 0.99, 25)
    found = cycles(Sweep(*band, LENGTH, law), share * LENGTH)
    if law == "linear":
        expected = band[0] + (band[1] - band[0]) * share
    else:
        expected = 1.0 / (1.0 / band[0] + (1.0 / band[1] - 1.0 / band[0]) * share)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("law", LAWS)
def test_a_doppler_scaled_call_is_shorter_and_higher(law):
    call, scale = Sweep(60e3, 35e3, LENGTH, law, taper=0.3), 1.0044
    heard = call.waveform(TIME, scale * call.frequency)
    sent = call.waveform(TIME * scale, call.frequency)
    np.testing.assert_allclose(heard, sent, atol=1e-9)
    assert not heard[TIME * scale > LENGTH].any()


def test_a_hyperbolic_sweep_in_motion_is_a_delayed_copy():
    call, scale = Sweep(60e3, 35e3, LENGTH, "hyperbolic"), 1.0044
    bend = (1.0 / call.end - 1.0 / call.start) / LENGTH
    ahead = (1.0 - scale) / (scale * bend * call.start)
    inside = (TIME > 5e-5) & (TIME < LENGTH - 5e-5)
    heard = call.waveform(TIME[inside], scale * call.frequency)
    again = call.waveform(TIME[inside] + ahead, call.frequency)
    turned = heard * again.conj()
    np.testing.assert_allclose(turned, turned[0], atol=1e-6)
    linear = Sweep(60e3, 35e3, LENGTH)
    turned = (
        linear.waveform(TIME[inside], scale * call.frequency)
        * linear.waveform(TIME[inside] + ahead, call.frequency).conj()
    )
    assert np.abs(turned - turned[0]).max() > 0.4, "no other law has this"


def answer(call, scale):
    """Return lags [s] and the matched filter's answer, as a share of that without motion."""
    sent, heard = (call.waveform(TIME, a * call.frequency) for a in (1.0, scale))
    full = np.abs(np.correlate(heard, sent, mode="full")) / np.sum(np.abs(sent) ** 2)
    return (np.arange(full.size) - TIME.size + 1) / RATE, full


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("band", [(60e3, 35e3), (35e3, 60e3)])
def test_the_range_doppler_coupling_is_the_delay_of_the_shifted_peak(law, band):
    call, scale = Sweep(*band, LENGTH, law), 1.0044
    lags, found = answer(call, scale)
    expected = coupling(call) * (scale - 1.0)
    assert lags[found.argmax()] == pytest.approx(expected, abs=0.05 * abs(expected) + 1.0 / RATE)


def test_a_hyperbolic_sweep_stays_as_loud_in_motion_and_a_tone_does_not():
    scale = 1.02  # some 3.4 m/s towards a post, at 343 m/s
    loud = [
        answer(call, scale)[1].max()
        for call in (
            Sweep(60e3, 35e3, LENGTH, "hyperbolic"),
            Sweep(60e3, 35e3, LENGTH),
            ToneBurst(35e3, LENGTH),
        )
    ]
    assert loud[0] > 0.95
    assert loud[1] < 0.9
    assert loud[2] < 0.4


def test_full_taper_is_a_hann_window_and_zero_taper_a_rectangle():
    share = np.linspace(0.0, 1.0, 101)
    hann = np.abs(Sweep(60e3, 35e3, LENGTH, taper=1.0).waveform(share * LENGTH, 47.5e3))
    np.testing.assert_allclose(hann, np.sin(np.pi * share) ** 2, atol=1e-9)
    plain = Sweep(60e3, 35e3, LENGTH).waveform(np.array([-1e-9, 0.0, LENGTH / 2, 2.9e-3]), 47.5e3)
    np.testing.assert_allclose(np.abs(plain), [0.0, 1.0, 1.0, 0.0])


@pytest.mark.parametrize("call", [None, *(Sweep(60e3, 35e3, LENGTH, law, 0.2) for law in LAWS)])
def test_settings_of_a_call_rebuild_it(call):
    given = CallConfig.model_validate(settings_of(call))
    assert sound_of(given, LENGTH, "emitter") == call


def written(folder, samples, rate=250_000):
    path = folder / "own.wav"
    soundfile.write(path, samples, rate, subtype="FLOAT")
    return path


@pytest.mark.parametrize("scale", [1.0, 1.0044])
def test_a_call_read_from_a_file_matches_the_written_call_under_motion(tmp_path, scale):
    wave = Sweep(60e3, 35e3, LENGTH, "hyperbolic", taper=0.5)
    time = np.arange(700) / 250e3
    path = written(tmp_path, 0.3 * wave.waveform(time, wave.frequency).real)
    call = sound_of(CallConfig(call=str(path), frequency=47.5e3), LENGTH, "emitter")
    expected = wave.waveform(TIME, scale * wave.frequency)
    found = call.waveform(TIME, scale * 47.5e3)
    inside = (TIME > 1e-5) & (TIME < LENGTH - 2e-5)
    turn = np.vdot(expected[inside], found[inside])
    assert abs(turn) / np.sum(np.abs(expected[inside]) ** 2) == pytest.approx(1.0, abs=2e-3)
    off = found * np.exp(-1j * np.angle(turn)) - expected
    assert np.abs(off[inside]).max() < 5e-3
    assert not call.waveform(np.array([-1e-6, 2.9e-3]), 47.5e3).any()


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.zeros(700), "silence"),
        (np.full(700, np.nan), "no finite numbers"),
        (np.sin(np.arange(701)), "expected 10 to 700"),
        (np.sin(np.arange(5)), "5 samples"),
        (np.sin(np.arange(1400)).reshape(700, 2), "2 channels"),
        (np.sin(0.2 * np.arange(700)), "expected about 80.. Hz"),
    ],
)
def test_a_file_that_holds_no_call_is_refused(tmp_path, samples, message):
    path = written(tmp_path, samples)
    with pytest.raises(InputError, match=message) as refused:
        sound_of(CallConfig(call=str(path)), LENGTH, "emitter")
    assert str(refused.value).startswith("emitter.")


def test_a_file_without_sound_is_refused_with_the_settings_name(tmp_path):
    (tmp_path / "empty.wav").touch()
    (tmp_path / "text.wav").write_text("call")
    (tmp_path / "link.wav").symlink_to("nowhere")
    for name in ("empty.wav", "text.wav", "link.wav", "gone.wav", "."):
        with pytest.raises(InputError, match=r"expected|a folder"):
            sound_of(CallConfig(call=str(tmp_path / name)), LENGTH, "beacon")
    with pytest.raises(InputError, match=r"beacon\.taper"):
        sound_of(CallConfig(call="own.wav", taper=0.5), LENGTH, "beacon")
