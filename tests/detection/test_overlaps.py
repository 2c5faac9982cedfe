"""Echoes that overlap: told apart as well as the bound allows, and single ones left alone."""

from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.stats import binom

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import BLOCK, Config, DetectionConfig, ScenarioConfig
from pipistrelle.detection.noise import EDGE_FLOOR, NOISE_QUANTILE, bearing_std
from pipistrelle.detection.overlaps import MOST, deviation, most_left, resolve, room_for
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.detection.snapshots import Detections, detector
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import world_of
from pipistrelle.geometry import wrap
from reference.echoes import BEACON, PULSE, SETTLED, SQUARE, found_in, matched_of, sounds
from reference.echoes import FINDER as MERGING

N, EVEN = 10, np.empty(0)
SCAN = np.linspace(-3.1, 3.1, 63)
ROOM, FEW, MANY, SIGMAS = room_for(MOST, N), 800, 20000, 3.5
SPLIT = 1.0 - NOISE_QUANTILE
PAIRS = [(0.6, 20.0), (0.4, 26.0), (1.2, 13.0)]
"""Distance of two sources in u [rad], and SNR of each at one element [dB]."""
RESOLVING = Config(detection=DetectionConfig(overlaps="resolve"))
FINDER = detector(RESOLVING, SQUARE, SETTLED.tones)
ROWS = [f.name for f in fields(Detections) if f.name != "direct"]


# Snapshots of one face


def waves(u, place=None):
    """Return the waves of directions, a column each."""
    return np.exp(1j * np.multiply.outer(np.arange(N) if place is None else place, u))


def snapshot(rng, u, snr_db, noise=1.0, place=None):
    """Draw a snapshot of sources of one level and any phases."""
    phases = np.exp(2j * np.pi * rng.random(len(u))) * 10.0 ** (snr_db / 20.0)
    draws = rng.standard_normal((2, N)) * np.sqrt(0.5)
    return waves(u, place) @ phases + noise * (draws[0] + 1j * draws[1]), phases


def cramer_rao(u, amplitude):
    """Return the bound of the directions' covariance, from the whole information matrix."""
    wave = waves(u)
    slope = 1j * np.arange(N)[:, None] * wave * amplitude
    columns = np.column_stack((slope, wave, 1j * wave))
    return np.linalg.inv(2.0 * (columns.conj().T @ columns).real)[: len(u), : len(u)]


def told(x, place=EVEN):
    """Return directions, rising, with their deviations, and the energy that is left."""
    count, left = resolve(x, SCAN, place, most_left(N), ROOM)
    order = np.argsort(ROOM.u[:count])
    return ROOM.u[order].copy(), np.array([deviation(x, ROOM, k, 1.0) for k in order]), left


@cache
def pairs(apart, snr_db, count):
    """Return errors of pairs that are told apart, over their bounds; and the share that is."""
    rng, rows = np.random.default_rng([int(100 * apart), int(snr_db)]), []
    for _ in range(count):
        u = rng.uniform(-1.5, 1.5) + np.array([-0.5, 0.5]) * apart
        x, amplitude = snapshot(rng, u, snr_db)
        found, std, _ = told(x)
        if found.size == 2:
            bound = np.sqrt(np.diag(cramer_rao(u, amplitude)))
            rows.append((found - u, bound, std))
    return *np.array(rows).transpose(1, 0, 2), len(rows) / count


def check_pairs(apart, snr_db, count):
    """Refuse pairs that are seldom told apart, with a bias, or far from the bound."""
    off, bound, std, share = pairs(apart, snr_db, count)
    chance = SIGMAS / np.sqrt(off.size)
    assert share > 0.95
    assert abs(np.mean(off / bound)) < chance
    assert abs(np.mean((off * [-1, 1]) / bound)) < 0.1 + chance, "nor do they repel each other"
    rms = np.sqrt(np.mean((off / bound) ** 2))
    assert 1.0 - chance < rms < 1.2
    assert np.sqrt(np.mean((off / std) ** 2)) == pytest.approx(1.0, abs=0.1 + chance)


@pytest.mark.parametrize(("apart", "snr_db"), PAIRS)
def test_two_sources_are_resolved_unbiased_and_near_the_cramer_rao_bound(apart, snr_db):
    check_pairs(apart, snr_db, FEW)


