"""`pipistrelle config`: where a setting comes from, and what it means."""

import json
import tomllib
from math import degrees, pi, radians, sin
from pathlib import Path

import pytest
from scipy.special import j1

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config


@pytest.fixture
def settings(obey):
    """Resolve settings as every verb does."""

    def settings(*words):
        status, printed, said = obey("config", "show", *words)
        assert (status, said) == (0, "")
        return Config.model_validate(tomllib.loads(printed))

    return settings


def test_settings_as_shown_are_a_file_of_the_same_settings(settings, obey):
    config = settings("--rays.power", "3", "--scenario.start", "1", "-2", "0.5", "--seed", "9")
    assert config.rays.power == 3.0
    assert config.scenario.start == (1.0, -2.0, 0.5)
    Path("mission.toml").write_text(obey("config", "show", "--rays.power", "3")[1])
    assert settings("--config", "mission.toml") == settings("--rays.power", "3")


def test_the_short_names_of_a_mission_set_what_they_say(settings):
    config = settings(
        *("--beamwidth", "60", "--landmarks", "3", "--duration", "10", "--engine", "dense"),
        *("--scenario.step", "0.25", "--air.speed-of-sound", "340", "--particles", "30"),
    )
    width = beamwidth(
        config.emitter.radius, frequency=config.emitter.frequency, speed_of_sound=340.0
    )
    assert degrees(width) == pytest.approx(60, rel=1e-12)
    assert config.scenario.landmarks == 3
    assert config.scenario.steps == 40
    assert config.receiver.engine == "dense"
    assert config.fastslam.particles == 30


def test_the_beamwidth_asked_for_is_that_of_the_call_in_the_air_asked_for(settings):
    words = ("--emitter.frequency", "50000", "--air.speed-of-sound", "330")
    radius = settings("--beamwidth", "60", *words).emitter.radius
    ka = 2.0 * pi * 50e3 / 330.0 * radius
    pressure = 2.0 * j1(ka * sin(radians(30.0))) / (ka * sin(radians(30.0)))
    assert pressure**2 == pytest.approx(0.5, rel=1e-9)


def test_flags_go_over_the_environment_over_the_file(settings, monkeypatch):
    Path("mission.toml").write_text("seed = 2\n[rays]\npower = 2\nratio = 0.2\n")
    monkeypatch.setenv("PIPISTRELLE_SEED", "3")
    monkeypatch.setenv("PIPISTRELLE_RAYS__POWER", "3")
    monkeypatch.setenv("PIPISTRELLE_DATA", "/nowhere")
    config = settings("--config", "mission.toml", "--seed", "4")
    assert (config.seed, config.rays.power, config.rays.ratio) == (4, 3.0, 0.2)


def test_the_schema_says_what_every_setting_means(obey):
    schema = json.loads(obey("config", "schema")[1])
    sections = schema["$defs"].values()
    listed = 1  # those of a caller, of which there may be several
    assert len(sections) == sum(type(v) is dict for v in Config().model_dump().values()) + listed
    assert all("description" in field for s in sections for field in s["properties"].values())
