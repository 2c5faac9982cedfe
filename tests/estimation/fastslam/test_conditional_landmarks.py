"""Excess paths in the particle filter: the star of a caller against the joint Gaussian of all."""

import copy
import itertools
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import BEARING, EXCESS_PATH, EXCESS_PATH_STD, RANGE, with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.fastslam.block import LANES
from pipistrelle.estimation.measurement import excess_path_of
from pipistrelle.estimation.motion import Motion
from reference.missions import (
    BICYCLE,
    START,
    draw_mission,
    ray_config,
    scan_with,
    scattered,
    steady,
)
from reference.swarms import (
    Drawn,
    assert_same,
    assert_sound,
    drawing,
    followed,
    members,
    never_resampling,
    small_mission,
    swarm_filter,
)
from reference.timed_fastslam import SlowTimedFastSlam
from reference.timing import timed

CLOSE = {"rtol": 0, "atol": 1e-9}
KNOWN_POSE = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
CALLER, ECHO = 1, 2
PLACE, POINT = np.array([6.0, 0.0]), np.array([3.0, 4.0])


def slow_twin(slam, excess_path_std=0.2):
    """Return the slow reference with a filter's settings, started."""
    stds = slam.range_std, slam.bearing_std
    slow = SlowTimedFastSlam(
        slam.motion, *stds, slam.rays, slam.gate, slam.settings, excess_path_std=excess_path_std
    )
    return slow.start(START.mean, START.covariance)


def tie_of(belief, particle, label):
    """Return slopes of a landmark's place by its caller's, (2, 2)."""
    (block, lane), n = divmod(particle, LANES), belief.landmark.tolist().index(label)
    return belief.slope[block, n].reshape(4, LANES)[:, lane].reshape(2, 2)


def gaussian(member):
    """Mean and covariance of a row of `members`."""
    return member[:2], member[[2, 3, 3, 4]].reshape(2, 2)


def crossed(belief, particle, label):
    """Covariance of a landmark with its caller, both of one member; or None."""
    n = belief.landmark.tolist().index(label)
    if belief.parent[n] < 0:
        return None
    callers = members(belief, particle, belief.landmark[belief.parent[n]])
    if len(members(belief, particle, label)) > 1 or len(callers) > 1:
        return None
    return tie_of(belief, particle, label) @ gaussian(callers[0])[1]


def assert_same_particles(belief, particles):
    """Poses, weights, every member of every landmark, and what ties it to its caller."""
    np.testing.assert_allclose(belief.cloud(), [p.pose for p in particles], **CLOSE)
    log_weight = [p.log_weight for p in particles]
    np.testing.assert_allclose(belief.log_weight, log_weight, rtol=1e-9, atol=1e-9)
    for number, p in enumerate(particles):
        assert list(p.map) == belief.landmark.tolist()
        for label, expected in p.map.items():
            rows = [(*m.mean, *m.covariance[[0, 0, 1], [0, 1, 1]], m.weight) for m in expected]
            found = members(belief, number, label)
            assert len(found) == len(rows)
            np.testing.assert_allclose(found, rows, **CLOSE)
            shared = crossed(belief, number, label)
            if shared is not None:
                hub = belief.landmark[belief.parent[belief.landmark == label][0]]
                known = p.cross.get((label, hub), np.zeros((2, 2)))
                np.testing.assert_allclose(shared, known, **CLOSE)


def assert_equal_to_the_joint(slam, mission):
    """Every frame of filter and reference agrees, before resampling and after."""
    slow, belief = slow_twin(slam), slam.init(START)
    rng, other = np.random.default_rng(1), np.random.default_rng(1)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, _ = slam.predict(belief, controls, dt, rng)
        slow.predict(controls, dt)
        before = never_resampling(slam).update(belief, scan, copy.deepcopy(rng))
        belief = slam.update(belief, scan, rng)
        slow.update(scan, other)
        assert belief.gated == slow.gated
        assert_same_particles(before, slow.before)
        assert_same_particles(belief, slow.particles)
        np.testing.assert_allclose(belief.pose().mean, slow.estimated[0], **CLOSE)
        np.testing.assert_allclose(belief.pose().covariance, slow.estimated[1], **CLOSE)
    return belief, slow


