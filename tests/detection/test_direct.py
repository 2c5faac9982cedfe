"""The direct call: what recognises it, when it began, and what an excess path is worth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import BLOCK, Config, MatchingConfig
from pipistrelle.detection.direct import (
    MIN_EDGE_ENERGY,
    DirectCalls,
    Lags,
    front_edge,
    loudest_first,
)
from pipistrelle.detection.front_end import average_faces
from pipistrelle.detection.matched import filter_blocks
from pipistrelle.detection.noise import EXCESS_PATH_FLOOR
from pipistrelle.detection.scans import with_columns
from pipistrelle.detection.snapshots import Columns, Detections, direct_of_faces
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.oracle import label_detections
from pipistrelle.experiments.hearing.scenario import caller_labels, world_of
from reference.echoes import BEACON, CONFIG, OWN, SAMPLED, SETTLED, C, found_in, matched_of, sounds

CALL = CONFIG.emitter.call_duration


def detected(*heard, key=1, blocks=200):
    """Detect sounds (delay [s], bearing [rad], tone, SNR of a call at one element [dB])."""
    delay, bearing, tone, snr_db = map(np.array, zip(*heard, strict=True))
    arrivals = sounds(delay, bearing, snr_db, tone)
    return found_in(matched_of(arrivals, key=stream_key(7, key, "direct"), blocks=blocks))


def off_by(found, delay):
    """How much later [m] the direct call is thought to have begun."""
    return C * (found.direct.delay[BEACON] - delay)


def test_the_vehicle_has_no_direct_call_and_silence_has_none():
    found = detected((0.02, 0.3, OWN, 20.0))
    assert found.direct.detection.tolist() == [-1, -1]
    assert np.isnan(found.direct.delay).all()


def test_the_first_of_a_tone_is_its_direct_call_though_an_echo_be_louder():
    found = detected((0.015, 0.3, BEACON, 20.0), (0.022, 1.9, BEACON, 26.0))
    assert abs(off_by(found, 0.015)) < 0.02
    strongest = found.power[found.caller == BEACON].argmax()
    assert C * (found.delay[found.caller == BEACON][strongest] - 0.015) > 2.0, (
        "or nothing is proved"
    )


def test_a_peak_much_fainter_than_the_loudest_is_no_direct_call():
    found = detected((0.012, 0.3, BEACON, 12.0), (0.022, 1.9, BEACON, 32.0))
    assert abs(off_by(found, 0.022)) < 0.02


def test_possible_leakage_of_another_tone_is_no_direct_call():
    faint = (0.0200, 0.3, BEACON, 22.0)
    assert detected(faint).direct.detection[BEACON] >= 0
    beside = detected(faint, (0.0200, 0.35, OWN, 46.0))
    assert (beside.caller == BEACON).any()
    assert beside.direct.detection[BEACON] == -1


@pytest.mark.parametrize("apart", [0.15, 0.3, 0.6])
def test_an_echo_overlapping_the_direct_call_does_not_move_its_front_edge(apart):
    worst, drawn = 0.0, 0.0
    for key in range(40):
        rng = np.random.default_rng(key)
        delay = 0.02 + rng.random() * BLOCK
        late = delay + apart / C + rng.random() / SETTLED.tones[BEACON]
        found = detected((delay, 0.3, BEACON, 26.0), (late, 0.45, BEACON, 25.0), key=key)
        if found.direct.detection[BEACON] < 0:
            continue  # the two all but extinguish each other
        first = found.direct.detection[BEACON]
        worst = max(worst, abs(off_by(found, delay)))
        drawn = max(drawn, abs(C * (found.delay[first] - delay)))
    assert worst < 0.06
    assert drawn > 2.0 * worst, "the whole call's best fit is drawn by it"


@cache
def edges(snr_db, count=600):
    """Errors and told deviations [s] of the front edges of isolated direct calls."""
    rng, rows = np.random.default_rng([3, int(snr_db)]), []
    for i in range(count):
        delay = 0.012 + rng.random() * BLOCK
        direct = detected((delay, rng.uniform(-0.6, 0.6), BEACON, snr_db), key=i, blocks=90).direct
        rows.append((direct.delay[BEACON] - delay, direct.delay_std[BEACON]))
    return np.array(rows).T


@pytest.mark.parametrize("snr_db", [21.0, 25.0, 30.0])
def test_errors_of_front_edges_match_their_deviations(snr_db):
    off, std = edges(snr_db)
    heard = np.isfinite(off)
    assert heard.mean() > 0.95
    share = np.mean(off[heard] ** 2 / (std[heard] ** 2 + SAMPLED**2))
    assert 0.6 < share < 1.5
    assert np.mean(off[heard] ** 2 / (0.25 * std[heard] ** 2)) > 2.0, "half of that would not do"


def test_rows_contain_excess_paths_with_deviations():
    delays = np.array([0.02, 0.031, 0.028])
    found = detected(
        (delays[0], 0.3, BEACON, 26.0), (delays[1], 1.2, BEACON, 20.0), (delays[2], -2.0, OWN, 20.0)
    )
    near = np.abs(found.delay[:, None] - delays).argmin(axis=1)
    label = np.where(found.caller == OWN, 7, np.where(near == 0, 51, 4))
    heard = average_faces(0.5, found, label, averaging="plain", speed_of_sound=C)
    rows = heard.rows
    told = dict(zip(rows.landmark.tolist(), rows.excess_path, strict=True))
    assert told[4] == pytest.approx(C * 0.011, abs=0.05)
    assert np.isnan([told[7], told[51]]).all(), "an own echo, and the direct call itself"
    stds = dict(zip(rows.landmark.tolist(), rows.excess_path_std, strict=True))
    assert EXCESS_PATH_FLOOR < stds[4] < 0.1


def test_an_excess_path_is_as_unsure_as_echo_and_direct_call_together():
    one, nan = np.ones(1), np.nan
    direct = DirectCalls(
        detection=np.array([-1, -1]), pulse=CALL,
        delay=np.array([nan, 0.02]), delay_std=np.array([nan, 4e-5]),
    )  # fmt: skip
    echo = Detections(
        face=np.array([0]), caller=np.array([BEACON]), angle=one, bearing=one, power=one,
        delay=np.array([0.03]), delay_std=np.array([3e-5]), bearing_std=one, direct=direct,
    )  # fmt: skip
    heard = average_faces(0.5, echo, np.array([4]), averaging="plain", speed_of_sound=C)
    spread = np.hypot(C * 5e-5, EXCESS_PATH_FLOOR)
    np.testing.assert_allclose(heard.rows.excess_path, C * 0.01, rtol=1e-12)
    np.testing.assert_allclose(heard.rows.excess_path_std, spread, rtol=1e-12)


def test_an_echo_during_the_direct_call_has_no_excess_path():
    for apart, heard_apart in ((0.8 * CALL, False), (1.3 * CALL, True)):
        found = detected((0.02, 0.0, BEACON, 26.0), (0.02 + apart, 3.1, BEACON, 20.0))
        late = found.delay > 0.02 + 0.5 * apart
        label = np.where(late, 4, 51)
        rows = average_faces(0.5, found, label, averaging="plain", speed_of_sound=C).rows
        assert np.isfinite(rows.excess_path[rows.landmark == 4]).tolist() == [heard_apart]


# By planted sounds: amplitudes block by block, the same at ten elements but for their phase

BLOCKS, BEGIN, M, ELEMENTS = 110, 60, 14, 10
FACE, TONE = 1, 2


def planted(*bursts, pulse=M, noise_std=0.0, rng=None):
    """Matched outputs of sounds: first block, number of blocks, amplitude.

    The square of the amplitude is the energy of a block over the mean of the noise that front edges
    are sought in. What begins within a block fills the rest of it.
    """
    x = np.zeros((BLOCKS, FACE + 1, TONE + 1, ELEMENTS), dtype=complex)
    phase, edges = np.exp(0.7j * np.arange(ELEMENTS)), np.arange(BLOCKS + 1)
    for begin, lasts, amplitude in bursts:
        share = np.diff(np.clip(edges, begin, begin + lasts))
        x[:, FACE, TONE] += amplitude * np.sqrt(2.0) * share[:, None] * phase
    if rng is not None:
        drawn = rng.normal(size=(BLOCKS, ELEMENTS, 2)) @ [1.0, 1.0j]
        x[:, FACE, TONE] += noise_std / np.sqrt(2.0) * drawn
    return filter_blocks(x, pulse=pulse, block=1, noise_std=1.0)


def edge(*bursts, b=BEGIN, **more):
    """Lag and standard deviation of the first edge up to lag b."""
    matched, pulse = planted(*bursts, **more), more.get("pulse", M)
    return front_edge(matched, b, FACE, TONE, pulse, MIN_EDGE_ENERGY)


def told_std(share, amplitude):
    """Standard deviation of an edge that fills a share of its block, by the formula."""
    return np.sqrt((1.0 + 0.5 * share**2) / (2.0 * ELEMENTS * amplitude**2))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.25, 0.5, 0.9])
def test_a_front_edge_without_noise_is_exact_with_the_formulas_deviation(share):
    lag, std = edge((BEGIN - share, M, 5.0))
    assert lag == pytest.approx(BEGIN - share, abs=1e-9)
    assert std == pytest.approx(told_std(share, 5.0), rel=1e-9)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_front_edge_of_a_long_call_is_sought_in_fourteenths_of_it(share):
    """Three blocks at once: their gain has three times the amplitude and of the noise."""
    begin = BEGIN - 3.0 * share
    lag, std = edge((begin, 3 * M, 5.0), pulse=3 * M)
    assert lag == pytest.approx(begin, abs=1e-9)
    assert std == pytest.approx(3.0 * told_std(share, np.sqrt(3.0) * 5.0), rel=1e-9)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_scatter_of_front_edges_in_noise_matches_their_deviation(share):
    """In a third of the noise it allows for: so what the fit leaves is less, and does not count."""
    rng, noise_std, count = np.random.default_rng(5), 0.3, 4000
    found = [edge((BEGIN - share, M, 12.0), noise_std=noise_std, rng=rng) for _ in range(count)]
    lag, std = np.array(found).T
    assert std == pytest.approx(told_std(share, 12.0), rel=0.1)
    drawn = np.std(lag) / noise_std
    within = 4.0 / np.sqrt(2.0 * count)  # four deviations of a standard deviation of so many
    assert within < 0.05
    assert drawn == pytest.approx(np.mean(std), rel=within)
    assert drawn != pytest.approx(np.mean(std) / 0.95, rel=0.005), "five hundredths would show"


@pytest.mark.parametrize(
    ("rough", "left"),
    [
        ([(BEGIN - 2, 1, 3.0j)], 9.0),
        ([(BEGIN - 1, 1, 3.0j)], 9.0),
        ([(BEGIN, 1, 3.0), (BEGIN + 1, 1, -3.0)], 18.0),
    ],
)
def test_residuals_of_the_fit_enlarge_an_edges_deviation(rough, left):
    """It is what the block before it, its own and the two behind it have beside a call."""
    lag, std = edge((BEGIN - 0.5, M, 50.0), *rough)
    assert lag == pytest.approx(BEGIN - 0.5, abs=1e-9)
    assert std == pytest.approx(np.sqrt(left) * told_std(0.5, 50.0), rel=1e-9)


def test_an_edge_is_found_from_a_call_and_two_lags_later():
    """The best fit of a whole call may be drawn so far by an echo at its heels."""
    for later in (0, M - 1, M + 2):
        lag, _ = edge((BEGIN, M, 5.0), b=BEGIN + later)
        assert lag == pytest.approx(BEGIN, abs=1e-9)


@pytest.mark.parametrize("odd", [(BEGIN - 1, 1, -1.2), (BEGIN, 1, 1.0)])
def test_an_edge_is_limited_to_its_fitted_block(odd):
    """A block against the call's phase, or louder than the call, is no more or less of a call."""
    lag, _ = edge(odd, (BEGIN, M, 5.0))
    assert lag == pytest.approx(BEGIN, abs=1e-9)


