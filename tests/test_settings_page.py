"""The page of settings: meaning, default, values and spellings of every setting."""

import re
import tomllib
from pathlib import Path

import pytest
from docs.settings_page import PLACE, TABLES, entry, extent, flag, markdown, variable

from pipistrelle.config import Config, InputError
from pipistrelle.settings import from_environment, from_flags, known_settings, resolve

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"
SETTINGS = list(known_settings())
VALUES = [key for key in SETTINGS if key not in TABLES]


def test_every_setting_is_listed_under_its_section():
    assert PAGE.read_text().count(PLACE) == 1
    sections = re.split(r"^## ", markdown(), flags=re.MULTILINE)[1:]
    named = {text.split("\n")[0]: re.findall(r"^`(\w+)`\n: ", text, re.M) for text in sections}
    wanted = {}
    for section, name in (key for key in SETTINGS if len(key) == 2):
        wanted.setdefault(section, []).append(name)
    assert named == wanted
    assert markdown().startswith("`seed`\n: ")


@pytest.mark.parametrize("key", VALUES, ids=".".join)
def test_an_entry_contains_meaning_default_values_flag_and_variable(key):
    name, text, spelled = entry(key).replace("\xa0", " ").strip().split("\n")
    assert name == f"`{key[-1]}`"
    assert spelled == f"  `{flag(key)}`, `{variable(key)}`"
    meaning, default, takes = re.fullmatch(
        r": (.*?) (None by default|Default `[^`]*`[^;]*); (.+)\.\\", text
    ).groups()
    field = known_settings()[key]
    if field.default is None:
        assert default == "None by default"
        takes = re.sub(r" (s|m|m/s|rad|rad/s)$", "", takes)  # the unit, else beside the default
    else:
        assert tomllib.loads("it = " + default.split("`")[1])["it"] == (
            list(field.default) if isinstance(field.default, tuple) else field.default
        )
    assert takes == extent(field)
    assert re.search(r"\w{3}", meaning), "the meaning is only a unit"
    assert list(from_environment({variable(key): "1"})) == [key]
    words = flag(key).removeprefix("--").replace("-", "_").split(".")
    assert tuple(words) == key


@pytest.mark.parametrize(
    ("key", "takes"),
    [
        (("seed",), "whole, ≥ 0"),
        (("scenario", "speed"), "−10000 to 10000"),
        (("scenario", "start"), "3 numbers"),
        (("scenario", "step"), "> 0"),
        (("air", "speed_of_sound"), "10 to 10000"),
        (("air", "temperature_c"), "> −50, < 60"),
        (("air", "spreading"), "`paper` or `bistatic`"),
        (("scenario", "world"), "a folder"),
        (("listening", "timing"), "`true` or `false`"),
        (("receiver", "elements"), "whole, 2 to 64"),
        (("detection", "peak_db"), "−300 to 0"),
        (("detection", "false_alarm"), "≥ 1e-100, < 0.1"),
        (("filter", "initial_pose_std"), "3 numbers, each ≥ 0"),
        (("rays", "range_bounds"), "2 numbers, each > 0"),
    ],
)
def test_the_values_of_a_setting_are_listed_briefly(key, takes):
    assert extent(known_settings()[key]) == takes


@pytest.mark.parametrize("key", VALUES, ids=".".join)
def test_values_beyond_a_listed_bound_are_rejected(key):
    takes = extent(known_settings()[key])
    if "`" in takes or "numbers" in takes:
        return
    bounds = re.findall(r"([≥>≤<]) ([−\de.-]+)", takes)
    if between := re.search(r"([−\de.+-]+) to ([−\de.+-]+)", takes):
        bounds = [("≥", between[1]), ("≤", between[2])]
    for sign, text in bounds:
        bound = float(text.replace("−", "-"))
        beyond = bound + (-1.0 if sign in "≥>" else 1.0)
        nested = {key[0]: {key[1]: beyond}} if len(key) == 2 else {key[0]: int(beyond)}
        with pytest.raises(InputError, match=re.escape(flag(key))):
            resolve(from_flags(nested))


def test_a_single_unit_follows_the_default():
    assert entry(("scenario", "beacon_distance")).startswith(
        "`beacon_distance`\n: Distance of the beacon from the centre, and of callers without a "
        "position. Default `15.0` m; >\xa00.\\\n"
    )
    assert 'Default `"paper"`; `paper` or `bistatic`.' in entry(("air", "spreading"))
    assert (
        "x, y [m], heading [rad]. Default `[0.05, 0.05, 0.0436]`; 3 numbers, each ≥\xa00."
        in entry(("filter", "initial_pose_std"))
    )


def test_the_spellings_at_the_top_of_the_page_work():
    assert resolve(from_environment({"PIPISTRELLE_RAYS__POWER": "3"})).rays.power == 3.0
    assert resolve(from_flags({"rays": {"power": 3.0}})).rays.power == 3.0
    assert Config().rays.power == 2.0