def timed_mission(strategy, callers, frames, **changes):
    mission = small_mission(strategy, frames=frames, **changes)
    return timed(mission, callers, np.random.default_rng(9), std=0.2)


FEW = [
    ("fused", [2], "instantaneous", "federated", "marginal", 1.0),
    ("fused", [2, 14], "aggregated", "exact", "sampled", 0.95),
    ("passive", [2], "instantaneous", "exact", "marginal", 1.0),
]
EVERY = list(
    itertools.product(
        ("active", "fused", "passive"),
        ([2],),
        ("instantaneous", "aggregated"),
        ("federated", "exact"),
        ("marginal", "sampled"),
        (0.95, 1.0),
    )
)


def assert_equal_whole_run(frames, strategy, callers, shares, mixture, weights, gate):
    slam = swarm_filter(
        5, mixture, weights=weights, rays=ray_config(weights=shares, power=2.0), gate=gate
    )
    outliers = 0.0 if gate == 1.0 else 0.03
    mission = timed_mission(strategy, callers, frames, outliers=outliers, bearing_std=0.15)
    belief, slow = assert_equal_to_the_joint(slam, mission)
    assert slow.resampled > 1
    return belief


@pytest.mark.parametrize("frames", [40, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("strategy", "callers", "shares", "mixture", "weights", "gate"), FEW)
def test_a_star_of_ties_equals_the_joint_gaussian_of_all(
    strategy, callers, shares, mixture, weights, gate, frames
):
    belief = assert_equal_whole_run(frames, strategy, callers, shares, mixture, weights, gate)
    assert np.abs(belief.slope).max() > 0.1


def tied(particle, labels):
    """Covariance of some landmarks of a particle of the slow reference, (2n, 2n)."""
    return np.block([
        [
            particle.map[one][0].covariance
            if one == other
            else particle.cross.get((one, other), np.zeros((2, 2)))
            for other in labels
        ]
        for one in labels
    ])  # fmt: skip


def test_the_joint_gaussian_of_all_particles_has_what_a_callers_landmarks_have_in_common():
    slam = swarm_filter(5, "federated", rays=ray_config(power=2.0))
    belief, slow = assert_equal_to_the_joint(slam, timed_mission("fused", [2], 40))
    joint, particles = belief.joint(), slow.particles
    placed = [a for a in joint.landmark.tolist() if all(len(p.map[a]) == 1 for p in particles)]
    weight = np.exp([p.log_weight for p in particles])
    weight /= weight.sum()
    places = np.array([np.concatenate([p.map[a][0].mean for a in placed]) for p in particles])
    within = sum(w * tied(p, placed) for w, p in zip(weight, particles, strict=True))
    between = np.cov(places.T, aweights=weight, ddof=0)
    rows = [3 + 2 * joint.landmark.tolist().index(a) + e for a in placed for e in (0, 1)]
    np.testing.assert_allclose(joint.covariance[np.ix_(rows, rows)], within + between, atol=1e-9)
    apart = np.kron(np.eye(len(placed)), np.ones((2, 2))) == 0.0
    stds = np.sqrt(np.diag(within))
    assert np.abs(within / np.outer(stds, stds))[apart].max() > 0.2, "it is much"
    assert np.linalg.eigvalsh(joint.covariance)[0] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("strategy", "callers", "shares", "mixture", "weights", "gate"), EVERY)
def test_a_star_of_ties_equals_the_joint_gaussian_of_all_with_every_option(
    strategy, callers, shares, mixture, weights, gate
):
    assert_equal_whole_run(60, strategy, callers, shares, mixture, weights, gate)


