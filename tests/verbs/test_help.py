"""`--help` lists verbs and common options, `--help-all` all settings with their defaults."""

import re
import subprocess
import sys
from ast import literal_eval
from contextlib import redirect_stdout
from functools import cache
from inspect import signature
from io import StringIO
from math import degrees

import pytest

import pipistrelle
from pipistrelle.__main__ import main
from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import PARAMETERS, BagConfig, Config, FastSlamConfig, RayConfig
from pipistrelle.settings import known_settings

HEAVY = {"numpy", "pydantic", "numba", "matplotlib"}
VERBS = ["run", "slam", "hear", "look", "study", "view", "report", "compare", "array"]


@pytest.fixture(scope="module")
def printed():
    """Return what a command line prints, all sections in one line; each is obeyed once."""

    @cache
    def printed(*words):
        text = StringIO()
        with redirect_stdout(text), pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["pipistrelle"])
            assert main(words) == 0
        return text.getvalue()

    return printed


def flowing(text):
    """Return a help text as one line without frames."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


def test_help_loads_no_kernels_and_the_list_of_verbs_no_arrays():
    code = (
        "import sys; from pipistrelle.__main__ import main; loaded = []\n"
        f"for words in ['--help'], ['--version'], *([v, '--help'] for v in {VERBS}):\n"
        f"    main(words); loaded.append((words[0], *sorted({HEAVY} & set(sys.modules))))\n"
        "print(); print(loaded)"
    )
    called = [sys.executable, "-c", code]
    said = subprocess.run(called, capture_output=True, text=True, check=True).stdout
    loaded = literal_eval(said.splitlines()[-1])
    assert loaded[:2] == [("--help",), ("--version",)]
    assert [words[0] for words in loaded[2:]] == VERBS
    assert not any("numba" in words for words in loaded)


def test_help_names_the_verbs(printed):
    verbs = re.findall(r"^│ (\w+) ", printed("--help"), re.M)
    assert verbs == sorted([*VERBS, "config", "doctor"])
    assert printed() == printed("--help")


@pytest.mark.parametrize("verb", [("run",), ("config", "show"), ("study",)])
def test_help_all_lists_every_setting_with_its_default(printed, verb):
    text = printed(*verb, "--help-all")
    known = known_settings()
    flags = {"--" + ".".join(key).replace("_", "-") for key in known}
    assert flags <= set(re.findall(r"--[a-z0-9.-]+", text))
    settled = [key for key, field in known.items() if field.default not in (None, ())]
    assert text.count("[default:") >= len(settled)


@pytest.mark.parametrize("verb", VERBS)
def test_help_lists_at_most_twenty_two_options_without_empty_defaults(printed, verb):
    text = printed(verb, "--help")
    flags = re.findall(r"^│ (--[a-z-]+)", text, re.M)
    assert 0 < len(flags) <= 22
    assert not re.search(r"--empty-|default: (none|no|False|\(\))\]", text)
    assert "--rays.exponent" not in text.partition("╯\n\n")[0]


@pytest.mark.parametrize("verb", ["run", "slam", "hear"])
def test_parameters_of_python_are_options_with_the_same_words(printed, verb):
    function = getattr(pipistrelle, verb)
    words = flowing(printed(verb, "--help"))
    named = {"strategies": "strategy", "filters": "filter", "config": "settings"}
    for name in set(signature(function).parameters) - {"progress", "settings", "log", "recording"}:
        assert f"--{named.get(name, name).replace('_', '-')} " in words
    text = "Half-power beamwidth" if verb == "run" else "A:B is from number A, counted from 0"
    assert verb == "slam" or (text in words and text in " ".join(function.__doc__.split()))


def test_help_all_of_slam_omits_settings_that_a_log_decides(printed):
    found = set(re.findall(r"--[a-z]+\.[a-z-]+", printed("slam", "--help-all")))
    rays = {name.replace("_", "-") for name in RayConfig.model_fields} - {"range-bounds"}
    swarm = (name.replace("_", "-") for name in FastSlamConfig.model_fields)
    assert found == {
        "--listening.excess-paths",
        *(f"--association.{name}" for name in ("method", "detection-rate", "clutter-rate")),
        *(f"--association.max-{name}-std" for name in ("angle", "range")),
        *(f"--filter.{name}" for name in ("noise", "excess-path-std", "robust")),
        *(f"--filter.{name}" for name in ("calibrate", "window")),
        *(f"--prior.{name.replace('_', '-')}-std" for name in PARAMETERS),
        *(f"--filter.caller-{name}-std" for name in ("speed", "walk")),
        *(f"--rays.{name}" for name in rays),
        *(f"--fastslam.{name}" for name in swarm),
        *(f"--bag.{name.replace('_', '-')}" for name in BagConfig.model_fields),
    }


def test_defaults_in_the_help_equal_the_defaults_of_the_settings(printed):
    words = flowing(printed("run", "--help"))
    told = dict(re.findall(r"--([a-z]+) [A-Z]+ (?:(?! --).)*?\[default: ([^]]+)\]", words))
    config = Config()
    width = beamwidth(
        config.emitter.radius,
        frequency=config.emitter.frequency,
        speed_of_sound=config.air.sound_speed,
    )
    assert told["beamwidth"] == f"{degrees(width):.1f}"
    assert told["landmarks"] == str(config.scenario.landmarks)
    assert told["duration"] == f"{config.scenario.steps * config.scenario.step:g}"
    assert told["particles"] == str(config.fastslam.particles)


@pytest.mark.parametrize(
    ("verb", "default"), [("run", "of best the smoother"), ("slam", "else smoother")]
)
def test_the_help_lists_the_filters_and_their_default(printed, verb, default):
    words = flowing(printed(verb, "--help"))
    choices = "[choices: ekf, fastslam, iekf, smoother, both, all]"
    assert f"{choices} [default: that of the settings, {default}]" in words
    assert "--filter --estimator CHOICE Estimators, separated by commas" in words
    assert "sets fastslam.particles" in words
