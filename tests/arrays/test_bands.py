"""Recording in the bands of calls: against every sample, whatever the call, delay and speed."""

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import GRID, bands_of, bins_of, window_lags
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import Layout, microphones_of, scattered, square_of_four
from pipistrelle.arrays.receiver import BandRecorder, real_samples
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import Config
from pipistrelle.detection import beams
from pipistrelle.detection.beams import wide_of
from pipistrelle.detection.matched import BandFilters
from reference.samples import around, record_samples

FACE = Layout(normal=np.zeros(1), position=square_of_four(Config().receiver).position)
CROSS = scattered(microphones_of([(0.02, 0.0, 0.0, 0.0, ""), (0.0, 0.03, 0.0, -3.0, "")]))
CALLS = {
    "linear": {"call": "sweep", "taper": 0.2},
    "hyperbolic": {"call": "sweep", "sweep": "hyperbolic", "taper": 0.2},
    "rising": {"call": "sweep", "band": (35e3, 60e3), "taper": 0.5},
    "tone": {"taper": 1.0},
}


def rig(name, layout=FACE):
    """Return settings, sampling, filters and recorder of a vehicle alone."""
    config = Config.model_validate({"emitter": CALLS[name]})
    settled = sampling(config, callers_of(config, np.zeros(2))[:1])
    return config, settled, BandFilters(settled.calls, settled.rate), BandRecorder(layout, settled)


def echoes(settled, delay, bearing, shift, level_db=0.0):
    """Return echoes with given delays, bearings and Doppler scales."""
    count = np.size(delay)
    return Arrivals(
        delay=np.array(delay, dtype=float).reshape(count),
        level_db=np.full(count, level_db),
        bearing=np.array(bearing, dtype=float).reshape(count),
        frequency=settled.tones[0] * np.array(shift, dtype=float).reshape(count),
        caller=np.zeros(count, dtype=np.int8),
        landmark=1 + np.arange(count),
    )


@pytest.mark.parametrize("layout", [FACE, CROSS])
@pytest.mark.parametrize("name", CALLS)
def test_envelopes_give_the_matched_outputs_of_samples(name, layout):
    _, settled, filters, recorder = rig(name, layout)
    heard = echoes(settled, [4.0012e-3, 5.5e-3, 6e-3], [0.3, -1.2, 2.9], [1.0, 1.0044, 0.996])
    samples = record_samples(round(12e-3 / settled.interval), heard, layout, settled, None)
    expected = around(filters, samples)
    lags, shape = window_lags(len(expected)), layout.shape
    envelopes = recorder.silence(lags)
    recorder.add(
        envelopes, heard, lags, settled.pulse * settled.interval - filters.cut * filters.interval
    )
    outputs = filters.outputs(envelopes, lags, 1.0).reshape(1, *shape, lags)
    found = outputs.transpose(3, 1, 0, 2)[: len(expected)]
    close = 8e-3 if name == "tone" else 5e-4  # the shift is a fifth of a tapered tone's band
    assert np.abs(found - expected).max() < close * np.abs(expected).max()
    late = echoes(settled, heard.delay + 1e-6, heard.bearing, [1.0, 1.0044, 0.996])
    samples = record_samples(round(12e-3 / settled.interval), late, layout, settled, None)
    other = around(filters, samples)
    assert np.abs(other - expected).max() > 0.05 * np.abs(expected).max(), "a microsecond shows"


def test_noise_in_bands_has_unit_variance_and_is_shared_where_bands_overlap():
    sweep = {"call": "sweep"}
    config = Config.model_validate({"emitter": sweep, "beacon": sweep | {"band": (30e3, 50e3)}})
    settled = sampling(config, callers_of(config, np.zeros(2)))
    recorder, filters = BandRecorder(FACE, settled), BandFilters(settled.calls, settled.rate)
    lags = window_lags(8000)
    one, other = recorder.noise(lags, 5)
    bands = bands_of(settled.calls, settled.rate)
    low, beyond = (sum(bins_of(band, lags, filters.interval)[:2]) for band in bands)
    np.testing.assert_array_equal(one[:, : beyond + len(other.T) - low], other[:, low - beyond :])
    outputs = filters.outputs(recorder.silence(lags), lags, 1.0, [one, other])
    np.testing.assert_allclose(np.mean(np.abs(outputs) ** 2, axis=(1, 2)), 1.0, atol=0.02)


def test_samples_hold_the_noise_of_the_bands():
    _, settled, filters, recorder = rig("linear")
    lags, first = 25 * GRID, settled.pulse * settled.block  # whole blocks
    noise, nothing = recorder.noise(lags, 3), echoes(settled, [], [], [])
    length, rng = first + lags * filters.step, np.random.default_rng(1)
    given = lags, 0, recorder.silence(lags), noise
    heard = np.fft.rfft(real_samples(given, nothing, FACE, settled, length, rng)[first:], axis=0)
    middle, low, high = bins_of(bands_of(settled.calls, 200e3)[0], lags, filters.interval)
    found = heard[middle + low : middle + high + 1].T * 2.0 / settled.rate
    np.testing.assert_allclose(found, noise[0], atol=1e-5 * np.abs(noise[0]).max())


def test_the_search_by_sectors_finds_the_peaks_of_all_beams():
    config, settled, filters, recorder = rig("hyperbolic")
    wide = wide_of(config, FACE, 0, settled.calls[0], filters.step)
    rng, lags = np.random.default_rng(2), window_lags(2500)
    delay, bearing = rng.uniform(4e-3, 40e-3, 60), rng.uniform(-1.3, 1.3, 60)
    envelopes = recorder.silence(lags)
    recorder.add(envelopes, echoes(settled, delay, bearing, np.ones(60), -10.0), lags, 2e-3)
    heard = filters.outputs(envelopes, lags, 1.0, recorder.noise(lags, 7))[0]
    numbers, whole = beams.find_wide(heard, wide, 2e-3, filters.cut)
    more, all_beams = wide.margin + beams.TAPS, np.zeros(lags)
    sound = np.pad(heard, ((0, 0), (more, more)))
    for b, at in enumerate(more + np.arange(float(lags))):
        powers = [beams._power(sound, at, n, wide.beams, wide.call) for n in wide.beams.bearing]
        all_beams[b] = max(powers)
    peaks = beams._peaks(all_beams, wide.threshold, wide.lobes, wide.cut_lobes, filters.cut)
    assert (np.abs(np.sin(numbers[5])) <= wide.sine_limit).all()
    assert whole.sum() > 15
    assert 0 <= peaks.size - whole.size <= 1, "one may be beyond the limit of the scan"