# Where nothing is to be learnt from excess paths


def run(mission, slam=None):
    *_, (belief, _) = followed(slam or swarm_filter(), mission, drawing())
    return belief


def without(mission, **columns):
    """The mission with other excess paths."""
    scans = [with_columns(scan, **columns) for scan in mission.scans]
    return replace(mission, scans=scans)


@pytest.mark.parametrize("caller", [99, 1], ids=["not in the map", "never surely known"])
def test_excess_paths_of_a_caller_whose_place_is_not_known_change_nothing(caller):
    mission = timed_mission("passive", [1], 8)
    mission = replace(
        mission, scans=[replace(s, callers=np.array([-1, caller])) for s in mission.scans]
    )
    belief = run(mission)
    assert_same(belief, run(without(mission, excess_path=np.nan)))
    assert not belief.slope.any()


def test_excess_paths_of_whom_nobody_knows_change_nothing():
    mission = timed_mission("fused", [2], 20)
    unknown = replace(
        mission, scans=[replace(s, callers=np.array([-1, -1])) for s in mission.scans]
    )
    assert_same(run(unknown), run(without(mission, excess_path=np.nan)))


def doubled(scan):
    """Return the scan with a further excess path of each landmark, by an unknown caller."""
    numbers = scan.numbers.copy()
    numbers[[BEARING, RANGE]], numbers[EXCESS_PATH], numbers[EXCESS_PATH_STD] = np.nan, 7.0, 0.05
    return replace(
        scan,
        landmark=np.tile(scan.landmark, 2),
        caller=np.concatenate([scan.caller, np.full(scan.landmark.size, 2)]),
        numbers=np.concatenate([scan.numbers, numbers], axis=1),
        callers=np.array([-1, scan.callers[1], 77]),
    )


@pytest.mark.parametrize("gate", [0.95, 1.0])
def test_further_excess_paths_of_a_landmark_that_is_tied_already_are_let_go(gate):
    mission = timed_mission("fused", [2], 20, outliers=0.05)
    more = replace(mission, scans=[doubled(scan) for scan in mission.scans])
    slam = swarm_filter(gate=gate)
    belief = run(mission, slam)
    assert_same(run(more, slam), belief)
    assert belief.slope.any()
    assert (belief.gated > 0) == (gate < 1.0)


def test_labels_are_only_names_where_excess_paths_are_heard_too():
    mission = timed_mission("fused", [2], 20)
    renamed = [
        replace(s, landmark=1000 - s.landmark, callers=np.array([-1, 998])) for s in mission.scans
    ]
    belief, other = run(mission), run(replace(mission, scans=renamed))
    np.testing.assert_array_equal(other.landmark, 1000 - belief.landmark)
    np.testing.assert_array_equal(other.slope, belief.slope)
    np.testing.assert_array_equal(other.member[:, :, : 5 * LANES], belief.member[:, :, : 5 * LANES])


def test_whole_missions_with_excess_paths_leave_sound_particles():
    for strategy in ("fused", "passive"):
        belief = run(timed_mission(strategy, [2], 60))
        assert_sound(belief)
        assert np.isfinite(belief.slope).all()


# One landmark, one caller


def known(spread=0.04, particles=3, **changes):
    """A filter at rest at the origin, and its belief that the caller is at PLACE, so surely."""
    rest = Motion(model="unicycle", control_std=(0.1, 0.1), noise_at_rest=False)
    slam = never_resampling(swarm_filter(particles, motion=rest, **changes))
    belief = slam.init(KNOWN_POSE)
    direct = scan_with([CALLER], [0.0], [PLACE[0]])
    belief = slam.update(belief, direct, drawing())
    member = belief.member.copy()
    member[:, 0, 2 * LANES : 5 * LANES] = np.repeat([spread, 0.0, 2.0 * spread], LANES)
    member[:, 0, :LANES], member[:, 0, LANES : 2 * LANES] = PLACE[:, None]
    return slam, replace(belief, member=member)