def test_a_sound_two_calls_earlier_does_not_move_an_edge():
    burst = BEGIN - M - 3, 1, 5.0
    assert edge(burst, (BEGIN, M, 5.0), b=BEGIN + M)[0] == pytest.approx(BEGIN, abs=1e-9)


def test_an_edge_with_sound_before_it_that_did_not_last_is_none():
    """It is told from nothing at all: then the whole's best fit may stand for it."""
    call = BEGIN, M, 5.0
    assert np.isnan(edge((BEGIN - 5, 1, 1.8), call)).tolist() == [True, False]
    assert edge((BEGIN - 5, 1, 1.8), call)[1] == np.inf
    assert np.isnan(edge()).all()


def test_the_block_before_an_edge_may_be_partly_filled():
    lag, _ = edge((BEGIN - 1, 1, 1.8), (BEGIN, M, 6.2))
    assert lag == pytest.approx(BEGIN - 1.8 / 6.2, abs=1e-9)
    assert np.isnan(edge((BEGIN - 2, 1, 1.8), (BEGIN, M, 6.2))[0])


def test_sound_counts_from_three_times_the_noise_energy():
    for energy, stands_out in ((2.9, False), (3.1, True)):
        _, std = edge((BEGIN - 5, 1, np.sqrt(energy)), (BEGIN, M, 5.0))
        assert np.isinf(std) == stands_out
        assert np.isnan(edge((BEGIN, M, np.sqrt(energy)))[0]) == (not stands_out)