@pytest.mark.slow
@pytest.mark.parametrize(("apart", "snr_db"), [*PAIRS, (0.3, 30.0), (2.0, 10.0), (0.6, 40.0)])
def test_many_pairs_are_resolved_unbiased_and_near_the_cramer_rao_bound(apart, snr_db):
    check_pairs(apart, snr_db, MANY)


def split_share(snr_db, count, threshold=None):
    """Return the share of single sources that are taken for several."""
    rng, split = np.random.default_rng(int(snr_db)), 0
    for _ in range(count):
        x, _ = snapshot(rng, rng.uniform(-2.0, 2.0, 1), snr_db)
        limits = most_left(N) if threshold is None else threshold
        split += resolve(x, SCAN, EVEN, limits, ROOM)[0] > 1
    return split / count


@pytest.mark.parametrize("snr_db", [6.0, 20.0, 60.0])
def test_a_single_source_is_split_at_most_at_the_stated_rate(snr_db):
    few = 3000
    assert split_share(snr_db, few) * few <= binom.isf(1e-6, few, SPLIT)
    assert split_share(snr_db, few, 0.6 * most_left(N)) * few > binom.isf(1e-6, few, SPLIT)


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [3.0, 6.0, 13.0, 20.0, 40.0, 60.0])
def test_many_single_sources_are_split_at_most_at_the_stated_rate(snr_db):
    many = 10 * MANY
    assert split_share(snr_db, many) * many <= binom.isf(1e-6, many, SPLIT)


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=25)
def test_no_other_pair_of_directions_leaves_less_of_a_snapshot(seed):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.5, 1.5) + np.array([-0.5, 0.5]) * rng.uniform(0.5, 1.5)
    x, _ = snapshot(rng, u, 22.0)
    found, _, left = told(x)
    if found.size != 2:
        return

    def left_of(u):
        wave = waves(u)
        return np.sum(np.abs(x - wave @ np.linalg.lstsq(wave, x, rcond=None)[0]) ** 2)

    slow = minimize(left_of, u, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-9})
    assert left == pytest.approx(left_of(found), rel=1e-6)
    assert left <= slow.fun + 2e-3


@pytest.mark.parametrize("place", [None, np.array([0, 1, 2, 4, 5, 7, 8, 9, 11, 13.0])])
def test_three_directions_without_noise_are_exact_for_any_element_positions(place):
    rng, u = np.random.default_rng(2), np.array([-1.0, 0.1, 0.9])
    x, _ = snapshot(rng, u, 60.0, noise=0.0, place=place)
    found, _, left = told(x, EVEN if place is None else place)
    np.testing.assert_allclose(found, u, atol=1e-5)
    assert left < 1e-2


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=50)
def test_a_mirrored_array_gives_mirrored_directions(seed):
    rng = np.random.default_rng(seed)
    x, _ = snapshot(rng, rng.uniform(-1.5, 1.5, rng.integers(1, 4)), 20.0)
    found, std, left = told(x)
    mirrored, mirrored_std, mirrored_left = told(x[::-1].copy())
    np.testing.assert_allclose(mirrored, -found[::-1], atol=0.05 * std.min(initial=1.0))
    np.testing.assert_allclose(mirrored_std, std[::-1], rtol=0.05)
    assert mirrored_left == pytest.approx(left, abs=5e-3)


@pytest.mark.parametrize("power", [12.0, 100.0, 1e5])
def test_a_single_source_has_the_deviation_of_one_beam(power):
    x = (np.sqrt(power / N) * waves(np.array([0.4])))[:, 0]
    _, (std,), _ = told(x)
    assert std == pytest.approx(bearing_std(power - 1.0, 1.0, N * N - 1.0), rel=1e-6)


def test_two_sources_inseparable_in_noise_stay_one():
    rng = np.random.default_rng(3)
    counts = [told(snapshot(rng, np.array([0.3, 0.35]), 10.0)[0])[0].size for _ in range(200)]
    assert np.mean(np.array(counts) == 1) > 0.95