def heard(bearing, excess_path, distance=np.nan):
    """An echo of the caller's call, over ECHO."""
    scan = scan_with(
        [ECHO], [bearing], [distance], excess_path=excess_path, excess_path_std=0.2, caller=1
    )
    return replace(scan, callers=np.array([-1, CALLER]))


def placed(bearing, excess_path, place=PLACE):
    """Where a first echo places a landmark, its own C and A; the caller being certainly there."""
    slam, belief = known(1e-9)
    member = belief.member.copy()
    member[:, 0, :LANES], member[:, 0, LANES : 2 * LANES] = place[0], place[1]
    belief = slam.update(replace(belief, member=member), heard(bearing, excess_path), drawing())
    rows = members(belief, 0, ECHO)
    assert len(rows) == 1
    A = tie_of(belief, 0, ECHO)
    return rows[0, :2], gaussian(rows[0])[1] - A @ np.diag([1e-9, 2e-9]) @ A.T, A


def slopes(f, x, step=1e-5):
    """Derivatives of f by central differences, (2, len(x))."""
    steps = step * np.eye(len(x))
    return np.column_stack([(f(x + s) - f(x - s)) / (2 * step) for s in steps])


def test_an_echo_places_its_landmark_where_ray_and_ellipse_cross_with_the_slopes_of_that_place():
    bearing, excess_path = np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE)
    place, C, A = placed(bearing, excess_path)
    np.testing.assert_allclose(place, POINT, atol=1e-12)
    by_both = slopes(lambda z: placed(*z)[0], np.array([bearing, excess_path]))
    by_caller = slopes(lambda b: placed(bearing, excess_path, b)[0], PLACE)
    np.testing.assert_allclose(A, by_caller, atol=1e-8)
    R = np.diag([0.15**2, 0.2**2])
    np.testing.assert_allclose(C, by_both @ R @ by_both.T, atol=1e-8)


ALONG = excess_path_of(np.zeros(2), np.array([3.0, 0.0]), PLACE)


@pytest.mark.parametrize(
    ("bearing", "excess_path"),
    [
        (0.0, ALONG),
        (0.0, 0.05),
        (0.3, -0.3),
        (0.3, 0.0),
        (0.02, 0.01),
        (3.0, 1e-9),
        (np.pi, 2e-12),
    ],
)
def test_where_an_excess_path_tells_no_range_a_landmark_enters_as_its_ray(bearing, excess_path):
    slam, belief = known()
    after = slam.update(belief, heard(bearing, excess_path), drawing())
    assert_sound(after)
    plain = slam.update(
        belief, with_columns(heard(bearing, excess_path), excess_path=np.nan), drawing()
    )
    np.testing.assert_array_equal(members(after, 0, ECHO), members(plain, 0, ECHO))
    assert len(members(after, 0, ECHO)) > 1


@pytest.mark.parametrize("point", [PLACE, np.zeros(2), 0.5 * PLACE, PLACE + 1e-5])
def test_a_landmark_at_its_caller_at_the_vehicle_or_between_them_takes_any_excess_path_unharmed(
    point,
):
    slam, belief = known()
    echo = heard(np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE))
    belief = slam.update(belief, echo, drawing())
    member = belief.member.copy()
    member[:, 1, :LANES], member[:, 1, LANES : 2 * LANES] = point[:, None]
    belief = replace(belief, member=member)
    for excess_path in (0.0, 0.3, 4.0):
        after = slam.update(belief, heard(0.1, excess_path), drawing())
        assert_sound(after)
        assert np.isfinite(after.slope).all()


def test_a_caller_that_is_hardly_known_places_nothing():
    echo = heard(np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE))
    for spread, alone in ((0.04, True), (0.6, False)):
        slam, belief = known(spread)
        belief = slam.update(belief, echo, drawing())
        assert (len(members(belief, 0, ECHO)) == 1) == alone