@pytest.mark.parametrize("stride", [1, 3])
def test_an_edge_below_three_tenths_of_the_following_sound_is_none(stride):
    for share, is_edge in ((0.28, False), (0.32, True)):
        before, lasts = (BEGIN - 6 * stride, 6 * stride, 50.0 * share), stride * M
        lag, std = edge(before, (BEGIN, lasts, 50.0), pulse=lasts, b=BEGIN)
        assert np.isfinite(lag) == is_edge
        assert np.isinf(std) == (not is_edge)


def test_an_edge_is_of_a_sound_that_lasts_three_blocks():
    for blocks, is_edge in ((2, False), (3, True)):
        assert np.isfinite(edge((BEGIN - 1, blocks, 5.0))[0]) == is_edge


def test_an_edge_needs_two_blocks_behind_it_in_the_record():
    matched = planted((BEGIN, M, 5.0))
    rises = BEGIN - M
    for b in range(rises + 10):
        lag, _ = front_edge(matched[: b + 1], b, FACE, TONE, M, MIN_EDGE_ENERGY)
        assert np.isfinite(lag) == (b >= rises + 3)


# Which detection it is of

START, INTERVAL = 0.5, 1e-4


def calls_of(*detections, sounds=((BEGIN, M, 5.0),)):
    """Direct calls among detections: caller, lag, power and standard deviation of the lag."""
    caller, lag, power, std = np.array(detections).T
    face, none = np.full(lag.size, FACE), np.zeros(lag.size)
    delay, delay_std = START + INTERVAL * lag, INTERVAL * std
    found = Columns(face, caller.astype(np.int64), none, none, delay, power, none, delay_std)
    direct = direct_of_faces(planted(*sounds), found, Lags(START, INTERVAL, M))
    return direct.detection, (direct.delay, direct.delay_std)


