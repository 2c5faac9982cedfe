"""What folders have in common."""

from pipistrelle.experiments.comparing.matching import (
    alike,
    differing,
    matched,
    named,
    section,
    worded,
)

THREE = [("active", "ekf"), ("fused", "ekf"), ("passive", "ekf")]
BOTH = [("fused", "ekf"), ("fused", "fastslam")]


def test_what_tells_nothing_apart_within_any_folder_is_no_part_of_a_name():
    assert alike([THREE, THREE]) == (True, False)
    assert alike([THREE, [("fused", "smoother")]]) == (True, False)
    assert alike([BOTH, [("fused", "ekf")]]) == (False, True)
    assert alike([BOTH, THREE]) == (True, True)
    assert alike([[("active", "ekf")], [("fused", "smoother")]]) == (False, False)


def test_a_name_leaves_out_what_tells_nothing_apart():
    assert named(("fused", "ekf")) == ("fused", "ekf")
    assert named(("fused", "ekf"), (False, True)) == ("", "ekf")
    assert named(("fused", "ekf"), (False, False)) == ("", "")


def test_a_title_says_what_estimates_have_in_common():
    assert worded([("fused", "ekf"), ("fused", "ekf")]) == "fused ekf"
    assert worded([("active", "mine:Own"), ("fused", "mine:Own")]) == "Own"
    assert worded([("active", "ekf"), ("fused", "iekf")]) == ""


def test_names_of_all_come_in_the_order_of_the_first_and_others_with_their_owners():
    common, alone = matched([["c", "a", "b"], ["a", "d", "c"], ["c", "a"]])
    assert common == ("c", "a")
    assert alone == {"b": (0,), "d": (1,)}
    assert matched([["a"], ["b"]]) == ((), {"a": (0,), "b": (1,)})


def test_settings_differ_where_a_value_does_or_is_not_there():
    told = differing([{"a": 1, "b": [1, 2], "c": 0}, {"a": 1, "b": [2, 1], "d": False}])
    assert told == {"b": ([1, 2], [2, 1]), "c": (0, None), "d": (None, False)}
    assert differing([{"a": 1}, {"a": 1.0}]) == {}


def test_a_section_is_what_stands_before_the_first_dot():
    assert [section(name) for name in ("a.b.c", "seed")] == ["a", "seed"]