def test_excess_paths_correct_a_map_and_neither_weigh_a_particle_nor_move_it():
    slam, belief = known(particles=40)
    echo = heard(np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE))
    belief = slam.update(belief, echo, drawing())
    normal, uniform = drawing().standard_normal((40, 3)), np.full(40, 0.5)
    far = heard(np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE) + 0.4)
    told = slam.update(belief, far, Drawn(normal, uniform))
    plain = slam.update(belief, with_columns(far, excess_path=np.nan), Drawn(normal, uniform))
    np.testing.assert_array_equal(told.log_weight, plain.log_weight)
    np.testing.assert_array_equal(told.cloud(), plain.cloud())
    moved = members(told, 0, ECHO) - members(plain, 0, ECHO)
    assert np.linalg.norm(moved[0, :2]) > 0.1


@pytest.mark.parametrize(("off", "gated"), [(0.0, 0), (0.5, 0), (5.0, 1)])
def test_the_gate_drops_an_excess_path_that_no_particle_expected_and_keeps_its_bearing(off, gated):
    slam, belief = known(gate=0.99)
    bearing, excess_path = np.arctan2(*POINT[::-1]), excess_path_of(np.zeros(2), POINT, PLACE)
    belief = slam.update(belief, heard(bearing, excess_path), drawing())
    after = slam.update(belief, heard(bearing, excess_path + off), drawing())
    plain = slam.update(
        belief, with_columns(heard(bearing, excess_path + off), excess_path=np.nan), drawing()
    )
    assert after.gated == gated
    same = np.array_equal(after.member, plain.member) and np.array_equal(after.slope, plain.slope)
    assert same == bool(gated)


# Consistency given the path


def forgetful(belief):
    """The belief that takes every landmark for itself: its caller's error is drawn anew."""
    return replace(belief, slope=np.zeros_like(belief.slope))


def map_nees(seed, forget):
    """Mean NEES of all landmarks tied, after a path that is known, from a caller hardly known."""
    rng, sure = np.random.default_rng(seed), replace(BICYCLE, control_std=(1e-9, 1e-9))
    start = Gaussian(mean=START.mean, covariance=np.zeros((3, 3)))
    field = np.concatenate([[[4.0, 2.0]], scattered(rng, 10, radius=9.0)])
    noise = {"bearing_std": 0.02, "beamwidth": 0.0, "hearing": 30.0}
    mission = draw_mission(rng, sure, start, field, steady((0.75, 0.027), 40), **noise)
    mission = timed(mission, [1], rng)
    first = mission.scans[0]
    way = field[0] - mission.path[1, :2]
    distance = np.where(first.landmark == 1, np.hypot(*way) + rng.normal(0.0, 0.5), np.nan)
    mission.scans[0] = with_columns(first, range=distance, range_std=0.5)
    slam = replace(swarm_filter(LANES, motion=sure), range_std=0.5, bearing_std=0.02)
    belief = slam.init(start)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, _ = slam.predict(belief, controls, dt)
        belief = slam.update(belief, scan, rng)
        belief = forgetful(belief) if forget else belief
    rows = belief.landmarks()
    error = rows.mean - field[rows.landmark - 1]
    alone = np.bincount(rows.landmark, minlength=12)[rows.landmark] == 1
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows.covariance), error)
    return nees[alone].mean()


@pytest.mark.slow
def test_given_the_path_the_map_is_as_sure_as_it_is_right_and_without_ties_it_is_not():
    nees = np.array([map_nees(seed, forget=False) for seed in range(150)])
    assert abs(nees.mean() - 2.0) < 4.0 * nees.std() / np.sqrt(nees.size)
    wrong = np.array([map_nees(seed, forget=True) for seed in range(15)])
    assert wrong.mean() > 6.0