def test_the_first_that_is_a_tenth_as_loud_as_the_loudest_of_its_tone_is_the_direct_call():
    caller, delay = np.array([1, 1, 0, 1, 1]), np.array([2.0, 3.0, 1.0, 5.0, 4.0])
    for share, first in ((0.09, 4), (0.11, 1)):
        power = np.array([0.01, share, 99.0, 1.0, 0.5])
        assert loudest_first(caller, delay, power, 1) == first
    assert loudest_first(caller, delay, power, 2) == -1


def test_a_direct_call_has_the_time_and_deviation_of_its_edge_in_seconds():
    found, (delay, std) = calls_of((OWN, 30, 9.0, 7.0), (TONE, BEGIN + 3, 9.0, 7.0))
    assert found.tolist() == [-1, -1, 1]
    assert delay[TONE] == pytest.approx(START + INTERVAL * BEGIN, abs=1e-12)
    assert std[TONE] == pytest.approx(INTERVAL * told_std(0.0, 5.0), rel=1e-9)
    assert np.isnan([delay[OWN], std[OWN]]).all()


def test_a_call_that_rises_too_little_has_the_time_of_the_wholes_best_fit():
    found, (delay, std) = calls_of((TONE, BEGIN + 0.3, 9.0, 7.0), sounds=[(BEGIN, M, 1.5)])
    assert (found[TONE], delay[TONE]) == (0, START + INTERVAL * (BEGIN + 0.3))
    assert std[TONE] == 7.0 * INTERVAL


