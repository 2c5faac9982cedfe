"""The page of settings: meaning, default, values and spellings of every setting."""

import re
import tomllib
from pathlib import Path

import pytest
from docs.settings_page import CALLER, PLACE, TABLES, entry, extent, flag, markdown, variable

from pipistrelle.config import CallerConfig, Config, InputError
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
    keys = CALLER.search((PAGE.parent / "callers.md").read_text())[0]
    assert re.findall(r"`(\w+)`", keys) == list(CallerConfig.model_fields)


ENTRY = re.compile(
    r"`(\w+)`\n: (.*?) (None by default|Default `[^`]*`[^;]*); (.+)\.\\\n  `(\S+)`, `(\S+)`"
)


def parts_of(key):
    """Return the parts of a setting's entry as they are, and as they should be."""
    name, meaning, default, takes, *spelled = ENTRY.fullmatch(
        entry(key).replace("\xa0", " ").strip()
    ).groups()
    field, words = known_settings()[key], flag(key).removeprefix("--").replace("-", "_").split(".")
    wanted = list(field.default) if isinstance(field.default, tuple) else field.default
    if wanted is None:
        takes = re.sub(r" (s|m|m/s|rad|rad/s)$", "", takes)  # the unit, else beside the default
        default = None if default == "None by default" else default
    else:
        default = tomllib.loads("it = " + default.split("`")[1])["it"]
    means = bool(re.search(r"\w{3}", meaning))  # not only a unit
    found = (name, means, default, takes, spelled, tuple(words))
    assert list(from_environment({variable(key): "1"})) == [key]
    return found, (key[-1], True, wanted, extent(field), [flag(key), variable(key)], key)


def test_an_entry_contains_meaning_default_values_flag_and_variable():
    assert [pair for pair in map(parts_of, VALUES) if pair[0] != pair[1]] == []


@pytest.mark.parametrize(
    ("key", "takes"),
    [
        (("seed",), "whole, ≥ 0"),
        (("scenario", "speed"), "−10000 to 10000"),
        (("scenario", "start"), "3 numbers"),
        (("scenario", "step"), "> 0"),
        (("scenario", "world"), "a folder"),
        (("listening", "excess_paths"), "`true` or `false`"),
        (("receiver", "elements"), "whole, 2 to 64"),
        (("detection", "false_alarm"), "≥ 1e-100, < 0.1"),
        (("filter", "initial_pose_std"), "3 numbers, each ≥ 0"),
    ],
)
def test_the_values_of_a_setting_are_listed_briefly(key, takes):
    assert extent(known_settings()[key]) == takes


def beyond(takes):
    """Yield values beyond the bounds of a setting of one number."""
    if "`" in takes or "numbers" in takes:
        return
    bounds = re.findall(r"([≥>≤<]) ([−\de.-]+)", takes)
    if between := re.search(r"([−\de.+-]+) to ([−\de.+-]+)", takes):
        bounds = [("≥", between[1]), ("≤", between[2])]
    for sign, bound in bounds:
        yield float(bound.replace("−", "-")) + (-1.0 if sign in "≥>" else 1.0)


def test_values_beyond_a_listed_bound_are_rejected():
    tried = [(key, value) for key in VALUES for value in beyond(extent(known_settings()[key]))]
    assert len(tried) > 100
    for key, value in tried:
        nested = {key[0]: {key[1]: value}} if len(key) == 2 else {key[0]: int(value)}
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
    assert resolve(from_environment({"PIPISTRELLE_RAYS__EXPONENT": "3"})).rays.exponent == 3.0
    assert resolve(from_flags({"rays": {"exponent": 3.0}})).rays.exponent == 3.0
    assert Config().rays.exponent == 2.0
