"""The page as a file: its numbers, nothing outside it, harmless whatever a mission is called."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.figures.player.page import SCRIPTS, page
from pipistrelle.figures.player.playback import Rows, playback

BAD = "</script><script>alert('a')</script>\"'&"


def numbers(text):
    found = re.search(r'<script type="application/json" id="numbers">(.*?)</script>', text, re.S)
    return json.loads(found[1])


def unpacked(packed):
    ((name, text),) = packed.items()
    return np.frombuffer(base64.b64decode(text), {"float32": "<f4", "int32": "<i4"}[name])


def test_the_numbers_are_the_missions(played):
    held = numbers(page(played))
    np.testing.assert_array_equal(unpacked(held["time"]), played.time.astype("f4"))
    np.testing.assert_array_equal(unpacked(held["truePose"]), played.true_pose.astype("f4").ravel())
    assert held["limits"] == [list(pair) for pair in played.limits]
    assert [one["name"] for one in held["estimates"][:2]] == [
        "active · EKF",
        "active · FastSLAM 2.0",
    ]
    assert [one["calls"] for one in held["estimates"]] == [True, True, True, True, False, False]
    for one, estimate in zip(held["estimates"], played.estimates, strict=True):
        assert one["role"] == estimate.strategy
        rows = one["mapped"]
        np.testing.assert_array_equal(unpacked(rows["first"]), estimate.mapped.first)
        np.testing.assert_array_equal(unpacked(rows["landmark"]), estimate.mapped.landmark)
        shape = (-1, rows["columns"])
        same = estimate.mapped.numbers.astype("f4")
        np.testing.assert_array_equal(unpacked(rows["numbers"]).reshape(shape), same)
    assert held["scales"]["placed"] == pytest.approx(np.sqrt(-2.0 * np.log(0.05)))
    assert held["farthest"] == 20.0


def test_a_page_speaks_of_excess_paths_only_where_some_were_heard(played, timed):
    silent, told = page(played), page(playback(*timed))
    for word in (
        'ellipses" type',
        "An ellipse of an excess path",
        "E hides the ellipses of excess paths",
    ):
        assert word not in silent
        assert word in told
    for one in numbers(silent)["estimates"]:
        assert not {"callers", "excessPaths", "resolved"} & one.keys(), "no number more than before"
    active, fused = numbers(told)["estimates"]
    assert "callers" in active
    assert {"callers", "excessPaths", "resolved"} <= fused.keys()
    assert "excessPaths" not in active


def test_the_same_mission_gives_the_same_bytes(played):
    assert page(played) == page(played)


def test_nothing_in_it_is_anywhere_else(played):
    text = page(played)
    assert re.findall(r"https?://[^\s\"'<]+", text) == ["http://www.w3.org/2000/svg"]
    assert not re.search(r"(?:src|href)=(?!\"data:)", text)
    assert "url(" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text


def test_whatever_a_mission_is_called_is_text(played):
    label, _, place = played.callers[0]
    named = replace(
        played,
        title=BAD,
        facts=(BAD,),
        callers=((label, BAD, place),),
        estimates=(replace(played.estimates[0], outcome=f"failed: {BAD}"),),
    )
    text = page(named)
    assert "alert('a')" not in text.replace(numbers_text(text), "")
    assert text.count("<script") == 2
    held = numbers(text)
    assert held["callers"][0]["name"] == BAD
    assert held["estimates"][0]["outcome"] == f"failed: {BAD}"


def numbers_text(text):
    return re.search(r'id="numbers">(.*?)</script>', text, re.S)[1]


def test_numbers_that_are_none_do_not_break_it(played):
    estimate = played.estimates[1]
    wild = np.full(estimate.mapped.numbers.shape, 1e300)
    lost = replace(
        estimate,
        pose=np.full_like(estimate.pose, np.nan),
        mapped=Rows(first=estimate.mapped.first, landmark=estimate.mapped.landmark, numbers=wild),
    )
    held = numbers(page(replace(played, estimates=(lost,))))["estimates"][0]
    assert np.isnan(unpacked(held["pose"])).all()
    assert np.isinf(unpacked(held["mapped"]["numbers"])).all()


def test_a_strategy_without_a_colour_of_its_own_is_drawn_in_ink(played):
    strange = replace(played.estimates[0], strategy="someone's own")
    assert numbers(page(replace(played, estimates=(strange,))))["estimates"][0]["role"] == "ink"


def test_every_script_is_in_it(played):
    from importlib.resources import files

    text, here = page(played), files("pipistrelle.figures.player")
    assert {path.name for path in here.iterdir() if path.name.endswith(".js")} == set(SCRIPTS)
    assert all((here / name).read_text(encoding="utf-8") in text for name in SCRIPTS)