def test_a_call_nearly_cancelled_by_another_is_not_found():
    found, when = calls_of((TONE, BEGIN, 9.0, 7.0), sounds=[(BEGIN - 5, 1, 1.8), (BEGIN, M, 5.0)])
    assert found[TONE] == -1
    assert np.isnan(when).all()


def test_no_edge_is_sought_too_near_the_start_of_the_record():
    """A call and what two lags about the fit may hide: M + 2 lags must come before it."""
    for lag, sought in ((M + 2.4, False), (M + 2.6, True)):
        _, (delay, _) = calls_of((TONE, lag, 9.0, 7.0), sounds=[(M, M, 5.0)])
        expected = M if sought else lag
        assert delay[TONE] == pytest.approx(START + INTERVAL * expected, abs=1e-12)


def test_only_a_tone_200_times_louder_within_a_call_may_leak():
    """A louder call of another tone at another time changes nothing, 10 ms away say."""
    for apart in (-100.0, -M - 0.5, -M + 0.5, 0.0, M - 0.5, M + 0.5, 100.0):
        for times in (190.0, 210.0):
            found, _ = calls_of((TONE, BEGIN, 1.0, 7.0), (OWN, BEGIN + apart, times, 7.0))
            assert found[TONE] == (-1 if abs(apart) < M and times > 200.0 else 0)


# In the paper's worlds


@cache
def in_worlds(radius=0.0088, worlds=3, delay_gate=0.25):
    """Errors of direct calls, of strongest detections, and of excess paths with their deviations.

    NaN of a passive row without an excess path. The oracle labels what is within a share of a call.
    """
    direct, strongest, rows = [], [], []
    for world in range(worlds):
        config = Config(seed=1000, matching=MatchingConfig(delay_gate=delay_gate))
        scenario, true = world_of(config, world), []
        beacon = int(caller_labels(scenario)[BEACON])

        def listened(found, arrivals, *layout, true=true, beacon=beacon, **gates):
            of = arrivals.caller == BEACON
            delays = dict(zip(arrivals.landmark[of].tolist(), arrivals.delay[of], strict=True))
            true.append(delays)
            heard = np.flatnonzero(found.caller == BEACON)
            direct.append(off_by(found, delays[beacon]))
            strongest.append(C * (found.delay[heard[found.power[heard].argmax()]] - delays[beacon]))
            return label_detections(found, arrivals, *layout, **gates)

        (frames,) = listen(scenario, config, (radius,), iteration=world, oracle=listened)
        for frame, delays in zip(frames, true, strict=True):
            told = frame.rows
            echoes = (told.caller == BEACON) & (told.landmark != beacon)
            for label, e, std in zip(
                told.landmark[echoes].tolist(),
                told.excess_path[echoes],
                told.excess_path_std[echoes],
                strict=True,
            ):
                rows.append((e - C * (delays[label] - delays[beacon]), std))
    return np.array(direct), np.array(strongest), np.array(rows).T