@pytest.mark.parametrize(("elements", "most"), [(2, 1), (4, 2), (5, 3), (10, 3), (40, 3)])
def test_few_elements_resolve_few_sources(elements, most):
    limits = most_left(elements)
    assert limits.size == most
    assert np.isfinite(limits).all()
    assert (np.diff(limits) < 0.0).all()


# Frames


def heard(echoes, finder=FINDER, key=1, mirror=False):
    """Return detections of echoes (delay [s], angle [deg], SNR [dB]) at the front face."""
    delay, angle, snr_db = np.array(echoes, float).T
    arrivals = sounds(delay, wrap(np.radians(angle) + SQUARE.normal[0]), snr_db, BEACON)
    matched = matched_of(arrivals, key=stream_key(7, key, "overlaps"), blocks=90)
    if mirror:
        matched = matched[..., ::-1].copy()
    return found_in(matched, finder)


def front(found):
    """Return angle [deg] and delay [ms] of the front face's rows, by angle."""
    here = found.face == 0
    rows = np.column_stack((np.degrees(found.angle[here]), 1e3 * found.delay[here]))
    return rows[np.argsort(rows[:, 0])]


PAIR = [(0.0100, -6.0, 25.0), (0.0111, 6.0, 24.0)]


def test_two_echoes_that_overlap_are_two_rows_each_with_its_bearing_and_its_delay():
    np.testing.assert_allclose(front(heard(PAIR)), [[-6.0, 10.0], [6.0, 11.1]], atol=0.35)
    merged = front(heard(PAIR, MERGING))
    off = np.abs(merged - np.array([[-6.0, 10.0], [6.0, 11.1]])[: len(merged)])
    assert len(merged) < 2 or off.max() > 0.6, "one scan does not"


def test_the_order_of_adding_echoes_does_not_matter():
    some, other = heard(PAIR), heard(PAIR[::-1])
    for name in ROWS:
        np.testing.assert_allclose(getattr(some, name), getattr(other, name), rtol=1e-6)


def test_mirrored_elements_give_mirrored_angles():
    rows, mirrored = front(heard(PAIR)), front(heard(PAIR, mirror=True))
    np.testing.assert_allclose(mirrored * [-1, 1], rows[::-1], atol=1e-3)


def test_one_echo_that_two_snapshots_hold_is_one_row():
    three = [(0.0100, 0.0, 25.0), (0.0117, 25.0, 22.0), (0.0134, -25.0, 25.0)]
    rows = front(heard(three))
    np.testing.assert_allclose(rows[:, 0], [-25.0, 0.0, 25.0], atol=1.0)


@pytest.mark.parametrize("delay", [PULSE * BLOCK, PULSE * BLOCK + 76.5 * BLOCK])
def test_echoes_at_the_ends_of_the_record_are_heard(delay):
    rows = front(heard([(delay, -8.0, 25.0), (delay, 8.0, 25.0)]))
    np.testing.assert_allclose(rows[:, 0], [-8.0, 8.0], atol=1.0)


def test_overlaps_are_not_resolved_by_default():
    assert MERGING.most_left.size == 0
    assert FINDER.most_left.size == MOST


def test_runs_of_lags_are_not_resolved():
    with pytest.raises(ValueError, match='needs snapshots "maxima", found "runs"'):
        DetectionConfig(overlaps="resolve", snapshots="runs")


@cache
def world_rows(overlaps):
    """Return rows and right rows of a world without labels, and what direct calls say."""
    config = Config(
        seed=31337, scenario=ScenarioConfig(steps=80), detection=DetectionConfig(overlaps=overlaps)
    )
    (frames,) = listen(world_of(config, 0), config, (0.0025,), labels=False)
    causes = np.concatenate([frame.causes for frame in frames])
    stds = [frame.unlabelled.excess_path_std for frame in frames]
    return causes.size, np.count_nonzero(causes != UNLABELLED), np.concatenate(stds)


def test_resolving_overlaps_removes_most_false_rows_of_a_world():
    (rows, right, _), (merged, merged_right, _) = world_rows("resolve"), world_rows("merge")
    assert rows - right < 0.4 * (merged - merged_right)
    assert right > merged_right


def test_no_excess_path_is_surer_than_its_direct_call():
    assert np.nanmin(world_rows("resolve")[2]) >= EDGE_FLOOR > np.nanmin(world_rows("merge")[2])
