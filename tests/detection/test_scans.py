"""None"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.detection.front_end import FrameMeasurements, average_faces, same_echo
from pipistrelle.detection.noise import BEARING_FLOOR, RANGE_FLOOR, ConstantNoise
from pipistrelle.detection.scans import (
    COLUMNS,
    OWN,
    UNLABELLED,
    labelled,
    make_scan,
    rows_of,
    scan_of,
    with_columns,
    without_labels,
)
from pipistrelle.detection.snapshots import Detections
from pipistrelle.geometry import circular_mean, wrap
from reference.missions import scan_with


def test_rows_of_a_scan_keep_all_their_columns_and_the_time():
    scan = make_scan(0.5, **{name: np.arange(4) + 10 * i for i, name in enumerate(COLUMNS)})
    some = rows_of(scan, np.array([True, False, True, False]))
    assert some.time == 0.5
    for i, name in enumerate(COLUMNS):
        assert getattr(some, name).tolist() == [10 * i, 10 * i + 2]
    assert rows_of(scan, np.zeros(4, dtype=bool)).landmark.size == 0


def test_a_column_that_no_scan_has_and_columns_of_several_lengths_are_refused():
    label, bearing = np.array([3, 4]), np.array([0.1, 0.2])
    with pytest.raises(InputError, match="scan: no such column bearing_sd; expected one of"):
        make_scan(0.5, label, bearing, bearing_sd=0.1)
    for wrong in ({"bearing": bearing[:1]}, {"bearing": bearing, "range": np.ones(3)}):
        with pytest.raises(InputError, match=r"expected \(2,\), that of landmark"):
            make_scan(0.5, label, **wrong)
    for wrong, kind in (({"landmark": [3.5, 4.0]}, "whole numbers"), ({"range": "4"}, "numbers")):
        with pytest.raises(InputError, match=f"expected {kind}"):
            make_scan(0.5, **({"landmark": label, "bearing": bearing} | wrong))
    for ragged in ({"landmark": [[1], [2, 3]]}, {"bearing": [[1.0], [2.0, 3.0]]}):
        with pytest.raises(InputError, match="rows of unlike lengths for"):
            make_scan(0.5, **({"landmark": label, "bearing": bearing} | ragged))
    assert make_scan(0.5, [3, 4], [0, 1]).bearing.dtype == np.float64


def test_unset_columns_of_a_scan_are_nan():
    scan = make_scan(0.5, np.array([3, 4]), np.array([0.1, 0.2]), range=2.0)
    assert scan.range.tolist() == [2.0, 2.0]
    assert scan.caller.tolist() == [OWN, OWN]
    for name in set(COLUMNS) - {"landmark", "caller", "bearing", "range"}:
        assert np.isnan(getattr(scan, name)).all(), name


def test_columns_are_replaced_and_checked_in_a_copy():
    scan = make_scan(0.5, np.array([3, 4]), np.array([0.1, 0.2]), range=2.0)
    other = with_columns(scan, bearing=-scan.bearing, caller=1)
    assert (other.bearing.tolist(), other.caller.tolist()) == ([-0.1, -0.2], [1, 1])
    assert (scan.bearing.tolist(), scan.caller.tolist()) == ([0.1, 0.2], [OWN, OWN])
    assert (other.time, other.range.tolist()) == (0.5, [2.0, 2.0])
    whole = make_scan(0.5, **{name: np.arange(4) + 10 * i for i, name in enumerate(COLUMNS)})
    for i, replaced in enumerate(COLUMNS):
        changed = with_columns(whole, **{replaced: 99})
        for j, name in enumerate(COLUMNS):
            expected = np.full(4, 99) if i == j else np.arange(4) + 10 * j
            assert getattr(changed, name).tolist() == expected.tolist()
    with pytest.raises(InputError, match="scan: no such column ranges"):
        with_columns(scan, ranges=1.0)


def test_the_memory_order_of_the_numbers_makes_no_difference():
    scan = make_scan(0.5, np.array([3, 4, 3]), np.array([0.1, 0.2, 0.3]), bearing_std=0.1)
    other = replace(scan, numbers=np.asfortranarray(scan.numbers))
    noise = ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.3)
    for change in (noise, lambda scan: labelled(scan, np.array([1, 2, 1]))):
        np.testing.assert_array_equal(change(other).numbers, change(scan).numbers)


law = settings(deadline=None, max_examples=100)
SEEDS = st.integers(0, 2**32 - 1)
AVERAGING = st.sampled_from(["plain", "weighted"])
NAMES = [name for name in Detections.__slots__ if name != "direct"]
NORMAL = np.array([0.0, 0.5, -1.0, -0.5]) * np.pi


def detections(*rows):
    """Return detections of rows (face, tone, angle off it [deg], delay [s], power)."""
    face, tone, angle, delay, power = (np.array(c) for c in zip(*rows, strict=True))
    angle = np.radians(angle.astype(float))
    return Detections(
        face=face,
        caller=tone,
        angle=angle,
        bearing=wrap(angle + NORMAL[face]),
        delay=delay.astype(float),
        power=power.astype(float),
    )


def crowd(rng, count=40, labels=8):
    """Return made-up detections with labels; some landmarks repeat on a face and tone."""
    rows = zip(
        rng.integers(0, 4, count),
        rng.integers(0, 2, count),
        rng.uniform(-75.0, 75.0, count),
        rng.uniform(3e-3, 0.2, count),
        rng.exponential(50.0, count),
        strict=True,
    )
    label = rng.integers(0, labels, count)
    return detections(*rows), np.where(label == 0, UNLABELLED, label)


def sure(rng, found):
    """Return detections that say how sure they are."""
    stds = rng.uniform(0.001, 0.1, (2, found.power.size))
    return replace(found, bearing_std=stds[0], delay_std=1e-3 * stds[1])


def heard_of(found, label, averaging="plain"):
    return average_faces(1.5, found, np.asarray(label), averaging=averaging, speed_of_sound=343.0)


def strongest(found, label, landmark, tone):
    """Return the rows to average, by the definition."""
    rows = []
    for face in range(4):
        here = np.flatnonzero((label == landmark) & (found.caller == tone) & (found.face == face))
        if here.size:
            rows.append(here[found.power[here].argmax()])
    return rows


@given(seed=SEEDS, averaging=AVERAGING)
@law
def test_each_landmark_gets_the_mean_of_its_strongest_estimate_of_each_face(seed, averaging):
    found, label = crowd(np.random.default_rng(seed))
    heard = heard_of(found, label, averaging)
    pairs = np.unique(np.column_stack((label, found.caller))[label >= 0], axis=0)
    rows = np.column_stack((heard.rows.landmark, heard.rows.caller))
    np.testing.assert_array_equal(rows, pairs)
    for i, (landmark, tone) in enumerate(pairs):
        rows = strongest(found, label, landmark, tone)
        weight = np.cos(found.angle[rows]) ** 2 if averaging == "weighted" else np.ones(len(rows))
        mean = circular_mean(found.bearing[rows], weight)
        assert abs(wrap(heard.rows.bearing[i] - mean)) < 1e-12
        assert -np.pi <= heard.rows.bearing[i] < np.pi
        loudest = 10.0 * np.log10(found.power[rows].max())
        assert heard.rows.level_db[i] == pytest.approx(loudest, abs=1e-9)
        if tone == OWN:
            late = np.average(found.delay[rows], weights=weight)
            assert heard.rows.range[i] == pytest.approx(0.5 * 343.0 * late, rel=1e-12)
        else:
            assert np.isnan(heard.rows.range[i])


@given(seed=SEEDS, averaging=AVERAGING)
@law
def test_the_order_of_the_detections_does_not_matter(seed, averaging):
    rng = np.random.default_rng(seed)
    found, label = crowd(rng)
    found = sure(rng, found)
    order = rng.permutation(label.size)
    columns = {name: getattr(found, name)[order] for name in NAMES}
    one = heard_of(found, label, averaging)
    two = heard_of(Detections(**columns), label[order], averaging)
    for name in COLUMNS:
        assert getattr(one.rows, name).tobytes() == getattr(two.rows, name).tobytes()
    assert one.clutter == two.clutter


@given(seed=SEEDS, averaging=AVERAGING)
@law
def test_the_deviation_of_a_mean_follows_from_parts_and_weights(seed, averaging):
    rng = np.random.default_rng(seed)
    found, label = crowd(rng)
    found = sure(rng, found)
    heard = heard_of(found, label, averaging)
    for i, (landmark, tone) in enumerate(zip(heard.rows.landmark, heard.rows.caller, strict=True)):
        rows = strongest(found, label, landmark, tone)
        weight = np.cos(found.angle[rows]) ** 2 if averaging == "weighted" else np.ones(len(rows))
        weight /= weight.sum()
        across = np.sqrt(np.sum(np.square(weight * found.bearing_std[rows])))
        floor = BEARING_FLOOR[min(tone, 1)]
        assert heard.rows.bearing_std[i] == pytest.approx(np.hypot(across, floor), rel=1e-12)
        along = 0.5 * 343.0 * np.sqrt(np.sum(np.square(weight * found.delay_std[rows])))
        along = np.hypot(along, RANGE_FLOOR) if tone == OWN else NAN
        assert heard.rows.range_std[i] == pytest.approx(along, nan_ok=True)


def test_a_mean_with_an_unknown_deviation_has_none():
    found = detections((0, 0, 44, 0.02, 9), (1, 0, -46, 0.02, 8), (0, 0, 10, 0.03, 9))
    found = replace(found, bearing_std=np.array([0.03, NAN, 0.02]), delay_std=np.full(3, 1e-6))
    heard = heard_of(found, [5, 5, 6])
    assert np.isnan(heard.rows.bearing_std).tolist() == [True, False]
    assert np.isfinite(heard.rows.range_std).all()


def test_directions_either_side_of_straight_back_average_straight_back():
    for spread in (0.1, 1e-6, 30.0):  # of the left face and the right one, looking back
        found = detections((1, 1, 90.0 - spread, 0.02, 9), (3, 1, spread - 90.0, 0.02, 8))
        for averaging in ("plain", "weighted"):
            (bearing,) = heard_of(found, [4, 4], averaging).rows.bearing
            assert -np.pi <= bearing < np.pi
            assert abs(wrap(bearing - np.pi)) < 1e-12


def test_unlabelled_detections_are_counted_and_change_nothing_else():
    found = detections((0, 0, 40, 0.02, 9), (1, 0, -50, 0.02, 7), (0, 0, 10, 0.02, 99))
    heard = heard_of(found, [3, 3, UNLABELLED])
    assert heard.clutter == 1
    assert heard.rows.landmark.tolist() == [3]
    assert heard.rows.bearing[0] == pytest.approx(np.radians(40.0), abs=1e-12)


def test_no_detections_give_empty_scans():
    nothing = np.zeros(0)
    found = Detections(
        face=nothing.astype(int), caller=nothing.astype(int), angle=nothing, bearing=nothing,
        delay=nothing, power=nothing,
    )  # fmt: skip
    heard = heard_of(found, nothing.astype(int))
    assert (heard.rows.landmark.size, heard.rows.bearing.size, heard.clutter) == (0, 0, 0)
    for strategy in ("active", "fused", "passive"):
        assert scan_of(heard.rows, strategy).landmark.size == 0


def test_weighting_makes_two_faces_as_precise_as_a_broadside_face():
    # A face's error goes with 1 / cos, the next one's with 1 / sin; their weighted mean's is 1.
    rng, count, error = np.random.default_rng(7), 4000, 1e-3
    for off in (16.0, 30.0, 45.0):
        spread = error / np.cos(np.radians([off, 90.0 - off]))
        noise = np.degrees(rng.standard_normal((count, 2)) * spread)
        rms = {}
        for averaging in ("plain", "weighted"):
            bearing = [
                heard_of(
                    detections((0, 0, off + one, 0.02, 2), (1, 0, off - 90.0 + two, 0.02, 1)),
                    [5, 5],
                    averaging,
                ).rows.bearing[0]
                for one, two in noise
            ]
            rms[averaging] = np.std(np.array(bearing) - np.radians(off)) / error
        sampling = 4.9 / np.sqrt(2.0 * count)
        assert rms["weighted"] == pytest.approx(1.0, rel=sampling)
        assert rms["plain"] == pytest.approx(0.5 * np.hypot(*spread) / error, rel=sampling)


NAN = np.nan


def heard_rows(*rows):
    """Return what was heard: rows (landmark, own bearing, beacon's bearing, range)."""
    parts = [
        (landmark, caller, bearing, NAN if caller else distance)
        for landmark, own, other, distance in rows
        for caller, bearing in enumerate((own, other))
        if not np.isnan(bearing)
    ]
    landmark, caller, bearing, distance = zip(*parts, strict=True)
    scan = scan_with(
        landmark, bearing, distance, time=2.0, caller=np.array(caller), bearing_std=NAN
    )
    return FrameMeasurements(rows=scan, clutter=0)


BOTH = heard_rows((1, 0.1, NAN, 3.0), (2, NAN, 0.2, NAN), (7, 3.1, -3.1, 9.0), (9, -0.4, 0.2, 5.0))


def test_active_takes_only_the_vehicles_tone():
    scan = scan_of(BOTH.rows, "active")
    assert (scan.time, scan.landmark.tolist()) == (2.0, [1, 7, 9])
    assert scan.bearing.tolist() == [0.1, 3.1, -0.4]
    assert scan.range.tolist() == [3.0, 9.0, 5.0]


def test_passive_takes_only_the_beacons_tone_without_ranges():
    scan = scan_of(BOTH.rows, "passive")
    assert scan.landmark.tolist() == [2, 7, 9]
    assert scan.bearing.tolist() == [0.2, -3.1, 0.2]
    assert np.isnan(scan.range).all()


def test_fused_takes_both_and_the_mean_direction_where_both_are_there():
    scan = scan_of(BOTH.rows, "fused")
    assert scan.landmark.tolist() == [1, 2, 7, 9]
    np.testing.assert_allclose(scan.bearing, [0.1, 0.2, -np.pi, -0.1], atol=1e-12)
    np.testing.assert_array_equal(scan.range, [3.0, NAN, 9.0, 5.0])


@given(seed=SEEDS, averaging=AVERAGING)
@law
def test_fused_is_the_union_of_active_and_passive(seed, averaging):
    found, label = crowd(np.random.default_rng(seed), labels=14)
    heard = heard_of(found, label, averaging)
    active, fused, passive = (scan_of(heard.rows, s) for s in ("active", "fused", "passive"))
    assert set(fused.landmark) == set(active.landmark) | set(passive.landmark)
    ranged = ~np.isnan(fused.range)
    assert fused.landmark[ranged].tolist() == active.landmark.tolist()
    assert fused.range[ranged].tolist() == active.range.tolist()
    for landmark, bearing in zip(fused.landmark, fused.bearing, strict=True):
        parts = np.concatenate([s.bearing[s.landmark == landmark] for s in (active, passive)])
        assert np.cos(bearing - circular_mean(parts)) == pytest.approx(1.0, abs=1e-12)
        assert -np.pi <= bearing < np.pi


@given(seed=SEEDS)
@law
def test_an_echo_is_of_one_call_at_one_time_from_one_side_and_once_on_a_face(seed):
    found, _ = crowd(np.random.default_rng(seed), count=60)
    number = same_echo(found, delay_gate=0.03, bearing_gate=0.8)
    assert set(number.tolist()) == set(range(number.max() + 1)), "every detection is of some echo"
    for echo in range(number.max() + 1):
        rows = np.flatnonzero(number == echo)
        loudest = rows[found.power[rows].argmax()]
        assert np.unique(found.caller[rows]).size == 1
        assert np.unique(found.face[rows]).size == rows.size
        assert np.all(np.abs(found.delay[rows] - found.delay[loudest]) <= 0.03)
        assert np.all(np.abs(wrap(found.bearing[rows] - found.bearing[loudest])) <= 0.8)


def test_detections_that_could_be_of_one_echo_are():
    found = detections((0, 0, 40, 0.0200, 9), (1, 0, -50, 0.0201, 7), (1, 1, -50, 0.0201, 8))
    assert same_echo(found, delay_gate=7e-4, bearing_gate=0.1).tolist() == [0, 0, 1]
    assert same_echo(found, delay_gate=5e-5, bearing_gate=0.1).tolist() == [0, 2, 1]


def test_hiding_labels_leaves_all_other_columns_unchanged():
    found, label = crowd(np.random.default_rng(3))
    heard = heard_of(found, label)
    hidden = without_labels(heard.rows, np.array([UNLABELLED, 4]))
    assert set(hidden.landmark.tolist()) == {UNLABELLED}
    for name in set(COLUMNS) - {"landmark"}:
        np.testing.assert_array_equal(getattr(hidden, name), getattr(heard.rows, name))
    fused = scan_of(hidden, "fused")
    assert fused.landmark.size == hidden.landmark.size, "nothing is merged without a label"


def test_rows_of_a_landmark_fuse_by_inverse_variance_if_all_are_known():
    rows = scan_with(
        [4, 4, 4], [3.1, -3.1, -3.0], [5.0, NAN, NAN], caller=np.arange(3),
        bearing_std=np.array([0.01, 0.02, 0.04]), range_std=0.3,
    )  # fmt: skip
    weight = np.array([16.0, 4.0, 1.0])
    fused = scan_of(rows, "fused")
    mean = wrap(3.1 + np.average(wrap(rows.bearing - 3.1), weights=weight))
    assert fused.bearing[0] == pytest.approx(mean, abs=1e-12)
    assert fused.bearing_std[0] == pytest.approx(0.04 / np.sqrt(21.0), rel=1e-12)
    assert fused.range_std.tolist() == [0.3]
    unsaid = with_columns(rows, bearing_std=np.array([0.01, NAN, 0.04]))
    plain = scan_of(unsaid, "fused")
    mean = wrap(3.1 + np.mean(wrap(rows.bearing - 3.1)))
    assert plain.bearing[0] == pytest.approx(mean, abs=1e-12)
    assert np.isnan(plain.bearing_std).all()


def test_three_callers_of_one_landmark_are_averaged_as_directions():
    rows = scan_with(
        [4, 4, 4], [3.1, -3.1, -3.0], [5.0, NAN, NAN], caller=np.arange(3), bearing_std=NAN
    )
    (bearing,) = scan_of(rows, "fused").bearing
    assert bearing == pytest.approx(wrap(3.1 + np.mean(wrap(rows.bearing - 3.1))), abs=1e-12)
    (bearing,) = scan_of(rows, "passive").bearing
    assert bearing == pytest.approx(-3.05, abs=1e-12)


@given(seed=SEEDS)
@law
def test_bearings_of_two_callers_fuse_to_their_midpoint_to_the_bit(seed):
    own, other = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, 9))
    both = heard_rows(*zip(range(9), own, other, np.ones(9), strict=True))
    halfway = wrap(own + 0.5 * wrap(other - own))
    assert scan_of(both.rows, "fused").bearing.tobytes() == halfway.tobytes()