def of_those_that_have_one(off, std):
    """Leave out passive rows without an excess path."""
    told = np.isfinite(off)
    return off[told], std[told]


def test_direct_calls_in_the_papers_worlds_are_hardly_ever_confused():
    direct, strongest, _ = in_worlds()
    known = np.isfinite(direct)
    assert known.mean() > 0.93
    assert np.mean(np.abs(direct[known]) > 0.15) < 0.002
    assert np.sqrt(np.mean(direct[known] ** 2)) < 0.03
    assert np.mean(np.abs(strongest) > 0.15) > 0.03, "the strongest alone is not enough"


def test_errors_of_excess_paths_in_the_papers_worlds_match_their_deviations():
    off, std = of_those_that_have_one(*in_worlds()[2])
    assert off.size > 15000
    assert np.median(np.abs(off)) < 0.015
    assert np.sqrt(np.mean(off**2)) < 0.06
    assert 0.7 < np.mean((off / std) ** 2) < 1.5
    assert np.mean((off / (0.5 * std)) ** 2) > 2.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("radius", "delay_gate", "least_share", "most_rms"),
    [(0.0088, 0.25, 0.9, 0.06), (0.0025, 0.25, 0.85, 0.06), (0.0088, 1.0, 0.9, 0.13)],
)
def test_excess_paths_are_as_good_in_many_of_the_papers_worlds(
    radius, delay_gate, least_share, most_rms
):
    """An oracle that takes what is off by a whole call for an echo lets wrong excess paths in."""
    direct, _, (off, std) = in_worlds(radius, 24, delay_gate)
    share, told = np.mean(np.isfinite(off)), np.mean(np.isfinite(direct))
    off, std = of_those_that_have_one(off, std)
    rms, median = np.sqrt(np.mean(off**2)), np.median(np.abs(off))
    far, wrong = np.mean(np.abs(off) > 3.0 * std), np.mean(np.abs(off) > 0.24)
    print(
        f"piston {radius} m, gate {delay_gate}: a direct call in {told:.1%} of frames; {off.size} "
        f"excess paths, of {share:.1%} of passive rows: {rms:.3f} m rms, {median:.4f} m median, "
        f"{far:.1%} beyond three told deviations, {wrong:.1%} beyond 0.24 m"
    )
    assert share > least_share
    assert rms < most_rms
    assert 0.008 < median < 0.015
    assert far < 0.03 or delay_gate > 0.25


def test_the_band_recorder_times_as_the_blocks_do():
    off = {}
    for taper in (0.0, 0.2):
        config = Config.model_validate({
            "seed": 1000, "scenario": {"steps": 16}, "emitter": {"taper": taper},
        })  # fmt: skip
        (frames,) = listen(world_of(config, 0), config, (0.0088,))
        told = [
            dict(zip(f.rows.landmark.tolist(), f.rows.excess_path, strict=True)) for f in frames
        ]
        off[taper] = [(n, label, e) for n, f in enumerate(told) for label, e in f.items() if e == e]
    both = {key[:2]: key[2] for key in off[0.0]}
    apart = [e - both[n, label] for n, label, e in off[0.2] if (n, label) in both]
    assert len(apart) > 40
    assert np.median(np.abs(apart)) < 0.03


def test_scans_without_timing_are_unchanged_to_the_bit():
    from pipistrelle.experiments.runs.heard_world import scans_of

    config = Config.model_validate({"scenario": {"steps": 40}})
    (frames,) = listen(world_of(config), config, (0.0088,))
    for strategy in ("active", "fused", "passive"):
        scans = scans_of(frames, strategy, config)
        untimed = [replace(f, rows=with_columns(f.rows, excess_path=np.nan)) for f in frames]
        old = scans_of(untimed, strategy, config)
        assert [s.numbers.tobytes() for s in scans] == [s.numbers.tobytes() for s in old]
        assert all(np.isnan(s.excess_path).all() for s in scans)
